"""The simplified Disney BRDF on the device: Lambert and a dielectric GGX lobe.

alpha = roughness^2, F0 = 0.04. The specular lobe is D Vis F with the height-correlated Smith visibility
(Heitz 2014), D the GGX distribution (Walter et al. 2007) and F Schlick's approximation (1994).
"""

import warp as wp

from beam_warp.kernels.common.constants import PI

DIELECTRIC_F0 = wp.constant(0.04)
"""Reflectance at normal incidence of an index of refraction of 1.5: every material here is such a dielectric."""

ALPHA_FLOOR = wp.constant(1.0e-3)
"""Smallest GGX alpha: below it D overflows float32 at its peak."""


@wp.func
def fresnel_schlick(v_dot_h: float) -> float:
    m = wp.clamp(1.0 - v_dot_h, 0.0, 1.0)
    m2 = m * m
    return DIELECTRIC_F0 + (1.0 - DIELECTRIC_F0) * m2 * m2 * m


@wp.func
def ggx_distribution(n_dot_h: float, alpha: float) -> float:
    a2 = alpha * alpha
    d = n_dot_h * n_dot_h * (a2 - 1.0) + 1.0
    return a2 / (PI * d * d)


@wp.func
def smith_visibility(n_dot_l: float, n_dot_v: float, alpha: float) -> float:
    """G2 / (4 n.l n.v)."""
    a2 = alpha * alpha
    light = n_dot_v * wp.sqrt(n_dot_l * n_dot_l * (1.0 - a2) + a2)
    view = n_dot_l * wp.sqrt(n_dot_v * n_dot_v * (1.0 - a2) + a2)
    return 0.5 / wp.max(light + view, 1.0e-12)


@wp.func
def specular_brdf(normal: wp.vec3, view: wp.vec3, light: wp.vec3, roughness: float) -> float:
    """f_s(view, light), without the cosine; 0 if either is below the surface."""
    n_dot_v = wp.dot(normal, view)
    n_dot_l = wp.dot(normal, light)
    value = float(0.0)
    if n_dot_v > 0.0 and n_dot_l > 0.0:
        alpha = wp.max(roughness * roughness, ALPHA_FLOOR)
        half = wp.normalize(view + light)
        value = (
            ggx_distribution(wp.dot(normal, half), alpha)
            * smith_visibility(n_dot_l, n_dot_v, alpha)
            * fresnel_schlick(wp.dot(view, half))
        )
    return value


@wp.func
def specular_albedo(terms: wp.array2d[wp.vec2], n_dot_v: float, roughness: float) -> float:
    """Directional albedo F0 A + B of the specular lobe, bilinear in the table of beam_warp.light.ggx.

    Rows: roughness. Columns: the square root of n.v.
    """
    y = wp.clamp(roughness, 0.0, 1.0) * float(terms.shape[0] - 1)
    x = wp.sqrt(wp.clamp(n_dot_v, 0.0, 1.0)) * float(terms.shape[1] - 1)
    row = wp.clamp(int(y), 0, terms.shape[0] - 2)
    column = wp.clamp(int(x), 0, terms.shape[1] - 2)
    fy = y - float(row)
    fx = x - float(column)
    top = terms[row, column] * (1.0 - fx) + terms[row, column + 1] * fx
    bottom = terms[row + 1, column] * (1.0 - fx) + terms[row + 1, column + 1] * fx
    both = top * (1.0 - fy) + bottom * fy
    return DIELECTRIC_F0 * both[0] + both[1]
