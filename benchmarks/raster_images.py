"""Pictures of what the rasteriser draws, to look at: all images, and the differences that numbers cannot place.

    python benchmarks/raster_images.py [--device cuda:0] [--out out] [--size 320 240] [--splat person.ply ...]

Writes, for the figure of ``raster_scenes.py`` and for splat files (by default the biker in ``$BEAM_DATA``, if there),

- NAME_images.png: captured colour, both depths, normals of the geometry, and normals of the depth images,
- NAME_differences.png: the fast composite against the readable one, and plane against exact depth in a grazing view,

each below 300 KB. Differences are stretched; titles say what white stands for.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray
from PIL import Image as PillowImage
from raster_contenders import Drawing, Seen
from raster_scenes import RasterScene, figure

from beam_warp import converters
from beam_warp.device.arrays import resolve_device
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.files import display_image
from beam_warp.image.panels import Panel, lay_out, over_background
from beam_warp.raster.depth_normals import DepthNormals
from beam_warp.raster.records import DepthMode, RasterOptions
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera

LARGEST_FILE = 300_000
COLUMNS = 3


class View(NamedTuple):
    """Images of one way of drawing, ``(H, W)`` or ``(H, W, 3)``; normals of directions, colour for a display."""

    color: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32]
    surface_normals: NDArray[np.float32]
    depth_normals: NDArray[np.float32]
    median_depth_normals: NDArray[np.float32]
    sums: Seen


def draw(scene: RasterScene, device: Any, *, depth: DepthMode = "plane", readable: bool = False) -> View:
    """Draw the captured colour, and what geometry says."""
    cloud, camera = scene.cloud, scene.camera
    drawing = Drawing(
        scene,
        device,
        values=np.zeros((len(cloud), 0), np.float32),
        radiance=cloud.radiance,
        normals=True,
        options=RasterOptions(depth=depth),
        readable=readable,
    )
    seen = drawing.seen()
    shape = (camera.height, camera.width)
    alpha = seen.alpha.reshape(shape)
    sums = seen.channels.reshape(*shape, -1)
    color = np.divide(sums[..., :3], alpha[..., None], out=np.zeros_like(sums[..., :3]), where=alpha[..., None] > 0.0)
    if cloud.radiance_color_space != DISPLAY_SRGB:
        color = display_image(color) / np.float32(255.0)
    length = np.linalg.norm(sums[..., 3:6], axis=-1, keepdims=True)
    normals = np.divide(sums[..., 3:6], length, out=np.zeros_like(sums[..., 3:6]), where=length > 0.0)
    depths = [image.reshape(shape) for image in (seen.depth, seen.median_depth)]
    return View(
        np.clip(color, 0.0, 1.0),
        alpha,
        *depths,
        normals,
        *(normals_of_depth(image, alpha, camera, device) for image in depths),
        seen,
    )


def normals_of_depth(
    depth: NDArray[np.float32], alpha: NDArray[np.float32], camera: Camera, device: Any
) -> NDArray[np.float32]:
    """Return the normals of a depth image, ``(H, W, 3)``, 0 where there is none."""
    found = wp.zeros((*depth.shape, 3), dtype=float, device=device)
    DepthNormals(camera, device=device).write(depth, alpha, found)
    return found.numpy()


def image_panels(view: View) -> Iterator[Panel]:
    """Yield one panel an image."""
    opaque = view.alpha > 0.5
    near, far = np.quantile(view.depth[opaque], (0.01, 0.99)) if opaque.any() else (0.0, 1.0)
    yield "captured colour", over_background(view.color, view.alpha[..., None])
    for title, image in (("mean depth", view.depth), ("median depth", view.median_depth)):
        nearness = 1.0 - 0.9 * np.clip((image - near) / max(far - near, 1e-6), 0.0, 1.0)
        yield f"{title} (white {near:.2f} m, black {far:.2f} m)", over_background(gray(nearness), view.alpha[..., None])
    yield "normals of the Gaussians (x, y, z as r, g, b)", over_background(*shaded(view.surface_normals, view.alpha))
    yield "normals of the mean depth", over_background(*shaded(view.depth_normals, view.alpha))
    yield "normals of the median depth", over_background(*shaded(view.median_depth_normals, view.alpha))


def difference_panels(scene: RasterScene, grazing: RasterScene, device: Any) -> Iterator[Panel]:
    """Yield what the fast composite changes, and what the exact depth does."""
    fast, readable = draw(scene, device), draw(scene, device, readable=True)
    yield stretched(
        "fast - readable, channels", np.abs(fast.sums.channels - readable.sums.channels).max(axis=1), scene, ""
    )
    yield stretched("fast - readable, mean depth", fast.sums.depth - readable.sums.depth, scene, " m")
    yield stretched("fast - readable, median", fast.sums.median_depth - readable.sums.median_depth, scene, " m")
    plane, exact = draw(grazing, device), draw(grazing, device, depth="exact")
    yield "grazing view", over_background(plane.color, plane.alpha[..., None])
    opaque = (plane.alpha > 0.5).reshape(-1)
    yield stretched("exact - plane, mean depth", (exact.sums.depth - plane.sums.depth) * opaque, grazing, " m")
    yield stretched(
        "exact - plane, median", (exact.sums.median_depth - plane.sums.median_depth) * opaque, grazing, " m"
    )
    for name, view in (("plane", plane), ("exact", exact)):
        yield f"{name}: normals of the mean depth", over_background(*shaded(view.depth_normals, view.alpha))
    yield "normals of the Gaussians", over_background(*shaded(plane.surface_normals, plane.alpha))


def stretched(title: str, gap: NDArray[np.floating], scene: RasterScene, unit: str) -> Panel:
    """Return absolute differences in grey, white at their 99.9 % but at least 1e-6."""
    gap = np.abs(gap).reshape(scene.camera.height, scene.camera.width)
    white = max(float(np.quantile(gap, 0.999)), 1e-6)
    shades = over_background(gray(np.clip(gap / white, 0.0, 1.0)), np.ones((*gap.shape, 1), np.float32))
    return f"{title} (white {white:.1g}{unit}, largest {gap.max():.1g}{unit})", shades


def gray(shades: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return shades as colours."""
    return np.repeat(shades[..., None], 3, axis=-1).astype(np.float32)


