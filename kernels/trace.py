"""Rays through Gaussians: transmittance in any order, and one unbiased sample of what a ray hits.

A Gaussian acts at x*, the point of its largest response on the ray (BEAM Eq. 7); it counts if x* lies in front of the
origin and before ``t_max`` ("peak in front").
"""

import warp as wp

from beam_warp.kernels.constants import ALPHA_MIN, DIRECTION_FLOOR, TRANSMITTANCE_STOP
from beam_warp.kernels.gaussian import Gaussians, ray_peak
from beam_warp.kernels.launching import launch
from beam_warp.kernels.sampling import hash_combine, unit_float

wp.set_module_options({"enable_backward": False})


@wp.func
def box_test_direction(direction: wp.vec3) -> wp.vec3:
    """Replaces zero components, for which Warp's slab test computes 0 * inf and loses hits on box planes."""
    safe = direction
    for k in range(3):
        if wp.abs(direction[k]) < DIRECTION_FLOOR:
            safe[k] = wp.where(direction[k] < 0.0, -DIRECTION_FLOOR, DIRECTION_FLOOR)
    return safe


@wp.func
def transmittance(bvh: wp.uint64, gaussians: Gaussians, origin: wp.vec3, direction: wp.vec3, t_max: float) -> float:
    """V = product of (1 - alpha) over the Gaussians that the ray meets; any order, stopped below 1e-4."""
    v = float(1.0)
    query = wp.bvh_query_ray(bvh, origin, box_test_direction(direction))
    index = int(0)
    while wp.bvh_query_next(query, index, t_max):
        peak = ray_peak(gaussians, index, origin, direction)
        if peak[0] >= ALPHA_MIN and peak[1] > 0.0 and peak[1] < t_max:
            v *= 1.0 - peak[0]
            if v < TRANSMITTANCE_STOP:
                break
    return v


@wp.func
def sampled_hit(
    bvh: wp.uint64, gaussians: Gaussians, origin: wp.vec3, direction: wp.vec3, t_max: float, stream: wp.uint32
) -> int:
    """Index of a Gaussian drawn with probability alpha times the transmittance before it, or -1 for none.

    Each Gaussian stops the ray with probability alpha, independently; the nearest that does wins. One unsorted
    traversal with a shrinking ``t_max`` is enough (Sun et al. 2025). The draw of a Gaussian is a function of
    (stream, Gaussian), so that the result does not depend on traversal order.
    """
    nearest = int(-1)
    t_nearest = t_max
    query = wp.bvh_query_ray(bvh, origin, box_test_direction(direction))
    index = int(0)
    while wp.bvh_query_next(query, index, t_nearest):
        peak = ray_peak(gaussians, index, origin, direction)
        if peak[0] >= ALPHA_MIN and peak[1] > 0.0 and peak[1] < t_nearest:
            if unit_float(hash_combine(stream, wp.uint32(index))) < peak[0]:
                nearest = index
                t_nearest = peak[1]
    return nearest


@wp.kernel
def trace_visibility_kernel(
    first: int,
    bvh: wp.uint64,
    gaussians: Gaussians,
    scene_origin: wp.vec3,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    t_max: float,
    out_visibility: wp.array[float],
):
    i = first + wp.tid()
    out_visibility[i] = transmittance(bvh, gaussians, origins[i] - scene_origin, directions[i], t_max)


def launch_trace_visibility(bvh, gaussians, scene_origin, origins, directions, t_max, out_visibility, device):
    """Trace one ray a thread."""
    launch(
        trace_visibility_kernel,
        len(origins),
        inputs=[bvh, gaussians, scene_origin, origins, directions, t_max],
        outputs=[out_visibility],
        device=device,
        block_dim=64,  # measured best on an H200: divergent rays, small blocks
    )
