"""Terms on Gaussians alone: each writes what it adds to the loss, and adds its gradients; `fixed_sums` adds it up."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})


@wp.func
def order_of(scales: wp.array2d[float], i: int) -> wp.vec3i:
    """Axes from the shortest to the longest; equal ones in their own order."""
    a = int(0)
    b = int(1)
    c = int(2)
    if scales[i, b] < scales[i, a]:
        a = int(1)
        b = int(0)
    if scales[i, c] < scales[i, b]:
        c = b
        b = int(2)
        if scales[i, b] < scales[i, a]:
            b = a
            a = int(2)
    return wp.vec3i(a, b, c)


@wp.kernel
def add_anisotropy_kernel(
    first: int,
    scales: wp.array2d[float],
    limit: float,
    scale: float,
    out_terms: wp.array[float],
    out_gradient: wp.array2d[float],
):
    i = first + wp.tid()
    term = float(0.0)
    order = order_of(scales, i)
    middle = scales[i, order[1]]
    ratio = scales[i, order[2]] / middle
    if ratio > limit:
        term = ratio - limit
        if out_gradient:
            out_gradient[i, order[2]] += scale / middle
            out_gradient[i, order[1]] -= scale * ratio / middle
    out_terms[i] = term


@wp.kernel
def add_opacity_kernel(
    first: int,
    opacities: wp.array[float],
    scale: float,
    out_terms: wp.array[float],
    out_gradient: wp.array[float],
):
    i = first + wp.tid()
    out_terms[i] = opacities[i]
    if out_gradient:
        out_gradient[i] += scale


def launch_add_anisotropy(
    scales: Any, limit: float, scale: float, out_terms: Any, out_gradient: Any, device: Any
) -> None:
    """Write max(longest / middle scale - limit, 0), and add ``scale`` times its gradient."""
    launch(
        add_anisotropy_kernel,
        len(out_terms),
        inputs=[scales, limit, scale],
        outputs=[out_terms, out_gradient],
        device=device,
    )


def launch_add_opacity(opacities: Any, scale: float, out_terms: Any, out_gradient: Any, device: Any) -> None:
    """Write every opacity, and add ``scale`` to its gradient."""
    launch(
        add_opacity_kernel,
        len(out_terms),
        inputs=[opacities, scale],
        outputs=[out_terms, out_gradient],
        device=device,
    )
