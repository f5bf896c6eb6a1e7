"""What a ray sees, front to back: depth, normal, blended attributes and what is left of the light.

Hits are collected in rounds of the nearest `BUFFER_SIZE` behind the last one, in the order (t, index), so that
coincident Gaussians are neither lost nor counted twice; then they are blended, until transmittance falls below the
stop. What lies behind hits that bring it there is not looked for.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.mesh.occluder import nearest_on_mesh
from beam_warp.kernels.trace.gaussian import Gaussians, ray_peak, whitening_times
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.wide_traversal import TracedRay, traced_ray, traversal
from beam_warp.kernels.trace.wide_tree import WideTree, meet_leaf

wp.set_module_options({"enable_backward": False})

BUFFER_SIZE = 48
"""Hits of a round: a surface of overlapping Gaussians stops most rays after fewer, and a warp goes through its tree
again for each of its rays that wants more."""

DARK = wp.constant(0.9)
"""Part of the stop below which the product of all hits is below the stop in any order, rounded or not."""

HIT_THREADS = 64
"""Most threads of a block of the kernels that keep hits: each has a column of shared memory."""

Hits = wp.types.vector(length=BUFFER_SIZE, dtype=wp.uint64)
LAST = wp.constant(BUFFER_SIZE - 1)


@wp.struct
class HitBuffer:
    """The nearest hits of a round in order: the bits of t before the Gaussian's number, which sort like both."""

    hits: Hits  # on the CPU; a kernel on CUDA keeps them in shared memory, of the buffer that it began last
    count: int  # hits met, those that found no place included
    passed: float  # what the hits met let pass; -1 if that is below the stop


READ, INSERT, SORT = (wp.constant(k) for k in range(3))

_HITS = """
#if defined(__CUDA_ARCH__)
    constexpr int stride = WP_TILE_BLOCK_DIM < THREADS ? WP_TILE_BLOCK_DIM : THREADS;
    __shared__ wp::uint64 kept[SIZE * stride];
    wp::uint64* own = kept + threadIdx.x;
#else
    wp::uint64* own = &buffer.hits[0];
    const int stride = 1;
#endif
    // A heap, the farthest first: its root is what a nearer hit replaces.
    const auto sink = [&](wp::uint64 sunk, int size) {
        int to = 0;
        for (int child = 1; child < size; child = 2 * to + 1) {
            wp::uint64 farther = own[child * stride];
            if (child + 1 < size && own[(child + 1) * stride] > farther)
                farther = own[++child * stride];
            if (sunk >= farther)
                break;
            own[to * stride] = farther;
            to = child;
        }
        own[to * stride] = sunk;
    };
    if (action == 0)
        return own[place * stride];
    int size = wp::min(buffer.count, SIZE);
    if (action == 1) {
        ++buffer.count;
        if (size < SIZE) {
            for (; size > 0 && own[(size - 1) / 2 * stride] < hit; size = (size - 1) / 2)
                own[size * stride] = own[(size - 1) / 2 * stride];
            own[size * stride] = hit;
        } else if (hit < own[0])
            sink(hit, SIZE);
    } else
        while (--size > 0) {
            const wp::uint64 farthest = own[0];
            sink(own[size * stride], size);
            own[size * stride] = farthest;
        }
    return hit;
"""


@wp.func_native(_HITS.replace("SIZE", str(BUFFER_SIZE)).replace("THREADS", str(HIT_THREADS)))
def hits_of_thread(buffer: wp.ref[HitBuffer], action: int, hit: wp.uint64, place: int) -> wp.uint64:
    """Keep a hit, in the place of the farthest if the buffer is full; sort all, nearest first; or return one.

    Threads that find hits at different times wait for each other. A heap takes a few steps for each, where a sorted
    list took half its length. A thread's own array would lie in CUDA's local memory, where threads that look at
    different places wait for each other; in shared memory a place of every thread has a bank of its own.
    """
    ...


