"""Values that float32 holds, uploaded vectors, and how far results are from float64."""

import numpy as np
import warp as wp

EPSILON = 2.0**-24
"""Largest relative rounding of a float32."""


def single(array):
    """Values that float32 holds, in float64."""
    return np.asarray(array, np.float32).astype(float)


def vectors(array, device):
    """Upload rows of three as vec3, rows of four as quaternions."""
    array = np.asarray(array, np.float32)
    return wp.array(array, dtype=wp.vec3 if array.shape[1] == 3 else wp.quat, device=device)


def zeros(count, width, device):
    return wp.zeros(count, dtype=wp.vec3 if width == 3 else wp.quat, device=device)


def relative_error(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)
