"""Path tracing of Gaussians and triangles under an environment and lights: one pass of samples over some pixels.

At every vertex all emitters are sampled directly and the BSDF is sampled on; each emitter's two estimates are combined
by the power heuristic (Veach 1997). Transmittance to an emitter multiplies what it sheds; rays that go on are stopped
by Gaussians with the probability of their alpha, so that both have the same mean.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.common.luminance import LUMINANCE
from beam_warp.kernels.common.pixel_sampling import PIXEL_CHUNK, PixelRays, pixel_direction, sample_pair
from beam_warp.kernels.common.sampling import hash_combine, stream_of, tangent_frame
from beam_warp.kernels.light.latlong import latlong_nearest
from beam_warp.kernels.light.lights import Lights, disc_pdf, disc_radiance, disc_reach, light_disc, sample_disc
from beam_warp.kernels.light.product_tree import (
    ProductTree,
    square_to_product_tree,
    square_to_product_tree_pdf,
    total_weight,
)
from beam_warp.kernels.light.scattering import (
    Shading,
    brdf_cosine,
    brdf_direction,
    brdf_pdf,
    power_heuristic,
    shading_of,
)
from beam_warp.kernels.render.path_vertices import PathMaterials, Vertex, first_vertex, lifted_vertex, next_vertex
from beam_warp.kernels.trace.closest_surface import HIT_THREADS
from beam_warp.kernels.trace.occluders import transmittance
from beam_warp.kernels.trace.settings import TraceSettings

wp.set_module_options({"enable_backward": False})

FIRST_PAIRS = wp.constant(2)
"""Pairs of random numbers before the first vertex: place in the pixel, choice of layer."""

VERTEX_PAIRS = wp.constant(3)
"""Pairs at a vertex besides one for each light: environment, BSDF direction, choice of lobe."""


@wp.struct
class PathLight:
    """All that sheds light."""

    environment: ProductTree
    has_environment: int
    turn: wp.vec2  # cosine and sine of the environment's rotation about z
    lights: Lights  # positions relative to the scene's origin
    albedo_table: wp.array2d[wp.vec2]


@wp.struct
class PathPass:
    """One pass over some pixels."""

    seed: wp.uint32
    samples: int  # of a pixel
    bounces: int  # after the first surface, at most


@wp.struct
class PathImages:
    """Sums over samples, a row for each pixel; means over coverage are taken when an image is asked for."""

    counts: wp.array[int]  # samples
    radiance: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]  # the part of it that came by way of another surface
    moments: wp.array[wp.vec2]  # of luminance, over passes: sum of pass means and of their squares
    passes: wp.array[int]
    coverage: wp.array[float]
    base_color: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    roughness: wp.array[float]
    distance: wp.array[float]  # along the optical axis
    caught: wp.array[wp.vec3]  # samples on catchers, their luminance with nothing in the way, and as it is


@wp.struct
class Gathered:
    """Light that a vertex scatters to the viewer, as it is and with nothing in the way of emitters."""

    shadowed: wp.vec3
    open: wp.vec3


@wp.func
def turned(direction: wp.vec3, turn: wp.vec2) -> wp.vec3:
    """Rotated about z by the angle of (cos, sin)."""
    return wp.vec3(
        turn[0] * direction[0] - turn[1] * direction[1], turn[1] * direction[0] + turn[0] * direction[1], direction[2]
    )


@wp.func
def turned_back(direction: wp.vec3, turn: wp.vec2) -> wp.vec3:
    return turned(direction, wp.vec2(turn[0], -turn[1]))


@wp.func
def scattered(shading: Shading, direction: wp.vec3, radiance: wp.vec3, pdf: float) -> wp.vec3:
    """What a sampled emitter adds, weighted against finding it by the BSDF."""
    weight = power_heuristic(pdf, brdf_pdf(shading, tangent_frame(shading.normal), direction))
    return wp.cw_mul(brdf_cosine(shading, direction), radiance) * (weight / pdf)


@wp.func
def gather_environment(
    occluders: Any, settings: TraceSettings, light: PathLight, vertex: Vertex, shading: Shading, at: wp.vec2
) -> Gathered:
    result = Gathered()
    normal = turned_back(shading.normal, light.turn)
    sample = square_to_product_tree(light.environment, normal, total_weight(light.environment, normal), at[0], at[1])
    direction = turned(sample.direction, light.turn)
    if sample.pdf > 0.0 and wp.dot(shading.normal, direction) > 0.0:
        result.open = scattered(shading, direction, sample.radiance, sample.pdf)
        result.shadowed = result.open * transmittance(
            occluders, settings, vertex.origin, direction, LARGEST_FLOAT, wp.uint32(0)
        )
    return result


@wp.func
def gather_light(
    occluders: Any, settings: TraceSettings, lights: Lights, k: int, vertex: Vertex, shading: Shading, at: wp.vec2
) -> Gathered:
    result = Gathered()
    disc = light_disc(lights, k, vertex.position)
    direction = disc.direction
    reach = disc.distance
    if wp.dot(disc.irradiance, LUMINANCE) > 0.0:
        if disc.sine > 0.0:
            sample = sample_disc(disc, at[0], at[1])
            direction = sample.direction
            reach = sample.reach
            if wp.dot(shading.normal, direction) > 0.0:
                result.open = scattered(shading, direction, sample.radiance, sample.pdf)
        elif wp.dot(shading.normal, direction) > 0.0:
            result.open = wp.cw_mul(brdf_cosine(shading, direction), disc.irradiance)
        result.shadowed = result.open
        if lights.shadowed[k] == 1 and wp.dot(result.open, LUMINANCE) > 0.0:
            result.shadowed = result.open * transmittance(
                occluders, settings, vertex.origin, direction, reach, wp.uint32(0)
            )
    return result


@wp.func
def found_by_chance(
    light: PathLight, vertex: Vertex, shading: Shading, direction: wp.vec3, t_hit: float, pdf: float
) -> Gathered:
    """Emitters that a ray drawn by the BSDF with density ``pdf`` runs into, weighted against sampling them."""
    result = Gathered()
    if light.has_environment == 1:
        local = turned_back(direction, light.turn)
        normal = turned_back(shading.normal, light.turn)
        other = square_to_product_tree_pdf(light.environment, normal, total_weight(light.environment, normal), local)
        result.open = latlong_nearest(light.environment.blocks.radiance, local) * power_heuristic(pdf, other)
        if t_hit == LARGEST_FLOAT:
            result.shadowed = result.open
    for k in range(light.lights.count):
        if light.lights.sizes[k] > 0.0:
            disc = light_disc(light.lights, k, vertex.position)
            light_pdf = disc_pdf(disc, direction)
            if light_pdf > 0.0:
                seen = disc_radiance(disc) * power_heuristic(pdf, light_pdf)
                result.open += seen
                reach = disc_reach(disc, wp.dot(disc.direction, direction))
                if t_hit >= reach or light.lights.shadowed[k] == 0:
                    result.shadowed += seen
    return result


@wp.struct
class PathSample:
    radiance: wp.vec3
    indirect: wp.vec3
    open: wp.vec3  # direct light with nothing in the way


@wp.func
def path_sample(
    occluders: Any,
    materials: PathMaterials,
    settings: TraceSettings,
    light: PathLight,
    start: Vertex,
    start_view: wp.vec3,
    stream: wp.uint32,
    sample: int,
    bounce_count: int,
) -> PathSample:
    """One sample of the radiance that leaves ``start`` towards ``start_view``."""
    result = PathSample()
    throughput = wp.vec3(1.0)
    vertex = start
    view = start_view
    pairs = VERTEX_PAIRS + light.lights.count
    for bounce in range(bounce_count + 1):
        shading = shading_of(vertex.normal, view, vertex.base_color, vertex.roughness, light.albedo_table)
        frame = tangent_frame(shading.normal)
        pair = FIRST_PAIRS + bounce * pairs
        gathered = wp.vec3(0.0)
        open = wp.vec3(0.0)
        if light.has_environment == 1:
            found = gather_environment(occluders, settings, light, vertex, shading, sample_pair(sample, stream, pair))
            gathered += found.shadowed
            open += found.open
        for k in range(light.lights.count):
            found = gather_light(
                occluders,
                settings,
                light.lights,
                k,
                vertex,
                shading,
                sample_pair(sample, stream, pair + VERTEX_PAIRS + k),
            )
            gathered += found.shadowed
            open += found.open

        at = sample_pair(sample, stream, pair + 1)
        choice = sample_pair(sample, stream, pair + 2)
        direction = brdf_direction(shading, frame, choice[0], at[0], at[1])
        following = Vertex()
        onward = wp.vec3(0.0)
        if wp.dot(shading.normal, direction) > 0.0:
            pdf = brdf_pdf(shading, frame, direction)
            onward = brdf_cosine(shading, direction) / pdf
            following = next_vertex(
                occluders,
                materials,
                settings,
                vertex.origin,
                direction,
                hash_combine(hash_combine(stream, wp.uint32(sample)), wp.uint32(bounce)),
            )
            t_hit = LARGEST_FLOAT
            if following.found:
                t_hit = following.t
            found = found_by_chance(light, vertex, shading, direction, t_hit, pdf)
            gathered += wp.cw_mul(onward, found.shadowed)
            open += wp.cw_mul(onward, found.open)
        gathered = wp.cw_mul(throughput, gathered)
        result.radiance += gathered
        if bounce == 0:
            result.open = open
        else:
            result.indirect += gathered
        if not following.found or bounce == bounce_count:
            break
        throughput = wp.cw_mul(throughput, onward)
        view = -direction
        if following.on_gaussian:
            following = lifted_vertex(occluders, following)
        vertex = following
    return result


@wp.kernel(enable_backward=False, module="unique", module_options={"fast_math": True})
def trace_paths_kernel(
    first: int,
    occluders: Any,
    materials: PathMaterials,
    settings: TraceSettings,
    light: PathLight,
    rays: PixelRays,
    pixels: wp.array[int],
    tracing: PathPass,
    out_images: PathImages,
):
    pixel = pixels[first + wp.tid()]
    stream = stream_of(tracing.seed, wp.uint32(0), wp.uint32(pixel))
    begin = out_images.counts[pixel]
    axis = wp.vec3(rays.camera_to_world[0, 2], rays.camera_to_world[1, 2], rays.camera_to_world[2, 2])
    radiance = wp.vec3(0.0)
    indirect = wp.vec3(0.0)
    base_color = wp.vec3(0.0)
    normal = wp.vec3(0.0)
    roughness = float(0.0)
    distance = float(0.0)
    coverage = float(0.0)
    caught = wp.vec3(0.0)
    for sample in range(begin, begin + tracing.samples):
        direction = pixel_direction(rays, pixel, sample_pair(sample, stream, 0))
        choice = sample_pair(sample, stream, 1)
        vertex = first_vertex(occluders, materials, settings, rays.origin, direction, choice[0])
        if vertex.found:
            if vertex.on_gaussian:
                vertex = lifted_vertex(occluders, vertex)
            bounces = tracing.bounces
            if vertex.catches:  # only the light that is missing is asked for
                vertex.base_color = wp.vec3(1.0)
                vertex.roughness = 1.0
                bounces = 0
            path = path_sample(occluders, materials, settings, light, vertex, -direction, stream, sample, bounces)
            if vertex.catches:
                caught += wp.vec3(1.0, wp.dot(path.open, LUMINANCE), wp.dot(path.radiance, LUMINANCE))
            else:
                coverage += 1.0
                radiance += path.radiance
                indirect += path.indirect
                base_color += vertex.base_color
                normal += vertex.normal
                roughness += vertex.roughness
                distance += vertex.t * wp.dot(direction, axis)
    mean = wp.dot(radiance, LUMINANCE) / float(tracing.samples)
    out_images.counts[pixel] = begin + tracing.samples
    out_images.passes[pixel] = out_images.passes[pixel] + 1
    out_images.radiance[pixel] = out_images.radiance[pixel] + radiance
    out_images.indirect[pixel] = out_images.indirect[pixel] + indirect
    out_images.moments[pixel] = out_images.moments[pixel] + wp.vec2(mean, mean * mean)
    out_images.coverage[pixel] = out_images.coverage[pixel] + coverage
    out_images.base_color[pixel] = out_images.base_color[pixel] + base_color
    out_images.normals[pixel] = out_images.normals[pixel] + normal
    out_images.roughness[pixel] = out_images.roughness[pixel] + roughness
    out_images.distance[pixel] = out_images.distance[pixel] + distance
    out_images.caught[pixel] = out_images.caught[pixel] + caught


launch_trace_paths = launcher(trace_paths_kernel, block_dim=HIT_THREADS, min_chunk=PIXEL_CHUNK)
"""Add a pass of samples to each of ``pixels``, numbers that must differ from each other."""
