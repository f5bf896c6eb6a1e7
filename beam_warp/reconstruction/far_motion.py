"""Motion that photographs reduced as far as tracking goes do not find: silhouettes tell where the body has gone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError
from beam_warp.reconstruction.hull import visual_hull
from beam_warp.reconstruction.joint_tracking import JointPose
from beam_warp.reconstruction.joints.graph import JointGraph
from beam_warp.reconstruction.joints.registration import register
from beam_warp.reconstruction.joints.selection import FAINTEST, select_joints
from beam_warp.reconstruction.joints.skinning import Anchors, Skin
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

FloatArray = NDArray[np.float64]

MOST_NODES = 400
"""Gaussians that are moved onto the hull; joints go with them. Of a person, a limb is about two of their spacings wide:
with half as many, limbs are torn."""

POINTS_PER_NODE = 4
"""Points of the hull for each of them."""

HULL_RESOLUTION = 64
"""Voxels along the longest side of the hull: half of a limb's width."""

ASTRAY = 0.01
"""Part of the joints that may lie anywhere."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """Distances to the subject in a view.

    Attributes:
        camera: Of the view.
        away: How far squares of pixels are from the nearest one that shows something of the subject, in their sides.
        size: Pixels along a side of a square.
    """

    camera: Camera
    away: FloatArray
    size: int

    @classmethod
    def of(cls, view: CapturedView, size: int) -> Silhouette | None:
        """Measure a view; None where it has no mask, or one that shows nothing."""
        if view.alpha is None or not (view.alpha >= 0.5).any():
            return None
        size = min(size, *view.alpha.shape)
        rows, columns = (count // size for count in view.alpha.shape)
        strips = view.alpha[: rows * size, : columns * size].reshape(rows, size, -1).max(axis=1)
        squares = strips.reshape(rows, columns, size).max(axis=2)
        away: Any = ndimage.distance_transform_edt(squares < 0.5)  # its types allow for no distances
        return cls(view.camera, away, size)

    def outside(self, points: NDArray[np.floating]) -> FloatArray:
        """Return how far points are outside, ``(N,)``; 0 for those that the image does not show."""
        x, y, depth = self.camera.project(points).T
        rows, columns = np.floor(y / self.size), np.floor(x / self.size)
        seen = (depth > 0.0) & (rows >= 0) & (columns >= 0) & (rows < len(self.away)) & (columns < self.away.shape[1])
        found = np.zeros(len(points))
        found[seen] = self.away[rows[seen].astype(int), columns[seen].astype(int)]
        return found


def squares_outside(points: NDArray[np.floating], silhouettes: Sequence[Silhouette]) -> float:
    """Return how far points are outside the silhouettes where each is farthest, but for `ASTRAY` of them.

    Args:
        points: Points of the subject's surface [m], ``(N, 3)``.
        silhouettes: Of views.

    Returns:
        A distance in squares, exact to one of them; 0 without silhouettes.
    """
    farthest = np.zeros(len(points))
    for silhouette in silhouettes:
        farthest = np.maximum(farthest, silhouette.outside(points))
    return float(np.quantile(farthest, 1.0 - ASTRAY))


def pose_on_hull(
    cloud: GaussianCloud,
    normals: NDArray[np.float32],
    carried: Anchors,
    joints: NDArray[np.float32],
    start: JointPose,
    views: Sequence[CapturedView],
    smallest_cosine: float,
    device: Any,
) -> JointPose | None:
    """Return the pose in which joints lie on the visual hull of views; None where masks have none.

    Args:
        cloud: Gaussians of the frame before.
        normals: Which way the surface faces at them, ``(N, 3)``; 0 where unknown.
        carried: Anchors of the Gaussians to the joints.
        joints: Joints in the frame before [m], ``(M, 3)``.
        start: Pose to begin with.
        views: The photographs.
        smallest_cosine: Least cosine between normals of neighbours.
        device: Warp device.
    """
    usable = np.flatnonzero(normals.any(axis=1) & (cloud.opacities >= FAINTEST))
    if not len(usable):
        return None
    try:
        hull = visual_hull(views, resolution=HULL_RESOLUTION, device=str(device)).mesh
    except InvalidArrayError:
        return None
    nodes = usable[select_joints(cloud.positions[usable], min(MOST_NODES, len(usable)))]
    rest, facing = cloud.positions[nodes].astype(np.float64), normals[nodes].astype(np.float64)
    graph = JointGraph.build(rest, normals=facing, smallest_cosine=smallest_cosine)
    import trimesh  # motion that far is rare

    points, faces, *_ = trimesh.sample.sample_surface(hull, POINTS_PER_NODE * len(nodes), seed=0)
    first = carried.joints[:, 0]
    turns = Rotation.from_quat(start.rotations[first[nodes]])
    places = start.positions[first[nodes]] + turns.apply(rest - joints[first[nodes]])
    surface = np.asarray(points), hull.face_normals[faces]
    matrices, found = register(graph, rest, facing, *surface, (turns.as_matrix(), places))
    far = _only_far(turns, places, Rotation.from_matrix(matrices), found, graph.spacing)
    outward = np.stack([np.bincount(first, normals[:, axis], len(joints)) for axis in range(3)], axis=1)
    anchors = Anchors.fit(joints, rest, normals=outward, joint_normals=facing, smallest_cosine=smallest_cosine)
    return _carry(joints, anchors, rest, *far, device)


def _only_far(
    turns: Rotation, places: FloatArray, found_turns: Rotation, found: FloatArray, near: float
) -> tuple[Rotation, FloatArray]:
    """Return found poses, and the expected ones where they are near: photographs find small motions better.

    Silhouettes do not show whether a round body spins.
    """
    squared = ((found - places) ** 2).sum(axis=1, keepdims=True)
    part = squared / (squared + near**2)
    return turns * Rotation.from_rotvec(part * (turns.inv() * found_turns).as_rotvec()), places + part * (
        found - places
    )


def _carry(
    joints: NDArray[np.float32], anchors: Anchors, rest: FloatArray, turns: Rotation, places: FloatArray, device: Any
) -> JointPose:
    """Return where nodes carry the joints."""
    skin = Skin(joints, np.tile([0.0, 0.0, 0.0, 1.0], (len(joints), 1)), anchors, rest, device=device)
    turned, moved = wp.clone(skin.rest_orientations), wp.clone(skin.rest_positions)
    rotations = upload(turns.as_quat().astype(np.float32), wp.quat, device)
    skin.warp(rotations, upload(places.astype(np.float32), wp.vec3, device), moved, turned)
    return JointPose(turned.numpy().copy(), moved.numpy().copy())
