"""Evidence of views on every Gaussian: the surface that it belongs to, and its colour towards each camera.

The rasteriser's blending weights say which pixels a Gaussian is part of, and how much. Spread back by them, the points
that pixels see give each Gaussian its place on the surface as it is *seen*, which its own centre is not (a third of
a fitted cloud lies behind the surface); and images give it colours.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.capture.quality import WHOLE, photon_noise
from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_count
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.jobs.listeners import CountProgress
from beam_warp.kernels.materials.view_evidence import (
    PIXEL_CHANNELS,
    CapturedPixels,
    SurfaceSamples,
    launch_add_views,
    launch_finish_surface,
    launch_observe,
    launch_write_samples,
)
from beam_warp.kernels.raster.bin_tiles import TILE
from beam_warp.kernels.raster.project import RasterView
from beam_warp.raster.layout import ViewLayout
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import samples_of_fit
from beam_warp.raster.sources import upload_gaussians
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

SURFACE_CHANNELS = 11
"""Number of a pixel's channels that are added up over views."""

LEAST_WEIGHT = 0.5
"""Samples that all views together must show of a Gaussian, by its blending weights, for it to be seen."""

LEAST_SHARE = 0.01
"""Part of the pixels that it would cover without others before it that they must show: layers let something through,
and with enough pixels that adds up."""

LEAST_AGREEMENT = 1e-3
"""Length of the mean of the normals below which it has no direction: both sides of a sheet are seen alike."""

PIXELS_AT_ONCE = 2**21
"""Most samples drawn at a time unless one camera has more: 48 bytes each, and as many for what was drawn."""

CUTTING_THREADS = 8
"""Images cut at a time."""

RADII = 3.4
"""Standard deviations up to which a Gaussian is drawn: beyond, alpha is below 1/255."""

MARGIN = 4
"""Pixels around the subject that stay: the pixel filter widens splats."""

HEADROOM = 0.995
"""Part of an image's largest value from which on a pixel counts as cut."""


@dataclass(frozen=True, eq=False)
class ViewEvidence:
    """Place, normal and colours of every Gaussian as views show them; arrays are on the device.

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
        misfit: Mean square of what images differ by from what the Gaussians show, less what their noise makes it, over
            the pixels with an image that show each one, ``(N, 3)`` float32 on the host; 0 where there is none.
        cameras: Of the views, cut to where Gaussians can be.
        raster: How splats are drawn.
    """

    positions: wp.array
    normals: wp.array
    agreement: wp.array
    weight: NDArray[np.float32]
    seen: NDArray[np.bool_]
    saturated: NDArray[np.float32]
    colors: wp.array
    directions: wp.array
    misfit: NDArray[np.float32]
    cameras: tuple[Camera, ...] = ()
    raster: RasterOptions = field(default_factory=RasterOptions)


class Shown(NamedTuple):
    """What an image shows of the subject, and the variance of its pixels over their values."""

    image: CapturedView
    noise: float


