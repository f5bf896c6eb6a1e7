"""Covariances of Gaussians in float64."""

import numpy as np
from scipy.spatial.transform import Rotation


def covariances(orientations, scales):
    """R S² Rᵀ, ``(N, 3, 3)``, of quaternions xyzw of any length and standard deviations."""
    rotations = Rotation.from_quat(np.asarray(orientations, np.float64)).as_matrix()
    return np.einsum("nij,nj,nkj->nik", rotations, np.asarray(scales, np.float64) ** 2, rotations)
