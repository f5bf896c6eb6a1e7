"""Blurring an environment map with the GGX lobe seen head-on (n = v = r), once per roughness.

The map is a quadtree of lat-long cells. A cell far from the lobe's axis, compared with its own size, counts as one
direction: the place of its flux, so that a small sun is never moved. Every item walks the tree in the same order and
writes one texel: the result has the same bits for every chunking.

Source: Karis 2013 (the weight D (n·l) with n = v = r); Barnes and Hut 1986 (opening cells by size over distance).
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.light.latlong import latlong_to_direction

wp.set_module_options({"enable_backward": False})


@wp.struct
class FluxTree:
    """Cells in depth-first order: what follows a cell are its four quarters, unless it is a leaf."""

    direction: wp.array[wp.vec3]  # unit, weighted by solid angle
    size_squared: wp.array[float]  # of the largest chord across the cell; 0 for a leaf
    next_cell: wp.array[int]  # the cell after all those inside this one
    flux_direction: wp.array[wp.vec3]  # unit, weighted by flux
    flux: wp.array[wp.vec3]  # integral of L over the cell
    solid_angle: wp.array[float]


@wp.func
def ggx_lobe_weight(distance_squared: float, alpha: float) -> float:
    """D(h) (n·l) for n = v, up to a factor, from the squared chord between l and n, which does not cancel."""
    n_dot_l = 1.0 - 0.5 * distance_squared
    if n_dot_l <= 0.0:
        return 0.0
    sine_squared = 0.25 * distance_squared  # of the half vector
    denominator = sine_squared + (1.0 - sine_squared) * alpha * alpha
    return n_dot_l / (denominator * denominator)


@wp.kernel
def prefilter_environment_kernel(
    first: int,
    tree: FluxTree,
    alpha: float,
    growth: float,
    smallest: float,
    largest: float,
    height: int,
    out_offset: int,
    out_texels: wp.array[wp.vec3],
):
    item = first + wp.tid()
    width = 2 * height
    axis = latlong_to_direction(
        (float(item % width) + 0.5) / float(width), (float(item // width) + 0.5) / float(height)
    )
    total = wp.vec3(0.0, 0.0, 0.0)
    weight = float(0.0)
    cell = int(0)
    cell_count = tree.next_cell.shape[0]
    while cell < cell_count:
        away = axis - tree.direction[cell]
        distance_squared = wp.dot(away, away)
        if tree.size_squared[cell] > wp.clamp(growth * distance_squared * wp.sqrt(distance_squared), smallest, largest):
            cell += 1
        else:
            to_flux = axis - tree.flux_direction[cell]
            total += tree.flux[cell] * ggx_lobe_weight(wp.dot(to_flux, to_flux), alpha)
            weight += tree.solid_angle[cell] * ggx_lobe_weight(distance_squared, alpha)
            cell = tree.next_cell[cell]
    out_texels[out_offset + item] = total / weight


def launch_prefilter_environment(
    tree: Any, *, alpha: float, opening: float, height: int, offset: int, out_texels: wp.array, device: Any
) -> None:
    """Fill one lat-long level of ``height`` rows at ``offset`` of the flat array of levels.

    With w = 2 alpha the lobe's width, a cell at distance d is opened where its size exceeds ``opening`` · w near the
    axis and ``opening`` · d · sqrt(d / w) elsewhere: cells may grow faster than their distance, because the lobe's
    share of energy falls as 1 / d². Wide lobes bend at the horizon, hence a largest size.
    """
    width = 2.0 * alpha
    largest = 0.04 / alpha
    smallest = min((opening * width) ** 2, largest)
    inputs = [tree, alpha, opening * opening / width, smallest, largest, height, offset]
    launch(prefilter_environment_kernel, 2 * height * height, inputs=inputs, outputs=[out_texels], device=device)