def view_evidence(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    images: Sequence[CapturedView] | None = None,
    *,
    options: RasterOptions | None = None,
    samples: int | Literal["auto"] = "auto",
    ceiling: float = float("inf"),
    device: str | None = None,
    progress: CountProgress | None = None,
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
        samples: Side of the square of samples that a pixel is the mean of; ``"auto"``: as it was fitted, see
            `beam_warp.raster.resolution.samples_of_fit`.
        ceiling: Largest value that the images can hold, scene-linear; infinite for scene-referred ones.
        device: Warp device; None takes the first CUDA device, or the CPU.
        progress: Called with (views done, views in all).

    Raises:
        InvalidArrayError: The cloud has no radiance, or images are not as many as cameras.
        InvalidOptionError: ``samples`` is out of range.

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
    raster = options or RasterOptions()
    if samples == "auto":
        side = samples_of_fit(cloud, cameras, raster)
    else:
        side = require_count("samples", samples, 1, 8)
    cut = _cut_to_subject(cloud, cameras, images)
    seen_by: list[Camera] = []
    for rasterizer, part, group in _groups(count, cut, side, raster, target):
        seen_by += (camera for camera, _ in group)
        drawn = SurfaceSamples()
        image = rasterizer.draw(gaussians)
        drawn.colors, drawn.alpha, drawn.depth = image.channels[0], image.alpha, image.median_depth
        drawn.display_srgb = int(cloud.radiance_color_space == DISPLAY_SRGB)
        pixels = wp.empty((rasterizer.first_pixels[-1], PIXEL_CHANNELS), dtype=float, device=target)
        rows = wp.empty((len(part) * count, PIXEL_CHANNELS), dtype=float, device=target)
        views = ViewLayout.of(rasterizer.cameras).views
        for view, (_, image_shown) in zip(views, group, strict=True):
            captured = _captured(image_shown, ceiling, target)
            pixel_count = view.width * view.height // side**2
            launch_write_samples(pixel_count, view, drawn, captured, side, wp.vec3(*origin), pixels, target)
        rasterizer.back_project(pixels, rows)
        launch_add_views(rows, len(part), SURFACE_CHANNELS, sums, target)
        if images is not None:
            launch_observe(
                len(views) * len(gaussians.positions),
                rows,
                gaussians.positions,
                gaussians.radiance,
                drawn.display_srgb,
                wp.array(views, dtype=RasterView, device=target),
                part.start,
                colors,
                directions,
                target,
            )
        if progress is not None:
            progress(part.stop, len(cameras))
    totals = sums.numpy()
    weight, cut = totals[:, 6].copy(), totals[:, 7]
    seen = weight >= np.maximum(LEAST_WEIGHT / side**2, LEAST_SHARE * _coverage(cloud, cameras, origin))
    seen &= np.linalg.norm(totals[:, 3:6], axis=1) > LEAST_AGREEMENT * weight
    positions, normals = (wp.empty(count, dtype=wp.vec3, device=target) for _ in range(2))
    agreement = wp.empty(count, dtype=float, device=target)
    launch_finish_surface(
        len(gaussians.positions),
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
    with_image = colors.numpy()[..., 3].sum(axis=0)[:, None]
    misfit = np.divide(totals[:, 8:], with_image, out=np.zeros_like(totals[:, 8:]), where=with_image > 0.0)
    misfit = np.maximum(misfit, 0.0)
    return ViewEvidence(
        positions, normals, agreement, weight, seen, saturated, colors, directions, misfit, tuple(seen_by), raster
    )


def _groups(
    count: int, views: Iterator[tuple[Camera, Shown | None]], samples: int, options: RasterOptions, device: wp.Device
) -> Iterator[tuple[Rasterizer, range, list[tuple[Camera, Shown | None]]]]:
    """Rasterise some views at a time, so many samples for a pixel's side; views of the same sizes share buffers."""
    rasterizer: Rasterizer | None = None
    start = 0
    group: list[tuple[Camera, Shown | None]] = []
    for view in itertools.chain(views, (None,)):
        pixels = sum(camera.width * camera.height for camera, _ in group)
        if group and (view is None or samples**2 * (pixels + view[0].width * view[0].height) > PIXELS_AT_ONCE):
            cameras = [camera.supersampled(samples) for camera, _ in group]
            sizes = [(camera.width, camera.height) for camera in cameras]
            if rasterizer is not None and [(c.width, c.height) for c in rasterizer.cameras] == sizes:
                rasterizer.set_cameras(cameras)
            else:
                rasterizer = Rasterizer(count, cameras, radiance=True, normals=True, options=options, device=device)
            yield rasterizer, range(start, start + len(group)), group
            start += len(group)
            group = []
        if view is not None:
            group.append(view)


def _cut_to_subject(
    cloud: GaussianCloud, cameras: Sequence[Camera], images: Sequence[CapturedView] | None
) -> Iterator[tuple[Camera, Shown | None]]:
    """Cut cameras and images to where Gaussians can be: most of a picture is background, which costs as much to move.

    Images are cut, and their noise is measured, ahead by threads while earlier ones are worked on.
    """
    low, high = _bounds(cloud)
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))

    def cut(index: int) -> tuple[Camera, Shown | None]:
        camera, image = cameras[index], None if images is None else images[index]
        left, top, right, bottom = _box(camera, corners)
        part = (left, top, right - left, bottom - top)
        if image is not None:
            image = image.cropped(*part)
            return image.camera, Shown(image, _noise(image))
        return camera.cropped(*part), None

    with ThreadPoolExecutor(CUTTING_THREADS) as pool:
        waiting: deque[Future[tuple[Camera, Shown | None]]] = deque()
        for index in range(len(cameras)):
            waiting.append(pool.submit(cut, index))
            if len(waiting) > CUTTING_THREADS:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _bounds(cloud: GaussianCloud) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the box of all Gaussians, their reach included [m]."""
    reach = RADII * cloud.scales.max(axis=1, keepdims=True).astype(np.float64)
    if not len(cloud):
        return np.zeros(3), np.zeros(3)
    return (cloud.positions - reach).min(axis=0), (cloud.positions + reach).max(axis=0)


def _box(camera: Camera, corners: NDArray[np.float64]) -> tuple[int, int, int, int]:
    """Return the part of an image that a box can be in: left, top, right, bottom; all of it where that is unclear."""
    whole = (0, 0, camera.width, camera.height)
    if not (((corners - camera.position) @ camera.forward) > 0.0).all():
        return whole
    places = camera.project(corners)[:, :2]
    low = np.floor(places.min(axis=0)).astype(int) - MARGIN
    high = np.ceil(places.max(axis=0)).astype(int) + MARGIN
    left, top = max(int(low[0]), 0), max(int(low[1]), 0)
    right, bottom = min(int(high[0]), camera.width), min(int(high[1]), camera.height)
    # tiles are 16 pixels wide: parts of the same size share buffers more often if sizes are whole tiles
    left, top = left // TILE * TILE, top // TILE * TILE
    right, bottom = min(-(-right // TILE) * TILE, camera.width), min(-(-bottom // TILE) * TILE, camera.height)
    return (left, top, right, bottom) if left < right and top < bottom else (0, 0, 1, 1)


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


def _noise(image: CapturedView) -> float:
    """Return the variance of a pixel over its value; 0 where nothing tells."""
    solid = np.ones(image.color.shape[:2], bool) if image.alpha is None else image.alpha > WHOLE
    return float(np.nan_to_num(photon_noise(image.color, solid)))


def _captured(shown: Shown | None, ceiling: float, device: wp.Device) -> CapturedPixels:
    """Bring an image to the device."""
    captured, image = CapturedPixels(), None if shown is None else shown.image
    color = np.zeros((0, 3), np.float32) if image is None else image.color.reshape(-1, 3)
    coverage = np.zeros(0, np.float32) if image is None or image.alpha is None else image.alpha.reshape(-1)
    captured.color = upload(color, wp.vec3, device)
    captured.coverage = upload(coverage, float, device)
    captured.ceiling = HEADROOM * ceiling
    captured.noise = 0.0 if shown is None else shown.noise
    return captured
