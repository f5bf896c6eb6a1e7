"""Gradient of one hit's alpha in closed form, and how a Gaussian's hits add up to gradients of its attributes.

A hit is alpha = o g(D), where D = |q|^2 is the least squared distance between the ray and the centre m of the unit
Gaussian and q = M (x - m) its closest point, M = S^-1 R^T and x = origin + t direction. t minimises D, so that its own
derivative drops out (envelope theorem) and x may be held still:

    dD/dm = -2 M^T q,   dD/dorigin = 2 M^T q,   dD/ddirection = 2 t M^T q,   dD/ds_k = -2 q_k^2 / s_k,
    dD/da_x = 2 q_y q_z (s_z / s_y - s_y / s_z) and cyclic, for a rotation R (1 + [a]x) about the local axes.

All are linear in q and in the products of its components. So a hit is stored as q and one weight, four floats, and a
Gaussian sums ten moments whatever it is differentiated by.
"""

import warp as wp

from beam_warp.kernels.trace.gaussian import QUARTIC_FALLOFF, Gaussians, whitening_times


@wp.struct
class HitRecords:
    """Hits of many rays, one after the other."""

    gaussian: wp.array[int]  # which one; the number of Gaussians marks a slot that was not filled
    record: wp.array[wp.vec4]  # q, and the gradient of the loss with respect to log(alpha)


@wp.struct
class HitMoments:
    """Sums over hits of one Gaussian, in float64: there may be millions.

    e is the gradient with respect to log(alpha), w = e dlog(alpha)/dD with respect to D.
    """

    weight: wp.float64  # sum of e
    point: wp.vec3d  # sum of w q
    square: wp.vec3d  # sum of w (q_x^2, q_y^2, q_z^2)
    cross: wp.vec3d  # sum of w (q_y q_z, q_z q_x, q_x q_y)


@wp.struct
class HitGradients:
    """Gradients with respect to the arrays of a cloud."""

    positions: wp.array[wp.vec3]
    orientations: wp.array[wp.vec4]
    scales: wp.array[wp.vec3]
    opacities: wp.array[float]


@wp.func
def whitened_closest_point(gaussians: Gaussians, index: int, origin: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Closest point of the ray's line to the centre, in the space of the unit Gaussian.

    As `ray_peak` finds its length: shifted first, then by cross products, without cancellation.
    """
    packed = gaussians.center_opacity[index]
    p = origin - wp.vec3(packed[0], packed[1], packed[2])
    p = p - direction * wp.dot(p, direction)
    d = whitening_times(gaussians, index, direction)
    return wp.cross(d, wp.cross(whitening_times(gaussians, index, p), d)) / wp.dot(d, d)


@wp.func
def transposed_whitening_times(gaussians: Gaussians, index: int, q: wp.vec3) -> wp.vec3:
    """M^T q: gradient in the space of the unit Gaussian to gradient in world space."""
    a = gaussians.whitening_0[index]
    b = gaussians.whitening_1[index]
    c = gaussians.whitening_2[index]
    return wp.vec3(
        a[0] * q[0] + b[0] * q[1] + c[0] * q[2],
        a[1] * q[0] + b[1] * q[1] + c[1] * q[2],
        a[2] * q[0] + b[2] * q[1] + c[2] * q[2],
    )


@wp.func
def log_response_slope(degree: int, distance_squared: float) -> float:
    """dlog(response)/dD; see `response`."""
    slope = float(-0.5)
    if degree == 4:
        slope = -2.0 * QUARTIC_FALLOFF * distance_squared
    return slope


@wp.func
def add_hits(
    start: HitMoments, degree: int, records: wp.array[wp.vec4], order: wp.array[int], begin: int, end: int
) -> HitMoments:
    """Add the hits at slots ``order[begin:end]``, in that order."""
    total = start
    for k in range(begin, end):
        record = records[order[k]]
        q = wp.vec3(record[0], record[1], record[2])
        w = wp.float64(record[3] * log_response_slope(degree, wp.dot(q, q)))
        x = wp.float64(q[0])
        y = wp.float64(q[1])
        z = wp.float64(q[2])
        total.weight += wp.float64(record[3])
        total.point += w * wp.vec3d(x, y, z)
        total.square += w * wp.vec3d(x * x, y * y, z * z)
        total.cross += w * wp.vec3d(y * z, z * x, x * y)
    return total


@wp.func
def add_sums(start: HitMoments, sums: wp.array[HitMoments], begin: int, end: int) -> HitMoments:
    """Add the sums of parts ``begin`` to ``end``, in that order."""
    total = start
    for k in range(begin, end):
        part = sums[k]
        total.weight += part.weight
        total.point += part.point
        total.square += part.square
        total.cross += part.cross
    return total


@wp.func
def single(v: wp.vec3d) -> wp.vec3:
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def scale_gradient(square: wp.vec3, scale: wp.vec3, floor: float) -> wp.vec3:
    """Gradient with respect to the scales as given: 0 for a component that was raised to ``floor``."""
    gradient = wp.vec3()
    for k in range(3):
        if scale[k] >= floor:
            gradient[k] = -2.0 * square[k] / scale[k]
    return gradient


@wp.func
def orientation_gradient(cross: wp.vec3, scale: wp.vec3, orientation: wp.quat) -> wp.vec4:
    """Gradient with respect to the quaternion xyzw as given, which is normalised before use: orthogonal to it.

    Turning n by a small rotation a about the local axes adds n (a / 2, 0), a product of quaternions, so a gradient g
    with respect to a is 2 n (g, 0) with respect to n.
    """
    torque = wp.quat(
        2.0 * cross[0] * (scale[2] / scale[1] - scale[1] / scale[2]),
        2.0 * cross[1] * (scale[0] / scale[2] - scale[2] / scale[0]),
        2.0 * cross[2] * (scale[1] / scale[0] - scale[0] / scale[1]),
        0.0,
    )
    turned = wp.normalize(orientation) * torque * (2.0 / wp.length(orientation))
    return wp.vec4(turned[0], turned[1], turned[2], turned[3])
