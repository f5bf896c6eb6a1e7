"""Light that reaches points from an environment: drawing rays towards it, and what they add up to."""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT, PI
from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.common.sampling import (
    SampleSet,
    draw_square,
    hash_combine,
    square_to_cosine_hemisphere,
    square_to_cosine_hemisphere_pdf,
    tangent_frame,
)
from beam_warp.kernels.common.spread import Spread, add_term, variance_of_sum
from beam_warp.kernels.light.environment_sampling import (
    EnvironmentDistribution,
    EnvironmentSample,
    environment_radiance,
    radiance_over_pdf,
    square_to_environment,
    square_to_environment_pdf,
)
from beam_warp.kernels.light.product_sampling import EnvironmentBlocks, square_to_product
from beam_warp.kernels.trace.surface_rays import RayBatch, ray_origin, stream_of_place
from beam_warp.kernels.trace.visibility import Rays

wp.set_module_options({"enable_backward": False})

LIGHT_STREAM = wp.constant(wp.uint32(0x49525241))

COSINE = wp.constant(0)
ENVIRONMENT = wp.constant(1)
PRODUCT = wp.constant(2)


@wp.struct
class LightMoments:
    """First moments of an environment's radiance over cells of the sphere [W/m^2], by channel, each with half the width
    of what its light is spread over along any axis."""

    red: wp.array[wp.vec4]
    green: wp.array[wp.vec4]
    blue: wp.array[wp.vec4]


@wp.struct
class Technique:
    """Samples of each point that one density draws."""

    density: int  # COSINE, ENVIRONMENT or PRODUCT
    samples: SampleSet
    begin: int  # place of its first sample among those of a point
    sample_count: int  # of a point, by all techniques
    known: int  # of its first samples it is known what they meet: they are not traced
    cosine_share: float  # part of a point's samples that COSINE draws
    environment_share: float  # part that ENVIRONMENT draws


@wp.func
def above_horizon(moment: wp.vec4, n: wp.vec3) -> float:
    """Mean of max(0, h) for h uniform over n . moment, give or take the half width."""
    middle = n[0] * moment[0] + n[1] * moment[1] + n[2] * moment[2]
    result = wp.max(middle, 0.0)
    if wp.abs(middle) < moment[3]:
        result = (middle + moment[3]) * (middle + moment[3]) / (4.0 * moment[3])
    return result


@wp.kernel
def sum_unshadowed_kernel(
    first: int, moments: LightMoments, normals: wp.array[wp.vec3], out_irradiance: wp.array[wp.vec3]
):
    """Irradiance over pi with nothing in the way. Threads of a warp read the same cell at the same time."""
    point = first + wp.tid()
    n = normals[point]
    red = float(0.0)
    green = float(0.0)
    blue = float(0.0)
    for cell in range(moments.red.shape[0]):
        red += above_horizon(moments.red[cell], n)
        green += above_horizon(moments.green[cell], n)
        blue += above_horizon(moments.blue[cell], n)
    out_irradiance[point] = wp.vec3(red, green, blue) / PI


@wp.func
def mixture_pdf(technique: Technique, n_dot_l: float, environment_pdf: float) -> float:
    """Density of a point's samples by cosine and environment together: dividing by it is the balance heuristic.

    Each density d has then the weight share_d pdf_d / sum of share_k pdf_k; the weights sum to one (Veach 1997, 9.2).
    """
    cosine_pdf = square_to_cosine_hemisphere_pdf(wp.vec3(0.0, 0.0, n_dot_l))
    return technique.cosine_share * cosine_pdf + technique.environment_share * environment_pdf


@wp.func
def draw_light(
    technique: Technique,
    distribution: EnvironmentDistribution,
    blocks: EnvironmentBlocks,
    cumulative: wp.array2d[float],
    point: int,
    normal: wp.vec3,
    u: float,
    v: float,
) -> EnvironmentSample:
    """A direction by the technique's density, with the density of all techniques together."""
    drawn = EnvironmentSample()
    if technique.density == PRODUCT:
        drawn = square_to_product(blocks, cumulative, point, u, v)
    elif technique.density == ENVIRONMENT:
        # The texel's own radiance and density: its direction, rounded at an edge, may lie in the texel next door.
        drawn = square_to_environment(distribution, u, v)
        drawn.pdf = mixture_pdf(technique, wp.dot(normal, drawn.direction), drawn.pdf)
    else:
        drawn.direction = tangent_frame(normal) * square_to_cosine_hemisphere(u, v)
        drawn.radiance = environment_radiance(distribution, drawn.direction)
        drawn.pdf = mixture_pdf(
            technique, wp.dot(normal, drawn.direction), square_to_environment_pdf(distribution, drawn.direction)
        )
    return drawn


@wp.func
def light_stream(technique: Technique, point_stream: wp.uint32) -> wp.uint32:
    return hash_combine(point_stream, LIGHT_STREAM + wp.uint32(technique.density))


