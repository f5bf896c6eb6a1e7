"""Targets of baking at a lower resolution: pixels much finer than the Gaussians cost time and tell nothing more.

Memory and time of baking fall by the square of the factor. Rays, denoising and the solve for the base colour stay at
the images' own resolution; their noise averages out over a reduced pixel as it does over a splat.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from beam_warp.kernels.materials.reduced_targets import launch_reduce_targets
from beam_warp.materials.bake import BakeTarget
from beam_warp.raster.resolution import reduced_camera


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
