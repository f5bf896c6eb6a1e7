"""Skinning in float64 NumPy: linear blending with matrices, dual quaternions as Kavan et al. 2008 write them."""

import numpy as np


def product(p, q):
    """Hamilton product of quaternions xyzw."""
    u, a, v, b = p[..., :3], p[..., 3:], q[..., :3], q[..., 3:]
    return np.concatenate([a * v + b * u + np.cross(u, v), a * b - (u * v).sum(-1, keepdims=True)], axis=-1)


def conjugate(q):
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def unit(q):
    return q / np.sqrt((q * q).sum(-1, keepdims=True))


def matrix(q):
    x, y, z, w = np.moveaxis(unit(q), -1, 0)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], -1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], -1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def signs(rotations, joints):
    """-1 where -q is nearer to the first anchor's rotation, (N, k)."""
    q = unit(rotations)[joints]
    return np.where((q * q[:, :1]).sum(-1) < 0.0, -1.0, 1.0)


def warp(rest, rotations, positions, blend, sign=None):
    """Return (positions, orientations) of the skin; ``rest`` = (x, orientations, joints, weights, joint positions)."""
    x, orientations, joints, weights, joint_rest = rest
    sign = signs(rotations, joints) if sign is None else sign
    q = unit(rotations)[joints] * sign[..., None]  # (N, k, 4)
    w = weights[..., None]
    real = (w * q).sum(1)
    length = np.sqrt((real * real).sum(-1, keepdims=True))
    turned = product(real / length, orientations)
    if blend == "linear":
        moved = np.einsum("nkij,nkj->nki", matrix(rotations)[joints], x[:, None] - joint_rest[joints])
        return (w * (moved + positions[joints])).sum(1), turned
    # joint a: x -> R x + t with t = x_a - R x_a,rest; its dual quaternion is q + eps (t, 0) q / 2
    shift = positions - np.einsum("mij,mj->mi", matrix(rotations), joint_rest)
    shift = np.concatenate([shift, np.zeros((len(shift), 1))], axis=-1)[joints]
    dual = (w * 0.5 * product(shift, q)).sum(1) / length
    real = real / length
    translation = 2.0 * product(dual, conjugate(real))[:, :3]
    return np.einsum("nij,nj->ni", matrix(real), x) + translation, turned
