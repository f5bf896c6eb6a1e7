"""Where to place a camera: looking at a point, on an orbit, or so near that points just fill its image."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_finite, require_number, require_range
from beam_warp.errors import InvalidArrayError, InvalidOptionError

if TYPE_CHECKING:
    from beam_warp.world.gaussians import GaussianCloud

PARALLEL_SINE = 1e-6
"""Below this sine between the viewing direction and up, the roll of a camera is undefined in double precision."""


def pose_looking_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> NDArray[np.float64]:
    """Return the camera-to-world pose ``(4, 4)`` of a camera at ``eye`` that looks at ``target``; see `Camera.look_at`.

    Raises:
        InvalidArrayError: ``eye``, ``target`` or ``up`` is not three finite numbers.
        InvalidOptionError: ``eye`` and ``target`` coincide, or ``up`` is parallel to the viewing direction.
    """
    start, end, above = (require_point(n, v) for n, v in (("eye", eye), ("target", target), ("up", up)))
    axis = end - start
    distance = float(np.linalg.norm(axis))
    if not distance > 0.0:
        raise InvalidOptionError(f"target must differ from eye, got {end.tolist()} for both. Move one of them.")
    forward = axis / distance
    right = np.cross(forward, above)
    sine = float(np.linalg.norm(right) / max(float(np.linalg.norm(above)), np.finfo(float).tiny))
    if not sine > PARALLEL_SINE:
        raise InvalidOptionError(
            f"up must not be parallel to the viewing direction {forward.round(6).tolist()}, got {above.tolist()}. "
            "Choose another up."
        )
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = start
    return pose


def orbit_directions(azimuth: float, elevation: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the unit direction from the centre to the camera, and the image's up, which is perpendicular to it.

    The angles [degree] are those of `Camera.orbit`.

    Raises:
        InvalidOptionError: An angle is out of range.
    """
    a = np.radians(require_number("azimuth", azimuth, -3600.0, 3600.0))
    e = np.radians(require_number("elevation", elevation, -90.0, 90.0))
    ground = np.array([np.sin(a), -np.cos(a), 0.0])
    zenith = np.array([0.0, 0.0, 1.0])
    return np.cos(e) * ground + np.sin(e) * zenith, np.cos(e) * zenith - np.sin(e) * ground


def bulk(positions: ArrayLike, opacities: ArrayLike | None = None) -> NDArray[np.float64]:
    """Return the positions that belong to the subject, without stray ones.

    Per axis, the box between the 1 % and 99 % quantiles by opacity is robust against any 1 % of strays but cuts off
    feet and fingers; grown by a quarter of its size to each side it holds them again.

    Args:
        positions: Centres [m], ``(N, 3)`` with N at least 1.
        opacities: Weight of each position, ``(N,)`` in [0, 1]; None weighs all the same.

    Returns:
        ``(M, 3)`` float64 with M at least 1.

    Raises:
        InvalidArrayError: An array breaks its contract, or there is no Gaussian.
    """
    points = require_points("positions", positions)
    if opacities is None:
        weights = np.ones(len(points))
    else:
        weights = require_array("opacities", opacities, (len(points),), np.float64)
        require_range("opacities", weights, 0.0, 1.0)
    if not weights.sum() > 0.0:
        weights = np.ones(len(points))
    inside = np.ones(len(points), dtype=bool)
    for axis in range(3):
        order = np.argsort(points[:, axis], kind="stable")
        share = np.cumsum(weights[order])
        sorted_points = points[order, axis]
        low, high = sorted_points[np.searchsorted(share, np.array([0.01, 0.99]) * share[-1])]
        grown = 0.25 * (high - low)
        inside &= (points[:, axis] >= low - grown) & (points[:, axis] <= high + grown)
    return points[inside] if inside.any() else points


def bulk_of(clouds: Iterable[GaussianCloud]) -> NDArray[np.float64]:
    """Return the `bulk` of each cloud that is not empty, together: ``(N, 3)`` [m], where N may be 0."""
    found = [bulk(cloud.positions, cloud.opacities) for cloud in clouds if len(cloud)]
    return np.concatenate(found) if found else np.zeros((0, 3))


def require_points(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return points ``(N, 3)`` as float64 after checking them.

    Raises:
        InvalidArrayError: There is no point, the shape is another, or a coordinate is not finite.
    """
    points = require_array(name, value, (None, 3), np.float64)
    if not len(points):
        raise InvalidArrayError(f"{name} must hold at least one point, got none. Check that the input is not empty.")
    require_finite(name, points)
    return points


def require_point(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return one point ``(3,)`` as float64 after checking it; see `require_points`."""
    point = require_array(name, value, (3,), np.float64)
    require_finite(name, point)
    return point