@wp.func_native("""
    union { float value; wp::uint32 bits; } time;
    time.value = t;
    return static_cast<wp::uint64>(time.bits) << 32 | static_cast<wp::uint32>(index);
""")
def packed_hit(t: float, index: int) -> wp.uint64:
    """The number that a hit of positive ``t`` is sorted by."""
    ...


@wp.func_native("""
    union { wp::uint32 bits; float value; } time;
    time.bits = static_cast<wp::uint32>(hit >> 32);
    return time.value;
""")
def time_of(hit: wp.uint64) -> float: ...


@wp.func
def insert_hit(buffer: wp.ref[HitBuffer], t: float, index: int):
    hits_of_thread(buffer, INSERT, packed_hit(t, index), 0)


@wp.func
def hit_time(buffer: wp.ref[HitBuffer], place: int) -> float:
    """``t`` of a hit."""
    return time_of(hits_of_thread(buffer, READ, wp.uint64(0), place))


@wp.func
def hit_index(buffer: wp.ref[HitBuffer], place: int) -> int:
    """Number of a hit's Gaussian."""
    return int(hits_of_thread(buffer, READ, wp.uint64(0), place) & wp.uint64(0xFFFFFFFF))


@wp.func
def insert_leaf(
    tree: WideTree, gaussians: Gaussians, settings: TraceSettings, ray: TracedRay, found: wp.ref[HitBuffer], leaf: int
):
    peak = meet_leaf(tree, gaussians, settings, leaf, ray.origin, ray.direction, ray.t_max)
    if peak.alpha > 0.0 and is_before(ray.t_min, ray.index_min, peak.t, peak.index):
        insert_hit(found, peak.t, peak.index)
        found.passed *= 1.0 - peak.alpha
        if found.passed < DARK * settings.stop:
            found.passed = -1.0


@wp.func
def reach_of_buffer(ray: TracedRay, found: wp.ref[HitBuffer]) -> float:
    """What lies behind a full buffer, or one that lets nothing pass, is passed over."""
    reach = ray.t_max
    if found.count >= BUFFER_SIZE or found.passed < 0.0:
        reach = wp.min(reach, hit_time(found, 0))
    return reach


@wp.func
def is_before(t: float, index: int, other_t: float, other_index: int) -> bool:
    return t < other_t or (t == other_t and index < other_index)


insert_all = traversal("insert_all", insert_leaf, reach=reach_of_buffer, ordered=True, in_place=True)


@wp.func
def nearest_hits(
    tree: WideTree,
    gaussians: Gaussians,
    settings: TraceSettings,
    origin: wp.vec3,
    direction: wp.vec3,
    t_last: float,
    index_last: int,
    t_max: float,
) -> HitBuffer:
    """The nearest hits behind (``t_last``, ``index_last``) and before ``t_max``, until they are below the stop."""
    ray = traced_ray(origin, direction, t_max)
    ray.t_min = t_last
    ray.index_min = index_last
    buffer = HitBuffer()
    buffer.passed = 1.0
    buffer = insert_all(tree, gaussians, settings, ray, buffer)
    hits_of_thread(buffer, SORT, wp.uint64(0), 0)
    return buffer


