"""Directions drawn from a GGX lobe by its visible normals: map and density, in the frame of the normal (+z).

Source: Dupuy and Benyoub 2023: seen from a stretched view direction, visible normals are a uniform spherical cap.
"""

import warp as wp

from beam_warp.kernels.common.constants import PI
from beam_warp.kernels.light.brdf import ggx_distribution


@wp.func
def stretched(view: wp.vec3, alpha: float) -> wp.vec3:
    """The view direction where the lobe is a hemisphere."""
    return wp.normalize(wp.vec3(alpha * view[0], alpha * view[1], view[2]))


@wp.func
def square_to_visible_reflection(view: wp.vec3, alpha: float, u: float, v: float) -> wp.vec3:
    """Reflect ``view`` about a visible normal; the result may lie below the surface, where the lobe is 0."""
    axis = stretched(view, alpha)
    phi = 2.0 * PI * u
    z = (1.0 - v) * (1.0 + axis[2]) - axis[2]
    radius = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    h = wp.vec3(radius * wp.cos(phi), radius * wp.sin(phi), z) + axis
    half = wp.normalize(wp.vec3(alpha * h[0], alpha * h[1], h[2]))
    return wp.normalize(2.0 * wp.dot(view, half) * half - view)


@wp.func
def square_to_visible_reflection_pdf(view: wp.vec3, light: wp.vec3, alpha: float) -> float:
    """G1(v) D(h) / (4 n.v) [1/sr]; it holds below the surface too, so that it integrates to one."""
    half = wp.normalize(view + light)
    density = float(0.0)
    if half[2] > 0.0 and view[2] > 0.0:
        a2 = alpha * alpha
        masking = view[2] + wp.sqrt(view[2] * view[2] * (1.0 - a2) + a2)
        density = 0.5 * ggx_distribution(half[2], alpha) / masking
    return density
