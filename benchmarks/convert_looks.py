"""What Gaussians look like, in float64 and by code that no converter uses, and how far two readings of them differ.

Compared is what a picture depends on: centres, covariance matrices, opacities, and colours from 20 directions. So it
does not matter which of its equal quaternions a file holds, in which order axes and scales come, or in which order the
Gaussians do.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit, sph_harm_y

from beam_warp.world.gaussians import GaussianCloud

Array = NDArray[np.float64]

DIRECTION_COUNT = 20


def directions() -> Array:
    """Return the directions from which colours are compared, spread evenly over the sphere, ``(20, 3)``."""
    index = np.arange(DIRECTION_COUNT) + 0.5
    z, turn = 1.0 - 2.0 * index / DIRECTION_COUNT, np.pi * (1.0 + 5.0**0.5) * index
    return np.stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z], axis=1)


def harmonics(towards: Array, count: int) -> Array:
    """Return the real spherical harmonics of 3DGS by SciPy's complex ones, ``(N, count)``; count is (degree + 1)^2."""
    polar, azimuth = np.arccos(np.clip(towards[:, 2], -1.0, 1.0)), np.arctan2(towards[:, 1], towards[:, 0])
    columns = []
    for index in range(count):
        band = int(np.sqrt(index))
        order = index - band * (band + 1)
        wave = sph_harm_y(band, abs(order), polar, azimuth)
        columns.append(wave.real if order == 0 else np.sqrt(2.0) * (wave.real if order > 0 else wave.imag))
    return np.stack(columns, axis=1)


@dataclass(frozen=True)
class Looks:
    """What Gaussians look like.

    Attributes:
        positions: Centres, ``(N, 3)``.
        covariances: Covariance matrices, ``(N, 3, 3)``.
        opacities: Peak alpha, ``(N,)``.
        colors: Colours from `directions`, ``(N, 20, 3)``.
    """

    positions: Array
    covariances: Array
    opacities: Array
    colors: Array

    def __len__(self) -> int:
        return len(self.positions)

    def of(self, rows: ArrayLike) -> Looks:
        """Return some of the Gaussians."""
        return Looks(*(getattr(self, field.name)[rows] for field in fields(self)))


def looks_of(
    positions: ArrayLike, quaternions: ArrayLike, scales: ArrayLike, opacities: ArrayLike, radiance: Array, turn: Array
) -> Looks:
    """Return the looks of activated arrays, all of them turned.

    Args:
        positions: ``(N, 3)``.
        quaternions: xyzw, of any length, ``(N, 4)``.
        scales: Linear, ``(N, 3)``.
        opacities: Linear, ``(N,)``.
        radiance: Spherical harmonics, ``(N, K, 3)``.
        turn: Orthogonal matrix, also a mirroring one, ``(3, 3)``.
    """
    axes = turn @ Rotation.from_quat(np.asarray(quaternions, np.float64)).as_matrix()
    basis = harmonics(directions() @ turn, radiance.shape[1])
    return Looks(
        np.asarray(positions, np.float64) @ turn.T,
        np.einsum("nij,nj,nkj->nik", axes, np.square(np.asarray(scales, np.float64)), axes),
        np.asarray(opacities, np.float64),
        0.5 + np.einsum("dk,nkc->ndc", basis, radiance.astype(np.float64)),
    )


def looks_of_cloud(cloud: GaussianCloud, turn: ArrayLike = np.eye(3)) -> Looks:  # noqa: B008
    """Return the looks of our reading of a file."""
    arrays = cloud.positions, cloud.orientations, cloud.scales, cloud.opacities, cloud.radiance
    return looks_of(*arrays, turn=np.asarray(turn, np.float64))  # pyright: ignore[reportArgumentType]


def looks_of_ply(path: Path) -> Looks:
    """Return the looks of a PLY as 3DGS trains it, by a reader of another project and the activations of the paper."""
    vertex = plyfile.PlyData.read(path)["vertex"]

    def columns(*names: str) -> Array:
        return np.stack([np.asarray(vertex[name], np.float64) for name in names], axis=1)

    rest = sum(prop.name.startswith("f_rest_") for prop in vertex.properties)
    higher = columns(*(f"f_rest_{index}" for index in range(rest))) if rest else np.zeros((vertex.count, 0))
    radiance = np.concatenate(
        [columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], higher.reshape(vertex.count, 3, rest // 3).transpose(0, 2, 1)],
        axis=1,
    )
    return looks_of(
        columns("x", "y", "z"),
        columns("rot_1", "rot_2", "rot_3", "rot_0"),
        np.exp(columns("scale_0", "scale_1", "scale_2")),
        expit(columns("opacity"))[:, 0],
        radiance,
        np.eye(3),
    )


def difference(found: Looks, truth: Looks) -> dict[str, Any]:
    """Return how far one reading is from another.

    Gaussians correspond row by row if their centres do; otherwise each is compared with the nearest of the truth.

    Returns:
        ``unmatched``: rows that are too many or too few, or whose nearest is another's, too. Root mean square and
        largest error of ``position`` as a part of the diagonal of the truth's box, of ``covariance`` as a part of its
        norm, of ``opacity``, and of ``color`` over all directions and channels.
    """
    diagonal = float(np.linalg.norm(np.ptp(truth.positions, axis=0))) or 1.0
    in_order = len(found) == len(truth) and np.abs(found.positions - truth.positions).max() <= 1e-5 * diagonal
    rows = np.arange(len(truth)) if in_order else cKDTree(truth.positions).query(found.positions)[1]
    other = truth.of(rows)
    errors = {
        "position": np.linalg.norm(found.positions - other.positions, axis=1) / diagonal,
        "covariance": _norms(found.covariances - other.covariances)
        / np.maximum(_norms(other.covariances), np.finfo(np.float32).tiny),
        "opacity": found.opacities - other.opacities,
        "color": found.colors - other.colors,
    }
    return {
        "gaussians": len(found),
        "unmatched": max(len(found), len(truth)) - len(np.unique(rows)),
        **{
            name: {"rms": float(np.sqrt(np.square(values).mean())), "largest": float(np.abs(values).max())}
            for name, values in errors.items()
        },
    }


def _norms(matrices: Array) -> Array:
    return np.linalg.norm(matrices, axis=(1, 2))
