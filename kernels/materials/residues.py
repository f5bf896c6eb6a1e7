"""Diffuse and specular residues of every view of a Gaussian under the traced light, and the fit of base colour to them.

Rays are traced once per Gaussian; every view's residues (BEAM Eqs. 4 and 5) come from the same rays, because visibility
does not depend on the view. Light without anything in the way is known in closed form (irradiance, small sources) or
blurred beforehand (what else a specular lobe sees); rays only say which share of it arrives (ratio estimator, Heitz et
al. 2018).
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.common.sampling import (
    hash_combine,
    owen_sobol_x,
    owen_sobol_y,
    square_to_cosine_hemisphere,
    stream_of,
    tangent_frame,
    unit_float,
)
from beam_warp.kernels.common.spherical_harmonics import captured_radiance
from beam_warp.kernels.common.spread import Spread, add_term, variance_of_sum
from beam_warp.kernels.light.brdf import ALPHA_FLOOR, fresnel_schlick, specular_albedo, specular_brdf
from beam_warp.kernels.light.lights import Lights, light_disc
from beam_warp.kernels.light.scattering import disc_specular
from beam_warp.kernels.light.shading import EnvironmentLight, reflected_radiance
from beam_warp.kernels.trace.occluders import sampled_hit
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.surface_rays import RayBatch, ray_origin

wp.set_module_options({"enable_backward": False})

BOUNCE_STREAM = wp.constant(wp.uint32(0x424F554E))

LEAST_VIEW_COSINE = wp.constant(0.02)
"""Views below this n.v see the edge of the surface, where no residue is defined."""

GRAZING = wp.constant(0.2)
FACING = wp.constant(0.5)
"""n.v from which on views count, and from which on they count fully: before, the shading normal decides."""

ROUNDS = wp.constant(3)
"""Rounds of reweighting: by then the weights have settled."""

RELATIVE_SPREAD = wp.constant(0.1)
LEAST_SPREAD = wp.constant(0.01)
"""Residual at which a view counts half: a tenth of what is explained, and for dark colours no less than this."""

ALBEDO_SCALING = wp.constant(0)
FRESNEL_HV = wp.constant(1)


@wp.struct
class LightRays:
    """Rays towards the environment as a batch lays them out, and what they found."""

    directions: wp.array[wp.vec3]
    weights: wp.array[wp.vec3]  # radiance times cosine over pi times density
    visibility: wp.array[float]
    paired: int  # whether rays come one from each stratum


@wp.struct
class ReflectedLight:
    """What specular lobes see of an environment: its suns and lamps, and the rest of it, blurred."""

    sources: Lights  # all of them distant, at most four
    rest: EnvironmentLight


@wp.struct
class GatheredLight:
    """Light at each point, by row."""

    unshadowed: wp.array[wp.vec3]  # irradiance over pi with nothing in the way
    arriving: wp.array[wp.vec3]  # irradiance over pi through what is in the way
    bounce: wp.array[wp.vec3]  # irradiance over pi from what the rays hit
    bounce_error: wp.array[float]  # standard error of the sum of its channels
    noise: wp.array[float]  # standard error of the arriving light over itself
    source_shares: wp.array[wp.vec4]  # part of each small source that nothing is in the way of
    tilt: wp.array[float]  # change of the logarithm of the arriving light for each radian that the normal turns


@wp.struct
class Observations:
    """Colours of points towards views, and their residues under the light: row v of each array is view v."""

    colors: wp.array2d[wp.vec4]  # radiance, and its weight, 0 where the view does not see the point
    directions: wp.array2d[wp.vec3]  # unit, towards the viewer
    specular: wp.array2d[wp.vec3]  # L_S
    diffuse_share: wp.array2d[float]  # what the specular lobe leaves for diffusion


@wp.struct
class ColorFit:
    """Sums of the weighted least-squares problem for base colour, per point and channel."""

    numerator: wp.array[wp.vec3]  # sum of w L_D (L_o - L_S)
    denominator: wp.array[wp.vec3]  # sum of w L_D^2
    observed: wp.array[wp.vec3]  # sum of w (L_o - L_S)^2
    views: wp.array[float]  # how many equally good views the weights are worth
    facing: wp.array[float]  # part of the weight of what was seen that was not seen grazing


@wp.func
def brightness(color: wp.vec3) -> float:
    return color[0] + color[1] + color[2]


@wp.kernel
def trace_bounce_kernel(
    first: int,
    occluders: Any,
    settings: TraceSettings,
    batch: RayBatch,
    gaussian_radiance: wp.array[wp.vec3],
    seed: wp.uint32,
    frame: wp.uint32,
    counts: wp.array[int],
    out_light: GatheredLight,
):
    """Irradiance over pi from the captured radiance of what cosine-distributed rays hit: one bounce, already lit.

    Each row has its count of rays, at least 2. Its standard error takes them as independent.
    """
    place = first + wp.tid()
    row = batch.rows[place]
    count = counts[row]
    basis = tangent_frame(batch.normals[place])
    origin = ray_origin(batch, place)
    stream = hash_combine(stream_of(seed, frame, wp.uint32(row)), BOUNCE_STREAM)
    total = wp.vec3()
    squares = float(0.0)
    for sample in range(count):
        direction = basis * square_to_cosine_hemisphere(
            unit_float(owen_sobol_x(sample, stream)), unit_float(owen_sobol_y(sample, stream))
        )
        hit = sampled_hit(
            occluders, settings, origin, direction, LARGEST_FLOAT, hash_combine(stream, wp.uint32(sample + 16))
        )
        if hit >= 0:
            total += gaussian_radiance[hit]
            squares += brightness(gaussian_radiance[hit]) * brightness(gaussian_radiance[hit])
    rays = float(count)
    sum = brightness(total)
    out_light.bounce[row] = total / rays
    out_light.bounce_error[row] = wp.sqrt(wp.max(squares - sum * sum / rays, 0.0) / (rays * (rays - 1.0)))


@wp.func
def source_towards(sources: Lights, direction: wp.vec3) -> int:
    """Which small source a ray goes to, -1 for none. What was taken for a source lies within twice its half angle."""
    found = int(-1)
    for k in range(sources.count):
        middle = -sources.directions[k]
        if wp.dot(middle, direction) > 0.0 and wp.length(wp.cross(middle, direction)) <= 2.0 * sources.sizes[k]:
            found = k
    return found


@wp.kernel
def gather_light_kernel(
    first: int, batch: RayBatch, rays: LightRays, ratio: int, sources: Lights, out_light: GatheredLight
):
    """Arriving light: E_unshadowed * sum V f / sum f, or the mean of V f; its noise; what a turn of the normal does.

    Where no ray found light, half of the unshadowed light is stated, give or take all of it. A small source that no ray
    went to is as open as the light in all.
    """
    place = first + wp.tid()
    row = batch.rows[place]
    begin = place * batch.sample_count
    n = batch.normals[place]
    free = wp.vec3()
    seen = wp.vec3()
    slope = wp.vec3()
    source_free = wp.vec4()
    source_seen = wp.vec4()
    for k in range(batch.sample_count):
        ray = begin + k
        f = rays.weights[ray]
        free += f
        seen += f * rays.visibility[ray]
        source = source_towards(sources, rays.directions[ray])
        if source >= 0:
            source_free[source] += brightness(f)
            source_seen[source] += brightness(f) * rays.visibility[ray]
        cosine = wp.dot(n, rays.directions[ray])
        if cosine > 0.0:
            slope += rays.directions[ray] * (brightness(f) * rays.visibility[ray] / cosine)
    center = float(0.0)
    if ratio == 1 and brightness(free) > 0.0:
        center = brightness(seen) / brightness(free)
    spread = Spread()
    spread.paired = rays.paired
    for k in range(batch.sample_count):
        ray = begin + k
        spread = add_term(spread, brightness(rays.weights[ray]) * (rays.visibility[ray] - center))
    arriving = seen / float(batch.sample_count)
    if ratio == 1:
        for c in range(3):
            arriving[c] = 0.5 * out_light.unshadowed[row][c]
            if free[c] > 0.0:
                arriving[c] = out_light.unshadowed[row][c] * seen[c] / free[c]
    noise = float(1.0)
    tilt = float(0.0)
    total = brightness(seen)
    if total > 0.0:
        noise = wp.sqrt(variance_of_sum(spread)) / total
        tilt = wp.length(slope - n * wp.dot(n, slope)) / total
    shares = wp.vec4(1.0, 1.0, 1.0, 1.0)
    for k in range(4):
        if source_free[k] > 0.0:
            shares[k] = source_seen[k] / source_free[k]
        elif brightness(free) > 0.0:
            shares[k] = brightness(seen) / brightness(free)
    out_light.source_shares[row] = shares
    out_light.arriving[row] = arriving
    out_light.noise[row] = noise
    out_light.tilt[row] = tilt


@wp.struct
class ShadedPoints:
    """Normals and roughness of the points that are shaded, by row."""

    normals: wp.array[wp.vec3]
    roughness: wp.array[float]


@wp.func
def seen_share(
    rays: LightRays, sources: Lights, begin: int, count: int, n: wp.vec3, v: wp.vec3, roughness: float, otherwise: float
) -> float:
    """Part of the lobe's light that is open, small sources left out; ``otherwise`` where no ray is in the lobe."""
    free = float(0.0)
    seen = float(0.0)
    for k in range(count):
        ray = begin + k
        power = brightness(rays.weights[ray])
        if power > 0.0 and source_towards(sources, rays.directions[ray]) < 0:
            part = power * specular_brdf(n, v, rays.directions[ray], roughness)
            free += part
            seen += part * rays.visibility[ray]
    share = otherwise
    if free > 0.0:
        share = seen / free
    return share


