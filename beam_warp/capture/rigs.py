"""Properties of a group of cameras: the point they look at, the volume that most of them see, and the up direction.

All estimates are robust: a minority of wrong cameras changes them little.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from beam_warp.errors import InvalidOptionError
from beam_warp.world.camera import OPENGL_TO_OPENCV, Camera

MIN_SPREAD = 1e-4
"""Least eigenvalue of the mean of I - a a^T over unit axes a that meet; axes within 0.6 degrees are below it."""

GRID = 32
"""Points along each side of the grid on which the common volume is found; a second grid refines the first box."""

MAX_CAMERAS = 64
"""Most cameras that are tested for what they see; of more cameras, an even selection is tested."""

COMMON_SHARE = 0.75
"""Share of the cameras that see every point of the common volume."""

LEAST_SHARE = 1.0 / 3.0
"""Least share of the cameras that must see a point in common."""


def meeting_point(poses: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the point of least summed distance to the optical axes, ``(3,)``; None if they are nearly parallel.

    It is found by least squares with weights of one over the distance, so that stray cameras count little.

    Args:
        poses: Camera to world in `Camera`'s axes, ``(N, 4, 4)``.
    """
    positions, axes = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if len(poses) < 2 or not np.linalg.eigvalsh(across.mean(axis=0))[0] > MIN_SPREAD:
        return None
    weights = np.ones(len(poses))
    scale = float(np.linalg.norm(positions - np.median(positions, axis=0), axis=1).max())
    point = np.zeros(3)
    for _ in range(50):
        normal = np.einsum("n,nij->ij", weights, across)
        point = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weights, across, positions))
        distance = np.linalg.norm(np.einsum("nij,nj->ni", across, point - positions), axis=1)
        weights = 1.0 / np.maximum(distance, 1e-3 * scale + 1e-300)
        weights /= weights.max()
    return point


