"""Reverse pass of visibility: each ray is traversed again, and its hits are handed to the Gaussians that they hit.

V = product of (1 - alpha_i), so dV/dlog(alpha_i) = -V alpha_i / (1 - alpha_i) whatever the order. Autodiff through the
traversal's loop is silently wrong; here the first traversal counts hits and finds V, the second stores them at slots
that belong to the ray alone, and after a stable sort by Gaussian each Gaussian's hits are added in the order of rays.
No float atomics: the same bits in every run, for any number of threads.

`tally_all` and `store_all` are the two traversals; they meet hits in the same order.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.constants import ALPHA_MAX
from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.mesh.occluder import mesh_blocks
from beam_warp.kernels.trace.gaussian import Gaussians
from beam_warp.kernels.trace.hit_gradients import (
    HitGradients,
    HitMoments,
    HitRecords,
    add_hits,
    add_sums,
    log_response_slope,
    orientation_gradient,
    scale_gradient,
    single,
    transposed_whitening_times,
    whitened_closest_point,
)
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.wide_traversal import TracedRay, traced_ray, traversal
from beam_warp.kernels.trace.wide_tree import LeafPeak, WideTree, meet_leaf

wp.set_module_options({"enable_backward": False})


SUM_BLOCK = wp.constant(256)
"""Hits in a block that one thread sums: a Gaussian with n hits costs its thread at most 512 + n / 256 additions."""


@wp.struct
class HitTally:
    """What the first traversal of a ray finds."""

    transmittance: float
    count: int  # of hits that have a gradient: alpha at its cap has none


@wp.struct
class RayReturn:
    """What the second traversal of a ray carries."""

    weight: float  # -V times the ray's adjoint
    hits: HitRecords  # where hits go
    slot: int  # of the next hit
    end: int
    origin: wp.vec3  # gradients with respect to the ray
    direction: wp.vec3


@wp.func
def store_hit(start: RayReturn, gaussians: Gaussians, peak: LeafPeak, ray: TracedRay) -> RayReturn:
    """Store a hit, unless it has no gradient, and add that gradient to the ray's."""
    result = start
    if peak.alpha < ALPHA_MAX:
        q = whitened_closest_point(gaussians, peak.index, ray.origin, ray.direction)
        e = start.weight * peak.alpha / (1.0 - peak.alpha)
        start.hits.gaussian[start.slot] = peak.index
        start.hits.record[start.slot] = wp.vec4(q[0], q[1], q[2], e)
        w = e * log_response_slope(gaussians.degree, wp.dot(q, q))
        pull = transposed_whitening_times(gaussians, peak.index, q) * (2.0 * w)
        result.origin += pull
        result.direction += pull * peak.t
        result.slot += 1
    return result


@wp.func
def tally_leaf(
    tree: WideTree, gaussians: Gaussians, settings: TraceSettings, ray: TracedRay, found: HitTally, leaf: int
) -> HitTally:
    peak = meet_leaf(tree, gaussians, settings, leaf, ray.origin, ray.direction, ray.t_max)
    tally = found
    if peak.alpha > 0.0:
        tally.transmittance *= 1.0 - peak.alpha
        if peak.alpha < ALPHA_MAX:
            tally.count += 1
    return tally


@wp.func
def is_tally_dark(settings: TraceSettings, found: HitTally) -> bool:
    return found.transmittance < settings.stop


tally_all = traversal("tally_all", tally_leaf, is_done=is_tally_dark)
"""V and the number of hits with gradients, over what `tree_transmittance` visits."""


@wp.func
def store_leaf(
    tree: WideTree, gaussians: Gaussians, settings: TraceSettings, ray: TracedRay, found: RayReturn, leaf: int
) -> RayReturn:
    peak = meet_leaf(tree, gaussians, settings, leaf, ray.origin, ray.direction, ray.t_max)
    result = found
    if peak.alpha > 0.0:
        result = store_hit(found, gaussians, peak, ray)
    return result


@wp.func
def is_full(settings: TraceSettings, found: RayReturn) -> bool:
    return found.slot == found.end


store_all = traversal("store_all", store_leaf, is_done=is_full)
"""Store the hits that `tally_all` counted: it ends after as many, which is where that one stopped."""


@wp.struct
class WeightedRays:
    """A batch of rays, and the gradient of the loss with respect to each one's visibility."""

    origins: wp.array[wp.vec3]
    directions: wp.array[wp.vec3]
    reaches: wp.array[float]  # one number, or one for each ray
    adjoints: wp.array[float]


@wp.struct
class HitTallies:
    """A `HitTally` for each ray."""

    transmittance: wp.array[float]
    count: wp.array[int]


@wp.struct
class RayGradients:
    """Gradients with respect to the rays of a batch."""

    origins: wp.array[wp.vec3]
    directions: wp.array[wp.vec3]


@wp.kernel
def count_hits_kernel(first: int, occluders: Any, settings: TraceSettings, rays: WeightedRays, out_tallies: HitTallies):
    """First traversal. A ray with adjoint 0 has no gradient to hand on and is not traced."""
    i = first + wp.tid()
    tally = HitTally()
    if rays.adjoints[i] != 0.0:
        t_max = rays.reaches[wp.min(i, rays.reaches.shape[0] - 1)]
        origin = rays.origins[i] - occluders.origin
        if not mesh_blocks(occluders.mesh, origin, rays.directions[i], t_max):
            tally.transmittance = 1.0
            ray = traced_ray(origin, rays.directions[i], t_max)
            tally = tally_all(occluders.tree, occluders.gaussians, settings, ray, tally)
    out_tallies.transmittance[i] = tally.transmittance
    out_tallies.count[i] = tally.count


