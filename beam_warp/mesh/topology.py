"""Topology of a triangle mesh: closed or open, manifold or not, its holes and parts."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class MeshReport:
    """Counts of a mesh's elements and defects; vertices are told apart by their numbers, not by where they are.

    Attributes:
        vertices: How many.
        faces: How many.
        parts: Parts that no edge joins.
        boundary_edges: Edges of one triangle.
        holes: Connected sets of boundary edges: one for each hole, two for an open tube.
        nonmanifold_edges: Edges of more than two triangles.
        area: [m^2].
    """

    vertices: int
    faces: int
    parts: int
    boundary_edges: int
    holes: int
    nonmanifold_edges: int
    area: float

    @property
    def closed(self) -> bool:
        """True if every edge has two triangles."""
        return not (self.boundary_edges or self.nonmanifold_edges)

    def as_dict(self) -> dict[str, Any]:
        """Return everything, for a report."""
        return {**asdict(self), "closed": self.closed}


def mesh_report(mesh: trimesh.Trimesh) -> MeshReport:
    """Count edges by their triangles, and parts."""
    faces = np.asarray(mesh.faces)
    count = len(mesh.vertices)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1).astype(np.int64)
    distinct, uses = np.unique(edges[:, 0] * count + edges[:, 1], return_counts=True)
    open_edges = distinct[uses == 1]
    ends = np.stack([open_edges // max(count, 1), open_edges % max(count, 1)], axis=1)
    rims = np.bincount(_parts_of(ends, count)[ends[:, 0]]) if len(ends) else ends
    return MeshReport(
        count,
        len(faces),
        int(np.count_nonzero(np.bincount(face_parts(faces, count)))),
        len(open_edges),
        int(np.count_nonzero(rims)),
        int((uses > 2).sum()),
        float(mesh.area),
    )


def face_parts(faces: ArrayLike, vertex_count: int) -> NDArray[np.integer[Any]]:
    """Return the number of the connected part that each face belongs to, ``(F,)``; parts share no vertex."""
    index = np.asarray(faces).reshape(-1, 3)
    return _parts_of(np.concatenate([index[:, :2], index[:, 1:]]), vertex_count)[index[:, 0]]


def _parts_of(edges: NDArray[np.integer[Any]], vertex_count: int) -> NDArray[np.int32]:
    """Return the number of the part of a graph that each vertex belongs to."""
    pattern = (np.ones(len(edges), bool), (edges[:, 0], edges[:, 1]))
    return connected_components(coo_matrix(pattern, (vertex_count, vertex_count)), directed=False)[1]
