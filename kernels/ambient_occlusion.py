"""Ambient occlusion of surface points: where rays start, the rays themselves, and their mean with its error."""

from typing import Any

import warp as wp

from beam_warp.kernels.constants import LARGEST_FLOAT
from beam_warp.kernels.launching import launch
from beam_warp.kernels.occluders import surface_layer, transmittance
from beam_warp.kernels.sampling import (
    hash_combine,
    owen_sobol_x,
    owen_sobol_y,
    square_to_cosine_hemisphere,
    stratum,
    stream_of,
    tangent_frame,
    unit_float,
)
from beam_warp.kernels.trace_settings import TraceSettings

wp.set_module_options({"enable_backward": False})


@wp.kernel
def local_surface_kernel(
    first: int,
    occluders: Any,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    out_surface: wp.array[wp.vec2],
):
    """(height, thickness) of the layer of Gaussians around each point, along its normal."""
    i = first + wp.tid()
    out_surface[i] = surface_layer(occluders, points[i] - occluders.origin, normals[i])


@wp.kernel
def trace_occlusion_kernel(
    first: int,
    occluders: Any,
    settings: TraceSettings,
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
    origin = points[point] - occluders.origin + n * offsets[point]
    slot = sample
    if stratum_bits[0] >= 0:
        slot = stratum(x, y, stratum_bits[0], stratum_bits[1])
    out_visibility[point * sample_count + slot] = transmittance(
        occluders, settings, origin, direction, LARGEST_FLOAT, hash_combine(stream, wp.uint32(sample + 16))
    )


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


def launch_local_surface(occluders, points, normals, out_surface, device):
    """Measure the layer of Gaussians around each point."""
    launch(
        local_surface_kernel,
        len(points),
        inputs=[occluders, points, normals],
        outputs=[out_surface],
        device=device,
        block_dim=64,
    )


def launch_trace_occlusion(
    occluders,
    settings,
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
            occluders,
            settings,
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
