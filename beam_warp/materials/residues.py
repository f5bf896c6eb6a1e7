"""Surface points that a camera's pixels show, and the light that they reflect to it.

The light part of the paper's Gaussian sampler (BEAM §3.2, Eqs. 4 to 7), for one view at a time, on the pixels that show
a surface and no others. The paper states sample counts, not densities. Here rays are drawn by multiple importance, half
of them by the environment, a quarter by the cosine and a quarter by the visible normals of the GGX lobe, joined by the
balance heuristic; all samples are independent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import warp as wp

from beam_warp.checks import require_choice, require_count, require_number
from beam_warp.device.arrays import upload
from beam_warp.kernels.materials.image_residues import (
    Residues,
    ResidueSamples,
    launch_draw_residue_rays,
    launch_reduce_residues,
)
from beam_warp.kernels.materials.pixel_surfaces import (
    PixelSurfaces,
    SurfaceImages,
    launch_gather_surfaces,
    launch_mark_surfaces,
    launch_scatter,
)
from beam_warp.light.ggx import specular_albedo_table
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.light_rays import DIFFUSE_WEIGHTS, DiffuseWeight
from beam_warp.raster.layout import ViewLayout
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, RasterOptions
from beam_warp.trace.rays import ray_batches, room_for_rays
from beam_warp.trace.sampling import sample_set
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import EXACT, trace_rays
from beam_warp.world.camera import Camera

SurfaceDepth = Literal["median", "mean"]

SURFACE_DEPTHS = ("median", "mean")
"""Depths at which a pixel's ray may meet the surface: the median, which jumps at silhouettes, or the mean, which lies
between front and back there."""

LEAST_ALPHA = 0.5
"""Coverage from which a pixel shows a surface."""

FEWEST_LIGHT_SAMPLES = 4
"""One for each density, and two for the environment."""


@dataclass(frozen=True, eq=False)
class ViewSurfaces:
    """The G-buffer of one view, on the device; images are flat, row by row.

    Attributes:
        camera: What sees it.
        alpha: Coverage, ``(H * W,)`` float.
        depth: Of the surface, along the optical axis [m], ``(H * W,)`` float; 0 where nothing is seen.
        rows: Points, normals, directions to the camera and roughness of the pixels that show a surface, ``(M,)`` each,
            and which pixels these are.
    """

    camera: Camera
    alpha: wp.array
    depth: wp.array
    rows: PixelSurfaces

    def __len__(self) -> int:
        """Return M."""
        return len(self.rows.pixels)

    def image(self, values: wp.array) -> wp.array:
        """Return an image of floats or vectors of rows, ``(H * W,)``; 0 where no surface is shown."""
        result = wp.zeros(len(self.alpha), dtype=values.dtype, device=values.device)
        launch_scatter(self.rows.pixels, values, result, values.device)
        return result


def view_surfaces(
    gaussians: GaussianArrays,
    camera: Camera,
    *,
    surface_depth: SurfaceDepth = "median",
    options: RasterOptions | None = None,
    device: Any,
) -> ViewSurfaces:
    """Draw what a camera sees, and collect the surface points of its pixels; waits for the device to count them.

    Args:
        gaussians: Arrays on the device; ``values`` holds the roughness, ``(N, 1)``.
        camera: The view.
        surface_depth: One of `SURFACE_DEPTHS`.
        options: How splats are drawn.
        device: Where the arrays are.
    """
    require_choice("surface_depth", surface_depth, SURFACE_DEPTHS)
    count = len(gaussians.positions)
    rasterizer = Rasterizer(count, [camera], value_count=1, normals=True, options=options, device=device)
    drawn = rasterizer.draw(gaussians)
    images = SurfaceImages()
    images.alpha = drawn.alpha
    images.depth = drawn.median_depth if surface_depth == "median" else drawn.depth
    images.channels = drawn.channels[0]
    pixel_count = len(images.alpha)
    marks, ends = (wp.empty(pixel_count, dtype=int, device=device) for _ in range(2))
    launch_mark_surfaces(len(images.alpha), images, LEAST_ALPHA, marks, device)
    wp.utils.array_scan(marks, ends, inclusive=True)
    found = int(ends[-1:].numpy()[0])
    rows = PixelSurfaces()
    rows.pixels = wp.empty(found, dtype=int, device=device)
    rows.roughness = wp.empty(found, dtype=float, device=device)
    for name in ("positions", "normals", "to_camera"):
        setattr(rows, name, wp.empty(found, dtype=wp.vec3, device=device))
    launch_gather_surfaces(len(marks), images, ViewLayout.of([camera]).views[0], marks, ends, rows, device)
    return ViewSurfaces(camera, images.alpha, images.depth, rows)


def surface_residues(
    scene: Scene,
    surfaces: ViewSurfaces,
    light: PreparedEnvironment,
    *,
    sample_count: int = 100,
    offset: float = 0.02,
    diffuse_weight: DiffuseWeight = "fresnel_hv",
    seed: int = 0,
    frame: int = 0,
) -> Residues:
    """Estimate what a white diffuser and the specular lobe at each pixel's surface send to the camera.

    L_D = 1/pi * integral of w_d V L (n.w) dw and L_S = integral of f_s V L (n.w) dw, both without bias.

    Args:
        scene: Occluders.
        surfaces: On the scene's device.
        light: The environment, prepared on the same device.
        sample_count: Rays a pixel, at least `FEWEST_LIGHT_SAMPLES`.
        offset: Lift of ray origins along the normal [m].
        diffuse_weight: w_d, one of `beam_warp.materials.light_rays.DIFFUSE_WEIGHTS`.
        seed: Same seed, same device, same bits.
        frame: Number of the noise: views and moments of different numbers have independent samples.

    Returns:
        Both residues [W/(m^2 sr)] by channel, and their standard errors over the mean of the channels, by row of
        ``surfaces``, on the device.

    Raises:
        InvalidOptionError: An option is out of range.

    Source: BEAM Eqs. 5 and 6; balance heuristic, Veach 1997; visible normals, Heitz 2018.
    """
    require_choice("diffuse_weight", diffuse_weight, tuple(DIFFUSE_WEIGHTS))
    require_count("sample_count", sample_count, FEWEST_LIGHT_SAMPLES, 1 << 20)
    require_number("offset", offset)
    require_count("seed", seed, 0, 2**32 - 1)
    require_count("frame", frame, 0, 2**32 - 1)
    device = scene.device
    samples = ResidueSamples()
    samples.set = sample_set("iid", sample_count)
    samples.environment_count = sample_count // 2
    samples.cosine_count = sample_count // 4
    table = upload(specular_albedo_table(), wp.vec2, device)
    residues = Residues()
    residues.diffuse, residues.specular = (wp.empty(len(surfaces), dtype=wp.vec3, device=device) for _ in range(2))
    residues.diffuse_error, residues.specular_error = (
        wp.empty(len(surfaces), dtype=float, device=device) for _ in range(2)
    )
    rows = surfaces.rows
    for batch in ray_batches(scene, rows.positions, rows.normals, offset, sample_count):
        rays = room_for_rays(batch, device, bernoulli=False, reaches=True)
        weights = wp.empty(len(rays.origins), dtype=wp.vec3, device=device)
        launch_draw_residue_rays(samples, light.distribution, batch, rows, (seed, frame), rays, weights, device)
        visibility = wp.empty(len(rays.origins), dtype=float, device=device)
        trace_rays(scene, EXACT, rays, visibility)
        weighting = DIFFUSE_WEIGHTS[diffuse_weight]
        launch_reduce_residues(
            len(batch.rows), batch, rows, rays.directions, weights, visibility, table, int(weighting), residues, device
        )
    return residues
