"""Sums over views of the rows that each view has for every Gaussian."""

import warp as wp

from beam_warp.kernels.common.launching import launcher

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sum_views_kernel(first: int, rows: wp.array2d[float], out_sums: wp.array2d[float]):
    """Add one column of a Gaussian's rows, view by view."""
    item = first + wp.tid()
    count = out_sums.shape[0]
    gaussian = item / out_sums.shape[1]
    column = item % out_sums.shape[1]
    total = float(0.0)
    for view in range(rows.shape[0] / count):
        total += rows[view * count + gaussian, column]
    out_sums[gaussian, column] = total


launch_sum_views = launcher(sum_views_kernel)
"""Sum ``(V * N, K)`` rows over the views to ``(N, K)``."""
