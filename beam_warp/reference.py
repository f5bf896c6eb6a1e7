"""Slow, obvious float64 twins of the tracer, without hierarchy or packing: what the fast code is measured against."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.assets import GaussianCloud


def rotation_matrices(orientations: ArrayLike) -> NDArray[np.float64]:
    """Return rotation matrices ``(N, 3, 3)`` of quaternions xyzw ``(N, 4)``, normalised first."""
    q = np.asarray(orientations, dtype=np.float64)
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        axis=1,
    )


def visibility_reference(
    cloud: GaussianCloud, origins: ArrayLike, directions: ArrayLike, *, t_max: float = math.inf
) -> NDArray[np.float64]:
    """Return the exact transmittance of each ray, one Gaussian after the other, never stopped early.

    Args:
        cloud: Occluders; scales of 0 are not allowed here.
        origins: Ray origins [m], ``(N, 3)``.
        directions: Unit directions, ``(N, 3)``.
        t_max: Reach of the rays [m].

    Returns:
        ``(N,)`` float64.

    Source: BEAM Eq. 7, with the cap 0.99 and the cut 1/255 of Kerbl et al. 2023.
    """
    o = np.asarray(origins, dtype=np.float64)
    d = np.asarray(directions, dtype=np.float64)
    result = np.ones(len(o))
    rotations = rotation_matrices(cloud.orientations)
    for center, rotation, scale, opacity in zip(
        cloud.positions.astype(np.float64), rotations, cloud.scales.astype(np.float64), cloud.opacities, strict=True
    ):
        whitening = rotation.T / scale[:, None]
        p = (o - center) @ whitening.T
        v = d @ whitening.T
        t = -np.einsum("nk,nk->n", p, v) / np.einsum("nk,nk->n", v, v)
        closest = p + t[:, None] * v
        alpha = np.minimum(0.99, float(opacity) * np.exp(-0.5 * np.einsum("nk,nk->n", closest, closest)))
        result *= np.where((alpha >= 1.0 / 255.0) & (t > 0.0) & (t < t_max), 1.0 - alpha, 1.0)
    return result