def shaded(normals: NDArray[np.float32], alpha: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return normals as colours, and coverage, none where there is no normal."""
    there = (normals != 0.0).any(axis=-1)
    return 0.5 * normals + 0.5, (alpha * there)[..., None]


def splat_scene(path: Path, width: int, height: int) -> RasterScene:
    """Read the first frame of a splat file, and look at it from its side."""
    cloud = change_axes(converters.read(path)[0], "rfu")
    camera = Camera.frame_cloud(
        cloud.positions, cloud.opacities, azimuth=35.0, elevation=5.0, width=width, height=height
    )
    return RasterScene(path.stem.partition(".")[0], cloud, camera)


def grazing_scene(scene: RasterScene) -> RasterScene:
    """Return the scene from close above its top, along its surface."""
    points = scene.cloud.positions
    low, high = np.quantile(points, (0.02, 0.98), axis=0)
    middle, size = 0.5 * (low + high), float((high - low).max())
    top = np.array([middle[0], middle[1], high[2]])
    camera = Camera.orbit(
        top, 0.6 * size, 20.0, 8.0, width=scene.camera.width, height=scene.camera.height, vertical_fov=30.0
    )
    return scene._replace(camera=camera)


def write_sheet(panels: Iterator[Panel], path: Path) -> None:
    """Write panels as a PNG, with as many colours as `LARGEST_FILE` allows."""
    sheet = PillowImage.fromarray(lay_out(list(panels), COLUMNS))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path, optimize=True)
    for colors in (256, 128, 64, 32):
        if path.stat().st_size <= LARGEST_FILE:
            return
        sheet.quantize(colors).save(path, optimize=True)


def found_splats() -> list[Path]:
    """Return the biker of the data folder, where there is one."""
    folder = Path(os.environ.get("BEAM_DATA", Path(__file__).parent.parent.parent / "shared" / "data"))
    path = folder / "splats" / "biker.compressed.ply"
    return [path] if path.is_file() else []


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--count", type=int, default=40_000, help="Gaussians of the figure")
    parser.add_argument("--splat", type=Path, nargs="*", default=found_splats(), help="splat files")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    scenes = [figure(arguments.count, *arguments.size)]
    scenes += [splat_scene(path, *arguments.size) for path in arguments.splat]
    for scene in scenes:
        if scene.cloud.radiance is None:
            print(f"{scene.name} has no captured colour and is left out", file=sys.stderr)
            continue
        write_sheet(image_panels(draw(scene, device)), arguments.out / f"{scene.name}_images.png")
        write_sheet(
            difference_panels(scene, grazing_scene(scene), device), arguments.out / f"{scene.name}_differences.png"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
