"""Ambient occlusion of surface points: where rays start, the rays themselves, and their mean with its error."""

from typing import Any

import warp as wp

from beam_warp.kernels.constants import LARGEST_FLOAT
from beam_warp.kernels.launching import launch
from beam_warp.kernels.occluders import surface_layer, transmittance
from beam_warp.kernels.sampling import (
    SampleSet,
    draw_square,
    hash_combine,
    square_to_cosine_hemisphere,
    stream_of,
    tangent_frame,
)
from beam_warp.kernels.spread import Spread, add_term, variance_of_sum
from beam_warp.kernels.trace_settings import TraceSettings

wp.set_module_options({"enable_backward": False})

LARGEST_DEVIATION = wp.constant(0.5)
"""Standard deviation of a number in [0, 1] that is either end as often: none has a larger one."""


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
    samples: SampleSet,
    out_visibility: wp.array[float],
):
    """One cosine-distributed ray a thread; the result goes to the ray's slot."""
    ray = first + wp.tid()
    point = ray / samples.count
    index = ray % samples.count
    n = normals[point]
    stream = stream_of(seed, frame, wp.uint32(first_point + point))
    drawn = draw_square(samples, index, stream)
    direction = tangent_frame(n) * square_to_cosine_hemisphere(drawn.u, drawn.v)
    origin = points[point] - occluders.origin + n * offsets[point]
    out_visibility[point * samples.count + drawn.slot] = transmittance(
        occluders, settings, origin, direction, LARGEST_FLOAT, hash_combine(stream, wp.uint32(index + 16))
    )


@wp.kernel
def reduce_visibility_kernel(
    first: int,
    visibility: wp.array[float],
    samples: SampleSet,
    out_mean: wp.array[float],
    out_error: wp.array[float],
):
    """Mean and standard error of each point's samples; of one sample nothing is known but that it lies in [0, 1]."""
    point = first + wp.tid()
    start = point * samples.count
    total = float(0.0)
    spread = Spread()
    spread.paired = wp.where(samples.columns > 0, 1, 0)
    for k in range(samples.count):
        total += visibility[start + k]
        spread = add_term(spread, visibility[start + k])
    out_mean[point] = total / float(samples.count)
    out_error[point] = LARGEST_DEVIATION
    if samples.count > 1:
        out_error[point] = wp.sqrt(variance_of_sum(spread)) / float(samples.count)


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
    samples,
    out_visibility,
    device,
):
    """Trace ``samples.count`` rays from each point."""
    launch(
        trace_occlusion_kernel,
        len(points) * samples.count,
        inputs=[
            occluders,
            settings,
            points,
            normals,
            offsets,
            wp.uint32(seed),
            wp.uint32(frame),
            first_point,
            samples,
        ],
        outputs=[out_visibility],
        device=device,
        block_dim=64,
    )


def launch_reduce_visibility(visibility, samples, out_mean, out_error, device):
    """Reduce each point's samples to mean and error."""
    launch(
        reduce_visibility_kernel,
        len(out_mean),
        inputs=[visibility, samples],
        outputs=[out_mean, out_error],
        device=device,
    )
