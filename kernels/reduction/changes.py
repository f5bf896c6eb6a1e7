"""Merged Gaussians with what a refit adds to them, and the derivatives to that."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch, launch_adjoint, launcher

COLORS = wp.constant(5)


@wp.kernel(enable_backward=False)
def clip_kernel(first: int, out_values: wp.array2d[float]):
    """Base colour, roughness and occlusion in [0, 1]."""
    i = first + wp.tid()
    for k in range(COLORS):
        out_values[i, k] = wp.clamp(out_values[i, k], 0.0, 1.0)


@wp.kernel
def change_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    orientations: wp.array[wp.quat],
    scales: wp.array[wp.vec3],
    logits: wp.array[float],
    values: wp.array2d[float],
    turns: wp.array[wp.quat],
    shift: wp.array[wp.vec3],
    turn: wp.array[wp.quat],
    stretch: wp.array[wp.vec3],
    logit: wp.array[float],
    materials: wp.array2d[float],
    out_positions: wp.array[wp.vec3],
    out_orientations: wp.array[wp.quat],
    out_scales: wp.array[wp.vec3],
    out_opacities: wp.array[float],
    out_values: wp.array2d[float],
):
    """Changes are in the axes of the reference frame, which ``turns`` take to this one's."""
    i = first + wp.tid()
    since = turns[i]
    out_positions[i] = positions[i] + wp.quat_rotate(since, shift[i])
    out_orientations[i] = orientations[i] * turn[i]
    s = stretch[i]
    out_scales[i] = wp.cw_mul(scales[i], wp.vec3(wp.exp(s[0]), wp.exp(s[1]), wp.exp(s[2])))
    out_opacities[i] = 1.0 / (1.0 + wp.exp(-(logits[i] + logit[i])))
    for k in range(COLORS):
        out_values[i, k] = values[i, k] + materials[i, k]
    lean = wp.quat_rotate(since, wp.vec3(materials[i, 5], materials[i, 6], materials[i, 7]))
    normal = wp.normalize(wp.vec3(values[i, 5], values[i, 6], values[i, 7]) + lean)
    out_values[i, 5] = normal[0]
    out_values[i, 6] = normal[1]
    out_values[i, 7] = normal[2]


launch_clip = launcher(clip_kernel)


def launch_change(merged: Any, changes: Any, out_gaussians: Any, device: Any) -> None:
    """Write the changed Gaussians; colours beyond their range are cut."""
    launch(change_kernel, len(merged[0]), inputs=[*merged, *changes], outputs=[*out_gaussians], device=device)
    launch_clip(len(merged[0]), out_gaussians[-1], device)


def launch_change_adjoint(
    merged: Any, changes: Any, gaussians: Any, gradients: Any, out_slopes: Any, device: Any
) -> None:
    """Overwrite the derivatives to the changes, from those to the changed Gaussians, as if no colour were cut."""
    for slopes in out_slopes:
        slopes.zero_()
    launch_adjoint(
        change_kernel,
        range(len(merged[0])),
        inputs=[*merged, *changes],
        outputs=[*gaussians],
        input_gradients=[*[None] * len(merged), *out_slopes],
        output_gradients=[*gradients],
        device=device,
    )
