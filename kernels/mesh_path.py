"""Path tracing of a mesh under a distant environment: radiance on pixels, and radiance that leaves surface points.

At every vertex of a path the environment is sampled directly and the BRDF is sampled on, and the two are combined by
multiple importance sampling with the power heuristic (Veach 1997). BRDF: Lambert weighted by 1 - E_spec(n.v), which
conserves energy, plus the dielectric GGX lobe of `beam_warp.kernels.brdf`.
"""

import warp as wp

from beam_warp.kernels.brdf import ALPHA_FLOOR, specular_albedo, specular_brdf
from beam_warp.kernels.environment_sampling import (
    EnvironmentDistribution,
    environment_radiance,
    square_to_environment,
    square_to_environment_pdf,
)
from beam_warp.kernels.ggx_sampling import square_to_visible_reflection, square_to_visible_reflection_pdf
from beam_warp.kernels.launching import launch
from beam_warp.kernels.mesh_surface import MeshSurface, SurfacePoint, closest_hit, is_open, surface_point
from beam_warp.kernels.pixel_sampling import PIXEL_CHUNK, PixelRays, pixel_direction, sample_pair
from beam_warp.kernels.sampling import square_to_cosine_hemisphere, stream_of, tangent_frame

wp.set_module_options({"enable_backward": False})

PI = wp.constant(3.14159265358979323846)

PAIRS_PER_VERTEX = wp.constant(3)
"""Pairs of random numbers at a vertex of a path: light, BRDF direction, choice of lobe."""

GRAZING_COSINE = wp.constant(1.0e-3)
"""A shading normal that leans away from the viewer is turned back until it faces him by this cosine."""


@wp.struct
class Shading:
    """A surface point seen from one direction."""

    normal: wp.vec3
    view: wp.vec3
    diffuse: wp.vec3  # base colour (1 - E_spec) / pi
    roughness: float
    alpha: float
    specular_share: float  # probability of sampling the specular lobe


@wp.func
def shading_of(point: SurfacePoint, view: wp.vec3, albedo_table: wp.array2d[wp.vec2]) -> Shading:
    shading = Shading()
    n = point.normal
    away = GRAZING_COSINE - wp.dot(n, view)
    if away > 0.0:
        n = wp.normalize(n + away * view)
    specular = specular_albedo(albedo_table, wp.dot(n, view), point.roughness)
    shading.normal = n
    shading.view = view
    shading.diffuse = point.base_color * ((1.0 - specular) / PI)
    shading.roughness = point.roughness
    shading.alpha = wp.max(point.roughness * point.roughness, ALPHA_FLOOR)
    c = point.base_color
    diffuse = (c[0] + c[1] + c[2]) / 3.0 * (1.0 - specular)
    # Neither lobe is starved: a share of 0.1 bounds the weight of any sample by ten times its lobe's own.
    shading.specular_share = wp.clamp(specular / (specular + diffuse), 0.1, 0.9)
    return shading


@wp.func
def brdf_cosine(shading: Shading, light: wp.vec3) -> wp.vec3:
    """BRDF times n.l, for light above the surface."""
    specular = specular_brdf(shading.normal, shading.view, light, shading.roughness)
    return (shading.diffuse + wp.vec3(specular)) * wp.dot(shading.normal, light)


@wp.func
def brdf_pdf(shading: Shading, frame: wp.mat33, light: wp.vec3) -> float:
    """Density of `brdf_direction` [1/sr], for light above the surface."""
    view = wp.transpose(frame) * shading.view
    local = wp.transpose(frame) * light
    return (
        shading.specular_share * square_to_visible_reflection_pdf(view, local, shading.alpha)
        + (1.0 - shading.specular_share) * local[2] / PI
    )


@wp.func
def brdf_direction(shading: Shading, frame: wp.mat33, choice: float, u: float, v: float) -> wp.vec3:
    local = square_to_cosine_hemisphere(u, v)
    if choice < shading.specular_share:
        local = square_to_visible_reflection(wp.transpose(frame) * shading.view, shading.alpha, u, v)
    return frame * local


@wp.func
def power_heuristic(pdf: float, other: float) -> float:
    """pdf^2 / (pdf^2 + other^2), for pdf above 0; written so that squares cannot overflow."""
    ratio = other / pdf
    return 1.0 / (1.0 + ratio * ratio)


