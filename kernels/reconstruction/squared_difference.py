"""Gradients of squared differences of rows of floats."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add_difference_gradients_kernel(
    first: int, values: wp.array2d[float], reference: wp.array2d[float], slope: float, out_gradients: wp.array2d[float]
):
    item = first + wp.tid()
    row = item / values.shape[1]
    column = item % values.shape[1]
    out_gradients[row, column] += slope * (values[row, column] - reference[row, column])


def launch_add_difference_gradients(values: Any, reference: Any, scale: float, out_gradients: Any, device: Any) -> None:
    """Add the gradients of ``scale`` times the sum of squared differences."""
    inputs = [values, reference, 2.0 * scale]
    launch(add_difference_gradients_kernel, values.size, inputs=inputs, outputs=[out_gradients], device=device)
