"""Surface normals at every Gaussian, with their confidence, and the points where its light is gathered."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from beam_warp.checks import require_number
from beam_warp.device.arrays import upload
from beam_warp.jobs.listeners import CountProgress
from beam_warp.kernels.materials.neighborhoods import (
    FaceRule,
    launch_consult_neighbors,
    launch_judge_faces,
    launch_mean_of_face,
    launch_take_faces,
    launch_thinnest_direction,
)
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.rays import ray_offsets
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import EXACT, FACING, TraceOptions
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import rotation_matrices

NEIGHBOR_COUNT = 16
"""Enough for a stable plane on a surface, few enough to stay local on a finger."""

FLAT_RATIO = 0.35
"""A Gaussian whose smallest scale is below this part of its middle one has an orientation of its own."""

LAYER_REACH = 3.0
"""How far from a point of the surface a Gaussian may lie and be of that layer, in largest deviations: as far as it is
opaque to the eye."""

ORIENTATION_RAYS = 8
SMOOTHING_PASSES = 3

FACE_SPREAD = 0.2
"""Standard deviation of normals that belong to one face [rad]: axes of fitted Gaussians scatter by half of it, and an
edge of 40 degrees lets next to nothing through."""

FACE_PASSES = 2

FACE_NEIGHBORS = 32
"""Neighbours among which a Gaussian looks for the face that it lies on: two rings and a half."""

FLAT_SPREAD = 0.05
LEAST_FLAT = 0.4
"""Standard deviation of normals within a flat face [rad], and the part of a neighbourhood that must differ by no more.
Less flat faces would turn what is round into facets."""

FACE_AROUND = 1.1
FACE_REACH = 1.6
OFF_PLANE = 0.16
"""Standard deviations of a neighbourhood, of the distance to a face, and of places about its plane [spacing]."""

FACE_TURN = 0.35
"""Standard deviation of how much the normal of a Gaussian turns [rad] as it takes that of a face."""

LEAST_TOWARDS = 0.7
"""Cosine to the normal that pixels see from which on a Gaussian's own axis can be that of the surface there: a
blend of two faces that meet at a right angle is half of that away from either."""


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


@dataclass(frozen=True, eq=False)
class Neighborhoods:
    """The points that views show, ``(S,)`` of N, with those around each.

    Attributes:
        rows: Which Gaussians they are of, ``(S,)``.
        places: Where they lie [m], ``(S,)`` vec3.
        weights: How far each speaks for its face: what views hardly show is hidden by others, ``(S,)`` float.
        near: Rows, among the points, of the nearest ones, the own one first, ``(S, K)`` int.
    """

    rows: NDArray[np.intp]
    places: wp.array
    weights: wp.array
    near: wp.array

    @classmethod
    def of(cls, cloud: GaussianCloud, evidence: ViewEvidence, device: wp.Device) -> Neighborhoods:
        """Find the points and their neighbours."""
        rows = np.flatnonzero(evidence.seen)
        places = evidence.positions.numpy()[rows]
        weights = (cloud.opacities * np.minimum(evidence.weight, 1.0))[rows].astype(np.float32)
        near = _neighbors(places, device, FACE_NEIGHBORS)
        return cls(rows, upload(places, wp.vec3, device), upload(weights, float, device), near)

    def mean_of_faces(self, normals: NDArray[np.float32]) -> NDArray[np.float32]:
        """Average normals over the faces that they belong to, ``(S, 3)``."""
        device = self.near.device
        current = upload(normals, wp.vec3, device)
        following, count = wp.empty_like(current), min(NEIGHBOR_COUNT + 1, self.near.shape[1])
        places, weights, near = self.places, self.weights, self.near
        for _ in range(FACE_PASSES):
            launch_mean_of_face(len(current), places, current, weights, near, count, FACE_SPREAD, following, device)
            current, following = following, current
        return current.numpy()

    def take_faces(self, normals: NDArray[np.float32], least_flat: float) -> NDArray[np.float32]:
        """Give points the normals of the faces in whose planes they lie, if these are flat enough, ``(S, 3)``."""
        device = self.near.device
        current = upload(normals, wp.vec3, device)
        following = wp.empty_like(current)
        support, flatness = (wp.empty(len(current), dtype=float, device=device) for _ in range(2))
        rule = FaceRule()
        rule.spread, rule.flat_spread, rule.least_flat = FACE_SPREAD, FLAT_SPREAD, least_flat
        rule.around, rule.reach, rule.off_plane, rule.turn = FACE_AROUND, FACE_REACH, OFF_PLANE, FACE_TURN
        places, weights, near = self.places, self.weights, self.near
        for _ in range(FACE_PASSES):
            launch_judge_faces(len(current), places, current, weights, near, rule, support, flatness, device)
            launch_take_faces(len(current), places, current, weights, near, support, flatness, rule, following, device)
            current, following = following, current
        return current.numpy()


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points where the light of each Gaussian is gathered; arrays of Warp are on the scene's device.

    Attributes:
        positions: Points on the surface [m], ``(N,)`` vec3.
        normals: Unit, outward, ``(N,)`` vec3; where not ``seen`` they may be 0.
        offsets: How far ray origins are lifted along the normals [m], ``(N,)`` float.
        seen: Points worth measuring; what hardly any view shows is filled from neighbours, ``(N,)`` bool.
        normal_error: By how much normals scatter in the pixels that show a Gaussian, and so may be off [rad], ``(N,)``
            float32; 0 where it is not known.
        confidence: Of the normals, in [0, 1], ``(N,)`` float32.
        tracing: What is in the way of rays from these points.
        around: What lies around the points that views show; None without views.
    """

    positions: wp.array
    normals: wp.array
    offsets: wp.array
    seen: NDArray[np.bool_]
    normal_error: NDArray[np.float32]
    confidence: NDArray[np.float32]
    tracing: TraceOptions = EXACT
    around: Neighborhoods | None = None

    @classmethod
    def at_centers(
        cls, cloud: GaussianCloud, scene: Scene, surface: SurfaceNormals, offset: float | Literal["auto"] = "auto"
    ) -> SurfacePoints:
        """Take the Gaussians' centres, for clouds without views; see `beam_warp.trace.rays.ray_offsets`."""
        positions = upload(cloud.positions, wp.vec3, scene.device)
        normals = upload(surface.normals, wp.vec3, scene.device)
        return cls(
            positions,
            normals,
            ray_offsets(scene, positions, normals, offset),
            np.ones(len(cloud), bool),
            np.zeros(len(cloud), np.float32),
            surface.confidence,
        )

    @classmethod
    def seen_by(
        cls, cloud: GaussianCloud, evidence: ViewEvidence, scene: Scene, offset: float | Literal["auto"] = "auto"
    ) -> SurfacePoints:
        """Take the points that views show.

        Such a point lies within the layer that shows it. With ``"auto"``, the scene's Gaussians get the normals there,
        and rays from the point meet only what faces them: the normals of its own face point along them, on the way out.
        So they need no lift, which would carry them out of creases. A stated lift has to clear the layer, for then all
        Gaussians are in the way, as in BEAM.

        Args:
            cloud: The Gaussians.
            evidence: What views show of them.
            scene: The same Gaussians, uploaded. With ``"auto"`` it has normals afterwards, see `_facing`.
            offset: Lift of rays [m], or ``"auto"``.
        """
        device = scene.device
        agreement = evidence.agreement.numpy()
        around = Neighborhoods.of(cloud, evidence, device)
        normals = evidence.normals.numpy().copy()
        normals[around.rows] = _face_normals(cloud, evidence, around)
        tracing, lift = (FACING, 0.0) if offset == "auto" else (EXACT, require_number("offset", offset))
        if tracing.cull:
            scene.face(_facing(cloud, evidence, normals))
        return cls(
            evidence.positions,
            upload(normals, wp.vec3, device),
            wp.full(len(cloud), lift, dtype=float, device=device),
            evidence.seen,
            np.arccos(np.clip(agreement, 0.0, 1.0)).astype(np.float32),
            agreement,
            tracing,
            around,
        )

    def on_faces(self) -> SurfacePoints:
        """Return the same points with the normals of the faces that they lie on, however little flat these are.

        Roundness is lost, so light is better gathered without. Highlights, though, are as wide as normals scatter.
        Points that no views show stay as they are.
        """
        if self.around is None:
            return self
        normals = self.normals.numpy().copy()
        normals[self.around.rows] = self.around.take_faces(normals[self.around.rows], least_flat=0.0)
        return replace(self, normals=upload(normals, wp.vec3, self.normals.device))


