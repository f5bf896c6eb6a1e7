"""Light of an environment with nothing in the way: irradiance for the diffuse lobe, split sum for the specular one.

Formulas and sources stand in `beam_warp.light.prefiltered`, those of lobes that are seen at an angle in
`beam_warp.kernels.light.stretched_lobe`.
"""

import warp as wp

from beam_warp.kernels.common.constants import PI
from beam_warp.kernels.light.brdf import specular_albedo
from beam_warp.kernels.light.latlong import direction_to_latlong, latlong_bilinear, latlong_wrap
from beam_warp.kernels.light.stretched_lobe import round_lobes

wp.set_module_options({"enable_backward": False})

MIN_N_DOT_V = wp.constant(1.0e-4)
"""Smallest cosine with the view direction: shading of a normal that faces away is that of the grazing one."""


@wp.struct
class EnvironmentLight:
    """One environment, made ready: irradiance, blurred radiance, and the specular albedo terms."""

    irradiance: wp.array2d[wp.vec3]
    texels: wp.array[wp.vec3]  # all levels of blurred radiance, sharpest first
    heights: wp.array[int]  # rows of each level; twice as many columns
    offsets: wp.array[int]  # where each level starts
    level_count: int
    first_roughness: float  # of level 1; level 0 is the mirror
    log_ratio: float  # natural logarithm of the ratio of roughness of one level to that of the level before
    albedo_terms: wp.array2d[wp.vec2]  # (A, B) over roughness and the square root of n·v


@wp.func
def level_texel(light: EnvironmentLight, start: int, height: int, row: int, column: int) -> wp.vec3:
    place = latlong_wrap(row, column, height, 2 * height)
    return light.texels[start + place[0] * 2 * height + place[1]]


@wp.func
def level_radiance(light: EnvironmentLight, level: int, uv: wp.vec2) -> wp.vec3:
    """Bilinear radiance of one level at a place of the lat-long map."""
    height = light.heights[level]
    start = light.offsets[level]
    x = uv[0] * float(2 * height) - 0.5
    y = uv[1] * float(height) - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - float(column)
    fy = y - float(row)
    top = level_texel(light, start, height, row, column) * (1.0 - fx)
    top += level_texel(light, start, height, row, column + 1) * fx
    bottom = level_texel(light, start, height, row + 1, column) * (1.0 - fx)
    bottom += level_texel(light, start, height, row + 1, column + 1) * fx
    return top * (1.0 - fy) + bottom * fy


@wp.func
def roughness_level(light: EnvironmentLight, roughness: float) -> float:
    """Position among the levels: linear in roughness up to level 1, in its logarithm from there."""
    position = roughness / light.first_roughness
    if position > 1.0:
        position = 1.0 + wp.log(position) / light.log_ratio
    return wp.clamp(position, 0.0, float(light.level_count - 1))


@wp.func
def blurred_radiance(light: EnvironmentLight, d: wp.vec3, roughness: float) -> wp.vec3:
    """Mean radiance under the round GGX lobe of a roughness about direction d."""
    position = roughness_level(light, roughness)
    level = wp.min(int(position), light.level_count - 2)
    f = position - float(level)
    uv = direction_to_latlong(d)
    return level_radiance(light, level, uv) * (1.0 - f) + level_radiance(light, level + 1, uv) * f


@wp.func
def specular_occlusion(ambient_occlusion: float, n_dot_v: float, roughness: float) -> float:
    """Share of the specular lobe that is open, guessed from ambient occlusion; 1 where that is 1."""
    exponent = wp.pow(2.0, -16.0 * roughness - 1.0)
    return wp.clamp(wp.pow(n_dot_v + ambient_occlusion, exponent) - 1.0 + ambient_occlusion, 0.0, 1.0)


@wp.func
def seen_normal(raw_normal: wp.vec3, view: wp.vec3) -> wp.vec3:
    """A normal of length 1; a blend whose normals cancel has none: take the one that is seen best."""
    size = wp.length(raw_normal)
    normal = view
    if size > 1.0e-12:
        normal = raw_normal / size
    return normal


@wp.func
def reflected_radiance(light: EnvironmentLight, normal: wp.vec3, view: wp.vec3, roughness: float) -> wp.vec3:
    """Mean radiance that the specular lobe sees; a normal that faces away is turned to graze the view, so that the
    mirror direction stays outside."""
    cosine = wp.dot(normal, view)
    facing = normal
    if cosine < MIN_N_DOT_V:
        facing = wp.normalize(normal + (MIN_N_DOT_V - cosine) * view)
        cosine = wp.dot(facing, view)
    mirrored = 2.0 * cosine * facing - view
    aside = cosine * view + (1.0 - 2.0 * cosine * cosine) * facing  # at right angles to it, as long as the sine
    lobes = round_lobes(cosine, roughness)
    total = wp.vec3()
    for k in range(4):
        d = wp.normalize(mirrored + lobes.offsets[k] * aside)
        total += blurred_radiance(light, d, lobes.roughness[k]) * lobes.weights[k]
    return total


@wp.func
def view_albedo(light: EnvironmentLight, normal: wp.vec3, view: wp.vec3, roughness: float) -> float:
    """Directional albedo of the specular lobe."""
    return specular_albedo(light.albedo_terms, wp.clamp(wp.dot(normal, view), MIN_N_DOT_V, 1.0), roughness)


@wp.func
def split_sum_radiance(
    light: EnvironmentLight,
    base_color: wp.vec3,
    roughness: float,
    ambient_occlusion: float,
    raw_normal: wp.vec3,
    view: wp.vec3,
) -> wp.vec3:
    """Radiance towards the camera; view is the unit direction from the surface to it."""
    normal = seen_normal(raw_normal, view)
    reflected = view_albedo(light, normal, view, roughness)
    diffuse = wp.cw_mul(base_color, latlong_bilinear(light.irradiance, normal)) * (
        (1.0 - reflected) * ambient_occlusion / PI
    )
    n_dot_v = wp.clamp(wp.dot(normal, view), MIN_N_DOT_V, 1.0)
    open_share = specular_occlusion(ambient_occlusion, n_dot_v, roughness)
    return diffuse + reflected_radiance(light, normal, view, roughness) * (reflected * open_share)
