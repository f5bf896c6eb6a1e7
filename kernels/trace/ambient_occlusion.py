"""Ambient occlusion of surface points: the rays, and their mean with its error."""

import warp as wp

from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.common.sampling import (
    SampleSet,
    draw_square,
    hash_combine,
    square_to_cosine_hemisphere,
    tangent_frame,
)
from beam_warp.kernels.common.spread import Spread, add_term, variance_of_sum
from beam_warp.kernels.trace.surface_rays import RayBatch, ray_origin, stream_of_place
from beam_warp.kernels.trace.visibility import Rays

wp.set_module_options({"enable_backward": False})

LARGEST_DEVIATION = wp.constant(0.5)
"""Standard deviation of a number in [0, 1] that is either end as often: none has a larger one."""


@wp.kernel
def draw_occlusion_kernel(first: int, batch: RayBatch, samples: SampleSet, out_rays: Rays):
    """One cosine-distributed ray a thread."""
    item = first + wp.tid()
    place = item / samples.count
    index = item % samples.count
    stream = stream_of_place(batch, place)
    drawn = draw_square(samples, index, stream)
    begin = place * batch.sample_count
    ray = begin + drawn.slot
    out_rays.origins[ray] = ray_origin(batch, place)
    out_rays.directions[ray] = tangent_frame(batch.normals[place]) * square_to_cosine_hemisphere(drawn.u, drawn.v)
    if out_rays.streams.shape[0] > 0:
        out_rays.streams[ray] = hash_combine(stream, wp.uint32(index + 16))


@wp.kernel
def reduce_visibility_kernel(
    first: int,
    batch: RayBatch,
    samples: SampleSet,
    visibility: wp.array[float],
    out_mean: wp.array[float],
    out_error: wp.array[float],
):
    """Mean and standard error of each point's samples; of one sample nothing is known but that it lies in [0, 1]."""
    place = first + wp.tid()
    begin = place * batch.sample_count
    total = float(0.0)
    spread = Spread()
    spread.paired = wp.where(samples.columns > 0, 1, 0)
    for k in range(samples.count):
        v = visibility[begin + k]
        total += v
        spread = add_term(spread, v)
    error = float(LARGEST_DEVIATION)
    if samples.count > 1:
        error = wp.sqrt(variance_of_sum(spread)) / float(samples.count)
    out_mean[batch.rows[place]] = total / float(samples.count)
    out_error[batch.rows[place]] = error


launch_draw_occlusion = launcher(draw_occlusion_kernel)
"""Draw the rays of a batch."""


launch_reduce_visibility = launcher(reduce_visibility_kernel, block_dim=64)
"""Reduce each point's samples to mean and error, in its own row."""