@wp.func
def entry_normal(gaussians: Gaussians, index: int, origin: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Unit normal of the support's ellipsoid where the ray enters it: R S^-1 y, y its point on the unit Gaussian.

    In the space of the unit Gaussian the ellipsoid is a sphere of the support's radius; normals carry over by the
    transpose of the whitening M = S^-1 R^T, which for a point y of that space is R S^-1 y.
    """
    center = load_row(gaussians.center_opacity, index)
    p = origin - wp.vec3(center[0], center[1], center[2])
    p = p - direction * wp.dot(p, direction)
    q = whitening_times(gaussians, index, p)
    d = whitening_times(gaussians, index, direction)
    dd = wp.dot(d, d)
    q = q - d * (wp.dot(q, d) / dd)
    a = load_row(gaussians.whitening_0, index)
    b = load_row(gaussians.whitening_1, index)
    c = load_row(gaussians.whitening_2, index)
    y = q - d * wp.sqrt(wp.max(a[3] - wp.dot(q, q), 0.0) / dd)
    normal = wp.vec3(a[0], a[1], a[2]) * y[0] + wp.vec3(b[0], b[1], b[2]) * y[1] + wp.vec3(c[0], c[1], c[2]) * y[2]
    return wp.normalize(normal)


@wp.struct
class SurfaceRecords:
    """What rays see, one row each."""

    depth: wp.array[float]
    expected_depth: wp.array[float]
    normals: wp.array[wp.vec3]
    attributes: wp.array2d[float]
    transmittance: wp.array[float]
    gaussians: wp.array[int]
    hit_counts: wp.array[int]
    mesh_depth: wp.array[float]
    mesh_faces: wp.array[int]


@wp.kernel
def trace_surface_kernel(
    first: int,
    occluders: Any,
    settings: TraceSettings,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    reaches: wp.array[float],
    threshold: float,
    attributes: wp.array2d[float],
    out_records: SurfaceRecords,
):
    i = first + wp.tid()
    origin = origins[i] - occluders.origin
    direction = directions[i]
    reach = reaches[wp.min(i, reaches.shape[0] - 1)]
    mesh = nearest_on_mesh(occluders.mesh, origin, direction, reach)
    channels = attributes.shape[1]
    for channel in range(channels):
        out_records.attributes[i, channel] = 0.0
    transmittance = float(1.0)
    opacity = float(0.0)  # sum of the weights: 1 - transmittance would lose digits of faint hits
    depth = float(0.0)
    normal = wp.vec3()
    threshold_depth = float(wp.inf)
    threshold_gaussian = int(-1)
    hits = int(0)
    t_last = float(0.0)
    index_last = int(-1)
    more = int(1)
    while more == 1:
        buffer = nearest_hits(
            occluders.tree, occluders.gaussians, settings, origin, direction, t_last, index_last, mesh.t
        )
        taken = wp.min(buffer.count, BUFFER_SIZE)
        k = int(0)
        while k < taken and transmittance >= settings.stop:
            t = hit_time(buffer, k)
            index = hit_index(buffer, k)
            peak = ray_peak(occluders.gaussians, index, origin, direction)
            if peak.alpha > 0.0:  # at the support's edge leaf and packed rows may round to different sides
                weight = transmittance * peak.alpha
                opacity += weight
                depth += weight * t
                normal += entry_normal(occluders.gaussians, index, origin, direction) * weight
                for channel in range(channels):
                    out_records.attributes[i, channel] += weight * attributes[index, channel]
                transmittance *= 1.0 - peak.alpha
                hits += 1
                if threshold_gaussian < 0 and transmittance < threshold:
                    threshold_gaussian = index
                    threshold_depth = t
            k += 1
        t_last = hit_time(buffer, LAST)
        index_last = hit_index(buffer, LAST)
        more = 0
        # A full buffer may have hidden others from view.
        if buffer.count >= BUFFER_SIZE and transmittance >= settings.stop:
            more = 1
    if hits > 0:
        depth /= opacity
        normal = wp.normalize(normal)
        for channel in range(channels):
            out_records.attributes[i, channel] = out_records.attributes[i, channel] / opacity
    else:
        depth = wp.inf
    if threshold_gaussian < 0 and mesh.face >= 0:
        threshold_depth = mesh.t
    out_records.depth[i] = threshold_depth
    out_records.expected_depth[i] = depth
    out_records.normals[i] = normal
    out_records.transmittance[i] = transmittance
    out_records.gaussians[i] = threshold_gaussian
    out_records.hit_counts[i] = hits
    out_records.mesh_depth[i] = wp.where(mesh.face >= 0, mesh.t, wp.inf)
    out_records.mesh_faces[i] = mesh.face


launch_trace_surface = launcher(trace_surface_kernel, block_dim=32)
"""Trace one ray a thread, front to back. A block is one warp, whose memory is free when its slowest ray is done."""
