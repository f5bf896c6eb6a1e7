"""Squared differences of rows of floats, and their gradients."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add_squared_difference_kernel(
    first: int,
    values: wp.array2d[float],
    reference: wp.array2d[float],
    slope: float,
    out_terms: wp.array[float],
    out_gradient: wp.array2d[float],
):
    item = first + wp.tid()
    row = item / values.shape[1]
    column = item % values.shape[1]
    difference = values[row, column] - reference[row, column]
    out_terms[item] = difference * difference
    if out_gradient:
        out_gradient[row, column] += slope * difference


def launch_add_squared_difference(
    values: Any, reference: Any, scale: float, out_terms: Any, out_gradient: Any, device: Any
) -> None:
    """Write every float's squared difference, and add ``scale`` times its gradient."""
    launch(
        add_squared_difference_kernel,
        out_terms.size,
        inputs=[values, reference, 2.0 * scale],
        outputs=[out_terms, out_gradient],
        device=device,
    )
