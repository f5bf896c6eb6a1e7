"""Kernels of baking beside the rasteriser: residuals of pixels, pulls towards other values, sums over views."""

import warp as wp

from beam_warp.kernels.common.launching import launcher

wp.set_module_options({"enable_backward": False})


@wp.kernel
def weigh_pixels_kernel(
    first: int,
    drawn: wp.array2d[float],
    targets: wp.array2d[float],
    weights: wp.array2d[float],
    out_pixels: wp.array2d[float],
):
    """No targets are targets of 0, masked ones may hold any value; columns without weights count nothing."""
    item = first + wp.tid()
    row = item / drawn.shape[1]
    c = item % drawn.shape[1]
    value = float(0.0)
    if c < weights.shape[1]:
        weight = weights[row, c]
        if weight > 0.0:
            difference = drawn[row, c]
            if targets:
                difference -= targets[row, c]
            value = weight * difference
    out_pixels[row, c] = value


@wp.kernel
def add_pull_kernel(
    first: int,
    values: wp.array2d[float],
    anchors: wp.array2d[float],
    strength: wp.array2d[float],
    scale: float,
    out_sums: wp.array2d[float],
):
    """Add scale times strength times (values - anchors); no anchors are anchors of 0."""
    item = first + wp.tid()
    row = item / values.shape[1]
    c = item % values.shape[1]
    value = values[row, c]
    if anchors:
        value -= anchors[row, c]
    out_sums[row, c] += scale * strength[row, c] * value


@wp.kernel
def clamp_rows_kernel(first: int, low: float, high: float, out_rows: wp.array2d[float]):
    item = first + wp.tid()
    row = item / out_rows.shape[1]
    c = item % out_rows.shape[1]
    out_rows[row, c] = wp.clamp(out_rows[row, c], low, high)


launch_weigh_pixels = launcher(weigh_pixels_kernel)
"""Multiply the differences of images and their targets by weights."""


launch_add_pull = launcher(add_pull_kernel)
"""Add the gradient of half of strength times the squared distance from the anchors."""


launch_clamp_rows = launcher(clamp_rows_kernel)
"""Cut rows to bounds."""
