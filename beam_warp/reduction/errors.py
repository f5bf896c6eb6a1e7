"""Where merged Gaussians err: the error of relit images, carried back to the Gaussians that show it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.sources import upload_gaussians
from beam_warp.reduction.sensitivity import MATERIALS, Sensitivity, material_rows
from beam_warp.world.gaussians import GaussianCloud

WIDTH = 4
"""Numbers of a pixel that are carried back, the fewest that the rasteriser takes; the error is one of them."""


def carried_errors(
    frames: Mapping[int, GaussianCloud], found: Sensitivity, *, raster: RasterOptions, device: Any
) -> NDArray[np.float64]:
    """Return the error that each merged Gaussian shows, over all views of the original, ``(K,)``.

    The error of a pixel is the quadratic form of `Sensitivity`; Gaussians share it as they share the pixel.

    Args:
        frames: Merged Gaussians of the frames that views are of.
        found: The views.
        raster: How splats are drawn.
        device: Warp device.
    """
    uploaded = {frame: upload_gaussians(cloud, device, values=material_rows(cloud)) for frame, cloud in frames.items()}
    count = len(next(iter(frames.values())))
    cameras = [[view.camera] for view in found.views]
    drawer = Rasterizer(count, cameras[0], value_count=MATERIALS, options=raster, device=device)
    pixels = wp.empty((len(drawer.images.alpha), WIDTH), dtype=float, device=device)
    rows = wp.empty((count, WIDTH), dtype=float, device=device)
    total = np.zeros(count)
    for view, camera in zip(found.views, cameras, strict=True):
        drawer.set_cameras(camera)
        view.errors(drawer.draw(uploaded[view.frame]), pixels)
        drawer.back_project(pixels, rows)
        total += rows.numpy()[:, 0]
    return total
