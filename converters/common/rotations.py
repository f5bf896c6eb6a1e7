"""Quaternions stored as their three smaller components, from which the largest follows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SMALLER_LIMIT = np.sqrt(0.5)
"""Largest size of a component that is not the largest of a unit quaternion."""


def from_smaller(smaller: NDArray[np.floating], largest_at: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return unit quaternions ``(N, 4)`` in the order of storage.

    Args:
        smaller: The other three components in their order, ``(N, 3)``. If rounding leaves no room for the fourth, all
            three are scaled to unit length.
        largest_at: Place of the largest component, which is positive, ``(N,)`` in [0, 3].
    """
    rows = np.arange(len(smaller))
    quaternions = np.empty((len(smaller), 4))
    for place in range(3):  # the largest is taken out of the order: the others keep theirs around it
        quaternions[rows, place + (place >= largest_at)] = smaller[:, place]
    squared = np.einsum("ij,ij->i", smaller, smaller, dtype=np.float64)
    quaternions[rows, largest_at] = np.sqrt(np.maximum(1.0 - squared, 0.0))
    return quaternions / np.sqrt(np.maximum(squared, 1.0))[:, None]


def to_smaller(quaternions: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return the three smaller components ``(N, 3)`` and the place of the largest ``(N,)``, which becomes positive.

    Args:
        quaternions: Unit quaternions in any order of components, ``(N, 4)``.
    """
    largest_at = np.argmax(np.abs(quaternions), axis=1)
    rows = np.arange(len(quaternions))
    signs = np.where(quaternions[rows, largest_at] < 0.0, -1.0, 1.0)
    smaller = np.empty((len(quaternions), 3))
    for place in range(3):
        smaller[:, place] = signs * quaternions[rows, place + (place >= largest_at)]
    return smaller, largest_at
