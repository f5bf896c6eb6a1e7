"""Activation: from the parameters that an optimiser moves to the splats that the rasteriser draws, and gradients back.

Scales are moved as logarithms and opacities as logits, so that no step leaves their range. The sampling filter widens a
Gaussian to what its training images can show, and takes the opacity that this adds away again: with f the filter's
deviation, s_i' = sqrt(s_i^2 + f^2) and o' = o prod s_i / s_i' (Yu et al. 2024, Mip-Splatting, Eq. 8). Here only for the
two larger axes: the thickness of a disc is no detail that an image shows, and would fade it out.

Dropout leaves a random part of the Gaussians out of a step, another one each time (Srivastava et al. 2014; Park et al.
2025 for Gaussians). Those that stay are more opaque in return, so that what passes all of them is the same in the mean.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.constants import ALPHA_MAX
from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.common.sampling import stream_of, unit_float

wp.set_module_options({"enable_backward": False})


@wp.struct
class Shapes:
    """Scales and opacities as an optimiser moves them."""

    log_scales: wp.array[wp.vec3]
    logits: wp.array[float]
    filters: wp.array[float]  # deviation of the sampling filter [m]


@wp.func
def smallest_axis(scales: wp.vec3) -> int:
    axis = int(2)
    if scales[0] < scales[1] and scales[0] < scales[2]:
        axis = 0
    elif scales[1] < scales[2]:
        axis = 1
    return axis


@wp.func
def sigmoid(x: float) -> float:
    return 1.0 / (1.0 + wp.exp(-x))


@wp.func
def widened(scale: float, filter: float) -> float:
    wide = wp.sqrt(scale * scale + filter * filter)
    if wide < scale:  # steps may shrink a scale until its square is no float
        wide = scale
    return wide


@wp.func
def part_of(some: float, whole: float) -> float:
    part = float(1.0)
    if whole != 0.0:  # a scale of 0 without a filter stays as it is
        part = some / whole
    return part


@wp.kernel
def activate_kernel(first: int, shapes: Shapes, out_scales: wp.array[wp.vec3], out_opacities: wp.array[float]):
    item = first + wp.tid()
    logs = shapes.log_scales[item]
    filter = shapes.filters[item]
    scales = wp.vec3(wp.exp(logs[0]), wp.exp(logs[1]), wp.exp(logs[2]))
    thin = smallest_axis(scales)
    opacity = sigmoid(shapes.logits[item])
    for axis in range(3):
        if axis != thin:
            wide = widened(scales[axis], filter)
            opacity *= part_of(scales[axis], wide)
            scales[axis] = wide
    out_scales[item] = scales
    out_opacities[item] = opacity


@wp.kernel
def drop_out_kernel(first: int, part: float, seed: wp.uint32, out_turns: wp.array[int], out_opacities: wp.array[float]):
    item = first + wp.tid()
    turn = out_turns[item]
    out_turns[item] = turn + 1
    opacity = out_opacities[item]
    if unit_float(stream_of(seed, wp.uint32(turn), wp.uint32(item))) < part:
        out_opacities[item] = 0.0
    else:
        out_opacities[item] = wp.max(opacity, wp.min(opacity / (1.0 - part), ALPHA_MAX))


@wp.kernel
def add_shape_gradients_kernel(
    first: int,
    shapes: Shapes,
    scale_gradients: wp.array[wp.vec3],
    opacity_gradients: wp.array[float],
    out_log_scales: wp.array[wp.vec3],
    out_logits: wp.array[float],
):
    item = first + wp.tid()
    logs = shapes.log_scales[item]
    filter = shapes.filters[item]
    scales = wp.vec3(wp.exp(logs[0]), wp.exp(logs[1]), wp.exp(logs[2]))
    thin = smallest_axis(scales)
    peak = sigmoid(shapes.logits[item])
    kept = float(1.0)
    for axis in range(3):
        if axis != thin:
            kept *= part_of(scales[axis], widened(scales[axis], filter))
    opacity_gradient = opacity_gradients[item]
    gradient = scale_gradients[item]
    found = out_log_scales[item]
    for axis in range(3):
        scale = scales[axis]
        if axis == thin:
            found[axis] += gradient[axis] * scale
        else:
            # ds'/dlog s = s^2 / s'; dlog(s / s')/dlog s = 1 - s^2 / s'^2 = (f / s')^2
            wide = widened(scale, filter)
            gone = float(0.0)
            if filter > 0.0:
                gone = filter / wide
            found[axis] += gradient[axis] * scale * part_of(scale, wide)
            found[axis] += opacity_gradient * peak * kept * gone * gone
    out_log_scales[item] = found
    out_logits[item] += opacity_gradient * kept * peak * (1.0 - peak)


launch_activate = launcher(activate_kernel)
"""Write the scales and opacities that are drawn."""

launch_drop_out = launcher(drop_out_kernel)
"""Leave out a part of the Gaussians that are drawn, and count the turn of each: the next one leaves out others."""


def launch_add_shape_gradients(
    shapes: Shapes, scale_gradients: Any, opacity_gradients: Any, out_log_scales: Any, out_logits: Any, device: Any
) -> None:
    """Add the gradients of what is moved, given those of what is drawn."""
    inputs = [shapes, scale_gradients, opacity_gradients]
    outputs = [out_log_scales, out_logits]
    launch(add_shape_gradients_kernel, scale_gradients.size, inputs=inputs, outputs=outputs, device=device)
