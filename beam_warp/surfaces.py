"""Which way the surface faces at every Gaussian, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from beam_warp.assets import GaussianCloud
from beam_warp.lighting import ambient_occlusion
from beam_warp.reference import rotation_matrices
from beam_warp.scene import Scene

NEIGHBOR_COUNT = 16
"""Enough for a stable plane on a surface, few enough to stay local on a finger."""

FLAT_RATIO = 0.35
"""A Gaussian whose smallest scale is below this part of its middle one has an orientation of its own."""

ORIENTATION_RAYS = 16
SMOOTHING_PASSES = 3


@dataclass(frozen=True)
class SurfaceNormals:
    """Oriented normals.

    Attributes:
        normals: Unit normals on the open side, ``(N, 3)`` float32.
        confidence: In [0, 1]: how planar the neighbourhood is, times how clearly one side is the open one, times how
            far the neighbours agree, ``(N,)`` float32.
        from_shape: True where the Gaussian's own shortest axis was taken, ``(N,)`` bool.
    """

    normals: NDArray[np.float32]
    confidence: NDArray[np.float32]
    from_shape: NDArray[np.bool_]


def estimate_normals(cloud: GaussianCloud, scene: Scene, *, seed: int = 0) -> SurfaceNormals:
    """Estimate the surface normal at every Gaussian.

    Where a Gaussian is flat, its shortest axis. Elsewhere the direction in which the mixture of its neighbours is
    thinnest: the smallest principal axis of their opacity-weighted covariance, each neighbour's own extent included.
    Of the two signs the one whose hemisphere is more open, by rays; the neighbours' vote where that is unclear. Then
    each normal moves towards its neighbours' mean as far as it is not certain itself.

    Args:
        cloud: Gaussians.
        scene: The same Gaussians, uploaded.
        seed: Same seed, same device, same result.

    Returns:
        Normals, confidence and origin.

    Source: principal axes, Hoppe et al. 1992; the mixture's covariance is that of a sum of Gaussians.
    """
    count = len(cloud)
    if count == 0:
        return SurfaceNormals(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, bool))
    positions = cloud.positions.astype(np.float64)
    neighbors = cKDTree(positions).query(positions, k=min(NEIGHBOR_COUNT + 1, count), workers=-1)[1]
    neighbors = neighbors.reshape(count, -1)

    rotations = rotation_matrices(cloud.orientations)
    scales = cloud.scales.astype(np.float64)
    axis_normal, planarity = _thinnest_direction(positions, rotations, scales, cloud.opacities, neighbors)
    order = np.argsort(scales, axis=1)
    shortest = np.take_along_axis(scales, order, axis=1)
    own_normal = np.take_along_axis(rotations, order[:, None, :1], axis=2)[..., 0]
    flatness = 1.0 - shortest[:, 0] / np.maximum(shortest[:, 1], 1e-30)
    from_shape = flatness > 1.0 - FLAT_RATIO
    normals = np.where(from_shape[:, None], own_normal, axis_normal)
    certainty = np.where(from_shape, flatness, planarity)

    openness = _open_side(scene, cloud.positions, normals, seed)
    normals *= np.where(openness < 0.0, -1.0, 1.0)[:, None]
    openness = np.abs(openness)
    certainty = np.clip(certainty, 0.0, 1.0) * cloud.opacities

    agreement = np.ones(count)
    for _ in range(SMOOTHING_PASSES):
        normals, agreement = _consult_neighbors(normals, certainty, openness, neighbors)
    confidence = np.clip(certainty * np.minimum(2.0 * openness, 1.0) * agreement, 0.0, 1.0)
    return SurfaceNormals(normals.astype(np.float32), confidence.astype(np.float32), from_shape)


def _thinnest_direction(
    positions: NDArray[np.float64],
    rotations: NDArray[np.float64],
    scales: NDArray[np.float64],
    opacities: NDArray[np.float32],
    neighbors: NDArray[np.intp],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest principal axis of each neighbourhood's mixture, and 1 - lambda_0 / lambda_1."""
    covariances = np.einsum("nij,nj,nkj->nik", rotations, scales**2, rotations)
    at = positions[neighbors]
    distance = np.linalg.norm(at - positions[:, None], axis=2)
    reach = np.maximum(distance[:, -1:], 1e-12)
    weight = opacities[neighbors] * np.exp(-2.0 * (distance / reach) ** 2)
    weight /= np.maximum(weight.sum(1, keepdims=True), 1e-12)
    centered = at - np.einsum("nk,nki->ni", weight, at)[:, None]
    spread = np.einsum("nk,nki,nkj->nij", weight, centered, centered)
    spread += np.einsum("nk,nkij->nij", weight, covariances[neighbors])
    values, vectors = np.linalg.eigh(spread)
    return vectors[..., 0], 1.0 - values[:, 0] / np.maximum(values[:, 1], 1e-30)


def _open_side(
    scene: Scene, positions: NDArray[np.float32], normals: NDArray[np.float64], seed: int
) -> NDArray[np.float64]:
    """Return how much more open the normal's side is than the other, in [-1, 1]."""
    up = normals.astype(np.float32)
    sides = [
        ambient_occlusion(scene, positions, sign * up, sample_count=ORIENTATION_RAYS, seed=seed).visibility
        for sign in (1.0, -1.0)
    ]
    return (sides[0] - sides[1]) / np.maximum(sides[0] + sides[1], 1e-3)


def _consult_neighbors(
    normals: NDArray[np.float64],
    certainty: NDArray[np.float64],
    openness: NDArray[np.float64],
    neighbors: NDArray[np.intp],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Move each normal towards its neighbours' weighted mean as far as it is uncertain; with their agreement."""
    weight = (certainty * openness)[neighbors] + 1e-6
    weight[:, 0] = 0.0  # column 0 is the Gaussian itself
    mean = np.einsum("nk,nki->ni", weight, normals[neighbors]) / np.maximum(weight.sum(1, keepdims=True), 1e-12)
    length = np.linalg.norm(mean, axis=1)
    direction = mean / np.maximum(length, 1e-12)[:, None]
    along = np.einsum("ni,ni->n", normals, direction)
    # Where rays do not tell the sides apart, the neighbours decide the sign.
    undecided = (openness < 0.25) & (length > 0.5)
    normals = np.where((undecided & (along < 0.0))[:, None], -normals, normals)
    share = (1.0 - np.minimum(certainty * (0.5 + openness), 1.0)) * np.minimum(length, 1.0)
    mixed = (1.0 - share)[:, None] * normals + share[:, None] * direction
    norm = np.linalg.norm(mixed, axis=1, keepdims=True)
    mixed = np.where(norm > 1e-6, mixed / np.maximum(norm, 1e-12), normals)
    return mixed, np.clip(length, 0.0, 1.0)
