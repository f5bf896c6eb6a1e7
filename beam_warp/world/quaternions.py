"""Rotations as unit quaternions xyzw: from directions, from and to matrices, product, and interpolation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def quaternion_of(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit quaternion of a rotation matrix ``(3, 3)``, by its largest component (Shepperd 1978)."""
    trace = np.trace(rotation)
    squares = np.append(1.0 + 2.0 * np.diag(rotation) - trace, 1.0 + trace)  # four times the squared components
    largest = int(np.argmax(squares))
    quaternion = np.empty(4)
    if largest == 3:
        quaternion[:3] = [rotation[i - 1, i - 2] - rotation[i - 2, i - 1] for i in range(3)]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        quaternion[j], quaternion[k] = rotation[i, j] + rotation[j, i], rotation[i, k] + rotation[k, i]
        quaternion[3] = rotation[k, j] - rotation[j, k]
    quaternion[largest] = squares[largest]
    return quaternion / np.linalg.norm(quaternion)


def matrix_of(quaternion: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation matrices ``(..., 3, 3)`` of unit quaternions ``(..., 4)``."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion, np.float64), -1, 0)
    rows = (
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        *(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack(rows, axis=-1).reshape(*x.shape, 3, 3)


def rotation_matrices(quaternions: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation matrices ``(..., 3, 3)`` of quaternions ``(..., 4)`` of any length but 0."""
    q = np.asarray(quaternions, np.float64)
    return matrix_of(q / np.linalg.norm(q, axis=-1, keepdims=True))


def turns_from_z(directions: ArrayLike) -> NDArray[Any]:
    """Return the shortest rotations ``(N, 4)`` that carry +z to unit directions; straight down, half a turn about x."""
    d = np.asarray(directions, np.float64)
    turns = np.stack([-d[:, 1], d[:, 0], np.zeros(len(d)), 1.0 + d[:, 2]], axis=1)
    turns[turns[:, 3] < 1e-9] = (1.0, 0.0, 0.0, 0.0)
    return turns / np.linalg.norm(turns, axis=1, keepdims=True)


def product(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Hamilton products of one quaternion ``(4,)`` with many ``(N, 4)``, which rotate first."""
    x, y, z, w = left
    matrix = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
    return right @ matrix.T


def slerp(first: ArrayLike, second: ArrayLike, fraction: float) -> NDArray[np.float64]:
    """Interpolate between rotations at constant angular speed along the shorter arc.

    A quaternion and its negative are the same rotation: the second quaternion takes the sign that is nearer to the
    first. Half a turn has two arcs of the same length; the signs as given choose one.

    Args:
        first: Rotations at fraction 0, ``(N, 4)``.
        second: Rotations at fraction 1, ``(N, 4)``.
        fraction: Fraction of the arc, in [0, 1].

    Returns:
        Unit quaternions, ``(N, 4)`` float64.

    Source: Shoemake 1985. The angle comes from the arctangent of chords, which keeps its digits where cosines are flat.
    """
    start, end = np.asarray(first, np.float64), np.asarray(second, np.float64)
    end = end * np.where(np.einsum("ij,ij->i", start, end) < 0.0, -1.0, 1.0)[:, None]
    chord, opposite = end - start, end + start
    angle = 2.0 * np.arctan2(_lengths(chord), _lengths(opposite))
    angle = np.maximum(angle, 1e-8)  # below, the weights are those of a line to all digits
    near, far = np.sin((1.0 - fraction) * angle), np.sin(fraction * angle)
    turned = near[:, None] * start + far[:, None] * end
    return turned / _lengths(turned)[:, None]


def _lengths(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths of vectors ``(N, 4)``."""
    return np.sqrt(np.einsum("ij,ij->i", rows, rows))
