"""Drift: the slip of tracked Gaussians over a surface whose points are known in every frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from beam_warp.checks import require_array, require_same_length
from beam_warp.errors import InvalidArrayError
from beam_warp.mesh.distances import SurfaceTree
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

NEAR = 0.03
"""A Gaussian farther from the true surface in the first frame is on no triangle of it: it is counted apart [m]."""

LEAST_OPACITY = 0.05
"""Fainter Gaussians are hardly held by any image."""

CARRIERS = 8
"""Gaussians that carry a vertex: those nearest to it in the first frame, each by its own rigid motion."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Drift:
    """Distances of points from where the true surface carried them, in one frame [mm].

    Attributes:
        mean_mm: Mean distance.
        median_mm: Median distance.
        p95_mm: Distance below which 95 % are.
        count: Number of points.
    """

    mean_mm: float
    median_mm: float
    p95_mm: float
    count: int

    @classmethod
    def of(cls, distances: FloatArray) -> Drift:
        """Summarise distances [m], at least one."""
        millimetres = 1e3 * distances
        median, p95 = np.quantile(millimetres, (0.5, 0.95))
        return cls(float(millimetres.mean()), float(median), float(p95), len(distances))


@dataclass(frozen=True)
class FrameDrift:
    """Drift from the first frame to another one.

    Attributes:
        gaussians: Distances of Gaussians from where the triangle next to them in the first frame carried them.
        vertices: Distances of the true mesh's vertices from where the Gaussians around them in the first frame carried
            them.
        followed: Part of the first frame's Gaussians whose identity is still there, in [0, 1].
    """

    gaussians: Drift
    vertices: Drift
    followed: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record."""
        return asdict(self)


def tracking_drift(
    clouds: Iterable[GaussianCloud],
    vertices: Iterable[ArrayLike],
    faces: ArrayLike,
    *,
    cameras: Sequence[Camera] = (),
    device: str | None = None,
) -> list[FrameDrift]:
    """Measure how far tracked Gaussians slip over the true surface.

    Forwards: each Gaussian of the first frame that is within `NEAR` of the surface is bound to the triangle next to it,
    by barycentric weights and by its offset in the triangle's own axes. In later frames it should be where the triangle
    carried that. Backwards, which is the drift per vertex: each vertex is carried by the `CARRIERS` Gaussians next to
    it in the first frame, by the mean of their rigid motions, and should be where it is. Gaussians fainter than
    `LEAST_OPACITY` count on neither side.

    Args:
        clouds: Frame by frame, with ``ids`` that persist; an identity that is gone is no longer followed.
        vertices: True vertices of the same frames, ``(V, 3)`` [m].
        faces: Triangles, the same in every frame, ``(F, 3)``.
        cameras: If given, only vertices that one of them sees in the first frame count.
        device: Warp device of what searches; None takes the first CUDA device, or the CPU where there is none.

    Returns:
        One record a frame, from the first, whose drift of Gaussians is 0 but for rounding.

    Raises:
        InvalidArrayError: A cloud has no ids, nothing of the first frame is followed, no Gaussian is near the surface,
            or vertices change in number.
    """
    start: _Start | None = None
    found = []
    for index, (cloud, moved) in enumerate(zip(clouds, vertices, strict=True)):
        points = require_array("vertices", moved, (None, 3), np.float64)
        if start is None:
            start = _Start.of(cloud, SurfaceTree(points, faces, device=device), cameras)
        require_same_length("vertices", points, "vertices of the first frame", start.vertex_count)
        found.append(start.compare(cloud, points, index))
    return found


@dataclass(frozen=True, eq=False)
class _Start:
    """The first frame: which Gaussians are followed, and what they and the vertices are bound to."""

    ids: NDArray[np.int64]
    positions: FloatArray
    turns: FloatArray
    corners: NDArray[np.int32]
    weights: FloatArray
    offsets: FloatArray
    bound: NDArray[np.bool_]
    seen_vertices: NDArray[np.int64]
    first_vertices: FloatArray
    vertex_count: int

    @classmethod
    def of(cls, cloud: GaussianCloud, tree: SurfaceTree, cameras: Sequence[Camera]) -> _Start:
        ids = _ids(cloud, 0)
        rows = np.flatnonzero(cloud.opacities >= LEAST_OPACITY)
        positions = cloud.positions[rows].astype(np.float64)
        nearest = tree.closest(positions)
        bound = nearest.distances <= NEAR
        if not bound.any():
            raise InvalidArrayError(
                f"clouds must start within {NEAR} m of the true surface, got none that is. Check axes and units."
            )
        corners = tree.faces[nearest.faces]
        offsets = np.einsum("nij,ni->nj", _triangle_axes(tree.vertices[corners]), positions - nearest.points)
        seen = _seen_vertices(tree, cameras)
        return cls(
            ids[rows],
            positions,
            cloud.orientations[rows].astype(np.float64),
            corners,
            nearest.weights,
            offsets,
            bound,
            seen,
            tree.vertices[seen],
            len(tree.vertices),
        )

    def compare(self, cloud: GaussianCloud, vertices: FloatArray, index: int) -> FrameDrift:
        """Return the drift of a later frame."""
        ids = _ids(cloud, index)
        order = np.argsort(ids, kind="stable")
        place = np.minimum(np.searchsorted(ids, self.ids, sorter=order), len(ids) - 1)
        now = order[place]
        there = ids[now] == self.ids
        bound = there & self.bound
        if not bound.any():
            raise InvalidArrayError(
                f"clouds must keep ids of the first frame, got none in frame {index}. Measure each segment by itself."
            )
        positions = cloud.positions[now[bound]].astype(np.float64)
        triangles = vertices[self.corners[bound]]
        carried = np.einsum("nk,nkc->nc", self.weights[bound], triangles)
        carried += np.einsum("nij,nj->ni", _triangle_axes(triangles), self.offsets[bound])
        return FrameDrift(
            gaussians=Drift.of(np.linalg.norm(positions - carried, axis=1)),
            vertices=Drift.of(self._vertex_distances(cloud, now, there, vertices)),
            followed=float(there.mean()),
        )

    def _vertex_distances(
        self, cloud: GaussianCloud, now: NDArray[np.int64], there: NDArray[np.bool_], vertices: FloatArray
    ) -> FloatArray:
        """Return how far each seen vertex is from where the Gaussians that were around it carried it [m]."""
        kept = np.flatnonzero(there)
        count = min(CARRIERS, len(kept))
        _, near = cKDTree(self.positions[kept]).query(self.first_vertices, k=count)
        near = near.reshape(len(self.first_vertices), count)
        turn = (
            Rotation.from_quat(cloud.orientations[now[kept]]) * Rotation.from_quat(self.turns[kept]).inv()
        ).as_matrix()
        before, after = self.positions[kept], cloud.positions[now[kept]].astype(np.float64)
        carried = np.zeros_like(self.first_vertices)
        for carrier in near.T:
            local = self.first_vertices - before[carrier]
            carried += after[carrier] + np.einsum("nij,nj->ni", turn[carrier], local)
        return np.linalg.norm(carried / count - vertices[self.seen_vertices], axis=1)


def _ids(cloud: GaussianCloud, index: int) -> NDArray[np.int64]:
    if cloud.ids is None or not len(cloud):
        raise InvalidArrayError(f"clouds must have ids, got none in frame {index}. Track with persistent identities.")
    return cloud.ids


def _triangle_axes(corners: FloatArray) -> FloatArray:
    """Return orthonormal axes of triangles ``(N, 3, 3)`` as columns: along the first edge, in the plane, the normal.

    A triangle without an area gets axes that are 0: what is bound to it has no offset.
    """
    edge = corners[:, 1] - corners[:, 0]
    normal = np.cross(edge, corners[:, 2] - corners[:, 0])
    axes = []
    for vector in (edge, np.cross(normal, edge), normal):
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        axes.append(np.divide(vector, length, out=np.zeros_like(vector), where=length > 0.0))
    return np.stack(axes, axis=-1)


def _seen_vertices(tree: SurfaceTree, cameras: Sequence[Camera]) -> NDArray[np.int64]:
    """Return the vertices on triangles whose middle some camera sees; every vertex of a triangle without cameras."""
    faces = np.arange(len(tree.faces), dtype=np.int32)
    if cameras:
        middle = np.full((len(faces), 3), 1.0 / 3.0)
        faces = faces[tree.seen_by(cameras, faces, middle)]
    seen = np.unique(tree.faces[faces]).astype(np.int64)
    if not len(seen):
        raise InvalidArrayError("cameras must see the truth, got none that does. Check poses and units.")
    return seen
