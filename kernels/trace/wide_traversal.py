"""Rays through the wide tree, one ray at a time: transmittance, one sampled hit, and the layer around a point.

The stack holds (first node, mask of what is left) in one number, 28 and 4 bits, one a level. Children are met in a
static order: sorting them by distance lowers the hits of a ray by 3 % and costs more than that.

The loop stands here once for each question, and again in `trace`, `trace_counts`, `closest_surface` and
`visibility_adjoint`: Warp's functions take no callbacks, and a stack that is handed to a function is copied.
"""

import warp as wp

from beam_warp.kernels.common.sampling import hash_combine, unit_float
from beam_warp.kernels.trace.gaussian import Gaussians
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.surface_layer import SurfaceLayer, add_to_layer
from beam_warp.kernels.trace.wide_tree import Stack, WideTree, load_leaf, lowest_bit, meet_leaf, meet_node, reciprocal

wp.set_module_options({"enable_backward": False})


@wp.func
def tree_transmittance(
    tree: WideTree,
    gaussians: Gaussians,
    settings: TraceSettings,
    origin: wp.vec3,
    direction: wp.vec3,
    t_max: float,
    stream: wp.uint32,
) -> float:
    """Product of (1 - alpha) in any order, or one Bernoulli sample of it."""
    inverse = reciprocal(direction)
    stack = Stack()
    depth = int(0)
    first_node = int(0)
    inner = int(1)
    v = float(1.0)
    while inner != 0:
        node = first_node + lowest_bit(inner)
        inner = inner & (inner - 1)
        if inner != 0:
            stack[depth] = (first_node << 4) | inner
            depth += 1
        hits = meet_node(tree, node, origin, inverse, 0.0, t_max)
        first_node = hits.first_node
        inner = hits.inner
        leaf = hits.leaf
        while leaf != 0:
            peak = meet_leaf(tree, gaussians, settings, hits.first_leaf + lowest_bit(leaf), origin, direction, t_max)
            leaf = leaf & (leaf - 1)
            if peak.alpha > 0.0:
                if settings.bernoulli == 1:
                    if unit_float(hash_combine(stream, wp.uint32(peak.index))) < peak.alpha:
                        v = 0.0
                else:
                    v *= 1.0 - peak.alpha
                if v < settings.stop or v == 0.0:
                    leaf = 0
                    inner = 0
                    depth = 0
        if inner == 0 and depth > 0:
            depth -= 1
            first_node = stack[depth] >> 4
            inner = stack[depth] & 15
    return v


@wp.func
def tree_sampled_hit(
    tree: WideTree,
    gaussians: Gaussians,
    settings: TraceSettings,
    origin: wp.vec3,
    direction: wp.vec3,
    t_max: float,
    stream: wp.uint32,
) -> int:
    """The nearest of the Gaussians that each stop the ray with probability alpha, or -1."""
    inverse = reciprocal(direction)
    stack = Stack()
    depth = int(0)
    first_node = int(0)
    inner = int(1)
    nearest = int(-1)
    t_nearest = t_max
    while inner != 0:
        node = first_node + lowest_bit(inner)
        inner = inner & (inner - 1)
        if inner != 0:
            stack[depth] = (first_node << 4) | inner
            depth += 1
        hits = meet_node(tree, node, origin, inverse, 0.0, t_nearest)
        first_node = hits.first_node
        inner = hits.inner
        leaf = hits.leaf
        while leaf != 0:
            peak = meet_leaf(
                tree, gaussians, settings, hits.first_leaf + lowest_bit(leaf), origin, direction, t_nearest
            )
            leaf = leaf & (leaf - 1)
            if peak.alpha > 0.0 and unit_float(hash_combine(stream, wp.uint32(peak.index))) < peak.alpha:
                nearest = peak.index
                t_nearest = peak.t
        if inner == 0 and depth > 0:
            depth -= 1
            first_node = stack[depth] >> 4
            inner = stack[depth] & 15
    return nearest


@wp.func
def tree_layer(tree: WideTree, gaussians: Gaussians, p: wp.vec3, n: wp.vec3) -> SurfaceLayer:
    """The layer of Gaussians that contain a point; a ray of no reach meets just the boxes around its origin."""
    inverse = reciprocal(n)
    stack = Stack()
    depth = int(0)
    first_node = int(0)
    inner = int(1)
    layer = SurfaceLayer()
    while inner != 0:
        node = first_node + lowest_bit(inner)
        inner = inner & (inner - 1)
        if inner != 0:
            stack[depth] = (first_node << 4) | inner
            depth += 1
        hits = meet_node(tree, node, p, inverse, 0.0, 0.0)
        first_node = hits.first_node
        inner = hits.inner
        leaf = hits.leaf
        while leaf != 0:
            index = load_leaf(tree, hits.first_leaf + lowest_bit(leaf)).index
            leaf = leaf & (leaf - 1)
            layer = add_to_layer(layer, gaussians, index, p, n)
        if inner == 0 and depth > 0:
            depth -= 1
            first_node = stack[depth] >> 4
            inner = stack[depth] & 15
    return layer
