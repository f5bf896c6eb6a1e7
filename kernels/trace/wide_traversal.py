"""Rays through the wide tree, one ray at a time.

`traversal` makes the loop over nodes and leaves for one question; this module asks three: transmittance, one sampled
hit, and the layer around a point. `closest_surface` and `visibility_adjoint` ask the others. `visibility` has a loop of
its own, in which one thread works through many rays.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.sampling import hash_combine, unit_float
from beam_warp.kernels.trace.gaussian import Gaussians
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.surface_layer import SurfaceLayer, add_to_layer
from beam_warp.kernels.trace.wide_tree import (
    Stack,
    WideTree,
    first_bit,
    load_leaf,
    lowest_bit,
    meet_leaf,
    meet_node,
    reciprocal,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class TracedRay:
    """A ray as a traversal asks about it; a question sets what it reads."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float  # nodes that end before it are passed over
    t_max: float
    index_min: int  # at t_min, Gaussians up to this one are passed over
    stream: wp.uint32  # random stream; Bernoulli acceptance draws from (stream, Gaussian)


@wp.func
def traced_ray(origin: wp.vec3, direction: wp.vec3, t_max: float) -> TracedRay:
    """A ray from its origin on, without a random stream."""
    ray = TracedRay()
    ray.origin = origin
    ray.direction = direction
    ray.t_max = t_max
    return ray


@wp.func
def whole_reach(ray: TracedRay, found: Any) -> float:
    """The ray's own reach, whatever was found."""
    return ray.t_max


@wp.func
def never_done(settings: TraceSettings, found: Any) -> bool:
    """A question that every leaf on the way may answer."""
    return False


def traversal(name, visit, *, reach=whole_reach, is_done=never_done, ordered=False, in_place=False):
    """Make the function that takes a ray through the wide tree and returns what it found.

    The stack holds (first node, axis, mask of what is left) in one number, 26, 2 and 4 bits, one a level. Children are
    met in a static order unless ``ordered``: sorting them by distance lowers the hits of a ray by 3 % and costs more
    than that.

    Everything is resolved when the kernel is compiled: the functions given are called directly and inlined, so a
    question carries no state but its own.

    Args:
        name: Of the function.
        visit: ``visit(tree, gaussians, settings, ray, found, leaf)`` returns ``found`` after a leaf whose box is met.
            The type of ``found``, a number or a structure, is the question's own.
        reach: ``reach(ray, found)`` returns how far nodes are looked for.
        is_done: ``is_done(settings, found)``, asked after each leaf, ends the traversal.
        ordered: Meet children from near to far along their node's axis.
        in_place: ``visit`` and ``reach`` take ``found`` by `wp.ref`, and ``visit`` changes it and returns nothing: for
            what is too large to be copied at every leaf.

    Returns:
        A Warp function of (tree, gaussians, settings, ray, found at the start).
    """
    Found = visit.input_types["found"]
    Found = Found.value_type if in_place else Found

    @wp.func(name=name)
    def traverse(tree: WideTree, gaussians: Gaussians, settings: TraceSettings, ray: TracedRay, start: Found) -> Found:
        inverse = reciprocal(ray.direction)
        stack = Stack()
        depth = int(0)
        first_node = int(0)
        inner = int(1)
        axis = int(0)
        found = start
        while inner != 0:
            bit = lowest_bit(inner)
            remaining = inner & (inner - 1)
            if ordered:
                bit = first_bit(inner, ray.direction[axis] < 0.0)
                remaining = inner & ~(1 << bit)
            node = first_node + bit
            if remaining != 0:
                entry = (first_node << 6) | remaining
                if ordered:
                    entry = entry | (axis << 4)
                stack[depth] = entry
                depth += 1
            hits = meet_node(tree, node, ray.origin, inverse, ray.t_min, reach(ray, found))
            first_node = hits.first_node
            inner = hits.inner
            axis = hits.axis
            leaf = hits.leaf
            while leaf != 0:
                if wp.static(in_place):
                    visit(tree, gaussians, settings, ray, found, hits.first_leaf + lowest_bit(leaf))
                else:
                    found = visit(tree, gaussians, settings, ray, found, hits.first_leaf + lowest_bit(leaf))
                leaf = leaf & (leaf - 1)
                if is_done(settings, found):
                    leaf = 0
                    inner = 0
                    depth = 0
            if inner == 0 and depth > 0:
                depth -= 1
                first_node = stack[depth] >> 6
                axis = (stack[depth] >> 4) & 3
                inner = stack[depth] & 15
        return found

    return traverse


@wp.func
def pass_gaussian(
    tree: WideTree, gaussians: Gaussians, settings: TraceSettings, ray: TracedRay, found: float, leaf: int
) -> float:
    """Transmittance behind a Gaussian, or behind a Bernoulli sample of it."""
    peak = meet_leaf(tree, gaussians, settings, leaf, ray.origin, ray.direction, ray.t_max)
    v = found
    if peak.alpha > 0.0:
        if settings.bernoulli == 1:
            if unit_float(hash_combine(ray.stream, wp.uint32(peak.index))) < peak.alpha:
                v = 0.0
        else:
            v = v * (1.0 - peak.alpha)
    return v


@wp.func
def is_dark(settings: TraceSettings, found: float) -> bool:
    return found < settings.stop or found == 0.0


pass_all = traversal("pass_all", pass_gaussian, is_done=is_dark)


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
    ray = traced_ray(origin, direction, t_max)
    ray.stream = stream
    return pass_all(tree, gaussians, settings, ray, 1.0)


@wp.struct
class NearestHit:
    """The nearest Gaussian so far that stopped a ray."""

    index: int  # -1 for none
    t: float  # the ray's reach for none


@wp.func
def draw_gaussian(
    tree: WideTree, gaussians: Gaussians, settings: TraceSettings, ray: TracedRay, found: NearestHit, leaf: int
) -> NearestHit:
    """Stop the ray at a Gaussian with probability alpha."""
    peak = meet_leaf(tree, gaussians, settings, leaf, ray.origin, ray.direction, found.t)
    result = found
    if peak.alpha > 0.0 and unit_float(hash_combine(ray.stream, wp.uint32(peak.index))) < peak.alpha:
        result.index = peak.index
        result.t = peak.t
    return result


@wp.func
def reach_of_nearest(ray: TracedRay, found: NearestHit) -> float:
    return found.t


draw_nearest = traversal("draw_nearest", draw_gaussian, reach=reach_of_nearest)


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
    ray = traced_ray(origin, direction, t_max)
    ray.stream = stream
    nearest = NearestHit()
    nearest.index = -1
    nearest.t = t_max
    return draw_nearest(tree, gaussians, settings, ray, nearest).index


@wp.func
def join_layer(
    tree: WideTree, gaussians: Gaussians, settings: TraceSettings, ray: TracedRay, found: SurfaceLayer, leaf: int
) -> SurfaceLayer:
    return add_to_layer(found, gaussians, load_leaf(tree, leaf).index, ray.origin, ray.direction)


join_all = traversal("join_all", join_layer)


@wp.func
def tree_layer(tree: WideTree, gaussians: Gaussians, p: wp.vec3, n: wp.vec3) -> SurfaceLayer:
    """The layer of Gaussians that contain a point; a ray of no reach meets just the boxes around its origin."""
    return join_all(tree, gaussians, TraceSettings(), traced_ray(p, n, 0.0), SurfaceLayer())
