"""Lights at a place or from a direction, as kernels see them: what arrives unshadowed, samples of them, and their disc.

A light of a size is a disc of even radiance in the sky of every point: a sphere, or a cone of directions. One of size 0
is a point or a direction, which no ray finds by chance.
"""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT, PI
from beam_warp.kernels.common.sampling import tangent_frame

DIRECTIONAL = wp.constant(0)
POINT = wp.constant(1)
SPOT = wp.constant(2)


@wp.struct
class Lights:
    """Some lights; made by `beam_warp.light.uploaded`. Positions are in the world."""

    kinds: wp.array[int]
    positions: wp.array[wp.vec3]  # of point and spot lights [m]
    directions: wp.array[wp.vec3]  # unit, the way the light travels; of directional and spot lights
    powers: wp.array[wp.vec3]  # irradiance of directional lights [W/m^2], radiant intensity of others [W/sr]
    sizes: wp.array[float]  # sine of half the angular diameter of directional lights, radius of others [m]
    cones: wp.array[wp.vec2]  # cosines of a spot's inner and outer half angles
    shadowed: wp.array[int]  # whether what is in the way casts a shadow
    count: int


@wp.struct
class LightDisc:
    """A light as it stands in the sky of a point."""

    direction: wp.vec3  # unit, from the point to the light's middle
    distance: float  # to the middle [m]
    irradiance: wp.vec3  # on a plane that faces the light, nothing in the way [W/m^2]; 0 inside the light
    sine: float  # of half the angle it takes up; 0 for a point


@wp.struct
class DiscSample:
    """A direction to a light."""

    direction: wp.vec3
    reach: float  # how far the light is along it [m]
    radiance: wp.vec3
    pdf: float  # [1/sr]


@wp.func
def light_disc(lights: Lights, k: int, point: wp.vec3) -> LightDisc:
    """Light ``k`` seen from a world point."""
    disc = LightDisc()
    if lights.kinds[k] == DIRECTIONAL:
        disc.direction = -lights.directions[k]
        disc.distance = LARGEST_FLOAT
        disc.irradiance = lights.powers[k]
        disc.sine = lights.sizes[k]
        return disc
    away = lights.positions[k] - point
    distance = wp.length(away)
    if distance > lights.sizes[k] and distance > 1.0e-6:
        disc.direction = away / distance
        disc.distance = distance
        disc.irradiance = lights.powers[k] / (distance * distance)
        disc.sine = lights.sizes[k] / distance
        if lights.kinds[k] == SPOT:
            cone = lights.cones[k]
            x = wp.clamp((-wp.dot(disc.direction, lights.directions[k]) - cone[1]) / (cone[0] - cone[1]), 0.0, 1.0)
            disc.irradiance = disc.irradiance * (x * x * (3.0 - 2.0 * x))
    return disc


@wp.func
def solid_angle(sine: float) -> float:
    """Solid angle [sr] of a cone of directions, by the sine of its half angle; exact for small ones too."""
    return 2.0 * PI * sine * sine / (1.0 + wp.sqrt(wp.max(1.0 - sine * sine, 0.0)))


@wp.func
def disc_radiance(disc: LightDisc) -> wp.vec3:
    """The even radiance that sheds the disc's irradiance on a plane that faces it; the disc must have a size."""
    return disc.irradiance / (PI * disc.sine * disc.sine)


@wp.func
def disc_reach(disc: LightDisc, cosine: float) -> float:
    """How far the light's surface is along a direction that meets it at an angle of that cosine with its middle [m]."""
    reach = disc.distance
    if reach < LARGEST_FLOAT:
        across = 1.0 - cosine * cosine
        reach = reach * (cosine - wp.sqrt(wp.max(disc.sine * disc.sine - across, 0.0)))
    return reach


@wp.func
def sample_disc(disc: LightDisc, u: float, v: float) -> DiscSample:
    """A direction drawn evenly from a disc of a size."""
    sample = DiscSample()
    angle = solid_angle(disc.sine)
    height = angle / (2.0 * PI) * u  # 1 - cos
    radius = wp.sqrt(wp.max(height * (2.0 - height), 0.0))
    phi = 2.0 * PI * v
    local = wp.vec3(radius * wp.cos(phi), radius * wp.sin(phi), 1.0 - height)
    sample.direction = wp.normalize(tangent_frame(disc.direction) * local)
    sample.reach = disc_reach(disc, 1.0 - height)
    sample.radiance = disc_radiance(disc)
    sample.pdf = 1.0 / angle
    return sample


@wp.func
def disc_pdf(disc: LightDisc, direction: wp.vec3) -> float:
    """Density of `sample_disc` [1/sr]; 0 off the disc, and for one without size."""
    density = float(0.0)
    if disc.sine > 0.0 and wp.dot(direction, disc.direction) > 0.0:
        # by the sine: the cosine of a narrow cone has no digits left
        across = wp.length(wp.cross(direction, disc.direction))
        if across <= disc.sine:
            density = 1.0 / solid_angle(disc.sine)
    return density