@wp.func
def unreflected_share(rays: LightRays, begin: int, count: int, v: wp.vec3) -> float:
    """Mean of 1 - F(h.v) over the arriving light (BEAM's diffuse weight)."""
    seen = float(0.0)
    passed = float(0.0)
    for k in range(count):
        ray = begin + k
        power = brightness(rays.weights[ray]) * rays.visibility[ray]
        if power > 0.0:
            h = wp.normalize(v + rays.directions[ray])
            seen += power
            passed += power * (1.0 - fresnel_schlick(wp.dot(v, h)))
    share = float(1.0)
    if seen > 0.0:
        share = passed / seen
    return share


@wp.func
def specular_residue(
    reflected: ReflectedLight,
    light: GatheredLight,
    row: int,
    n: wp.vec3,
    v: wp.vec3,
    roughness: float,
    open_share: float,
) -> wp.vec3:
    """L_S of a point: the environment that is open, and what bounces, by the lobe's albedo; and its small sources."""
    albedo = specular_albedo(reflected.rest.albedo_terms, wp.dot(n, v), roughness)
    lobe = reflected_radiance(reflected.rest, n, v, roughness)
    total = (lobe * open_share + light.bounce[row]) * albedo
    alpha = wp.max(roughness * roughness, ALPHA_FLOOR)
    for k in range(reflected.sources.count):
        disc = light_disc(reflected.sources, k, wp.vec3())
        total += disc.irradiance * (disc_specular(n, v, alpha, disc) * light.source_shares[row][k])
    return total


