"""How much each Gaussian is pulled at by the images, summed over steps: where one is too few."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add_stress_kernel(
    first: int,
    position_gradients: wp.array[wp.vec3],
    out_sums: wp.array[float],
    out_counts: wp.array[float],
):
    item = first + wp.tid()
    pull = wp.length(position_gradients[item])
    if pull > 0.0:
        out_sums[item] += pull
        out_counts[item] += 1.0


def launch_add_stress(position_gradients: Any, out_sums: Any, out_counts: Any, device: Any) -> None:
    """Add the lengths of the gradients, and count the steps in which there was one."""
    launch(
        add_stress_kernel,
        out_sums.size,
        inputs=[position_gradients],
        outputs=[out_sums, out_counts],
        device=device,
    )
