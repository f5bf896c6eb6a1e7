"""Meshes as flat Gaussians, for players that draw nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import turns_from_z
from beam_warp.world.shot import ShotMesh

SPREAD, THICKNESS = 0.6, 0.01
"""Standard deviations of a disc along its triangle and across, over the legs of that triangle: there is no gap between
discs, and none is seen from its edge."""

OPACITY = 0.99


def discs_of(mesh: ShotMesh, count: int = 20_000) -> GaussianCloud:
    """Return about ``count`` opaque discs that cover a mesh, nothing of it occluded.

    Every triangle is divided into n² equal ones, and each of those becomes a disc. Slender triangles are blurred. What
    only catches shadows is left out.

    Args:
        mesh: Triangles with materials.
        count: Number of discs; there is at least one for each triangle.
    """
    surface, kept = mesh.surface, ~np.asarray(mesh.catches_shadows, bool)
    faces = surface.faces[kept]
    corners = surface.vertices[faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(across, axis=1)
    leg = np.sqrt(doubled.sum() / max(count, 1))
    parts = np.maximum(np.ceil(np.sqrt(doubled) / max(leg, 1e-12)), 1).astype(int)
    rows = np.repeat(np.arange(len(faces)), parts**2)
    weights = np.concatenate([np.zeros((0, 3)), *(_middles(n) for n in parts)])[:, None, :]
    normals = (weights @ surface.normals[faces][rows])[:, 0]
    spread = np.sqrt(doubled)[rows] / parts[rows]
    arrays: dict[str, Any] = {
        "positions": (weights @ corners[rows])[:, 0],
        "orientations": turns_from_z(across[rows] / np.maximum(doubled[rows, None], 1e-300)),
        "scales": spread[:, None] * np.array([SPREAD, SPREAD, THICKNESS]),
        "opacities": np.full(len(rows), OPACITY),
        "base_color": (weights @ surface.base_color[faces][rows])[:, 0],
        "roughness": (weights[:, 0] * surface.roughness[faces][rows]).sum(axis=1),
        "ambient_occlusion": np.ones(len(rows)),
        "normals": normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12),
    }
    return GaussianCloud(**arrays)


def _middles(n: int) -> NDArray[np.float64]:
    """Return barycentric coordinates of the middles of the n² equal parts of a triangle, ``(n², 3)``."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    upright = np.stack([i, j], axis=-1)[i + j < n] + 1.0 / 3.0
    turned = np.stack([i, j], axis=-1)[i + j < n - 1] + 2.0 / 3.0
    found = np.concatenate([upright, turned]) / n
    return np.column_stack([found, 1.0 - found.sum(axis=1)])