def up_direction(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Return the mean of the cameras' upward directions, ``(3,)``: of length 1 where all agree, 0 where none do."""
    return np.mean([-camera.camera_to_world[:3, 1] for camera in cameras], axis=0)


def seen_by(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points ``(N, 3)`` are in a camera's image."""
    x, y, depth = camera.project(points).T
    return (depth > 0.0) & (x >= 0.0) & (x <= camera.width) & (y >= 0.0) & (y <= camera.height)


def frustum_corners(camera: Camera, depth: float) -> NDArray[np.float64]:
    """Return the world positions of an image's corners at a depth [m]: from the top left one, clockwise, ``(4, 3)``."""
    x = (np.array([0.0, camera.width, camera.width, 0.0]) - camera.center_x) / camera.focal_x
    y = (np.array([0.0, 0.0, camera.height, camera.height]) - camera.center_y) / camera.focal_y
    local = depth * np.stack([x, y, np.ones(4)], axis=-1)
    return local @ camera.camera_to_world[:3, :3].T + camera.position


def frustum_volume(cameras: Sequence[Camera]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the box around the points that most cameras see.

    The search reaches from the point that the cameras look at as far as their distance to it; for nearly parallel
    cameras, it reaches four times their extent ahead of them.

    Args:
        cameras: At least two cameras. `COMMON_SHARE` of them must see a point; if no point is seen by so many, it is
            0.8 of the largest number that see one point.

    Returns:
        The lower and the upper corner [m], ``(3,)`` each.

    Raises:
        InvalidOptionError: There are fewer than two cameras, or no point is seen by two of them and by `LEAST_SHARE`.
    """
    if len(cameras) < 2:
        raise InvalidOptionError(
            f"cameras must be at least 2 to have a volume in common, got {len(cameras)}. Add some."
        )
    step = -(-len(cameras) // MAX_CAMERAS)
    asked = cameras[::step]
    center, reach = _region(asked)
    low, high = center - reach, center + reach
    needed: int | None = None
    for _ in range(2):
        points, cell = _grid(low, high)
        counts = np.sum([seen_by(camera, points) for camera in asked], axis=0)
        most = int(counts.max())
        if needed is None:
            if most < max(2, int(np.ceil(LEAST_SHARE * len(asked)))):
                raise InvalidOptionError(
                    f"cameras must have a volume in common, got no point that more than {most} of {len(asked)} see. "
                    "Check the poses: their axes, their units, and that they are camera-to-world."
                )
            needed = max(2, min(int(np.ceil(COMMON_SHARE * len(asked))), int(np.ceil(0.8 * most))))
        inside = points[counts >= needed]
        if not len(inside):
            break
        low, high = inside.min(axis=0) - cell, inside.max(axis=0) + cell
    return low, high


def _grid(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centres of `GRID` cells a side, ``(GRID^3, 3)``, and half a cell."""
    cell = (high - low) / GRID
    index = np.stack(np.meshgrid(*(np.arange(GRID) + 0.5,) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return low + index * cell, 0.5 * cell


def _region(cameras: Sequence[Camera]) -> tuple[NDArray[np.float64], float]:
    """Return the centre and the half-size of the box in which common points are searched."""
    poses = np.array([camera.camera_to_world for camera in cameras])
    positions = poses[:, :3, 3]
    point = meeting_point(poses)
    if point is not None:
        reach = float(np.median(np.linalg.norm(positions - point, axis=1)))
        if reach > 0.0:
            return point, reach
    middle = np.median(positions, axis=0)
    extent = 2.0 * float(np.linalg.norm(positions - middle, axis=1).max())
    reach = 2.0 * (extent if extent > 0.0 else 1.0)
    return middle + reach * poses[:, :3, 2].mean(axis=0), reach


def facing_share(cameras: Sequence[Camera], poses: NDArray[np.float64] | None = None) -> float | None:
    """Return the share of cameras that show the point where the optical axes meet.

    Args:
        cameras: Cameras with their intrinsics.
        poses: Poses to use instead of the cameras' own, ``(N, 4, 4)``.

    Returns:
        A share from 0 to 1; None if the axes are nearly parallel.
    """
    own = np.array([camera.camera_to_world for camera in cameras]) if poses is None else poses
    point = meeting_point(own)
    if point is None:
        return None
    facing = 0
    for camera, pose in zip(cameras, own, strict=True):
        x, y, z = (point - pose[:3, 3]) @ pose[:3, :3]
        if z > 1e-6 * (1e-300 + float(np.linalg.norm(pose[:3, 3]))):
            column, row = camera.focal_x * x / z + camera.center_x, camera.focal_y * y / z + camera.center_y
            facing += 0.0 <= column <= camera.width and 0.0 <= row <= camera.height
    return facing / len(cameras)


NO_UP, ONE_UP = 0.3, 0.7
"""Lengths of the mean upward direction: below the first, cameras have no common up; above the second, they do."""

UP_MARGIN = 0.2
"""Largest difference in agreement on up, and on z as up, at which two mistakes are not told apart."""

POSE_MISTAKES = {
    "OpenCV poses were given as OpenGL's, or the other way round: negate the second and third column": lambda q: (
        q @ OPENGL_TO_OPENCV
    ),
    "world-to-camera poses in OpenCV axes were given: invert them, and negate the second and third column": lambda q: (
        np.linalg.inv(q @ OPENGL_TO_OPENCV)
    ),
    "world-to-camera poses in OpenGL axes were given: invert them": lambda q: (
        np.linalg.inv(q @ OPENGL_TO_OPENCV) @ OPENGL_TO_OPENCV
    ),
    "world-to-camera poses were given: invert them": np.linalg.inv,
}
"""Usual mistakes in poses written for nerfstudio, each with the function that undoes it in the poses as read."""


DOUBT, TRUST = 0.5, 0.8
"""Poses are right if the first share of the cameras or more looks at a common point with a common up; a mistake is
likely if at least the second share looks at a common point once the mistake is undone."""


def likely_mistakes(cameras: Sequence[Camera]) -> tuple[str, ...]:
    """Return the mistakes in writing the poses that, once undone, make the cameras look at a common point.

    Poses are doubted in two cases: their cameras do not look at a common point, or they do and have no common up
    direction, but would have one with a mistake undone. The second case is that of inverted poses around a subject,
    which look at a common point too, but are rolled in all ways.

    Args:
        cameras: Cameras; with fewer than three, nothing can be said.

    Returns:
        The likeliest mistake first, by the cameras' agreement on up; others follow if they agree nearly as well. Empty
        if the poses are not doubted, or if no known mistake explains them.
    """
    if len(cameras) < 3:
        return ()
    poses = np.array([camera.camera_to_world for camera in cameras])
    share = facing_share(cameras)
    if share is None:
        return ()
    undone = {name: undo(poses) for name, undo in POSE_MISTAKES.items()}
    agreed = {name: _up_length(q) for name, q in undone.items() if (facing_share(cameras, q) or 0.0) >= TRUST}
    if share >= DOUBT:
        if _up_length(poses) >= NO_UP:
            return ()
        agreed = {name: length for name, length in agreed.items() if length >= ONE_UP}
    # Two mistakes may differ only by a rotation of the world, which cameras do not tell: the one with z up is likelier.
    likely = {name: length - 0.5 * float(undone[name][:, 2, 1].mean()) for name, length in agreed.items()}
    best = max(likely.values(), default=0.0)
    return tuple(sorted((name for name in likely if likely[name] >= best - UP_MARGIN), key=lambda name: -likely[name]))


def _up_length(poses: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(poses[:, :3, 1].mean(axis=0)))
