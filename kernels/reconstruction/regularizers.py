"""Terms on Gaussians alone: each writes what it adds to the loss, and adds its gradients; `fixed_sums` adds it up."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})

POLE = wp.constant(1.0e-4)
"""The entropy's slope is that at this distance from 0 and 1 where an opacity is nearer: it has poles there."""


@wp.func
def part_of(mask: wp.array[float], i: int) -> float:
    """What a Gaussian counts: 1 without a mask."""
    part = float(1.0)
    if mask:
        part = mask[i]
    return part


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
def add_flatness_kernel(
    first: int,
    scales: wp.array2d[float],
    spacings: wp.array[float],
    mask: wp.array[float],
    scale: float,
    out_terms: wp.array[float],
    out_gradient: wp.array2d[float],
):
    i = first + wp.tid()
    weight = part_of(mask, i)
    term = float(0.0)
    if weight != 0.0:
        shortest = order_of(scales, i)[0]
        term = weight * scales[i, shortest] / spacings[i]
        if out_gradient:
            out_gradient[i, shortest] += scale * weight / spacings[i]
    out_terms[i] = term


@wp.kernel
def add_anisotropy_kernel(
    first: int,
    scales: wp.array2d[float],
    limit: float,
    mask: wp.array[float],
    scale: float,
    out_terms: wp.array[float],
    out_gradient: wp.array2d[float],
):
    i = first + wp.tid()
    weight = part_of(mask, i)
    term = float(0.0)
    if weight != 0.0:
        order = order_of(scales, i)
        middle = scales[i, order[1]]
        ratio = scales[i, order[2]] / middle
        if ratio > limit:
            term = weight * (ratio - limit)
            if out_gradient:
                out_gradient[i, order[2]] += scale * weight / middle
                out_gradient[i, order[1]] -= scale * weight * ratio / middle
    out_terms[i] = term


@wp.kernel
def write_longest_kernel(first: int, scales: wp.array2d[float], mask: wp.array[float], out_longest: wp.array[float]):
    i = first + wp.tid()
    longest = float(0.0)
    weight = part_of(mask, i)
    if weight != 0.0:
        longest = weight * scales[i, order_of(scales, i)[2]]
    out_longest[i] = longest


@wp.kernel
def add_size_kernel(
    first: int,
    scales: wp.array2d[float],
    total: wp.array[float],
    parts: wp.array[float],
    low: float,
    high: float,
    mask: wp.array[float],
    scale: float,
    out_terms: wp.array[float],
    out_gradient: wp.array2d[float],
):
    i = first + wp.tid()
    weight = part_of(mask, i)
    term = float(0.0)
    if weight != 0.0:
        mean = total[0] / parts[0]
        longest = order_of(scales, i)[2]
        size = scales[i, longest] / mean
        slope = float(0.0)
        if size > high:
            term = weight * (size - high)
            slope = 1.0
        elif size < low:
            term = weight * (low - size)
            slope = -1.0
        if out_gradient and slope != 0.0:
            out_gradient[i, longest] += scale * weight * slope / mean
    out_terms[i] = term


@wp.kernel
def write_parts_kernel(first: int, mask: wp.array[float], out_parts: wp.array[float]):
    i = first + wp.tid()
    out_parts[i] = part_of(mask, i)


@wp.kernel
def add_opacity_kernel(
    first: int,
    opacities: wp.array[float],
    mask: wp.array[float],
    scale: float,
    out_terms: wp.array[float],
    out_gradient: wp.array[float],
):
    i = first + wp.tid()
    weight = part_of(mask, i)
    term = float(0.0)
    if weight != 0.0:
        term = weight * opacities[i]
        if out_gradient:
            out_gradient[i] += scale * weight
    out_terms[i] = term


@wp.func
def entropy_part(p: float) -> float:
    """-p ln p, which ends at 0."""
    part = float(0.0)
    if not (p <= 0.0):
        part = -p * wp.log(p)
    return part


@wp.kernel
def add_entropy_kernel(
    first: int,
    opacities: wp.array[float],
    mask: wp.array[float],
    scale: float,
    out_terms: wp.array[float],
    out_gradient: wp.array[float],
):
    i = first + wp.tid()
    weight = part_of(mask, i)
    term = float(0.0)
    if weight != 0.0:
        opacity = opacities[i]
        term = weight * (entropy_part(opacity) + entropy_part(1.0 - opacity))
        if out_gradient:
            kept = wp.clamp(opacity, POLE, 1.0 - POLE)
            out_gradient[i] += scale * weight * wp.log((1.0 - kept) / kept)
    out_terms[i] = term


def launch_add_flatness(
    scales: Any, spacings: Any, mask: Any, scale: float, out_terms: Any, out_gradient: Any, device: Any
) -> None:
    """Write min scale / spacing of every Gaussian, and add ``scale`` times its gradient."""
    launch(
        add_flatness_kernel,
        len(out_terms),
        inputs=[scales, spacings, mask, scale],
        outputs=[out_terms, out_gradient],
        device=device,
    )


def launch_add_anisotropy(
    scales: Any, limit: float, mask: Any, scale: float, out_terms: Any, out_gradient: Any, device: Any
) -> None:
    """Write max(longest / middle scale - limit, 0), and add ``scale`` times its gradient."""
    launch(
        add_anisotropy_kernel,
        len(out_terms),
        inputs=[scales, limit, mask, scale],
        outputs=[out_terms, out_gradient],
        device=device,
    )


def launch_write_longest(scales: Any, mask: Any, out_longest: Any, device: Any) -> None:
    """Write the longest scale of every Gaussian, times what it counts."""
    launch(write_longest_kernel, len(out_longest), inputs=[scales, mask], outputs=[out_longest], device=device)


def launch_write_parts(mask: Any, out_parts: Any, device: Any) -> None:
    """Write what every Gaussian counts."""
    launch(write_parts_kernel, len(out_parts), inputs=[mask], outputs=[out_parts], device=device)


def launch_add_size(
    scales: Any,
    total: Any,
    parts: Any,
    low: float,
    high: float,
    mask: Any,
    scale: float,
    out_terms: Any,
    out_gradient: Any,
    device: Any,
) -> None:
    """Write how far the longest scale is outside low to high times its mean, total / parts; add the gradient."""
    launch(
        add_size_kernel,
        len(out_terms),
        inputs=[scales, total, parts, low, high, mask, scale],
        outputs=[out_terms, out_gradient],
        device=device,
    )


def launch_add_opacity(opacities: Any, mask: Any, scale: float, out_terms: Any, out_gradient: Any, device: Any) -> None:
    """Write every opacity, and add ``scale`` to its gradient."""
    launch(
        add_opacity_kernel,
        len(out_terms),
        inputs=[opacities, mask, scale],
        outputs=[out_terms, out_gradient],
        device=device,
    )


def launch_add_entropy(opacities: Any, mask: Any, scale: float, out_terms: Any, out_gradient: Any, device: Any) -> None:
    """Write the entropy of every opacity, and add ``scale`` times its gradient."""
    launch(
        add_entropy_kernel,
        len(out_terms),
        inputs=[opacities, mask, scale],
        outputs=[out_terms, out_gradient],
        device=device,
    )
