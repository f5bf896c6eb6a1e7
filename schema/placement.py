"""Placement of a prim: the transform from the prim to the world in metres, and its application to Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.errors import AssetFormatError
from beam_warp.world.gaussians import sh_degree_of
from beam_warp.world.harmonics import sh_transform
from beam_warp.world.quaternions import product, quaternion_of

SIMILARITY_TOLERANCE = 1e-5
"""Largest deviation of L L^T / s^2 from the identity: matrices are often stored after a float32 step (1e-7 each)."""


@dataclass(frozen=True)
class Placement:
    """A similarity: ``world = scale * (orthogonal @ local) + translation``.

    Attributes:
        scale: Metres per local unit, positive.
        orthogonal: Rotation or reflection, ``(3, 3)``.
        translation: Translation [m], ``(3,)``.
    """

    scale: float
    orthogonal: NDArray[np.float64]
    translation: NDArray[np.float64]

    @property
    def is_identity(self) -> bool:
        """True if `apply` would change no bit."""
        return self.scale == 1.0 and np.array_equal(self.orthogonal, np.eye(3)) and not self.translation.any()

    @np.errstate(over="ignore", invalid="ignore")  # what is not finite stays so, and is refused by a cloud
    def apply(self, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Transform every array that depends on position, size or direction.

        A reflection and its negative, which is a rotation, have the same effect on an ellipsoid: quaternions take the
        rotation, normals and spherical harmonics the reflection itself.
        """
        moved = dict(arrays)
        rotation = quaternion_of(self.orthogonal * np.sign(np.linalg.det(self.orthogonal)))
        moved["positions"] = (
            self.scale * (arrays["positions"].astype(np.float64) @ self.orthogonal.T) + self.translation
        )
        moved["scales"] = self.scale * arrays["scales"].astype(np.float64)
        turned = product(rotation, arrays["orientations"].astype(np.float64))
        lengths = np.linalg.norm(turned, axis=1, keepdims=True)
        moved["orientations"] = turned / np.where(lengths == 0.0, 1.0, lengths)  # a cloud refuses a length of 0
        if "normals" in arrays:
            moved["normals"] = arrays["normals"].astype(np.float64) @ self.orthogonal.T
        if "radiance" in arrays:
            degree = sh_degree_of(arrays["radiance"].shape[1])
            if degree > 0:
                turn = sh_transform(self.orthogonal, degree)
                moved["radiance"] = np.einsum("kj,njc->nkc", turn, arrays["radiance"].astype(np.float64))
        return moved


def placement_of(matrix: NDArray[np.float64], meters_per_unit: float, where: str) -> Placement:
    """Decompose a local-to-world matrix of USD (row vectors, ``p' = p M``) into a similarity in metres.

    Raises:
        AssetFormatError: The matrix projects, shears, scales unevenly, or is singular.
    """
    if not (np.isfinite(matrix).all() and np.array_equal(matrix[:, 3], (0.0, 0.0, 0.0, 1.0))):
        raise AssetFormatError(
            f"{where} must be placed by rotation, uniform scale and translation, got a transform whose last column is "
            f"{matrix[:, 3].tolist()}. Bake the transform into the Gaussians."
        )
    linear = matrix[:3, :3].T
    determinant = float(np.linalg.det(linear))
    scale = abs(determinant) ** (1.0 / 3.0)
    orthogonal = linear / scale if scale > 0.0 else linear
    deviation = float(np.abs(orthogonal @ orthogonal.T - np.eye(3)).max())
    if not (scale > 0.0 and deviation <= SIMILARITY_TOLERANCE):
        raise AssetFormatError(
            f"{where} must be placed by rotation, uniform scale and translation, got a transform that shears or "
            f"scales unevenly (by {deviation:.3g}). Bake the transform into the Gaussians."
        )
    if deviation > 0.0:  # the nearest orthogonal matrix, so that quaternions and harmonics stay exact
        left, _, right = np.linalg.svd(orthogonal)
        orthogonal = left @ right
    return Placement(scale * meters_per_unit, orthogonal, matrix[3, :3] * meters_per_unit)
