"""Closed triangle meshes with a material at every vertex, which the path tracer renders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_finite, require_range, require_same_length, require_unit
from beam_warp.errors import InvalidArrayError


@dataclass(frozen=True, eq=False, kw_only=True)
class MaterialMesh:
    """Triangles with vertex normals and materials.

    Attributes:
        vertices: World positions [m], ``(V, 3)`` float32.
        faces: Vertex indices, counter-clockwise seen from outside, ``(F, 3)`` int32, F at least 1.
        normals: Unit outward normals of the smooth surface that the mesh stands for, ``(V, 3)`` float32.
        base_color: Diffuse reflectance in [0, 1], scene-linear Rec.709, ``(V, 3)`` float32.
        roughness: Perceptual roughness in [0, 1] (alpha = roughness^2), ``(V,)`` float32.

    Raises:
        InvalidArrayError: An array's shape, finiteness, range or unit length breaks the contract.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    base_color: NDArray[np.float32]
    roughness: NDArray[np.float32]

    def __post_init__(self) -> None:
        """Convert and check every array once."""
        for name, shape, dtype in (
            ("vertices", (None, 3), np.float32),
            ("faces", (None, 3), np.int32),
            ("normals", (None, 3), np.float32),
            ("base_color", (None, 3), np.float32),
            ("roughness", (None,), np.float32),
        ):
            array = require_array(name, getattr(self, name), shape, dtype)
            if name != "faces":
                require_finite(name, array)
                require_same_length(name, array, "vertices", len(np.atleast_1d(np.asarray(self.vertices))))
            object.__setattr__(self, name, array)
        if not len(self.faces):
            raise InvalidArrayError("faces must hold at least one triangle, got none. Pass a mesh with a surface.")
        require_range("faces", self.faces, 0, len(self.vertices) - 1, "Index existing vertices.")
        require_unit("normals", self.normals)
        require_range("base_color", self.base_color, 0.0, 1.0)
        require_range("roughness", self.roughness, 0.0, 1.0)

    def beside(self, other: MaterialMesh) -> MaterialMesh:
        """Return both meshes as one, this one's vertices and triangles first."""
        joined = {
            name: np.concatenate([getattr(self, name), getattr(other, name)])
            for name in ("vertices", "normals", "base_color", "roughness")
        }
        return MaterialMesh(faces=np.concatenate([self.faces, other.faces + len(self.vertices)]), **joined)

    def interpolate(self, values: ArrayLike, faces: ArrayLike, weights: ArrayLike) -> NDArray[np.float64]:
        """Return vertex values at points of the surface.

        Args:
            values: One row a vertex, ``(V, C)`` or ``(V,)``.
            faces: The triangle of each point, ``(N,)``.
            weights: Barycentric weights of its corners, ``(N, 3)``.

        Returns:
            ``(N, C)`` or ``(N,)`` float64.
        """
        corners = np.asarray(values, np.float64)[self.faces[np.asarray(faces)]]
        return np.einsum("nk,nk...->n...", np.asarray(weights, np.float64), corners)


def vertex_normals(vertices: ArrayLike, faces: ArrayLike) -> NDArray[np.float64]:
    """Return unit vertex normals, the mean of the adjoining faces' normals weighted by their angle at the vertex.

    Angles make the result independent of how a surface is cut into triangles (Thürmer and Wüthrich 1998).

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``; every vertex must be on a face with an area.

    Returns:
        ``(V, 3)`` float64.
    """
    points, index = np.asarray(vertices, np.float64), np.asarray(faces)
    corners = points[index]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face_normals /= np.maximum(np.linalg.norm(face_normals, axis=1, keepdims=True), 1e-30)
    normals = np.zeros_like(points)
    for corner in range(3):
        one = corners[:, (corner + 1) % 3] - corners[:, corner]
        two = corners[:, (corner + 2) % 3] - corners[:, corner]
        angle = np.arctan2(np.linalg.norm(np.cross(one, two), axis=1), np.einsum("nk,nk->n", one, two))
        for axis in range(3):
            normals[:, axis] += np.bincount(index[:, corner], angle * face_normals[:, axis], len(points))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
