"""Resolution of images for baking: pixels much finer than the Gaussians cost time and tell nothing more.

Images are reduced by a whole factor to where a pixel is half as wide as the splats' deviation, if they are finer
than that: memory and time of baking fall by the factor's square. Rays, denoising and the solve for the base colour stay
at the images' own resolution; their noise averages out over a reduced pixel as it does over a splat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from beam_warp.kernels.materials.reduced_targets import launch_reduce_targets
from beam_warp.materials.bake import BakeTarget
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.metadata import LOW_PASS_RANGE

WIDEST_PIXEL = 0.5
"""Width of a reduced pixel in deviations of splats, at most.

A reduced bake draws splats at the centres of blocks and compares them with means over what counts of these; both differ
by what the picture bends within a block, and at rims. Measured on a ball of splats, in views apart: at a width of 0.5
the images drawn of the result have an error of 56 dB from that, at 0.8 of 47 dB; on a reconstructed figure, 44 dB at
1.3.
"""

SMALL_SPLATS = 25.0
"""Percentile of the deviations that counts."""

MEASURED_SPLATS = 4096
"""Least number of splats that the percentile is taken of; larger clouds are thinned evenly."""


def reduction_factor(cloud: GaussianCloud, cameras: Sequence[Camera], *, near: float) -> int:
    """Return by how much images may be reduced for baking, the same for all: 1 unless pixels are far finer than splats.

    A splat's deviation is the second largest scale of its Gaussian, seen from the front.

    Args:
        cloud: Gaussians.
        cameras: Their views; the one that sees them smallest decides.
        near: Depth before which nothing is drawn [m].
    """
    some = slice(None, None, max(1, len(cloud) // MEASURED_SPLATS))
    positions = cloud.positions[some].astype(np.float64)
    deviations = np.sort(cloud.scales[some], axis=1)[:, 1].astype(np.float64)
    least = np.inf
    for camera in cameras:
        rotation, shift = camera.world_to_camera[2, :3], camera.world_to_camera[2, 3]
        depth = positions @ rotation + shift
        seen = depth >= near
        if seen.any():
            focal = min(camera.focal_x, camera.focal_y)
            least = min(least, float(np.percentile(focal * deviations[seen] / depth[seen], SMALL_SPLATS)))
    largest = max(max(camera.width, camera.height) for camera in cameras)
    return int(np.clip(WIDEST_PIXEL * least, 1, largest)) if np.isfinite(least) else 1


def reduced_target(target: BakeTarget, factor: int, device: Any) -> BakeTarget:
    """Return the target of a view of fewer pixels: means by weight, and sums of the weights.

    So the normal equations keep what pixels say in sum, and evidence is still counted in the images' own pixels. Blocks
    beyond the last whole ones count with the pixels that they have.

    Args:
        target: On the device, ``(H, W, K)``.
        factor: Side of a block of pixels that become one.
        device: Where the arrays are.
    """
    if factor == 1:
        return target
    camera = reduced_camera(target.camera, factor)
    shape = (camera.height, camera.width, target.targets.shape[2])
    means, sums = (wp.empty(shape, dtype=float, device=device) for _ in range(2))
    launch_reduce_targets(means.size, target.targets, target.weights, factor, means, sums, device)
    return BakeTarget(camera, means, sums)


def reduced_camera(camera: Camera, factor: int) -> Camera:
    """Return a camera with one pixel for each block of them, those beyond the last whole ones too."""
    width, height = -(-camera.width // factor), -(-camera.height // factor)
    return camera.cropped(0, 0, width * factor, height * factor).reduced(factor)


def reduced_options(options: RasterOptions, factor: int) -> RasterOptions:
    """Return how reduced views are drawn: splats of the same shape in the scene, sampled at fewer places."""
    return replace(options, low_pass=max(options.low_pass / factor**2, LOW_PASS_RANGE[0]))