@wp.func
def path_radiance(
    surface: MeshSurface,
    environment: EnvironmentDistribution,
    albedo_table: wp.array2d[wp.vec2],
    start: SurfacePoint,
    start_view: wp.vec3,
    stream: wp.uint32,
    sample: int,
    bounce_count: int,
) -> wp.vec3:
    """One sample of the radiance that leaves ``start`` towards ``start_view``."""
    total = wp.vec3(0.0)
    throughput = wp.vec3(1.0)
    point = start
    view = start_view
    for bounce in range(bounce_count + 1):
        shading = shading_of(point, view, albedo_table)
        frame = tangent_frame(shading.normal)
        pair = 1 + bounce * PAIRS_PER_VERTEX

        at = sample_pair(sample, stream, pair)
        light = square_to_environment(environment, at[0], at[1])
        if light.pdf > 0.0 and wp.dot(shading.normal, light.direction) > 0.0:
            if is_open(surface, point.origin, light.direction):
                weight = power_heuristic(light.pdf, brdf_pdf(shading, frame, light.direction))
                total += wp.cw_mul(
                    wp.cw_mul(throughput, brdf_cosine(shading, light.direction)), light.radiance * (weight / light.pdf)
                )

        at = sample_pair(sample, stream, pair + 1)
        choice = sample_pair(sample, stream, pair + 2)
        direction = brdf_direction(shading, frame, choice[0], at[0], at[1])
        if wp.dot(shading.normal, direction) <= 0.0:
            break
        pdf = brdf_pdf(shading, frame, direction)
        throughput = wp.cw_mul(throughput, brdf_cosine(shading, direction)) / pdf
        hit = closest_hit(surface, point.origin, direction)
        if not hit.found:
            weight = power_heuristic(pdf, square_to_environment_pdf(environment, direction))
            total += wp.cw_mul(throughput, environment_radiance(environment, direction)) * weight
            break
        if not hit.front:  # inside: a mesh that is closed shows its back only through rounding at an edge
            break
        point = surface_point(surface, hit.face, hit.weights)
        view = -direction
    return total


@wp.kernel
def trace_pixels_kernel(
    first: int,
    surface: MeshSurface,
    environment: EnvironmentDistribution,
    albedo_table: wp.array2d[wp.vec2],
    rays: PixelRays,
    seed: wp.uint32,
    sample_count: int,
    bounce_count: int,
    out_radiance: wp.array[wp.vec3],
    out_alpha: wp.array[float],
):
    pixel = first + wp.tid()
    stream = stream_of(seed, wp.uint32(0), wp.uint32(pixel))
    total = wp.vec3(0.0)
    covered = int(0)
    for sample in range(sample_count):
        direction = pixel_direction(rays, pixel, sample_pair(sample, stream, 0))
        hit = closest_hit(surface, rays.origin, direction)
        if hit.found:
            covered += 1
            if hit.front:
                point = surface_point(surface, hit.face, hit.weights)
                total += path_radiance(
                    surface, environment, albedo_table, point, -direction, stream, sample, bounce_count
                )
    out_radiance[pixel] = total / float(sample_count)
    out_alpha[pixel] = float(covered) / float(sample_count)


@wp.kernel
def trace_outgoing_kernel(
    first: int,
    surface: MeshSurface,
    environment: EnvironmentDistribution,
    albedo_table: wp.array2d[wp.vec2],
    faces: wp.array[int],
    weights: wp.array[wp.vec3],
    directions: wp.array2d[wp.vec3],
    seed: wp.uint32,
    sample_count: int,
    bounce_count: int,
    out_radiance: wp.array2d[wp.vec3],
):
    """A point's directions share one sample set, so that what is averaged over them is stratified as a whole."""
    index = first + wp.tid()
    stream = stream_of(seed, wp.uint32(1), wp.uint32(index))
    point = surface_point(surface, faces[index], weights[index])
    for d in range(directions.shape[1]):
        total = wp.vec3(0.0)
        for sample in range(sample_count):
            total += path_radiance(
                surface,
                environment,
                albedo_table,
                point,
                directions[index, d],
                stream,
                d * sample_count + sample,
                bounce_count,
            )
        out_radiance[index, d] = total / float(sample_count)


def launch_trace_pixels(
    surface, environment, albedo_table, rays, seed, sample_count, bounce_count, out_radiance, out_alpha
):
    """Estimate premultiplied radiance and coverage of every pixel."""
    launch(
        trace_pixels_kernel,
        len(out_alpha),
        inputs=[surface, environment, albedo_table, rays, wp.uint32(seed), sample_count, bounce_count],
        outputs=[out_radiance, out_alpha],
        device=out_alpha.device,
        block_dim=64,
        min_chunk=PIXEL_CHUNK,
    )


def launch_trace_outgoing(
    surface, environment, albedo_table, faces, weights, directions, seed, sample_count, bounce_count, out_radiance
):
    """Estimate the radiance that leaves every point in each of its directions."""
    launch(
        trace_outgoing_kernel,
        len(faces),
        inputs=[
            surface,
            environment,
            albedo_table,
            faces,
            weights,
            directions,
            wp.uint32(seed),
            sample_count,
            bounce_count,
        ],
        outputs=[out_radiance],
        device=faces.device,
        block_dim=64,
    )
