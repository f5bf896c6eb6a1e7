"""Light that reaches a Gaussian, and what of its captured colour that light explains.

Rays are traced once per Gaussian; every view's diffuse and specular residue (BEAM Eqs. 4 and 5) is evaluated from the
same rays, because visibility does not depend on the view.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.brdf import specular_albedo, specular_brdf
from beam_warp.kernels.constants import LARGEST_FLOAT
from beam_warp.kernels.environment_sampling import radiance_over_pdf
from beam_warp.kernels.launching import launch
from beam_warp.kernels.occluders import sampled_hit
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
from beam_warp.kernels.surface_rays import RayBatch, ray_origin, rays_of
from beam_warp.kernels.trace import Rays
from beam_warp.kernels.trace_settings import TraceSettings

wp.set_module_options({"enable_backward": False})

PI = wp.constant(3.14159265358979323846)
LIGHT_STREAM = wp.constant(wp.uint32(0x4C494748))
BOUNCE_STREAM = wp.constant(wp.uint32(0x424F554E))


@wp.struct
class LightRays:
    """Rays towards the environment as a batch lays them out, and what they found."""

    directions: wp.array[wp.vec3]
    radiance_over_pdf: wp.array[wp.vec3]
    visibility: wp.array[float]


@wp.struct
class CapturedSurface:
    """What is known of the points, by row: spherical harmonics of the whole cloud, each point's place in it, …"""

    radiance: wp.array2d[wp.vec3]
    gaussians: wp.array[int]
    display_srgb: int  # whether the harmonics are display sRGB
    roughness: wp.array[float]


@wp.struct
class ColorFit:
    """Sums of the weighted least-squares problem for base colour, per point and channel."""

    numerator: wp.array[wp.vec3]  # sum of w L_D (L_o - L_S)
    denominator: wp.array[wp.vec3]  # sum of w L_D^2
    observed: wp.array[wp.vec3]  # sum of w (L_o - L_S)^2
    relative_error: wp.array[float]  # standard error of the irradiance over the irradiance


@wp.kernel
def draw_light_kernel(
    first: int,
    blocks: EnvironmentBlocks,
    cumulative: wp.array2d[float],
    batch: RayBatch,
    samples: SampleSet,
    seed: wp.uint32,
    frame: wp.uint32,
    out_rays: Rays,
    out_radiance_over_pdf: wp.array[wp.vec3],
):
    """One ray a thread, by environment times cosine; what goes below the horizon is not traced."""
    item = first + wp.tid()
    place = item / samples.count
    stream = hash_combine(stream_of(seed, frame, wp.uint32(batch.rows[place])), LIGHT_STREAM)
    square = draw_square(samples, item % samples.count, stream)
    drawn = square_to_product(blocks, cumulative, place, square.u, square.v)
    at = rays_of(batch, place)
    ray = at[0] + square.slot * at[1]
    out_rays.origins[ray] = ray_origin(batch, place)
    out_rays.directions[ray] = drawn.direction
    out_rays.reaches[ray] = wp.where(wp.dot(batch.normals[place], drawn.direction) > 0.0, float(LARGEST_FLOAT), -1.0)
    out_radiance_over_pdf[ray] = radiance_over_pdf(drawn)


@wp.kernel
def trace_bounce_kernel(
    first: int,
    occluders: Any,
    settings: TraceSettings,
    batch: RayBatch,
    gaussian_radiance: wp.array[wp.vec3],
    seed: wp.uint32,
    frame: wp.uint32,
    sample_count: int,
    out_irradiance: wp.array[wp.vec3],
):
    """Irradiance over pi from the captured radiance of what cosine-distributed rays hit: one bounce, already lit."""
    place = first + wp.tid()
    basis = tangent_frame(batch.normals[place])
    origin = ray_origin(batch, place)
    stream = hash_combine(stream_of(seed, frame, wp.uint32(batch.rows[place])), BOUNCE_STREAM)
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
    out_irradiance[batch.rows[place]] = total / float(sample_count)


