"""Irradiance that arrives at every Gaussian, straight from the environment and from lights, shadows taken into account.

With e_k(n) the irradiance that region k of an environment sheds on a normal and V_k the share of it that is seen, what
arrives is E(n) sum V_k e_k(n) / sum e_k(n), by channel: a ratio, so that E, known in closed form, stays exact. Without
regions it is E(n) times ambient occlusion.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.common.luminance import luminance
from beam_warp.kernels.common.sampling import hash_word, unit_float
from beam_warp.kernels.light.latlong import latlong_bilinear
from beam_warp.kernels.light.lights import Lights
from beam_warp.kernels.render.shadow_maps import ShadowMaps, visible_share
from beam_warp.kernels.render.surface_lighting import DistantLight, LightShadows, lit_irradiance, unturned
from beam_warp.kernels.trace.incident_light import LightMoments, above_horizon

wp.set_module_options({"enable_backward": False})

TAU = wp.constant(6.283185307179586)

ROUGHNESS = wp.constant(3)
"""First of the columns of a Gaussian's values after its base colour; the others are below."""

OCCLUSION = wp.constant(4)
NORMAL = wp.constant(5)
ARRIVING = wp.constant(8)
OPENNESS = wp.constant(11)

POINT_CHUNK = 256
"""Fewest points of one launch on the CPU: each reads many texels."""


@wp.struct
class RegionShadows:
    """Regions of an environment, and a map of each; no regions for none."""

    maps: ShadowMaps
    moments: LightMoments  # as turned


@wp.struct
class SceneLight:
    """All light of a shot, and its shadows."""

    environment: DistantLight
    regions: RegionShadows
    lights: Lights
    shadows: LightShadows


@wp.func
def random_turn(item: int) -> wp.vec2:
    """Cosine and sine of an angle that an item's number hashes to."""
    angle = TAU * unit_float(hash_word(wp.uint32(item)))
    return wp.vec2(wp.cos(angle), wp.sin(angle))


@wp.func
def region_light(moments: LightMoments, k: int, normal: wp.vec3) -> wp.vec3:
    """Irradiance over pi of a region with nothing in the way; 0 below the horizon."""
    return wp.vec3(
        above_horizon(moments.red[k], normal),
        above_horizon(moments.green[k], normal),
        above_horizon(moments.blue[k], normal),
    )


@wp.func
def openness_of(seen: wp.vec3, total: wp.vec3) -> wp.vec3:
    """Share of each channel's irradiance that arrives; 1 where no region is above the horizon."""
    openness = wp.vec3(1.0, 1.0, 1.0)
    for c in range(3):
        if total[c] > 0.0:
            openness[c] = wp.min(seen[c] / total[c], 1.0)
    return openness


@wp.func
def environment_openness(regions: RegionShadows, point: wp.vec3, normal: wp.vec3, turn: wp.vec2) -> wp.vec3:
    """Share of each channel's irradiance of an environment that arrives at a point."""
    total = wp.vec3()
    seen = wp.vec3()
    for k in range(regions.moments.red.shape[0]):
        light = region_light(regions.moments, k, normal)
        if light[0] + light[1] + light[2] > 0.0:
            total += light
            seen += light * visible_share(regions.maps, k, point, normal, turn)
    return openness_of(seen, total)


@wp.func
def gathered_openness(moments: LightMoments, shares: wp.array2d[float], place: int, normal: wp.vec3) -> wp.vec3:
    """The same at a Gaussian, whose shares of the regions are known."""
    total = wp.vec3()
    seen = wp.vec3()
    for k in range(shares.shape[0]):
        light = region_light(moments, k, normal)
        if light[0] + light[1] + light[2] > 0.0:
            total += light
            seen += light * shares[k, place]
    return openness_of(seen, total)


@wp.func
def row_vector(values: wp.array2d[float], row: int, column: int) -> wp.vec3:
    return wp.vec3(values[row, column], values[row, column + 1], values[row, column + 2])


@wp.kernel
def see_regions_kernel(
    first: int,
    order: wp.array[int],
    positions: wp.array[wp.vec3],
    values: wp.array2d[float],
    regions: RegionShadows,
    out_shares: wp.array2d[float],
):
    """Share of every region's light that reaches each Gaussian; 0 below the horizon.

    An item is one region of one Gaussian: a loop over regions leaves a GPU too few threads, and those too many
    registers. Neighbours in ``order`` are near each other in space: they read the same texels.
    """
    item = first + wp.tid()
    k = item / order.shape[0]
    place = item % order.shape[0]
    i = order[place]
    normal = row_vector(values, i, NORMAL)
    light = region_light(regions.moments, k, normal)
    share = float(0.0)
    if light[0] + light[1] + light[2] > 0.0:
        share = visible_share(regions.maps, k, positions[i], normal, random_turn(i))
    out_shares[k, place] = share


@wp.kernel
def light_gaussians_kernel(
    first: int,
    order: wp.array[int],
    positions: wp.array[wp.vec3],
    values: wp.array2d[float],
    light: SceneLight,
    shares: wp.array2d[float],
    out_arriving: wp.array[wp.vec4],
    out_lit: wp.array[wp.vec3],
):
    """``out_arriving`` is the environment's, and its share of the unshadowed luminance; ``out_lit`` all lights'."""
    place = first + wp.tid()
    i = order[place]
    normal = row_vector(values, i, NORMAL)
    point = positions[i]
    turn = random_turn(i)
    free = latlong_bilinear(light.environment.light.irradiance, unturned(light.environment, normal))
    arriving = free * values[i, OCCLUSION]
    share = values[i, OCCLUSION]
    if shares.shape[0] > 0:
        arriving = wp.cw_mul(free, gathered_openness(light.regions.moments, shares, place, normal))
        if luminance(free) > 0.0:
            share = luminance(arriving) / luminance(free)
    out_arriving[i] = wp.vec4(arriving[0], arriving[1], arriving[2], share)
    out_lit[i] = arriving + lit_irradiance(light.lights, light.shadows, point, normal, turn)


def launch_light_gaussians(order, gaussians, light, shares, out_arriving, out_lit, device):
    """Find what arrives at the Gaussians, of their positions and values, in an order.

    ``shares`` is room for a number a region and Gaussian.
    """
    inputs = [order, gaussians.positions, gaussians.values]
    options = {"device": device, "block_dim": 128, "min_chunk": POINT_CHUNK}
    launch(see_regions_kernel, shares.size, inputs=[*inputs, light.regions], outputs=[shares], **options)
    inputs = [*inputs, light, shares]
    launch(light_gaussians_kernel, len(order), inputs=inputs, outputs=[out_arriving, out_lit], **options)
