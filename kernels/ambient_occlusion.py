"""Ambient occlusion of surface points: where rays start, the rays themselves, and their mean with its error."""

import warp as wp

from beam_warp.kernels.constants import ALPHA_MIN, LARGEST_FLOAT
from beam_warp.kernels.gaussian import Gaussians, whitening_times
from beam_warp.kernels.launching import launch
from beam_warp.kernels.sampling import (
    owen_sobol_x,
    owen_sobol_y,
    square_to_cosine_hemisphere,
    stratum,
    stream_of,
    tangent_frame,
    unit_float,
)
from beam_warp.kernels.trace import transmittance

wp.set_module_options({"enable_backward": False})


@wp.func
def extent_along(gaussians: Gaussians, index: int, n: wp.vec3) -> float:
    """n^T Sigma n: variance of the whole Gaussian along n; row k of the whitening is axis k over scale k."""
    total = float(0.0)
    for k in range(3):
        row = gaussians.whitening_0[index]
        if k == 1:
            row = gaussians.whitening_1[index]
        if k == 2:
            row = gaussians.whitening_2[index]
        axis = wp.vec3(row[0], row[1], row[2])
        along = wp.dot(axis, n) / wp.dot(axis, axis)
        total += along * along
    return total


@wp.kernel
def local_surface_kernel(
    first: int,
    bvh: wp.uint64,
    gaussians: Gaussians,
    scene_origin: wp.vec3,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    out_surface: wp.array[wp.vec2],
):
    """(height, thickness) of the layer of Gaussians around a point, along its normal.

    On the line point + h n a Gaussian's response is again a Gaussian in h. Those that contain the point, weighted by
    their peak alpha on the line, give the height at which the surface is seen there. Thickness joins two variances: of
    each Gaussian along the normal as a whole, so that a tilted flat one counts with the height of its edges, and of
    the heights among each other.
    """
    i = first + wp.tid()
    p = points[i] - scene_origin
    n = normals[i]
    total = float(0.0)
    mean = float(0.0)
    within = float(0.0)
    count = float(0.0)
    first_moment = float(0.0)
    second_moment = float(0.0)
    query = wp.bvh_query_aabb(bvh, p, p)
    index = int(0)
    while wp.bvh_query_next(query, index):
        packed = gaussians.center_opacity[index]
        q = whitening_times(gaussians, index, p - wp.vec3(packed[0], packed[1], packed[2]))
        if wp.dot(q, q) < gaussians.whitening_0[index][3]:
            d = whitening_times(gaussians, index, n)
            dd = wp.dot(d, d)
            height = -wp.dot(q, d) / dd
            closest = q + d * height
            weight = packed[3] * wp.exp(-0.5 * wp.dot(closest, closest))
            total += weight
            mean += weight * height
            within += weight * extent_along(gaussians, index, n)
            count += packed[3]
            first_moment += packed[3] * height
            second_moment += packed[3] * height * height
    surface = wp.vec2(0.0, 0.0)
    if total >= ALPHA_MIN:
        mean /= total
        middle = first_moment / count
        between = wp.max(second_moment / count - middle * middle, 0.0)
        surface = wp.vec2(mean, wp.sqrt(within / total + between))
    out_surface[i] = surface


@wp.kernel
def trace_occlusion_kernel(
    first: int,
    bvh: wp.uint64,
    gaussians: Gaussians,
    scene_origin: wp.vec3,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    offsets: wp.array[float],
    seed: wp.uint32,
    frame: wp.uint32,
    first_point: int,
    sample_count: int,
    stratum_bits: wp.vec2i,
    out_visibility: wp.array[float],
):
    """One cosine-distributed ray a thread; the result goes to the ray's stratum, or to its number if there are none."""
    ray = first + wp.tid()
    point = ray / sample_count
    sample = ray % sample_count
    n = normals[point]
    stream = stream_of(seed, frame, wp.uint32(first_point + point))
    x = owen_sobol_x(sample, stream)
    y = owen_sobol_y(sample, stream)
    direction = tangent_frame(n) * square_to_cosine_hemisphere(unit_float(x), unit_float(y))
    origin = points[point] - scene_origin + n * offsets[point]
    slot = sample
    if stratum_bits[0] >= 0:
        slot = stratum(x, y, stratum_bits[0], stratum_bits[1])
    out_visibility[point * sample_count + slot] = transmittance(bvh, gaussians, origin, direction, LARGEST_FLOAT)


@wp.kernel
def reduce_visibility_kernel(
    first: int,
    visibility: wp.array[float],
    sample_count: int,
    stratified: int,
    out_mean: wp.array[float],
    out_error: wp.array[float],
):
    """Mean and standard error of each point's samples.

    Stratified samples: neighbouring strata a, b estimate each other's spread, (V_a - V_b)^2, the collapsed-strata
    estimator (Cochran 1977, §5A.12); differences between the strata only make it larger, so it errs on the safe side.
    Otherwise the textbook variance of the mean.
    """
    point = first + wp.tid()
    start = point * sample_count
    total = float(0.0)
    for k in range(sample_count):
        total += visibility[start + k]
    mean = total / float(sample_count)
    spread = float(0.0)
    if stratified == 1:
        for k in range(sample_count / 2):
            d = visibility[start + 2 * k] - visibility[start + 2 * k + 1]
            spread += d * d
        spread = wp.sqrt(spread) / float(sample_count)
    elif sample_count > 1:
        for k in range(sample_count):
            d = visibility[start + k] - mean
            spread += d * d
        spread = wp.sqrt(spread / (float(sample_count) * float(sample_count - 1)))
    out_mean[point] = mean
    out_error[point] = spread


def launch_local_surface(bvh, gaussians, scene_origin, points, normals, out_surface, device):
    """Measure the layer of Gaussians around each point."""
    launch(
        local_surface_kernel,
        len(points),
        inputs=[bvh, gaussians, scene_origin, points, normals],
        outputs=[out_surface],
        device=device,
        block_dim=64,
    )


def launch_trace_occlusion(
    bvh,
    gaussians,
    scene_origin,
    points,
    normals,
    offsets,
    seed,
    frame,
    first_point,
    sample_count,
    stratum_bits,
    out_visibility,
    device,
):
    """Trace ``sample_count`` rays from each point."""
    launch(
        trace_occlusion_kernel,
        len(points) * sample_count,
        inputs=[
            bvh,
            gaussians,
            scene_origin,
            points,
            normals,
            offsets,
            wp.uint32(seed),
            wp.uint32(frame),
            first_point,
            sample_count,
            stratum_bits,
        ],
        outputs=[out_visibility],
        device=device,
        block_dim=64,
    )


def launch_reduce_visibility(visibility, sample_count, stratified, out_mean, out_error, device):
    """Reduce each point's samples to mean and error."""
    launch(
        reduce_visibility_kernel,
        len(out_mean),
        inputs=[visibility, sample_count, int(stratified)],
        outputs=[out_mean, out_error],
        device=device,
    )
