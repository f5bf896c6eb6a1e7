"""Light that reaches a Gaussian, and what of its captured colour that light explains.

Rays are traced once per Gaussian; every view's diffuse and specular residue (BEAM Eqs. 4 and 5) is evaluated from the
same rays, because visibility does not depend on the view.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.brdf import specular_albedo, specular_brdf
from beam_warp.kernels.constants import LARGEST_FLOAT
from beam_warp.kernels.environment_sampling import radiance_over_pdf
from beam_warp.kernels.latlong import latlong_bilinear
from beam_warp.kernels.launching import launch
from beam_warp.kernels.occluders import sampled_hit, transmittance
from beam_warp.kernels.product_sampling import EnvironmentBlocks, square_to_product
from beam_warp.kernels.sampling import (
    SampleSet,
    draw_square,
    hash_combine,
    owen_sobol_x,
    owen_sobol_y,
    square_to_cosine_hemisphere,
    stream_of,
    tangent_frame,
    unit_float,
)
from beam_warp.kernels.spherical_harmonics import captured_radiance
from beam_warp.kernels.trace_settings import TraceSettings

wp.set_module_options({"enable_backward": False})

PI = wp.constant(3.14159265358979323846)
LIGHT_STREAM = wp.constant(wp.uint32(0x4C494748))
BOUNCE_STREAM = wp.constant(wp.uint32(0x424F554E))


@wp.struct
class SurfacePoints:
    """Where light is gathered."""

    positions: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    offsets: wp.array[float]
    roughness: wp.array[float]


@wp.struct
class LightRays:
    """Rays towards the environment, ``sample_count`` a point, in order of their strata."""

    directions: wp.array[wp.vec3]
    radiance_over_pdf: wp.array[wp.vec3]
    visibility: wp.array[float]


@wp.struct
class CapturedColor:
    """Spherical harmonics of the whole cloud, the row of each point in it, and whether they are display sRGB."""

    radiance: wp.array2d[wp.vec3]
    rows: wp.array[int]
    display_srgb: int


@wp.struct
class ColorFit:
    """Sums of the weighted least-squares problem for base colour, per point and channel."""

    numerator: wp.array[wp.vec3]  # sum of w L_D (L_o - L_S)
    denominator: wp.array[wp.vec3]  # sum of w L_D^2
    observed: wp.array[wp.vec3]  # sum of w (L_o - L_S)^2
    relative_error: wp.array[float]  # standard error of the irradiance over the irradiance


@wp.kernel
def trace_light_kernel(
    first: int,
    occluders: Any,
    settings: TraceSettings,
    points: SurfacePoints,
    blocks: EnvironmentBlocks,
    cumulative: wp.array2d[float],
    seed: wp.uint32,
    frame: wp.uint32,
    first_point: int,
    samples: SampleSet,
    out_rays: LightRays,
):
    ray = first + wp.tid()
    point = ray / samples.count
    index = ray % samples.count
    stream = hash_combine(stream_of(seed, frame, wp.uint32(first_point + point)), LIGHT_STREAM)
    at = draw_square(samples, index, stream)
    drawn = square_to_product(blocks, cumulative, point, at.u, at.v)
    slot = point * samples.count + at.slot
    n = points.normals[point]
    v = float(0.0)
    if wp.dot(n, drawn.direction) > 0.0:
        origin = points.positions[point] - occluders.origin + n * points.offsets[point]
        v = transmittance(occluders, settings, origin, drawn.direction, LARGEST_FLOAT, stream + wp.uint32(index))
    out_rays.directions[slot] = drawn.direction
    out_rays.radiance_over_pdf[slot] = radiance_over_pdf(drawn)
    out_rays.visibility[slot] = v


@wp.kernel
def trace_bounce_kernel(
    first: int,
    occluders: Any,
    settings: TraceSettings,
    points: SurfacePoints,
    gaussian_radiance: wp.array[wp.vec3],
    seed: wp.uint32,
    frame: wp.uint32,
    first_point: int,
    sample_count: int,
    out_irradiance: wp.array[wp.vec3],
):
    """Irradiance over pi from the captured radiance of what cosine-distributed rays hit: one bounce, already lit."""
    point = first + wp.tid()
    n = points.normals[point]
    basis = tangent_frame(n)
    origin = points.positions[point] - occluders.origin + n * points.offsets[point]
    stream = hash_combine(stream_of(seed, frame, wp.uint32(first_point + point)), BOUNCE_STREAM)
    total = wp.vec3()
    for sample in range(sample_count):
        direction = basis * square_to_cosine_hemisphere(
            unit_float(owen_sobol_x(sample, stream)), unit_float(owen_sobol_y(sample, stream))
        )
        hit = sampled_hit(
            occluders, settings, origin, direction, LARGEST_FLOAT, hash_combine(stream, wp.uint32(sample + 16))
        )
        if hit >= 0:
            total += gaussian_radiance[hit]
    out_irradiance[point] = total / float(sample_count)


@wp.kernel
def fit_color_kernel(
    first: int,
    points: SurfacePoints,
    rays: LightRays,
    sample_count: int,
    irradiance_map: wp.array2d[wp.vec3],
    bounce: wp.array[wp.vec3],
    albedo_table: wp.array2d[wp.vec2],
    views: wp.array[wp.vec3],
    captured: CapturedColor,
    out_irradiance: wp.array[wp.vec3],
    out_fit: ColorFit,
):
    """Ratio estimate of the irradiance, then the least-squares sums over views.

    E = E_unshadowed * sum V f / sum f: the noise of f cancels, what remains comes from where V varies
    (Heitz et al. 2018). Diffuse weight 1 - E_spec(n.v): what the specular lobe reflects is not left for diffusion.
    """
    point = first + wp.tid()
    start = point * sample_count
    n = points.normals[point]
    roughness = points.roughness[point]
    free = wp.vec3()
    seen = wp.vec3()
    for k in range(sample_count):
        f = rays.radiance_over_pdf[start + k] * wp.max(wp.dot(n, rays.directions[start + k]), 0.0)
        free += f
        seen += f * rays.visibility[start + k]
    unshadowed = latlong_bilinear(irradiance_map, n)
    irradiance = wp.vec3()
    for c in range(3):
        if free[c] > 0.0:
            irradiance[c] = unshadowed[c] * seen[c] / free[c]
    out_irradiance[point] = irradiance

    # Error of the ratio by neighbouring strata of its linearised terms (V - R) f, on the sum of the channels.
    relative_error = float(1.0)
    free_sum = free[0] + free[1] + free[2]
    seen_sum = seen[0] + seen[1] + seen[2]
    if seen_sum > 0.0:
        ratio = seen_sum / free_sum
        spread = float(0.0)
        before = float(0.0)
        for k in range(sample_count):
            w = rays.radiance_over_pdf[start + k]
            power = (w[0] + w[1] + w[2]) * wp.max(wp.dot(n, rays.directions[start + k]), 0.0)
            term = (rays.visibility[start + k] - ratio) * power
            if k % 2 == 1:
                spread += (term - before) * (term - before)
            before = term
        relative_error = wp.sqrt(spread) / seen_sum

    basis = tangent_frame(n)
    numerator = wp.vec3()
    denominator = wp.vec3()
    observed = wp.vec3()
    for view in range(views.shape[0]):
        v = basis * views[view]
        weight = views[view][2]  # projected area: what a camera there sees of the surface
        specular = wp.vec3()
        for k in range(sample_count):
            light = rays.directions[start + k]
            cosine = wp.dot(n, light)
            if cosine > 0.0:
                specular += rays.radiance_over_pdf[start + k] * (
                    rays.visibility[start + k] * cosine * specular_brdf(n, v, light, roughness)
                )
        albedo = specular_albedo(albedo_table, weight, roughness)
        specular = specular / float(sample_count) + bounce[point] * albedo
        diffuse = (irradiance / PI + bounce[point]) * (1.0 - albedo)
        target = captured_radiance(captured.radiance, captured.rows[point], -v, captured.display_srgb) - specular
        numerator += wp.cw_mul(diffuse, target) * weight
        denominator += wp.cw_mul(diffuse, diffuse) * weight
        observed += wp.cw_mul(target, target) * weight
    out_fit.numerator[point] = numerator
    out_fit.denominator[point] = denominator
    out_fit.observed[point] = observed
    out_fit.relative_error[point] = relative_error


def launch_trace_light(scene, settings, points, blocks, cumulative, stream, first_point, samples, out_rays):
    """Draw and trace the rays towards the environment; ``stream`` is (seed, frame)."""
    launch(
        trace_light_kernel,
        len(points.positions) * samples.count,
        inputs=[
            scene.occluders,
            settings,
            points,
            blocks,
            cumulative,
            wp.uint32(stream[0]),
            wp.uint32(stream[1]),
            first_point,
            samples,
        ],
        outputs=[out_rays],
        device=scene.device,
        block_dim=64,
    )


def launch_trace_bounce(scene, settings, points, gaussian_radiance, stream, first_point, sample_count, out_irradiance):
    """Gather one bounce; ``stream`` is (seed, frame)."""
    launch(
        trace_bounce_kernel,
        len(points.positions),
        inputs=[
            scene.occluders,
            settings,
            points,
            gaussian_radiance,
            wp.uint32(stream[0]),
            wp.uint32(stream[1]),
            first_point,
            sample_count,
        ],
        outputs=[out_irradiance],
        device=scene.device,
        block_dim=64,
    )


def launch_fit_color(
    points,
    rays,
    sample_count,
    irradiance_map,
    bounce,
    albedo_table,
    views,
    captured,
    out_irradiance,
    out_fit,
    device,
):
    """Accumulate the least-squares sums of every point."""
    launch(
        fit_color_kernel,
        len(points.positions),
        inputs=[
            points,
            rays,
            sample_count,
            irradiance_map,
            bounce,
            albedo_table,
            views,
            captured,
        ],
        outputs=[out_irradiance, out_fit],
        device=device,
        block_dim=64,
    )
