"""Distances between two surfaces where cameras see them: the Chamfer distance of a reconstruction to its truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import (
    require_array,
    require_count,
    require_finite,
    require_range,
    require_same_length,
    require_unit,
)
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError
from beam_warp.kernels.mesh.rays import launch_cast_rays
from beam_warp.kernels.mesh.surface_distance import SeeingCameras, launch_find_closest_points, launch_find_seen_points
from beam_warp.world.camera import Camera

SAMPLE_COUNT = 200_000
"""Points on each surface: 3 mm apart on a person; the mean of their distances has a relative error of about 1 / 450."""

LEAST_COSINE = 0.1
"""A camera sees a surface that is turned from it by at most 84 degrees: beyond, a pixel shows ten times its own width
of it."""


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """The points of a surface that are closest to given ones.

    Attributes:
        points: ``(N, 3)`` float64 [m].
        faces: Their triangles, ``(N,)`` int32.
        weights: Barycentric weights of the triangles' corners, ``(N, 3)`` float64.
        distances: ``(N,)`` float64 [m].
    """

    points: NDArray[np.float64]
    faces: NDArray[np.int32]
    weights: NDArray[np.float64]
    distances: NDArray[np.float64]


class SurfaceTree:
    """A triangle mesh with its bounding volume hierarchy on a device."""

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, *, device: str | None = None) -> None:
        """Upload a mesh.

        Args:
            vertices: ``(V, 3)`` [m].
            faces: Vertex indices, counter-clockwise seen from outside, ``(F, 3)``, F at least 1.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.

        Raises:
            InvalidArrayError: An array breaks its contract.
            DeviceError: There is no such device.
        """
        self.vertices = require_array("vertices", vertices, (None, 3), np.float64)
        require_finite("vertices", self.vertices)
        self.faces = require_array("faces", faces, (None, 3), np.int32)
        if not len(self.faces):
            raise InvalidArrayError("faces must hold at least one triangle, got none. Pass a mesh with a surface.")
        require_range("faces", self.faces, 0, len(self.vertices) - 1, "Index existing vertices.")
        self.device = resolve_device(device)
        # float32 in the middle of the mesh: rounding is that of its size, not of its place.
        self._middle = 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))
        self._mesh = wp.Mesh(self._local(self.vertices), upload(self.faces.reshape(-1), int, self.device))

    def at(self, faces: NDArray[np.int32], weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points that barycentric weights name, ``(N, 3)`` float64."""
        return np.einsum("nk,nkc->nc", weights, self.vertices[self.faces[faces]])

    def normals(self, faces: NDArray[np.int32]) -> NDArray[np.float64]:
        """Return unit normals of triangles, ``(N, 3)``; 0 for triangles without an area."""
        corners = self.vertices[self.faces[faces]]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        return np.divide(cross, length, out=np.zeros_like(cross), where=length > 0.0)

    def sample(self, count: int, seed: int = 0) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """Return triangles and barycentric weights of points that are uniform by area, stratified over triangles.

        Raises:
            InvalidArrayError: No triangle has an area.
            InvalidOptionError: The count is out of range.
        """
        require_count("count", count, 1, 10**8)
        corners = self.vertices[self.faces]
        areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        total = np.cumsum(areas)
        if not total[-1] > 0.0:
            raise InvalidArrayError("faces must have an area, got 0 for all. Pass a mesh with a surface.")
        rng = np.random.default_rng(seed)
        at = (np.arange(count) + rng.random(count)) / count * total[-1]
        faces = np.minimum(np.searchsorted(total, at, side="right"), len(areas) - 1).astype(np.int32)
        root, share = np.sqrt(rng.random(count)), rng.random(count)
        return faces, np.stack([1.0 - root, root * (1.0 - share), root * share], axis=-1)

    def closest(self, points: ArrayLike) -> ClosestPoints:
        """Return the closest points of the surface to others ``(N, 3)``.

        Raises:
            InvalidArrayError: ``points`` has another shape or is not finite.
        """
        given = require_array("points", points, (None, 3), np.float64)
        require_finite("points", given)
        faces = wp.zeros(len(given), dtype=int, device=self.device)
        weights = wp.zeros(len(given), dtype=wp.vec3, device=self.device)
        launch_find_closest_points(len(given), self._mesh.id, self._local(given), faces, weights, self.device)
        found, shares = faces.numpy(), weights.numpy().astype(np.float64)
        at = self.at(found, shares)
        return ClosestPoints(at, found, shares, np.linalg.norm(at - given, axis=1))

    def cast(self, origins: ArrayLike, directions: ArrayLike) -> NDArray[np.float64]:
        """Return how far rays go until they meet the surface from either side [m], ``(N,)``; NaN for those that do not.

        Args:
            origins: ``(N, 3)`` [m].
            directions: Of unit length, ``(N, 3)``.

        Raises:
            InvalidArrayError: An array has another shape, is not finite, or a direction is not of unit length.
        """
        starts = require_array("origins", origins, (None, 3), np.float64)
        along = require_array("directions", directions, (None, 3), np.float64)
        require_same_length("directions", along, "origins", len(starts))
        require_finite("origins", starts)
        require_finite("directions", along)
        require_unit("directions", along)
        distances = wp.zeros(len(starts), dtype=float, device=self.device)
        launch_cast_rays(
            self._mesh.id, self._local(starts), upload(along.astype(np.float32), wp.vec3, self.device), distances
        )
        found = distances.numpy().astype(np.float64)
        return np.where(found >= 0.0, found, np.nan)

    def seen_by(
        self,
        cameras: Sequence[Camera],
        faces: NDArray[np.int32],
        weights: NDArray[np.float64],
        *,
        least_cosine: float = LEAST_COSINE,
    ) -> NDArray[np.bool_]:
        """Return which points of the surface some camera sees: on its image, from the front, past every triangle."""
        struct = SeeingCameras()
        for name, dtype, rows in (
            ("positions", wp.vec3, [camera.position - self._middle for camera in cameras]),
            ("world_to_camera", wp.mat33, [camera.camera_to_world[:3, :3].T for camera in cameras]),
            ("focal", wp.vec2, [(camera.focal_x, camera.focal_y) for camera in cameras]),
            ("center", wp.vec2, [(camera.center_x, camera.center_y) for camera in cameras]),
            ("size", wp.vec2, [(camera.width, camera.height) for camera in cameras]),
        ):
            setattr(struct, name, upload(np.asarray(rows, np.float32), dtype, self.device))
        seen = wp.zeros(len(faces), dtype=wp.uint8, device=self.device)
        normals = upload(self.normals(faces).astype(np.float32), wp.vec3, self.device)
        points = self._local(self.at(faces, weights))
        launch_find_seen_points(len(seen), self._mesh.id, struct, least_cosine, points, normals, seen, self.device)
        return seen.numpy().astype(bool)

    def _local(self, points: NDArray[np.float64]) -> wp.array:
        return upload((points - self._middle).astype(np.float32), wp.vec3, self.device)


