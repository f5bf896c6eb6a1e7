"""One picture of a reconstructed frame: photograph, render, their difference, and normals, from two sides."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import straight
from beam_warp.image.panels import Panel, display_color, lay_out, over_background
from beam_warp.kernels.reconstruction.display_encoding import launch_average
from beam_warp.mesh.extract import mesh_of_gaussians
from beam_warp.mesh.preview import shaded_image
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.sources import upload_gaussians
from beam_warp.raster.view_images import view_images
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

AMPLIFICATION = 8
"""Factor by which differences are brightened: 1/8 of the display's range comes to white."""

MOST_ROWS = 540
"""Most rows of pixels of a panel: larger ones are reduced."""

FUSED_ROWS = 270
"""Most rows of pixels of the depth that a preview's mesh is fused from: twice as many make four times the triangles,
and show little more."""

FEWEST_ROWS = 240
"""Fewest rows of pixels of a panel: smaller ones are enlarged, so that their titles fit."""


def opposite_cameras(cameras: Sequence[Camera]) -> list[int]:
    """Return which two cameras look from sides furthest apart, the first of all being one; fewer if there are fewer."""
    if len(cameras) < 2:
        return list(range(len(cameras)))
    forward = np.stack([camera.forward for camera in cameras])
    return [0, 1 + int(np.argmin(forward[1:] @ forward[0]))]


def reconstruction_preview(
    cloud: GaussianCloud,
    views: Sequence[CapturedView],
    *,
    shadings: Sequence[NDArray[np.uint8]] = (),
    options: RasterOptions | None = None,
    samples: int = 1,
    device: str | None = None,
) -> NDArray[np.uint8]:
    """Draw a frame beside its photographs, a row for each view.

    Args:
        cloud: Gaussians with scene-linear radiance, axes "rfu".
        views: Photographs to compare with, of one size.
        shadings: For each view a picture of the frame's mesh from there, ``(H, W, 3)`` 8-bit sRGB, reduced as panels
            are; none leaves the column out.
        options: How splats are drawn: as they were when the Gaussians were fitted.
        samples: Side of the square of samples of a pixel: as it was when the Gaussians were fitted.
        device: Warp device.

    Returns:
        8-bit sRGB, ``(H, W, 3)``.
    """
    factor = _reduction(views[0].camera, MOST_ROWS)
    views = [view.reduced(factor) for view in views]
    drawn = _drawn(cloud, [view.camera for view in views], samples * factor, options, device)
    panels: list[Panel] = []
    for index, (view, (radiance, normals, alpha)) in enumerate(zip(views, drawn, strict=True)):
        photograph = _shown(view)
        render = over_background(display_color(radiance, alpha[..., 0]), alpha)
        difference = np.abs(photograph.astype(np.int16) - render) * AMPLIFICATION
        if view.alpha is None:  # nothing is known of what lies around the subject
            difference = np.rint(difference * alpha)
        row: list[Panel] = [
            (f"{view.name}: photograph", photograph),
            ("render", render),
            (f"difference, {AMPLIFICATION} times", np.minimum(difference, 255).astype(np.uint8)),
            ("normals (x, y, z as r, g, b)", over_background(0.5 * straight(normals, alpha) + 0.5, alpha)),
        ]
        if shadings:
            row.append(("mesh", shadings[index]))
        panels += [(title, _enlarged(pixels)) for title, pixels in row]
    return lay_out(panels, len(panels) // len(views))


def mesh_shadings(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    shown: Sequence[int],
    *,
    options: RasterOptions | None = None,
    device: str | None = None,
) -> list[NDArray[np.uint8]]:
    """Return what some cameras see of the surface that all of them see of a cloud, ``(H, W, 3)`` 8-bit sRGB each.

    Pictures have the size of panels.

    Args:
        cloud: Gaussians.
        cameras: Cameras that its depth is drawn for, with fewer pixels than a preview shows.
        shown: Numbers of the cameras whose pictures are returned.
        options: How splats are drawn.
        device: Warp device.

    Returns:
        A picture for each; none where there is no surface.
    """
    smaller = [camera.reduced(_reduction(camera, FUSED_ROWS)) for camera in cameras]
    try:
        mesh = mesh_of_gaussians(cloud, smaller, options=options, device=device)
    except InvalidArrayError:
        return []
    seeing = [cameras[index].reduced(_reduction(cameras[index], MOST_ROWS)) for index in shown]
    return [shaded_image(mesh, camera, device=device) for camera in seeing]


def _drawn(
    cloud: GaussianCloud, cameras: Sequence[Camera], side: int, options: RasterOptions | None, device: str | None
) -> Iterator[tuple[NDArray[np.float32], ...]]:
    """Draw a cloud for cameras of one size: colour and normals times alpha, ``(H, W, 3)``, and alpha ``(H, W, 1)``.

    Each pixel is the mean of ``side`` x ``side`` samples, taken where they are drawn: they are many.
    """
    target, fine = resolve_device(device), [camera.supersampled(side) for camera in cameras]
    gaussians = upload_gaussians(cloud, target, radiance=cloud.radiance)
    rasterizer = Rasterizer(len(cloud), fine[:1], radiance=True, normals=True, options=options, device=target)
    for camera in fine:
        rasterizer.set_cameras([camera])
        rasterizer.draw(gaussians)
        (image,) = view_images(rasterizer)
        samples = (
            image.select(rasterizer.color_channels),
            image.select(rasterizer.normal_channels),
            image.alpha.reshape((camera.height, camera.width, 1)),
        )
        means = [wp.empty((camera.height // side, camera.width // side, it.shape[2]), float, target) for it in samples]
        for part, mean in zip(samples, means, strict=True):
            launch_average(part, side, False, mean, target)
        yield tuple(mean.numpy() for mean in means)


def _reduction(camera: Camera, most_rows: int) -> int:
    """Return by which whole factor a view is reduced, so that so many rows are left at most."""
    return min(-(-camera.height // most_rows), camera.width)


def _shown(view: CapturedView) -> NDArray[np.uint8]:
    """Return a photograph for a display, over the background where its coverage is known."""
    alpha = np.ones(view.color.shape[:2], np.float32) if view.alpha is None else view.alpha
    return over_background(display_color(view.color, alpha), alpha[..., None])


def _enlarged(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Enlarge a small panel by a whole factor."""
    factor = max(-(-FEWEST_ROWS // len(pixels)), 1)
    return np.repeat(np.repeat(pixels, factor, axis=0), factor, axis=1)
