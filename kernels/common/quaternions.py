"""Rotations as quaternions (xyzw) of any length, and how a loss changes with them."""

import warp as wp

from beam_warp.kernels.common.row_loads import load_row


@wp.func
def as_row(q: wp.quat) -> wp.vec4:
    return wp.vec4(q[0], q[1], q[2], q[3])


@wp.func
def load_quaternion(rows: wp.array[wp.vec4], index: int) -> wp.quat:
    row = load_row(rows, index)
    return wp.quat(row[0], row[1], row[2], row[3])


@wp.func
def load_rotation(rows: wp.array[wp.vec4], index: int) -> wp.quat:
    """The unit quaternion of a row; the identity for one of zeros."""
    return wp.normalize(load_quaternion(rows, index))


@wp.func
def conjugate(q: wp.quat) -> wp.quat:
    return wp.quat(-q[0], -q[1], -q[2], q[3])


@wp.func
def pure(v: wp.vec3) -> wp.quat:
    return wp.quat(v[0], v[1], v[2], 0.0)


@wp.func
def vector_part(q: wp.quat) -> wp.vec3:
    return wp.vec3(q[0], q[1], q[2])


@wp.func
def rotate_adjoint(q: wp.quat, v: wp.vec3, g: wp.vec3) -> wp.quat:
    """Gradient of g . R(q) v with respect to a unit q = (u, s), for R(q) v = v + 2 s u x v + 2 u x (u x v).

    Off the unit sphere other forms of R have other gradients; they agree on its tangents, where
    ``normalization_adjoint`` projects to.
    """
    u = vector_part(q)
    s = q[3]
    du = s * wp.cross(v, g) + wp.dot(u, v) * g + wp.dot(u, g) * v - 2.0 * wp.dot(g, v) * u
    ds = wp.dot(g, wp.cross(u, v))
    return wp.quat(2.0 * du[0], 2.0 * du[1], 2.0 * du[2], 2.0 * ds)


@wp.func
def normalization_adjoint(q: wp.quat, gradient: wp.quat) -> wp.quat:
    """Gradient with respect to q of what has ``gradient`` with respect to q / |q|: orthogonal to q; 0 where q is."""
    length = wp.length(q)
    result = wp.quat(0.0, 0.0, 0.0, 0.0)
    if length > 0.0:
        unit = q / length
        result = (gradient - unit * wp.dot(unit, gradient)) / length
    return result
