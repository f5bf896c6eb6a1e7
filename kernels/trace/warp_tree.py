"""Traversal of Warp's own binary hierarchy: the simple backend, and the check on the wide one."""

import warp as wp

from beam_warp.kernels.common.constants import DIRECTION_FLOOR
from beam_warp.kernels.common.sampling import hash_combine, unit_float
from beam_warp.kernels.trace.gaussian import Gaussians, ray_peak
from beam_warp.kernels.trace.settings import TraceSettings, counts


@wp.struct
class WarpTree:
    """A ``wp.Bvh`` over the Gaussians' bounds."""

    bvh: wp.uint64


@wp.func
def box_test_direction(direction: wp.vec3) -> wp.vec3:
    """Replaces zero components, for which a slab test computes 0 * inf and loses hits on box planes."""
    safe = direction
    for k in range(3):
        if wp.abs(direction[k]) < DIRECTION_FLOOR:
            safe[k] = wp.where(direction[k] < 0.0, -DIRECTION_FLOOR, DIRECTION_FLOOR)
    return safe


@wp.func
def warp_tree_transmittance(
    tree: WarpTree,
    gaussians: Gaussians,
    settings: TraceSettings,
    origin: wp.vec3,
    direction: wp.vec3,
    t_max: float,
    stream: wp.uint32,
) -> float:
    """Product of (1 - alpha) in any order, or one Bernoulli sample of it."""
    v = float(1.0)
    query = wp.bvh_query_ray(tree.bvh, origin, box_test_direction(direction))
    index = int(0)
    # Boxes are met at their entry, which lies before the peak: reach is no nearer than t_max.
    while wp.bvh_query_next(query, index, t_max):
        peak = ray_peak(gaussians, index, origin, direction)
        if counts(gaussians, settings, index, peak, direction, t_max):
            if settings.bernoulli == 1:
                if unit_float(hash_combine(stream, wp.uint32(index))) < peak.alpha:
                    v = 0.0
                    break
            else:
                v *= 1.0 - peak.alpha
                if v < settings.stop:
                    break
    return v


@wp.func
def warp_tree_sampled_hit(
    tree: WarpTree,
    gaussians: Gaussians,
    settings: TraceSettings,
    origin: wp.vec3,
    direction: wp.vec3,
    t_max: float,
    stream: wp.uint32,
) -> int:
    """The nearest of the Gaussians that each stop the ray with probability alpha, or -1."""
    nearest = int(-1)
    t_nearest = t_max
    query = wp.bvh_query_ray(tree.bvh, origin, box_test_direction(direction))
    index = int(0)
    while wp.bvh_query_next(query, index, t_nearest):
        peak = ray_peak(gaussians, index, origin, direction)
        if counts(gaussians, settings, index, peak, direction, t_nearest):
            if unit_float(hash_combine(stream, wp.uint32(index))) < peak.alpha:
                nearest = index
                t_nearest = peak.t
    return nearest
