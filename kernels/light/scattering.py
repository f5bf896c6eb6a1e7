"""What a surface point scatters, and directions drawn by it: one truth for the deferred shader and all path tracers.

Lambert weighted by 1 - E_spec(n.v), which conserves energy (Kulla and Conty 2017), plus the dielectric GGX lobe of
`beam_warp.kernels.light.brdf`. Directions are drawn from the two lobes by chance: the diffuse one by the cosine, the
specular one by visible normals.

A light of a size has a specular lobe wider than a point's: alpha'^2 = alpha^2 + (sin(half angle) / 2)^2. A half vector
moves by half of what the light's direction does, so that variances add; of a mirror the lobe's peak is then the disc's
radiance (F / (4 pi alpha'^2) E = F E / (pi sin^2) at normal incidence), and the distribution's norm keeps energy. Karis
2013 widens by a sum instead, alpha + sin / 3, and bends the lobe towards the disc.
"""

import warp as wp

from beam_warp.kernels.common.constants import PI
from beam_warp.kernels.common.sampling import square_to_cosine_hemisphere
from beam_warp.kernels.light.brdf import ALPHA_FLOOR, specular_albedo, specular_brdf
from beam_warp.kernels.light.ggx_sampling import square_to_visible_reflection, square_to_visible_reflection_pdf
from beam_warp.kernels.light.lights import LightDisc

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
def shading_of(
    normal: wp.vec3, view: wp.vec3, base_color: wp.vec3, roughness: float, albedo_table: wp.array2d[wp.vec2]
) -> Shading:
    """What a unit normal, a unit direction to the viewer and a material make of a point."""
    shading = Shading()
    n = normal
    away = GRAZING_COSINE - wp.dot(n, view)
    if away > 0.0:
        n = wp.normalize(n + away * view)
    specular = specular_albedo(albedo_table, wp.dot(n, view), roughness)
    shading.normal = n
    shading.view = view
    shading.diffuse = base_color * ((1.0 - specular) / PI)
    shading.roughness = roughness
    shading.alpha = wp.max(roughness * roughness, ALPHA_FLOOR)
    diffuse = (base_color[0] + base_color[1] + base_color[2]) / 3.0 * (1.0 - specular)
    # Neither lobe is starved: a share of 0.1 bounds the weight of any sample by ten times its lobe's own.
    shading.specular_share = wp.clamp(specular / (specular + diffuse), 0.1, 0.9)
    return shading


@wp.func
def brdf_cosine(shading: Shading, light: wp.vec3) -> wp.vec3:
    """BRDF times n.l, for light above the surface."""
    specular = specular_brdf(shading.normal, shading.view, light, shading.roughness)
    return (shading.diffuse + wp.vec3(specular)) * wp.dot(shading.normal, light)


@wp.func
def disc_specular(normal: wp.vec3, view: wp.vec3, alpha: float, disc: LightDisc) -> float:
    """Specular BRDF times n.l for a light of a size."""
    half = 0.5 * disc.sine
    wide = wp.sqrt(alpha * alpha + half * half)
    return specular_brdf(normal, view, disc.direction, wp.sqrt(wide)) * wp.max(wp.dot(normal, disc.direction), 0.0)


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