launch_count_hits = launcher(count_hits_kernel, block_dim=64)
"""Trace one ray a thread and count the hits that have gradients."""


@wp.kernel
def store_hits_kernel(
    first: int,
    occluders: Any,
    settings: TraceSettings,
    rays: WeightedRays,
    tallies: HitTallies,
    slot_ends: wp.array[int],
    out_hits: HitRecords,
    out_order: wp.array[int],
    out_rays: RayGradients,
):
    """Second traversal. ``slot_ends`` is the inclusive scan of the tallies' counts; ``out_order`` numbers the slots."""
    i = first + wp.tid()
    ray = RayReturn()
    ray.weight = -rays.adjoints[i] * tallies.transmittance[i]
    ray.end = slot_ends[i]
    begin = ray.end - tallies.count[i]
    ray.hits = out_hits
    ray.slot = begin
    if begin < ray.end:
        t_max = rays.reaches[wp.min(i, rays.reaches.shape[0] - 1)]
        origin = rays.origins[i] - occluders.origin
        traced = traced_ray(origin, rays.directions[i], t_max)
        ray = store_all(occluders.tree, occluders.gaussians, settings, traced, ray)
    # The compiler may round a tie differently in the two traversals; then a slot stays free, and none overflows.
    for slot in range(ray.slot, ray.end):
        out_hits.gaussian[slot] = occluders.gaussians.center_opacity.shape[0]
    for slot in range(begin, ray.end):
        out_order[slot] = slot
    out_rays.origins[i] = ray.origin
    out_rays.directions[i] = ray.direction


launch_store_hits = launcher(store_hits_kernel, block_dim=64)
"""Trace one ray a thread and store its hits."""


@wp.func
def first_not_below(sorted_values: wp.array[int], begin: int, end: int, value: int) -> int:
    """First place in ``begin`` to ``end`` whose value is not below ``value``; ``end`` if there is none.

    ``wp.lower_bound`` returns ``end - 1`` in that case.
    """
    low = begin
    high = end
    while low < high:
        middle = low + (high - low) // 2
        if sorted_values[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def sum_blocks_kernel(first: int, degree: int, hits: HitRecords, order: wp.array[int], out_sums: wp.array[HitMoments]):
    """Sum each block of `SUM_BLOCK` sorted hits that are all of one Gaussian; the other sums are not used."""
    i = first + wp.tid()
    begin = i * SUM_BLOCK
    end = begin + SUM_BLOCK
    if hits.gaussian[begin] == hits.gaussian[end - 1]:
        out_sums[i] = add_hits(HitMoments(), degree, hits.record, order, begin, end)


launch_sum_blocks = launcher(sum_blocks_kernel)
"""Sum whole blocks of sorted hits, one a thread, so that a Gaussian that all rays hit is not one thread's work."""


@wp.kernel
def add_moments_kernel(
    first: int,
    degree: int,
    hits: HitRecords,
    order: wp.array[int],
    hit_count: int,
    sums: wp.array[HitMoments],
    out_moments: wp.array[HitMoments],
):
    """``hits.gaussian`` is sorted, ``order`` says at which slot each hit's record is."""
    i = first + wp.tid()
    begin = first_not_below(hits.gaussian, 0, hit_count, i)
    end = first_not_below(hits.gaussian, begin, hit_count, i + 1)
    if begin < end:
        total = out_moments[i]
        first_block = (begin + SUM_BLOCK - 1) // SUM_BLOCK
        end_block = end // SUM_BLOCK
        if first_block < end_block:
            total = add_hits(total, degree, hits.record, order, begin, first_block * SUM_BLOCK)
            total = add_sums(total, sums, first_block, end_block)
            begin = end_block * SUM_BLOCK
        out_moments[i] = add_hits(total, degree, hits.record, order, begin, end)


launch_add_moments = launcher(add_moments_kernel)
"""Add sorted hits to the moments of their Gaussians, one Gaussian a thread; ``sums`` from `launch_sum_blocks`."""


@wp.kernel
def resolve_moments_kernel(
    first: int,
    gaussians: Gaussians,
    orientations: wp.array[wp.quat],
    scales: wp.array[wp.vec3],
    smallest_scale: float,
    largest_ratio: float,
    moments: wp.array[HitMoments],
    out_gradients: HitGradients,
):
    """Gradients of the cloud's arrays by a Gaussian's moments; 0 for Gaussians that take no part."""
    i = first + wp.tid()
    position = wp.vec3()
    orientation = wp.vec4()
    scale = wp.vec3()
    opacity = float(0.0)
    if gaussians.whitening_0[i][3] > 0.0:
        total = moments[i]
        given = scales[i]
        floor = wp.max(smallest_scale, wp.max(given) * largest_ratio)  # as `pack_gaussians_kernel`
        raised = wp.vec3(wp.max(given[0], floor), wp.max(given[1], floor), wp.max(given[2], floor))
        opacity = wp.float32(total.weight) / gaussians.center_opacity[i][3]
        position = -2.0 * transposed_whitening_times(gaussians, i, single(total.point))
        scale = scale_gradient(single(total.square), given, floor)
        orientation = orientation_gradient(single(total.cross), raised, orientations[i])
    out_gradients.positions[i] = position
    out_gradients.orientations[i] = orientation
    out_gradients.scales[i] = scale
    out_gradients.opacities[i] = opacity


launch_resolve_moments = launcher(resolve_moments_kernel)
"""Resolve every Gaussian's moments to its gradients."""
