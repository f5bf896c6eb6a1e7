"""Directions that are spread evenly over a sphere, or over a part of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def even_directions(count: int, first: float = 1.0, last: float = -1.0) -> NDArray[np.float64]:
    """Return a spherical Fibonacci set, ``(count, 3)``: unit vectors, z in equal steps from one height to another."""
    index = np.arange(count) + 0.5
    z = first + (last - first) * index / count
    phi, radius = np.pi * (1.0 + np.sqrt(5.0)) * index, np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)
