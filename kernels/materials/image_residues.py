"""Diffuse and specular residue of surface points towards one camera (BEAM Eqs. 5 and 6), by independent samples.

Both come from the same rays. A point's rays are drawn by three densities: the environment, the cosine, and the visible
normals of its GGX lobe; each is divided by the density of all three together (balance heuristic, Veach 1997, 9.2), so
that none alone can make a sample weigh much.
"""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.common.sampling import (
    SampleSet,
    draw_square,
    hash_combine,
    square_to_cosine_hemisphere,
    square_to_cosine_hemisphere_pdf,
    stream_of,
    tangent_frame,
)
from beam_warp.kernels.common.spread import Spread, add_term, variance_of_sum
from beam_warp.kernels.light.brdf import ALPHA_FLOOR, PI, fresnel_schlick, specular_albedo, specular_brdf
from beam_warp.kernels.light.environment_sampling import (
    EnvironmentDistribution,
    environment_radiance,
    square_to_environment,
    square_to_environment_pdf,
)
from beam_warp.kernels.light.ggx_sampling import square_to_visible_reflection, square_to_visible_reflection_pdf
from beam_warp.kernels.materials.pixel_surfaces import PixelSurfaces
from beam_warp.kernels.materials.residues import FRESNEL_HV, brightness
from beam_warp.kernels.trace.surface_rays import RayBatch, ray_origin
from beam_warp.kernels.trace.visibility import Rays

wp.set_module_options({"enable_backward": False})

RESIDUE_STREAM = wp.constant(wp.uint32(0x52455349))


@wp.struct
class ResidueSamples:
    """Samples of a point, shared among densities: the first ones, the next ones, the rest."""

    set: SampleSet
    environment_count: int
    cosine_count: int


@wp.struct
class Residues:
    """Radiance of a white diffuser and of the specular lobe by row, with the standard errors of their means over the
    channels."""

    diffuse: wp.array[wp.vec3]
    specular: wp.array[wp.vec3]
    diffuse_error: wp.array[float]
    specular_error: wp.array[float]


@wp.func
def mixture_pdf(samples: ResidueSamples, environment_pdf: float, cosine_pdf: float, lobe_pdf: float) -> float:
    """Density of a point's samples by all three densities together."""
    lobe_count = samples.set.count - samples.environment_count - samples.cosine_count
    total = float(samples.environment_count) * environment_pdf
    total += float(samples.cosine_count) * cosine_pdf + float(lobe_count) * lobe_pdf
    return total / float(samples.set.count)


@wp.kernel
def draw_residue_rays_kernel(
    first: int,
    samples: ResidueSamples,
    distribution: EnvironmentDistribution,
    batch: RayBatch,
    surfaces: PixelSurfaces,
    seed: wp.uint32,
    frame: wp.uint32,
    out_rays: Rays,
    out_weights: wp.array[wp.vec3],
):
    """One ray a thread, and its radiance times cosine over density; what brings no light is not traced."""
    item = first + wp.tid()
    place = item / samples.set.count
    index = item % samples.set.count
    row = batch.rows[place]
    basis = tangent_frame(batch.normals[place])
    view = wp.transpose(basis) * surfaces.to_camera[row]
    alpha = wp.max(surfaces.roughness[row] * surfaces.roughness[row], ALPHA_FLOOR)
    stream = hash_combine(stream_of(seed, frame, wp.uint32(row)), RESIDUE_STREAM)
    square = draw_square(samples.set, index, stream)
    light = wp.vec3()
    direction = wp.vec3()
    radiance = wp.vec3()
    environment_pdf = float(0.0)
    if index < samples.environment_count:
        # The texel's own radiance and density: its direction, rounded at an edge, may lie in the texel next door.
        drawn = square_to_environment(distribution, square.u, square.v)
        direction = drawn.direction
        light = wp.transpose(basis) * direction
        radiance = drawn.radiance
        environment_pdf = drawn.pdf
    else:
        if index < samples.environment_count + samples.cosine_count:
            light = square_to_cosine_hemisphere(square.u, square.v)
        else:
            light = square_to_visible_reflection(view, alpha, square.u, square.v)
        direction = basis * light
        radiance = environment_radiance(distribution, direction)
        environment_pdf = square_to_environment_pdf(distribution, direction)
    weight = wp.vec3()
    if light[2] > 0.0:
        pdf = mixture_pdf(
            samples,
            environment_pdf,
            square_to_cosine_hemisphere_pdf(light),
            square_to_visible_reflection_pdf(view, light, alpha),
        )
        weight = radiance * (light[2] / pdf)
    ray = place * batch.sample_count + index
    out_weights[ray] = weight
    out_rays.origins[ray] = ray_origin(batch, place)
    out_rays.directions[ray] = direction
    out_rays.reaches[ray] = wp.where(weight[0] + weight[1] + weight[2] > 0.0, float(LARGEST_FLOAT), -1.0)


@wp.kernel
def reduce_residues_kernel(
    first: int,
    batch: RayBatch,
    surfaces: PixelSurfaces,
    directions: wp.array[wp.vec3],
    weights: wp.array[wp.vec3],
    visibility: wp.array[float],
    albedo_table: wp.array2d[wp.vec2],
    diffuse_weight: int,
    out_residues: Residues,
):
    """Means over a point's samples."""
    place = first + wp.tid()
    row = batch.rows[place]
    n = batch.normals[place]
    v = surfaces.to_camera[row]
    roughness = surfaces.roughness[row]
    kept = 1.0 - specular_albedo(albedo_table, wp.dot(n, v), roughness)
    diffuse = wp.vec3()
    specular = wp.vec3()
    diffuse_spread = Spread()
    specular_spread = Spread()
    for k in range(batch.sample_count):
        ray = place * batch.sample_count + k
        light = directions[ray]
        arriving = weights[ray] * visibility[ray]
        share = kept
        if diffuse_weight == FRESNEL_HV:
            share = 1.0 - fresnel_schlick(wp.dot(v, wp.normalize(v + light)))
        to_diffuse = arriving * (share / PI)
        to_specular = arriving * specular_brdf(n, v, light, roughness)
        diffuse += to_diffuse
        specular += to_specular
        diffuse_spread = add_term(diffuse_spread, brightness(to_diffuse) / 3.0)
        specular_spread = add_term(specular_spread, brightness(to_specular) / 3.0)
    count = float(batch.sample_count)
    out_residues.diffuse[row] = diffuse / count
    out_residues.specular[row] = specular / count
    out_residues.diffuse_error[row] = wp.sqrt(variance_of_sum(diffuse_spread)) / count
    out_residues.specular_error[row] = wp.sqrt(variance_of_sum(specular_spread)) / count


def launch_draw_residue_rays(
    samples, distribution, batch, surfaces, stream: tuple[int, int], out_rays, out_weights, device
):
    """Draw a batch's rays towards the light; ``stream`` is (seed, frame)."""
    launch(
        draw_residue_rays_kernel,
        len(batch.rows) * samples.set.count,
        inputs=[samples, distribution, batch, surfaces, *map(wp.uint32, stream)],
        outputs=[out_rays, out_weights],
        device=device,
        block_dim=128,
    )


launch_reduce_residues = launcher(reduce_residues_kernel, block_dim=64)
"""Add up each point's samples, in its own row."""
