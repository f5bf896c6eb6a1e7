"""Visibility of given rays: one ray a thread."""

from typing import Any

import warp as wp

from beam_warp.kernels.launching import launch
from beam_warp.kernels.occluders import transmittance
from beam_warp.kernels.sampling import stream_of
from beam_warp.kernels.trace_settings import TraceSettings

wp.set_module_options({"enable_backward": False})


@wp.kernel
def trace_visibility_kernel(
    first: int,
    occluders: Any,
    settings: TraceSettings,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    reaches: wp.array[float],
    seed: wp.uint32,
    out_visibility: wp.array[float],
):
    """``reaches`` holds one number, or one for each ray."""
    i = first + wp.tid()
    t_max = reaches[wp.min(i, reaches.shape[0] - 1)]
    stream = stream_of(seed, wp.uint32(0), wp.uint32(i))
    out_visibility[i] = transmittance(occluders, settings, origins[i] - occluders.origin, directions[i], t_max, stream)


def launch_trace_visibility(occluders, settings, origins, directions, reaches, seed, out_visibility, device):
    """Trace one ray a thread."""
    launch(
        trace_visibility_kernel,
        len(origins),
        inputs=[occluders, settings, origins, directions, reaches, wp.uint32(seed)],
        outputs=[out_visibility],
        device=device,
        block_dim=64,  # measured best on an H200: divergent rays, small blocks
    )
