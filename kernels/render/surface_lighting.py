"""What lights and an environment make of a surface point in a deferred renderer: functions that its kernels share."""

import warp as wp

from beam_warp.kernels.light.lights import LightDisc, Lights, light_disc
from beam_warp.kernels.light.scattering import Shading, disc_specular
from beam_warp.kernels.light.shading import EnvironmentLight
from beam_warp.kernels.render.shadow_maps import ShadowMaps, face_towards, visible_share


@wp.struct
class LightShadows:
    """Which maps belong to which light."""

    maps: ShadowMaps
    first_maps: wp.array[int]  # of each light
    map_counts: wp.array[int]  # 0 for no shadow, 1, or 6 around it


@wp.struct
class DistantLight:
    """An environment, and how it is turned."""

    light: EnvironmentLight
    turn: wp.array[wp.vec2]  # one: cosine and sine of the angle about z by which it is turned


@wp.func
def unturned(environment: DistantLight, v: wp.vec3) -> wp.vec3:
    """A world direction in the environment's own axes."""
    turn = environment.turn[0]
    return wp.vec3(v[0] * turn[0] + v[1] * turn[1], v[1] * turn[0] - v[0] * turn[1], v[2])


@wp.func
def light_visibility(
    lights: Lights, shadows: LightShadows, k: int, point: wp.vec3, normal: wp.vec3, turn: wp.vec2
) -> float:
    """Share of a light that reaches a point."""
    count = shadows.map_counts[k]
    share = float(1.0)
    if count > 0:
        face = int(0)
        if count > 1:
            face = face_towards(point - lights.positions[k])
        share = visible_share(shadows.maps, shadows.first_maps[k] + face, point, normal, turn)
    return share


@wp.func
def disc_cosine(disc: LightDisc, normal: wp.vec3) -> float:
    """Mean of max(0, n.l) over a light's disc; as if heights were even over it where the horizon cuts it."""
    middle = wp.dot(normal, disc.direction)
    # the variance along one axis of an even disc of directions is sin^2 / 4; that of an even interval is width^2 / 3
    width = 0.8660254 * disc.sine * wp.sqrt(wp.max(1.0 - middle * middle, 0.0))
    cosine = wp.max(middle, 0.0)
    if wp.abs(middle) < width:
        cosine = (middle + width) * (middle + width) / (4.0 * width)
    return cosine


@wp.func
def lit_radiance(lights: Lights, shadows: LightShadows, shading: Shading, point: wp.vec3, turn: wp.vec2) -> wp.vec3:
    """Radiance that a point scatters of all lights."""
    total = wp.vec3()
    for k in range(lights.count):
        disc = light_disc(lights, k, point)
        cosine = disc_cosine(disc, shading.normal)
        if cosine > 0.0 and wp.max(disc.irradiance) > 0.0:
            share = light_visibility(lights, shadows, k, point, shading.normal, turn)
            if share > 0.0:
                scattered = shading.diffuse * cosine + wp.vec3(
                    disc_specular(shading.normal, shading.view, shading.alpha, disc)
                )
                total += wp.cw_mul(scattered, disc.irradiance) * share
    return total


@wp.func
def lit_irradiance(lights: Lights, shadows: LightShadows, point: wp.vec3, normal: wp.vec3, turn: wp.vec2) -> wp.vec3:
    """Irradiance of all lights on a point."""
    total = wp.vec3()
    for k in range(lights.count):
        disc = light_disc(lights, k, point)
        cosine = disc_cosine(disc, normal)
        if cosine > 0.0 and wp.max(disc.irradiance) > 0.0:
            total += disc.irradiance * (cosine * light_visibility(lights, shadows, k, point, normal, turn))
    return total


@wp.func
def unshadowed_irradiance(lights: Lights, point: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Irradiance of all lights on a point with nothing in the way."""
    total = wp.vec3()
    for k in range(lights.count):
        disc = light_disc(lights, k, point)
        total += disc.irradiance * disc_cosine(disc, normal)
    return total