@wp.kernel
def view_residues_kernel(
    first: int,
    batch: RayBatch,
    rays: LightRays,
    light: GatheredLight,
    reflected: ReflectedLight,
    surface: ShadedPoints,
    diffuse_weight: int,
    out_views: Observations,
):
    """Specular residue and diffuse share of one view of one point; views of a point are neighbours."""
    item = first + wp.tid()
    view_count = out_views.colors.shape[0]
    place = item / view_count
    view = item % view_count
    row = batch.rows[place]
    begin = place * batch.sample_count
    n = surface.normals[row]
    v = out_views.directions[view, row]
    cosine = wp.dot(n, v)
    specular = wp.vec3()
    share = float(0.0)
    if cosine > LEAST_VIEW_COSINE and out_views.colors[view, row][3] > 0.0:
        roughness = surface.roughness[row]
        free = brightness(light.unshadowed[row])
        openness = float(1.0)
        if free > 0.0:
            openness = brightness(light.arriving[row]) / free
        seen = seen_share(rays, reflected.sources, begin, batch.sample_count, n, v, roughness, openness)
        specular = specular_residue(reflected, light, row, n, v, roughness, seen)
        share = 1.0 - specular_albedo(reflected.rest.albedo_terms, cosine, roughness)
        if diffuse_weight == FRESNEL_HV:
            share = unreflected_share(rays, begin, batch.sample_count, v)
    out_views.specular[view, row] = specular
    out_views.diffuse_share[view, row] = share


@wp.func
def facing_weight(cosine: float) -> float:
    """0 for grazing views, 1 for those that face the surface."""
    return wp.clamp((cosine - GRAZING) / (FACING - GRAZING), 0.0, 1.0)