@wp.kernel
def draw_light_kernel(
    first: int,
    technique: Technique,
    distribution: EnvironmentDistribution,
    blocks: EnvironmentBlocks,
    cumulative: wp.array2d[float],
    batch: RayBatch,
    out_rays: Rays,
    out_weights: wp.array[wp.vec3],
):
    """One ray a thread, and its radiance times cosine over pi times density; what brings no light is not traced."""
    item = first + wp.tid()
    place = item / technique.samples.count
    normal = batch.normals[place]
    point_stream = stream_of_place(batch, place)
    index = item % technique.samples.count
    square = draw_square(technique.samples, index, light_stream(technique, point_stream))
    drawn = draw_light(technique, distribution, blocks, cumulative, place, normal, square.u, square.v)
    weight = radiance_over_pdf(drawn) * (wp.max(wp.dot(normal, drawn.direction), 0.0) / PI)
    begin = place * batch.sample_count
    slot = technique.begin + square.slot
    ray = begin + slot
    out_weights[ray] = weight
    out_rays.origins[ray] = ray_origin(batch, place)
    out_rays.directions[ray] = drawn.direction
    is_traced = weight[0] + weight[1] + weight[2] > 0.0 and index >= technique.known
    out_rays.reaches[ray] = wp.where(is_traced, float(LARGEST_FLOAT), -1.0)
    if out_rays.streams.shape[0] > 0:
        out_rays.streams[ray] = hash_combine(hash_combine(point_stream, LIGHT_STREAM), wp.uint32(slot))


@wp.kernel
def recall_visibility_kernel(
    first: int,
    technique: Technique,
    pilot: SampleSet,
    batch: RayBatch,
    places: wp.array[int],
    visibility: wp.array[float],
    out_visibility: wp.array[float],
):
    """Put what the first samples of points met where a longer set of the same sequence has them.

    ``visibility`` holds it in the strata of the first samples alone, points in the order of ``places``.
    """
    item = first + wp.tid()
    place = item / pilot.count
    stream = light_stream(technique, stream_of_place(batch, place))
    index = item % pilot.count
    known = places[batch.rows[place]] * pilot.count + draw_square(pilot, index, stream).slot
    slot = technique.begin + draw_square(technique.samples, index, stream).slot
    out_visibility[place * batch.sample_count + slot] = visibility[known]


@wp.kernel
def reduce_light_kernel(
    first: int,
    batch: RayBatch,
    weights: wp.array[wp.vec3],
    visibility: wp.array[float],
    counts: wp.vec2i,
    paired: wp.vec2i,
    unshadowed: wp.array[wp.vec3],
    out_value: wp.array[wp.vec3],
    out_error: wp.array[wp.vec3],
):
    """Irradiance over pi and its standard error, by channel, from the samples of up to two techniques.

    Plain, without ``unshadowed``: the mean of V f. Ratio: unshadowed * sum V f / sum f (Heitz et al. 2018), whose error
    is that of the linearised terms (V - ratio) f. Where no sample found light, the ratio is anything in [0, 1].
    """
    place = first + wp.tid()
    row = batch.rows[place]
    ratio = unshadowed.shape[0] > 0
    count = counts[0] + counts[1]
    begin = place * batch.sample_count
    free = wp.vec3()
    seen = wp.vec3()
    for k in range(count):
        ray = begin + k
        free += weights[ray]
        seen += weights[ray] * visibility[ray]
    value = wp.vec3()
    error = wp.vec3()
    for c in range(3):
        scale = 1.0 / float(count)
        center = float(0.0)
        if ratio:
            scale = 0.0
            if free[c] > 0.0:
                scale = unshadowed[row][c] / free[c]
                center = seen[c] / free[c]
        here = Spread()
        there = Spread()
        here.paired = paired[0]
        there.paired = paired[1]
        for k in range(counts[0]):
            ray = begin + k
            here = add_term(here, weights[ray][c] * (visibility[ray] - center))
        for k in range(counts[0], count):
            ray = begin + k
            there = add_term(there, weights[ray][c] * (visibility[ray] - center))
        value[c] = scale * seen[c]
        error[c] = scale * wp.sqrt(variance_of_sum(here) + variance_of_sum(there))
        if ratio and not (free[c] > 0.0):
            value[c] = 0.5 * unshadowed[row][c]
            error[c] = 0.5 * unshadowed[row][c]
    out_value[row] = value
    out_error[row] = error


launch_sum_unshadowed = launcher(sum_unshadowed_kernel)
"""Sum the irradiance over pi of every normal, with nothing in the way."""


def launch_draw_light(technique, environment, cumulative, batch, out_rays, out_weights, device):
    """Draw one technique's rays."""
    launch(
        draw_light_kernel,
        len(batch.rows) * technique.samples.count,
        inputs=[technique, environment.distribution, environment.blocks, cumulative, batch],
        outputs=[out_rays, out_weights],
        device=device,
        block_dim=128,
    )


launch_recall_visibility = launcher(recall_visibility_kernel)
"""Take over what is known of a batch's rays."""


launch_reduce_light = launcher(reduce_light_kernel, block_dim=64)
"""Add up each point's samples, in its own row; ``unshadowed`` is by row too, or empty."""