@dataclass(frozen=True)
class SurfaceDistances:
    """Distances between a reconstructed surface and its truth.

    Attributes:
        chamfer_mm: Mean of the two directed means [mm].
        to_truth_mm: Mean distance from the reconstruction to the truth: what is wrong or too much [mm].
        to_reconstruction_mm: Mean distance from the truth to the reconstruction: also what is missing [mm].
        to_truth_p95_mm: 95 % of the reconstruction are closer [mm].
        to_reconstruction_p95_mm: 95 % of the truth are closer [mm].
        seen_share: Part of the truth's area that some camera sees, in [0, 1].
    """

    chamfer_mm: float
    to_truth_mm: float
    to_reconstruction_mm: float
    to_truth_p95_mm: float
    to_reconstruction_p95_mm: float
    seen_share: float

    def as_dict(self) -> dict[str, float]:
        """Return a JSON-able record."""
        return asdict(self)


def surface_distances(
    reconstruction: Any,
    truth: Any,
    cameras: Sequence[Camera],
    *,
    sample_count: int = SAMPLE_COUNT,
    seed: int = 0,
    device: str | None = None,
) -> SurfaceDistances:
    """Measure a reconstructed surface against the true one, where cameras see the truth.

    From points of either surface, uniform by area, to the closest point of the other *surface*. A point of the truth
    counts if some camera sees it; a point of the reconstruction counts if the point of the truth that is closest to it
    is seen. So what nobody could know (soles, the inside of a sleeve) is left out of both directions, while floaters,
    inner shells and holes before the eyes of a camera count in full.

    Args:
        reconstruction: Has ``vertices`` ``(V, 3)`` and ``faces`` ``(F, 3)``: a ``trimesh.Trimesh`` does.
        truth: The same.
        cameras: What took the images, at least one.
        sample_count: Points on each surface.
        seed: Of the points.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Raises:
        InvalidArrayError: A mesh has no surface, or no camera sees the truth.
        InvalidOptionError: The count is out of range.
        DeviceError: There is no such device.
    """
    found = SurfaceTree(reconstruction.vertices, reconstruction.faces, device=device)
    known = SurfaceTree(truth.vertices, truth.faces, device=device)
    faces, weights = known.sample(sample_count, seed)
    seen = known.seen_by(cameras, faces, weights)
    if not seen.any():
        raise InvalidArrayError("cameras must see the truth, got none that does. Check poses and units.")
    missing = found.closest(known.at(faces[seen], weights[seen])).distances
    nearest = known.closest(found.at(*found.sample(sample_count, seed + 1)))
    counted = known.seen_by(cameras, nearest.faces, nearest.weights)
    if not counted.any():
        raise InvalidArrayError(
            "reconstruction must lie near what cameras see, got none of it there. Check axes and units."
        )
    wrong = nearest.distances[counted]
    return SurfaceDistances(
        chamfer_mm=500.0 * float(wrong.mean() + missing.mean()),
        to_truth_mm=1e3 * float(wrong.mean()),
        to_reconstruction_mm=1e3 * float(missing.mean()),
        to_truth_p95_mm=1e3 * float(np.quantile(wrong, 0.95)),
        to_reconstruction_p95_mm=1e3 * float(np.quantile(missing, 0.95)),
        seen_share=float(seen.mean()),
    )