def estimate_normals(
    cloud: GaussianCloud, scene: Scene, *, seed: int = 0, progress: CountProgress | None = None
) -> SurfaceNormals:
    """Estimate the surface normal at every Gaussian.

    Where a Gaussian is flat, its shortest axis. Elsewhere the direction in which the mixture of its neighbours is
    thinnest: the smallest principal axis of their opacity-weighted covariance, each neighbour's own extent included.
    Of the two signs the one whose hemisphere is more open, by rays; the neighbours' vote where that is unclear. Then
    each normal moves towards its neighbours' mean as far as it is not certain itself.

    Args:
        cloud: Gaussians.
        scene: The same Gaussians, uploaded.
        seed: Same seed, same device, same result.
        progress: Called now and then with (Gaussians done, Gaussians in all).

    Returns:
        Normals, confidence and origin.

    Source: principal axes, Hoppe et al. 1992; the mixture's covariance is that of a sum of Gaussians.
    """
    count = len(cloud)
    if count == 0:
        return SurfaceNormals(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, bool))
    device = scene.device
    neighbors = _neighbors(cloud.positions, device)
    direction = wp.empty(count, dtype=wp.vec3, device=device)
    planarity = wp.empty(count, dtype=float, device=device)
    launch_thinnest_direction(
        len(cloud),
        upload(cloud.positions, wp.vec3, device),
        upload(cloud.orientations, wp.quat, device),
        upload(cloud.scales, wp.vec3, device),
        upload(cloud.opacities, float, device),
        neighbors,
        direction,
        planarity,
        device,
    )
    own, flatness = _shortest_axes(cloud)
    from_shape = flatness > 1.0 - FLAT_RATIO
    normals = np.where(from_shape[:, None], own, direction.numpy())
    certainty = np.where(from_shape, flatness, planarity.numpy())

    openness = _open_side(scene, cloud.positions, normals, seed, progress)
    normals *= np.where(openness < 0.0, -1.0, 1.0)[:, None]
    openness = np.abs(openness)

    current, following = upload(normals, wp.vec3, device), wp.empty(count, dtype=wp.vec3, device=device)
    agreement = wp.empty(count, dtype=float, device=device)
    weight, sides = upload(certainty * cloud.opacities, float, device), upload(openness, float, device)
    for _ in range(SMOOTHING_PASSES):
        launch_consult_neighbors(len(current), current, weight, sides, neighbors, following, agreement, device)
        current, following = following, current
    confidence = np.clip(certainty * np.minimum(2.0 * openness, 1.0) * agreement.numpy(), 0.0, 1.0)
    return SurfaceNormals(current.numpy(), confidence.astype(np.float32), from_shape)