@wp.kernel
def fit_color_kernel(
    first: int, views: Observations, light: GatheredLight, surface: ShadedPoints, rounds: int, out_fit: ColorFit
):
    """Least-squares sums over views, outliers counted little in every round but the first (Cauchy's weights)."""
    row = first + wp.tid()
    n = surface.normals[row]
    arriving = light.arriving[row] + light.bounce[row]
    base_color = wp.vec3()
    numerator = wp.vec3()
    denominator = wp.vec3()
    observed = wp.vec3()
    weight_sum = float(0.0)
    square_sum = float(0.0)
    seen = float(0.0)
    faced = float(0.0)
    for turn in range(rounds + 1):
        numerator = wp.vec3()
        denominator = wp.vec3()
        observed = wp.vec3()
        weight_sum = float(0.0)
        square_sum = float(0.0)
        seen = float(0.0)
        faced = float(0.0)
        for view in range(views.colors.shape[0]):
            sample = views.colors[view, row]
            weight = sample[3] * facing_weight(wp.dot(n, views.directions[view, row]))
            seen += sample[3]
            if weight > 0.0:
                faced += weight
                diffuse = arriving * views.diffuse_share[view, row]
                target = wp.vec3(sample[0], sample[1], sample[2]) - views.specular[view, row]
                if turn > 0:
                    explained = wp.cw_mul(base_color, diffuse)
                    spread = wp.max(RELATIVE_SPREAD * brightness(explained) / 3.0, LEAST_SPREAD)
                    off = target - explained
                    weight = weight * spread * spread / (spread * spread + wp.dot(off, off))
                numerator += wp.cw_mul(diffuse, target) * weight
                denominator += wp.cw_mul(diffuse, diffuse) * weight
                observed += wp.cw_mul(target, target) * weight
                weight_sum += weight
                square_sum += weight * weight
        for c in range(3):
            base_color[c] = 0.0
            if denominator[c] > 0.0:
                base_color[c] = wp.clamp(numerator[c] / denominator[c], 0.0, 1.0)
    out_fit.numerator[row] = numerator
    out_fit.denominator[row] = denominator
    out_fit.observed[row] = observed
    out_fit.views[row] = wp.where(square_sum > 0.0, weight_sum * weight_sum / square_sum, 0.0)
    out_fit.facing[row] = wp.where(seen > 0.0, faced / seen, 0.0)


@wp.kernel
def sample_radiance_kernel(
    first: int,
    radiance: wp.array2d[wp.vec3],
    gaussians: wp.array[int],
    display_srgb: int,
    normals: wp.array[wp.vec3],
    views: wp.array[wp.vec3],
    out_colors: wp.array2d[wp.vec4],
    out_directions: wp.array2d[wp.vec3],
):
    """Captured radiance towards viewers that each point has around its normal, weighted by projected area."""
    row = first + wp.tid()
    basis = tangent_frame(normals[row])
    for view in range(views.shape[0]):
        v = basis * views[view]
        color = captured_radiance(radiance, gaussians[row], -v, display_srgb)
        out_colors[view, row] = wp.vec4(color[0], color[1], color[2], views[view][2])
        out_directions[view, row] = v


def launch_trace_bounce(scene, settings, batch, gaussian_radiance, stream, counts, out_light):
    """Gather one bounce by so many rays for each row; ``stream`` is (seed, frame)."""
    launch(
        trace_bounce_kernel,
        len(batch.rows),
        inputs=[scene.occluders, settings, batch, gaussian_radiance, *map(wp.uint32, stream), counts],
        outputs=[out_light],
        device=scene.device,
        block_dim=64,
    )


launch_gather_light = launcher(gather_light_kernel, block_dim=64)
"""Add up the light of a batch's rays."""


def launch_view_residues(batch, rays, light, reflected, surface, diffuse_weight, out_views, device):
    """Write the residues of every view of a batch's points."""
    launch(
        view_residues_kernel,
        len(batch.rows) * out_views.colors.shape[0],
        inputs=[batch, rays, light, reflected, surface, diffuse_weight],
        outputs=[out_views],
        device=device,
        block_dim=128,
    )


def launch_fit_color(views, light, surface, robust, out_fit, device):
    """Accumulate the least-squares sums of every point."""
    inputs = [views, light, surface, ROUNDS if robust else 0]
    launch(fit_color_kernel, len(surface.normals), inputs=inputs, outputs=[out_fit], device=device, block_dim=64)


launch_sample_radiance = launcher(sample_radiance_kernel, block_dim=64)
"""Take captured spherical harmonics for what views would show."""
