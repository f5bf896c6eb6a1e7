"""What views show of every Gaussian: the surface it belongs to, and its colour towards each camera.

The rasteriser's blending weights say which pixels a Gaussian is part of, and how much. Spread back by them, the points
that pixels see give each Gaussian its place on the surface as it is *seen*, which its own centre is not (a third of
a fitted cloud lies behind the surface); and images give it colours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.assets import DISPLAY_SRGB, GaussianCloud
from beam_warp.cameras import Camera
from beam_warp.captured_views import CapturedView
from beam_warp.devices import resolve_device, upload
from beam_warp.errors import InvalidArrayError
from beam_warp.kernels.project import View
from beam_warp.kernels.view_evidence import (
    PIXEL_CHANNELS,
    CapturedPixels,
    SurfacePixels,
    launch_add_rows,
    launch_finish_surface,
    launch_observe,
    launch_write_pixels,
)
from beam_warp.raster_layout import ViewLayout
from beam_warp.raster_records import RasterOptions
from beam_warp.rasterizer import Rasterizer
from beam_warp.rasterizing import upload_gaussians

SURFACE_CHANNELS = 8
"""Of a pixel's channels, those that are added up over views."""

LEAST_WEIGHT = 0.5
"""Pixels that all views together must show of a Gaussian, by its blending weights, for it to be seen."""

LEAST_SHARE = 0.01
"""Part of the pixels that it would cover without others before it that they must show: layers let something through,
and with enough pixels that adds up."""

PIXELS_AT_ONCE = 2**21
"""Most pixels drawn at a time unless one camera has more: 48 bytes each, and as many for what was drawn."""

HEADROOM = 0.995
"""Of what a display-referred image can hold: from there on a pixel counts as cut."""


@dataclass(frozen=True, eq=False)
class ViewEvidence:
    """What views show of every Gaussian; arrays are on the device.

    Attributes:
        positions: The point of the surface that it belongs to [m], ``(N,)`` vec3; its own centre where it is not seen.
        normals: Unit normal of that surface, ``(N,)`` vec3; 0 where it is not seen.
        agreement: Length of the mean of the normals that pixels see there, ``(N,)`` float: 1 on planes, less at edges.
        weight: Pixels of all views together, by blending weights, ``(N,)`` float32 on the host.
        seen: Which Gaussians any view shows, ``(N,)`` bool, host.
        saturated: Part of its weight in pixels with an image that were cut at their ceiling, ``(N,)`` float32, host.
        colors: Scene-linear radiance towards each camera and its weight [pixel], ``(V, N)`` vec4; of no views if there
            were no images.
        directions: Unit, towards each camera, ``(V, N)`` vec3.
    """

    positions: wp.array
    normals: wp.array
    agreement: wp.array
    weight: NDArray[np.float32]
    seen: NDArray[np.bool_]
    saturated: NDArray[np.float32]
    colors: wp.array
    directions: wp.array


