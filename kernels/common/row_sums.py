"""Rows of floats that are added to others."""

import warp as wp

from beam_warp.kernels.common.launching import launcher

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add_rows_kernel(first: int, rows: wp.array2d[float], out_rows: wp.array2d[float]):
    item = first + wp.tid()
    width = rows.shape[1]
    out_rows[item / width, item % width] += rows[item / width, item % width]


launch_add_rows = launcher(add_rows_kernel)
"""Add rows to others of the same shape."""
