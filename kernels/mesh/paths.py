"""Path tracing of a mesh under a distant environment: radiance on pixels, and radiance that leaves surface points.

At every vertex of a path the environment is sampled directly and the BRDF is sampled on, and the two are combined by
multiple importance sampling with the power heuristic (Veach 1997). What a point scatters: see
`beam_warp.kernels.light.scattering`.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.common.pixel_sampling import PIXEL_CHUNK, PixelRays, pixel_direction, sample_pair
from beam_warp.kernels.common.sampling import stream_of, tangent_frame
from beam_warp.kernels.light.environment_sampling import (
    EnvironmentDistribution,
    environment_radiance,
    square_to_environment,
    square_to_environment_pdf,
)
from beam_warp.kernels.light.scattering import brdf_cosine, brdf_direction, brdf_pdf, power_heuristic, shading_of
from beam_warp.kernels.mesh.surface import MeshSurface, SurfacePoint, closest_hit, is_open, surface_point

wp.set_module_options({"enable_backward": False})

PAIRS_PER_VERTEX = wp.constant(3)
"""Pairs of random numbers at a vertex of a path: light, BRDF direction, choice of lobe."""


@wp.struct
class LitMesh:
    """A mesh, the environment that lights it, and the table that its shading reads."""

    surface: MeshSurface
    environment: EnvironmentDistribution
    albedo_table: wp.array2d[wp.vec2]  # directional albedo of the specular lobe


@wp.func
def path_radiance(
    lit: LitMesh, start: SurfacePoint, start_view: wp.vec3, stream: wp.uint32, sample: int, bounce_count: int
) -> wp.vec3:
    """One sample of the radiance that leaves ``start`` towards ``start_view``."""
    total = wp.vec3(0.0)
    throughput = wp.vec3(1.0)
    point = start
    view = start_view
    for bounce in range(bounce_count + 1):
        shading = shading_of(point.normal, view, point.base_color, point.roughness, lit.albedo_table)
        frame = tangent_frame(shading.normal)
        pair = 1 + bounce * PAIRS_PER_VERTEX

        at = sample_pair(sample, stream, pair)
        light = square_to_environment(lit.environment, at[0], at[1])
        if light.pdf > 0.0 and wp.dot(shading.normal, light.direction) > 0.0:
            if is_open(lit.surface, point.origin, light.direction):
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
        hit = closest_hit(lit.surface, point.origin, direction)
        if not hit.found:
            weight = power_heuristic(pdf, square_to_environment_pdf(lit.environment, direction))
            total += wp.cw_mul(throughput, environment_radiance(lit.environment, direction)) * weight
            break
        if not hit.front:  # inside: a mesh that is closed shows its back only through rounding at an edge
            break
        point = surface_point(lit.surface, hit.face, hit.weights)
        view = -direction
    return total


@wp.kernel
def trace_pixels_kernel(
    first: int,
    lit: LitMesh,
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
        hit = closest_hit(lit.surface, rays.origin, direction)
        if hit.found:
            covered += 1
            if hit.front:
                point = surface_point(lit.surface, hit.face, hit.weights)
                total += path_radiance(lit, point, -direction, stream, sample, bounce_count)
    out_radiance[pixel] = total / float(sample_count)
    out_alpha[pixel] = float(covered) / float(sample_count)


@wp.kernel
def trace_outgoing_kernel(
    first: int,
    lit: LitMesh,
    faces: wp.array[int],
    weights: wp.array[wp.vec3],
    directions: wp.array2d[wp.vec3],
    seed: wp.uint32,
    sample_count: int,
    bounce_count: int,
    out_radiance: wp.array2d[wp.vec3],
):
    """A point's directions share one sample set, so that an average over them is stratified as a whole."""
    index = first + wp.tid()
    stream = stream_of(seed, wp.uint32(1), wp.uint32(index))
    point = surface_point(lit.surface, faces[index], weights[index])
    for d in range(directions.shape[1]):
        total = wp.vec3(0.0)
        for sample in range(sample_count):
            total += path_radiance(lit, point, directions[index, d], stream, d * sample_count + sample, bounce_count)
        out_radiance[index, d] = total / float(sample_count)


def lit_mesh(surface, environment, albedo_table) -> LitMesh:
    """Put together the input of paths."""
    lit = LitMesh()
    lit.surface, lit.environment, lit.albedo_table = surface, environment, albedo_table
    return lit


def launch_trace_pixels(lit, rays, seed, sample_count, bounce_count, out_radiance, out_alpha):
    """Estimate premultiplied radiance and coverage of every pixel."""
    launch(
        trace_pixels_kernel,
        len(out_alpha),
        inputs=[lit, rays, wp.uint32(seed), sample_count, bounce_count],
        outputs=[out_radiance, out_alpha],
        device=out_alpha.device,
        block_dim=64,
        min_chunk=PIXEL_CHUNK,
    )


def launch_trace_outgoing(lit, faces, weights, directions, seed, sample_count, bounce_count, out_radiance):
    """Estimate the radiance that leaves every point in each of its directions."""
    inputs = [lit, faces, weights, directions, wp.uint32(seed), sample_count, bounce_count]
    launch(trace_outgoing_kernel, len(faces), inputs=inputs, outputs=[out_radiance], device=faces.device, block_dim=64)
