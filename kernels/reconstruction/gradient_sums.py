"""Gradients of Gaussians that are added up: of changes since the frame before, and their lengths."""

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


@wp.kernel
def add_gradient_lengths_kernel(
    first: int, position_gradients: wp.array[wp.vec3], out_sums: wp.array[float], out_counts: wp.array[float]
):
    item = first + wp.tid()
    length = wp.length(position_gradients[item])
    if length > 0.0:
        out_sums[item] += length
        out_counts[item] += 1.0


def launch_add_difference_gradients(values: Any, reference: Any, scale: float, out_gradients: Any, device: Any) -> None:
    """Add the gradients of ``scale`` times the sum of squared differences."""
    inputs = [values, reference, 2.0 * scale]
    launch(add_difference_gradients_kernel, values.size, inputs=inputs, outputs=[out_gradients], device=device)


def launch_add_gradient_lengths(position_gradients: Any, out_sums: Any, out_counts: Any, device: Any) -> None:
    """Add the lengths of the gradients, and count the steps in which there was one.

    Where lengths are large, Gaussians are split.
    """
    outputs = [out_sums, out_counts]
    launch(add_gradient_lengths_kernel, out_sums.size, inputs=[position_gradients], outputs=outputs, device=device)
