"""Lengths of each Gaussian's position gradients, summed over steps: where they are large, Gaussians are split."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add_gradient_lengths_kernel(
    first: int, position_gradients: wp.array[wp.vec3], out_sums: wp.array[float], out_counts: wp.array[float]
):
    item = first + wp.tid()
    length = wp.length(position_gradients[item])
    if length > 0.0:
        out_sums[item] += length
        out_counts[item] += 1.0


def launch_add_gradient_lengths(position_gradients: Any, out_sums: Any, out_counts: Any, device: Any) -> None:
    """Add the lengths of the gradients, and count the steps in which there was one."""
    launch(
        add_gradient_lengths_kernel,
        out_sums.size,
        inputs=[position_gradients],
        outputs=[out_sums, out_counts],
        device=device,
    )
