"""Reduction of bake targets to blocks of pixels: means by weight, and sums of the weights."""

import warp as wp

from beam_warp.kernels.common.launching import launcher

wp.set_module_options({"enable_backward": False})


@wp.kernel
def reduce_targets_kernel(
    first: int,
    targets: wp.array3d[float],
    weights: wp.array3d[float],
    factor: int,
    out_targets: wp.array3d[float],
    out_weights: wp.array3d[float],
):
    """A thread a value; what counts nothing may hold anything, and a block of it gets 0."""
    item = first + wp.tid()
    column = item % out_targets.shape[2]
    block = item / out_targets.shape[2]
    x = block % out_targets.shape[1]
    y = block / out_targets.shape[1]
    total = float(0.0)
    weight_sum = float(0.0)
    for row in range(y * factor, wp.min((y + 1) * factor, targets.shape[0])):
        for pixel in range(x * factor, wp.min((x + 1) * factor, targets.shape[1])):
            weight = weights[row, pixel, column]
            if weight > 0.0:
                total += weight * targets[row, pixel, column]
                weight_sum += weight
    mean = float(0.0)
    if weight_sum > 0.0:
        mean = total / weight_sum
    out_targets[y, x, column] = mean
    out_weights[y, x, column] = weight_sum


launch_reduce_targets = launcher(reduce_targets_kernel)
"""Reduce ``(H, W, K)`` targets and weights to ``(ceil(H / factor), ceil(W / factor), K)``."""
