"""Covariances of Gaussians in float64, from their definition."""

import numpy as np


def covariances(orientations, scales):
    """R S² Rᵀ, ``(N, 3, 3)``, of quaternions xyzw of any length and standard deviations."""
    x, y, z, w = (np.asarray(orientations, float) / np.linalg.norm(orientations, axis=1, keepdims=True)).T
    rotations = np.empty((len(x), 3, 3))
    for column, vector in enumerate(np.eye(3)):  # q v q*, by its cross products
        u = np.stack([x, y, z], axis=1)
        twice = 2.0 * np.cross(u, vector)
        rotations[:, :, column] = vector + w[:, None] * twice + np.cross(u, twice)
    scaled = rotations * np.asarray(scales, float)[:, None, :]
    return scaled @ scaled.transpose(0, 2, 1)
