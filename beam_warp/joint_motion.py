"""Where joints will be next, if they go on as they went."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_finite
from beam_warp.errors import InvalidArrayError


def extrapolate_poses(
    rotations: ArrayLike, positions: ArrayLike, previous_rotations: ArrayLike, previous_positions: ArrayLike
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return (rotations, positions) after one more step like the last: q (q_previous^-1 q) and x + (x - x_previous).

    Each joint turns about itself by the angle, below 180 degrees, and about the axis of its last step.

    Args:
        rotations: Quaternions xyzw of any length but 0, now, ``(M, 4)``.
        positions: Now, ``(M, 3)``.
        previous_rotations: One step before, ``(M, 4)``.
        previous_positions: One step before, ``(M, 3)``.

    Returns:
        Unit quaternions, on the side of ``rotations``, ``(M, 4)`` float32, and positions, ``(M, 3)`` float32.

    Raises:
        InvalidArrayError: An array has another shape, is not finite, or a quaternion is 0.
    """
    now = _unit("rotations", rotations, None)
    before = _unit("previous_rotations", previous_rotations, len(now))
    here = require_array("positions", positions, (len(now), 3), np.float64)
    there = require_array("previous_positions", previous_positions, (len(now), 3), np.float64)
    require_finite("positions", here)
    require_finite("previous_positions", there)
    # For unit quaternions q p^-1 q = 2 (p . q) q - p: the reflection of p on q, and of -p its negative. The side of q
    # is where its product with q, 2 (p . q)^2 - 1 times the sign, is not negative.
    cosine = np.einsum("mc,mc->m", before, now)[:, None]
    turned = 2.0 * cosine * now - before
    turned *= np.where(np.einsum("mc,mc->m", turned, now) < 0.0, -1.0, 1.0)[:, None]
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return turned.astype(np.float32), (2.0 * here - there).astype(np.float32)


def _unit(name: str, value: ArrayLike, count: int | None) -> NDArray[np.float64]:
    """Return unit quaternions."""
    quaternions = require_array(name, value, (count, 4), np.float64)
    require_finite(name, quaternions)
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not (length > 0.0).all():
        row = int(np.flatnonzero(~(length > 0.0))[0])
        raise InvalidArrayError(
            f"{name} must be quaternions of a length above 0, got 0 at row {row}. Pass 0, 0, 0, 1 for no rotation."
        )
    return quaternions / length