def view_evidence(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    images: Sequence[CapturedView] | None = None,
    *,
    options: RasterOptions | None = None,
    ceiling: float = float("inf"),
    device: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ViewEvidence:
    """Draw a cloud for cameras and spread what their pixels see back over its Gaussians.

    Observed colour is the fitted radiance towards the camera plus the difference between image and rendering, spread
    back by blending weights: what the fit explains keeps its sharpness, what it does not is not lost. Silhouettes and
    pixels at the ceiling count for nothing.

    Args:
        cloud: Gaussians with captured radiance, in the internal world.
        cameras: Of any sizes, at least one.
        images: What the cameras saw, one each; None takes the surface alone.
        options: How splats are drawn: as they were fitted.
        ceiling: Largest value that the images can hold, scene-linear; infinite for scene-referred ones.
        device: Warp device; None takes the first CUDA device, or the CPU.
        progress: Called with (views done, views in all).

    Raises:
        InvalidArrayError: The cloud has no radiance, or images are not as many as cameras.

    Source: the transpose of alpha blending, as in the gradients of Kerbl et al. 2023.
    """
    if cloud.radiance is None:
        raise InvalidArrayError("radiance must be given, got None. Import Gaussians with captured colour.")
    if images is not None and len(images) != len(cameras):
        raise InvalidArrayError(
            f"images must be one for each of {len(cameras)} cameras, got {len(images)}. Leave neither out."
        )
    target = resolve_device(device)
    count = len(cloud)
    observed = len(cameras) if images is not None else 0
    origin = cloud.positions.astype(np.float64).mean(axis=0) if count else np.zeros(3)
    gaussians = upload_gaussians(cloud, target, radiance=cloud.radiance)
    sums = wp.zeros((count, SURFACE_CHANNELS), dtype=float, device=target)
    colors = wp.zeros((observed, count), dtype=wp.vec4, device=target)
    directions = wp.zeros((observed, count), dtype=wp.vec3, device=target)
    for rasterizer, part in _groups(count, cameras, options, target):
        drawn = SurfacePixels()
        image = rasterizer.draw(gaussians)
        drawn.colors, drawn.alpha, drawn.depth = image.channels[0], image.alpha, image.median_depth
        drawn.display_srgb = int(cloud.radiance_color_space == DISPLAY_SRGB)
        pixels = wp.empty((rasterizer.first_pixels[-1], PIXEL_CHANNELS), dtype=float, device=target)
        rows = wp.empty((len(part) * count, PIXEL_CHANNELS), dtype=float, device=target)
        views = ViewLayout.of(cameras[part.start : part.stop]).views
        for view, index in zip(views, part, strict=True):
            captured = _captured(None if images is None else images[index], ceiling, target)
            launch_write_pixels(view, drawn, captured, wp.vec3(*origin), pixels, target)
        rasterizer.back_project(pixels, rows)
        launch_add_rows(rows, len(part), SURFACE_CHANNELS, sums, target)
        if images is not None:
            launch_observe(
                rows,
                gaussians.positions,
                gaussians.radiance,
                drawn.display_srgb,
                wp.array(views, dtype=View, device=target),
                part.start,
                colors,
                directions,
                target,
            )
        if progress is not None:
            progress(part.stop, len(cameras))
    totals = sums.numpy()
    weight, cut = totals[:, 6].copy(), totals[:, 7]
    seen = weight >= np.maximum(LEAST_WEIGHT, LEAST_SHARE * _coverage(cloud, cameras, origin))
    positions, normals = (wp.empty(count, dtype=wp.vec3, device=target) for _ in range(2))
    agreement = wp.empty(count, dtype=float, device=target)
    launch_finish_surface(
        sums,
        gaussians.positions,
        wp.vec3(*origin),
        upload(seen.astype(np.int32), int, target),
        positions,
        normals,
        agreement,
        target,
    )
    saturated = np.divide(cut, weight, out=np.zeros_like(cut), where=weight > 0.0)
    return ViewEvidence(positions, normals, agreement, weight, seen, saturated, colors, directions)


def _groups(
    count: int, cameras: Sequence[Camera], options: RasterOptions | None, device: wp.Device
) -> Iterator[tuple[Rasterizer, range]]:
    """Rasterise some views at a time; views of the same sizes share their buffers."""
    rasterizer: Rasterizer | None = None
    start = 0
    while start < len(cameras):
        end = start + 1
        pixels = cameras[start].width * cameras[start].height
        while end < len(cameras):
            pixels += cameras[end].width * cameras[end].height
            if pixels > PIXELS_AT_ONCE:
                break
            end += 1
        group = list(cameras[start:end])
        sizes = [(camera.width, camera.height) for camera in group]
        if rasterizer is not None and [(c.width, c.height) for c in rasterizer.cameras] == sizes:
            rasterizer.set_cameras(group)
        else:
            rasterizer = Rasterizer(count, group, radiance=True, normals=True, options=options, device=device)
        yield rasterizer, range(start, end)
        start = end


def _coverage(cloud: GaussianCloud, cameras: Sequence[Camera], center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return about how many pixels each Gaussian would cover in all views with nothing before it, ``(N,)``.

    2 pi opacity times the product of its larger deviations, at the distance of the whole cloud's middle, half of the
    views from behind.
    """
    density = sum(
        camera.focal_x * camera.focal_y / max(float(np.sum((camera.position - center) ** 2)), 1e-12)
        for camera in cameras
    )
    larger = np.sort(cloud.scales.astype(np.float64), axis=1)[:, 1:].prod(axis=1)
    return np.pi * density * cloud.opacities * larger


def _captured(image: CapturedView | None, ceiling: float, device: wp.Device) -> CapturedPixels:
    """Bring an image to the device."""
    captured = CapturedPixels()
    color = np.zeros((0, 3), np.float32) if image is None else image.color.reshape(-1, 3)
    coverage = np.zeros(0, np.float32) if image is None or image.alpha is None else image.alpha.reshape(-1)
    captured.color = upload(color, wp.vec3, device)
    captured.coverage = upload(coverage, float, device)
    captured.ceiling = HEADROOM * ceiling
    return captured
