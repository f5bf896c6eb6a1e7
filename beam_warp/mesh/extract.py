"""The surface of a Gaussian cloud: its depth drawn from several cameras, checked, and fused into a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from beam_warp.checks import require_choice, require_count
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.mesh.consistency import depth_consistency
from beam_warp.mesh.depths import DepthImages, DepthView
from beam_warp.mesh.fusion import SMALLEST_PART, fuse_depths
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.sources import upload_gaussians
from beam_warp.world.camera import Camera
from beam_warp.world.framing import bulk
from beam_warp.world.gaussians import GaussianCloud

if TYPE_CHECKING:
    import trimesh

DEPTHS = ("median", "mean")
COLORS = ("none", "base_color", "radiance")

Depth = Literal["median", "mean"]
Color = Literal["none", "base_color", "radiance"]

RINGS = (-45.0, 0.0, 45.0)
"""Elevations of the rings of cameras around a subject [degree]; one more looks down, and one up."""

RING_CAMERAS = 10
"""Cameras of a ring: neighbours are 36 degrees apart, so that most points are seen by six within 60 degrees."""


def mesh_of_gaussians(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    *,
    voxel: float | None = None,
    depth: Depth = "median",
    color: Color = "none",
    confirmations: int = 1,
    smallest_part: float = SMALLEST_PART,
    options: RasterOptions | None = None,
    device: Any = None,
) -> trimesh.Trimesh:
    """Return the surface that cameras see of a cloud.

    Args:
        cloud: Gaussians, in the world's axes.
        cameras: Cameras that draw its depth; the surface stays open where none of them sees it.
        voxel: Edge of a voxel [m]; None takes the median width of a pixel at the surface (see `fuse_depths`).
        depth: ``"median"`` of a pixel's splats, which stays on one surface at edges, or the ``"mean"``.
        color: What vertices carry, as display sRGB: nothing, base colour, or the captured colour as the cameras see it.
        confirmations: Pixels that fewer other views confirm, or that more contradict, are left out (see
            `depth_consistency`); with one camera, none is left out.
        smallest_part: See `fuse_depths`.
        options: How splats are drawn.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Returns:
        See `fuse_depths`; ``metadata["consistency"]`` holds the summary of the check.

    Raises:
        InvalidArrayError: Nothing is seen, no two views agree, or the cloud lacks the colour that was asked for.
        InvalidOptionError: An option is out of range, or ``voxel`` needs too much memory.
    """
    require_count("confirmations", confirmations, 0)
    images = draw_depths(cloud, cameras, depth=depth, color=color, options=options, device=device)
    consistency = depth_consistency(images)
    if len(cameras) > 1:
        images.keep(consistency.mask(confirmations))
    mesh = fuse_depths(images, voxel=voxel, smallest_part=smallest_part)
    mesh.metadata["consistency"] = consistency.as_dict()
    return mesh


def draw_depths(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    *,
    depth: Depth = "median",
    color: Color = "none",
    options: RasterOptions | None = None,
    device: Any = None,
) -> DepthImages:
    """Draw a cloud's depth and normals for one camera after the other, as input of fusion.

    Raises:
        InvalidArrayError: The cloud lacks the colour that was asked for.
        InvalidOptionError: An option is not one of its choices, or there is no camera.
    """
    require_choice("depth", depth, DEPTHS)
    require_choice("color", color, COLORS)
    if color != "none" and getattr(cloud, color) is None:
        raise InvalidArrayError(f"cloud must have {color}, got none. Choose another color, or 'none'.")
    space = {"none": None, "base_color": LINEAR_REC709, "radiance": cloud.radiance_color_space}[color]
    target = resolve_device(device)
    images = DepthImages(cameras, color_space=space, device=target)
    gaussians = upload_gaussians(
        cloud,
        target,
        values=cloud.base_color if color == "base_color" else None,
        radiance=cloud.radiance if color == "radiance" else None,
    )
    rasterizer: Rasterizer | None = None
    for index, camera in enumerate(cameras):
        last = rasterizer.cameras[0] if rasterizer is not None else None
        if rasterizer is not None and last is not None and (last.width, last.height) == (camera.width, camera.height):
            rasterizer.set_cameras([camera])
        else:
            rasterizer = Rasterizer(
                len(cloud),
                [camera],
                value_count=3 if color == "base_color" else 0,
                radiance=color == "radiance",
                normals=True,
                options=options,
                device=target,
            )
        drawn = rasterizer.draw(gaussians)
        rows = drawn.channels[0]
        colors = rasterizer.color_channels or rasterizer.value_channels
        view = DepthView(
            camera=camera,
            depth=drawn.median_depth if depth == "median" else drawn.depth,
            alpha=drawn.alpha,
            normals=rows[:, rasterizer.normal_channels.start :],
            color=rows[:, colors.start :] if colors else None,
        )
        images.write(index, view)
    return images


def surrounding_cameras(cloud: GaussianCloud, *, side: int = 512) -> tuple[Camera, ...]:
    """Return cameras all around a cloud, each as near as it fits into the image.

    Rings of `RING_CAMERAS` at the elevations `RINGS`, turned against one another, and one each from above and below.

    Args:
        cloud: Gaussians, in the world's axes, at least one; strays do not count (see `bulk`).
        side: Width and height of the images [pixel].

    Raises:
        InvalidArrayError: The cloud is empty.
    """
    points = bulk(cloud.positions, cloud.opacities)
    places = [
        (360.0 * (i + row / len(RINGS)) / RING_CAMERAS, elevation)
        for row, elevation in enumerate(RINGS)
        for i in range(RING_CAMERAS)
    ]
    return tuple(
        Camera.frame_points(points, azimuth=azimuth, elevation=elevation, width=side, height=side)
        for azimuth, elevation in (*places, (0.0, 90.0), (0.0, -90.0))
    )
