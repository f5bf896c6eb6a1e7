"""One Gaussian against one ray: the record on the device and the maximum response along a ray."""

import warp as wp

from beam_warp.kernels.common.constants import ALPHA_MAX
from beam_warp.kernels.common.row_loads import load_row

QUARTIC_FALLOFF = wp.constant(4.5 / 81.0)
"""Response exp(-x^4 / 18) of degree 4: equal to exp(-x^2 / 2) at three standard deviations (3DGRT)."""


@wp.struct
class Gaussians:
    """Gaussians of a scene, packed in rows of 16 bytes so that CUDA loads each in one transaction.

    ``whitening_k`` is row k of M = S^-1 R^T, which carries world space into the space where the Gaussian is a unit
    sphere; the squared support radius rides in ``whitening_0.w`` and is -1 for a Gaussian that takes no part.
    """

    center_opacity: wp.array[wp.vec4]
    whitening_0: wp.array[wp.vec4]
    whitening_1: wp.array[wp.vec4]
    whitening_2: wp.array[wp.vec4]
    normals: wp.array[wp.vec3]  # outward unit normals; empty where the cloud has none
    degree: int  # of the response: 2 is the Gaussian, 4 falls off faster (3DGRT)


@wp.func
def whitening_times(gaussians: Gaussians, index: int, v: wp.vec3) -> wp.vec3:
    """M v: world vector to the space of the unit Gaussian."""
    a = load_row(gaussians.whitening_0, index)
    b = load_row(gaussians.whitening_1, index)
    c = load_row(gaussians.whitening_2, index)
    return wp.vec3(
        a[0] * v[0] + a[1] * v[1] + a[2] * v[2],
        b[0] * v[0] + b[1] * v[1] + b[2] * v[2],
        c[0] * v[0] + c[1] * v[1] + c[2] * v[2],
    )


@wp.func
def response(degree: int, distance_squared: float) -> float:
    """Response at a squared distance from the centre of the unit Gaussian; 1 at the centre."""
    exponent = -0.5 * distance_squared
    if degree == 4:
        exponent = -QUARTIC_FALLOFF * distance_squared * distance_squared
    return wp.exp(exponent)


@wp.struct
class RayPeak:
    """Where and how strongly a Gaussian acts on a ray."""

    alpha: float  # 0 outside the support
    t: float  # of the largest response on the ray's line


@wp.func
def ray_peak(gaussians: Gaussians, index: int, origin: wp.vec3, direction: wp.vec3) -> RayPeak:
    """Largest response along the ray's whole line.

    The closest point to the centre is found first and the whitening applied there: in float32 the shift removes the
    cancellation that ruins the quadratic's discriminant (measured error 0.16 in benign cases) and any affine form
    ``M o + b``. The squared distance is |M p x M d|^2 / |M d|^2 (Moenne-Loccoz et al. 2024).
    """
    packed = load_row(gaussians.center_opacity, index)
    p = origin - wp.vec3(packed[0], packed[1], packed[2])
    t_closest = -wp.dot(p, direction)
    p = p + direction * t_closest
    q = whitening_times(gaussians, index, p)
    d = whitening_times(gaussians, index, direction)
    dd = wp.dot(d, d)
    c = wp.cross(q, d)
    cc = wp.dot(c, c)
    radius_squared = gaussians.whitening_0[index][3]
    peak = RayPeak()
    peak.t = t_closest - wp.dot(q, d) / dd
    if cc < radius_squared * dd:
        peak.alpha = wp.min(ALPHA_MAX, packed[3] * response(gaussians.degree, cc / dd))
    return peak