@wp.kernel
def fit_color_kernel(
    first: int,
    batch: RayBatch,
    rays: LightRays,
    unshadowed: wp.array[wp.vec3],
    bounce: wp.array[wp.vec3],
    albedo_table: wp.array2d[wp.vec2],
    views: wp.array[wp.vec3],
    surface: CapturedSurface,
    out_irradiance: wp.array[wp.vec3],
    out_fit: ColorFit,
):
    """Ratio estimate of the irradiance, then the least-squares sums over views.

    E = E_unshadowed * sum V f / sum f: the noise of f cancels, what remains comes from where V varies
    (Heitz et al. 2018). Diffuse weight 1 - E_spec(n.v): what the specular lobe reflects is not left for diffusion.
    """
    place = first + wp.tid()
    point = batch.rows[place]
    at = rays_of(batch, place)
    n = batch.normals[place]
    roughness = surface.roughness[point]
    free = wp.vec3()
    seen = wp.vec3()
    for k in range(batch.sample_count):
        ray = at[0] + k * at[1]
        f = rays.radiance_over_pdf[ray] * wp.max(wp.dot(n, rays.directions[ray]), 0.0)
        free += f
        seen += f * rays.visibility[ray]
    irradiance = wp.vec3()
    for c in range(3):
        if free[c] > 0.0:
            irradiance[c] = unshadowed[point][c] * PI * seen[c] / free[c]
    out_irradiance[point] = irradiance

    # Error of the ratio by neighbouring strata of its linearised terms (V - R) f, on the sum of the channels.
    relative_error = float(1.0)
    free_sum = free[0] + free[1] + free[2]
    seen_sum = seen[0] + seen[1] + seen[2]
    if seen_sum > 0.0:
        ratio = seen_sum / free_sum
        spread = float(0.0)
        before = float(0.0)
        for k in range(batch.sample_count):
            ray = at[0] + k * at[1]
            w = rays.radiance_over_pdf[ray]
            power = (w[0] + w[1] + w[2]) * wp.max(wp.dot(n, rays.directions[ray]), 0.0)
            term = (rays.visibility[ray] - ratio) * power
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
        for k in range(batch.sample_count):
            ray = at[0] + k * at[1]
            light = rays.directions[ray]
            cosine = wp.dot(n, light)
            if cosine > 0.0:
                specular += rays.radiance_over_pdf[ray] * (
                    rays.visibility[ray] * cosine * specular_brdf(n, v, light, roughness)
                )
        albedo = specular_albedo(albedo_table, weight, roughness)
        specular = specular / float(batch.sample_count) + bounce[point] * albedo
        diffuse = (irradiance / PI + bounce[point]) * (1.0 - albedo)
        target = captured_radiance(surface.radiance, surface.gaussians[point], -v, surface.display_srgb) - specular
        numerator += wp.cw_mul(diffuse, target) * weight
        denominator += wp.cw_mul(diffuse, diffuse) * weight
        observed += wp.cw_mul(target, target) * weight
    out_fit.numerator[point] = numerator
    out_fit.denominator[point] = denominator
    out_fit.observed[point] = observed
    out_fit.relative_error[point] = relative_error


def launch_draw_light(blocks, cumulative, batch, samples, stream, out_rays, out_radiance_over_pdf, device):
    """Draw the rays towards the environment; ``stream`` is (seed, frame)."""
    launch(
        draw_light_kernel,
        len(batch.rows) * samples.count,
        inputs=[blocks, cumulative, batch, samples, wp.uint32(stream[0]), wp.uint32(stream[1])],
        outputs=[out_rays, out_radiance_over_pdf],
        device=device,
        block_dim=128,
    )


def launch_trace_bounce(scene, settings, batch, gaussian_radiance, stream, sample_count, out_irradiance):
    """Gather one bounce; ``stream`` is (seed, frame)."""
    launch(
        trace_bounce_kernel,
        len(batch.rows),
        inputs=[
            scene.occluders,
            settings,
            batch,
            gaussian_radiance,
            wp.uint32(stream[0]),
            wp.uint32(stream[1]),
            sample_count,
        ],
        outputs=[out_irradiance],
        device=scene.device,
        block_dim=64,
    )


def launch_fit_color(batch, rays, unshadowed, bounce, albedo_table, views, surface, out_irradiance, out_fit, device):
    """Accumulate the least-squares sums of every point; all but ``rays`` is by row."""
    launch(
        fit_color_kernel,
        len(batch.rows),
        inputs=[batch, rays, unshadowed, bounce, albedo_table, views, surface],
        outputs=[out_irradiance, out_fit],
        device=device,
        block_dim=64,
    )