def _facing(cloud: GaussianCloud, evidence: ViewEvidence, normals: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the normals by which Gaussians face rays, ``(N, 3)``: of all that belong to a layer that views show.

    Such a Gaussian lies within `LAYER_REACH` of where views show it, or is buried that near to another that does. The
    rest is a side that no camera looks at, though a layer before it may let a little of it through: what faces there is
    not known, and 0 faces every ray.
    """
    extents = LAYER_REACH * cloud.scales.max(axis=1)
    shown = evidence.seen & (np.linalg.norm(evidence.positions.numpy() - cloud.positions, axis=1) <= extents)
    facing = np.where(shown[:, None], normals, np.float32(0.0))
    rows, others = np.flatnonzero(shown), np.flatnonzero(~shown)
    if len(rows) and len(others):
        distance, nearest = cKDTree(cloud.positions[rows]).query(cloud.positions[others], workers=-1)
        buried = distance <= extents[rows[nearest]]
        facing[others[buried]] = normals[rows[nearest[buried]]]
    return facing


def _neighbors(places: NDArray[np.float32], device: wp.Device, most: int = NEIGHBOR_COUNT) -> wp.array:
    """Return the rows of the nearest places, the own one first, ``(N, K)`` int with K at most ``most + 1``."""
    count = len(places)
    if count == 0:
        return wp.zeros((0, 1), dtype=int, device=device)
    found = cKDTree(places).query(places, k=min(most + 1, count), workers=-1)[1]
    return upload(found.reshape(count, -1).astype(np.int32), int, device)


def _face_normals(cloud: GaussianCloud, evidence: ViewEvidence, around: Neighborhoods) -> NDArray[np.float32]:
    """Return normals of seen Gaussians that stay crisp at edges, ``(S, 3)``.

    What pixels see is a blend of the Gaussians in them, and spread back it is blended once more: edges are rounded
    by two pixels. A flat Gaussian's own axis is not blended, but it is noisy; so it is averaged over its face. Where
    pixels agree with the face, to within the noise of the axes, there is no edge, and they know the normal better.
    Last, what lies in the plane of a flat face takes its normal: rounded edges between flat faces become crisp.
    """
    own, flatness = _shortest_axes(cloud.select(around.rows))
    blended = evidence.normals.numpy()[around.rows]
    towards = (own * blended).sum(axis=1)
    is_own = (flatness > 1.0 - FLAT_RATIO) & (np.abs(towards) > LEAST_TOWARDS)
    outward = own * np.where(towards < 0.0, -1.0, 1.0)[:, None]
    faces = around.mean_of_faces(np.where(is_own[:, None], outward, blended).astype(np.float32))
    agrees = (faces * blended).sum(axis=1) > np.cos(0.5 * FACE_SPREAD)
    return around.take_faces(np.where(agrees[:, None], blended, faces), LEAST_FLAT)


def _shortest_axes(cloud: GaussianCloud) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return each Gaussian's shortest axis in the world, and 1 - smallest scale / middle scale."""
    order = np.argsort(cloud.scales, axis=1)
    ordered = np.take_along_axis(cloud.scales, order, axis=1)
    axis = np.take_along_axis(rotation_matrices(cloud.orientations), order[:, None, :1], axis=2)[..., 0]
    flatness = 1.0 - ordered[:, 0] / np.maximum(ordered[:, 1], 1e-30)
    return axis.astype(np.float32), flatness.astype(np.float32)


def _open_side(
    scene: Scene,
    positions: NDArray[np.float32],
    normals: NDArray[np.float32],
    seed: int,
    progress: CountProgress | None,
) -> NDArray[np.float32]:
    """Return how much more open the normal's side is than the other, in [-1, 1]."""
    sides = []
    for side in range(2):

        def report(done: int, total: int, before: int = side) -> None:
            if progress is not None:
                progress((before * total + done) // 2, total)

        up = normals if side == 0 else -normals
        found = ambient_occlusion(scene, positions, up, sample_count=ORIENTATION_RAYS, seed=seed, progress=report)
        sides.append(found.visibility)
    return (sides[0] - sides[1]) / np.maximum(sides[0] + sides[1], np.float32(1e-3))
