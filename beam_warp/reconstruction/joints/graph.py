"""The graph of joints, and the joints near a point: nearest neighbours with weights, on the host.

Lengths are measured in joint spacings, the median distance from a joint to the nearest one that it goes with, never in
metres: a subject of 2 m and one of 2 mm get the same graph.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from beam_warp.checks import require_array, require_count, require_finite, require_number
from beam_warp.errors import InvalidArrayError
from beam_warp.world.framing import require_points

REACH = 1.5
"""Length l of the weights exp(-d^2 / l^2), in joint spacings: on an evenly covered surface the eighth neighbour of a
joint then has about a quarter of the weight of the nearest."""

SMALLEST_COSINE = -0.2
"""Least cosine between the normals of two joints of one surface: up to 101 degrees, so that the faces at a right angle,
such as the edge of a box, still count as one where normals are 10 degrees off."""

CANDIDATES = 3
"""Neighbours looked at for each one that is kept, where normals may rule some out: of two sheets in contact, half."""


Facing = Callable[[NDArray[np.int64]], NDArray[np.bool_]]
"""A test which joints of some edges do not face apart from the points that these leave."""


@dataclass(frozen=True, eq=False)
class JointGraph:
    """Directed edges from every joint to its nearest ones.

    Attributes:
        neighbors: The joints at the ends of the edges, nearest first, ``(M, k)`` int32; an edge that is not there has
            the joint itself and weight 0. k is at most M - 1.
        weights: Positive, each row adds up to 1 (to 0 without edges), ``(M, k)`` float32.
        incoming: Edges by the joint at their end, as numbers ``joint * k + slot``, ``(E,)`` int32, ascending for each
            joint. A joint's gradient is a sum over these, so no two threads add to one sum.
        incoming_starts: Where each joint's begin, and the end of the last, ``(M + 1,)`` int32.
        spacing: Median length of the shortest edge of a joint, in the units of the positions; 1 for one joint.
    """

    neighbors: NDArray[np.int32]
    weights: NDArray[np.float32]
    incoming: NDArray[np.int32]
    incoming_starts: NDArray[np.int32]
    spacing: float

    @classmethod
    def build(
        cls,
        joint_positions: ArrayLike,
        neighbor_count: int = 8,
        *,
        normals: ArrayLike | None = None,
        smallest_cosine: float = SMALLEST_COSINE,
    ) -> JointGraph:
        """Connect every joint to its nearest ones, with weights exp(-d^2 / l^2), l = 1.5 spacings, that add up to 1.

        Args:
            joint_positions: The joints, ``(M, 3)``.
            neighbor_count: Edges that leave a joint, k; M - 1 if there are fewer joints.
            normals: Which way the surface faces at each joint, outward, ``(M, 3)`` of any length; 0 where unknown.
                Joints that face apart are then not connected: an arm on a hip is near it in space, far along the
                surface, and must come off. They are, nearest ones, where no joint near faces otherwise.
            smallest_cosine: Least cosine between the normals of two joints that do not face apart.

        Raises:
            InvalidArrayError: An array has another shape, is not finite, or most joints coincide.
            InvalidOptionError: ``neighbor_count`` is out of range.
        """
        joints = require_points("joint_positions", joint_positions)
        count = min(require_count("neighbor_count", neighbor_count, 1, 64), len(joints) - 1)
        directions = _directions("normals", normals, len(joints))
        facing = _facing(directions, directions, smallest_cosine)
        ends, squared = _nearest(joints, joints, count, facing, themselves=True)
        spacing = _spacing(squared)
        weights = proximity_weights(squared, REACH * spacing)
        there = weights > 0.0
        ends = np.where(there, ends, np.arange(len(joints))[:, None]).astype(np.int32)
        edges, starts = group_by(ends.ravel(), np.flatnonzero(there.ravel()), len(joints))
        return cls(ends, weights, edges, starts, spacing)


def torn_fraction(graph: JointGraph, rest_positions: ArrayLike, positions: ArrayLike) -> float:
    """Return the fraction of joints with an edge more than twice as long as at rest, or less than half.

    Skin stretches a little; where tracking is lost or the topology changes, edges stretch a lot.

    Args:
        graph: Of the joints.
        rest_positions: ``(M, 3)``.
        positions: ``(M, 3)``.

    Raises:
        InvalidArrayError: An array has another shape or is not finite.
    """
    count = len(graph.neighbors)
    before, after = (
        require_array(name, value, (count, 3), np.float64)
        for name, value in (("rest_positions", rest_positions), ("positions", positions))
    )
    require_finite("rest_positions", before)
    require_finite("positions", after)
    old, new = (np.linalg.norm(x[graph.neighbors] - x[:, None], axis=-1) for x in (before, after))
    # Joints that coincide at rest must not divide by 0; a millionth of the spacing is nothing beside any edge.
    floor = 1e-6 * graph.spacing
    ratios = np.where(graph.weights > 0.0, (new + floor) / (old + floor), 1.0)
    return float(((ratios > 2.0) | (ratios < 0.5)).any(axis=1).mean())


def joint_spacing(
    joints: NDArray[np.float64], normals: ArrayLike | None = None, smallest_cosine: float = SMALLEST_COSINE
) -> float:
    """Return the median distance from a joint to the nearest other one that goes with it; 1 for one joint.

    Raises:
        InvalidArrayError: It is 0: at least half of the joints coincide with others.
    """
    directions = _directions("joint_normals", normals, len(joints))
    facing = _facing(directions, directions, smallest_cosine)
    return _spacing(_nearest(joints, joints, min(8, len(joints) - 1), facing, themselves=True)[1])


def nearest_joints(
    points: NDArray[np.float64],
    joints: NDArray[np.float64],
    count: int,
    normals: ArrayLike | None,
    joint_normals: ArrayLike | None,
    smallest_cosine: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the joints that are nearest to each point and their squared distances, ``(N, count)``, nearest first.

    Joints that face apart from a point are left out, unless all near ones do; where fewer are left, the rest has an
    infinite distance. ``count`` is at most the number of joints.
    """
    facing = _facing(
        _directions("normals", normals, len(points)),
        _directions("joint_normals", joint_normals, len(joints)),
        smallest_cosine,
    )
    return _nearest(points, joints, count, facing, themselves=False)


def proximity_weights(squared: NDArray[np.float64], length: float) -> NDArray[np.float32]:
    """Return exp(-d^2 / l^2) of ascending squared distances, each row divided by its sum; 0 for infinite ones.

    The nearest one's exponent is taken from all of them, which changes nothing but that nothing underflows: far from
    every joint the nearest has weight 1, instead of 0 / 0.
    """
    if squared.shape[1] == 0:
        return np.zeros(squared.shape, np.float32)
    nearest = np.where(np.isfinite(squared[:, :1]), squared[:, :1], 0.0)
    # float32 has no room below 1e-38, and weights of less than 1e-12 carry nothing
    weights = np.exp(-np.minimum((squared - nearest) / length**2, 1e3))
    weights[weights < 1e-12] = 0.0
    total = weights.sum(axis=1, keepdims=True)
    return (weights / np.where(total > 0.0, total, 1.0)).astype(np.float32)


def stable_order(keys: NDArray[np.int32], limit: int) -> NDArray[np.intp]:
    """Return what sorts numbers from 0 to below a limit, equal ones as they stand; 16 bits are sorted far faster."""
    return np.argsort(keys.astype(np.uint16) if limit <= 2**16 else keys, kind="stable")


def group_by(
    groups: NDArray[np.int32], items: NDArray[np.int64], group_count: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return ``items`` ordered by ``groups[item]``, ascending in each, and where each begins, and the last ends."""
    chosen = groups[items]
    ordered = items[stable_order(chosen, group_count)]
    starts = np.concatenate([[0], np.cumsum(np.bincount(chosen, minlength=group_count))])
    return ordered.astype(np.int32), starts.astype(np.int32)


def _spacing(squared: NDArray[np.float64]) -> float:
    """Return the median distance of joints to their nearest, of ascending squared ones; 1 for one joint."""
    if squared.shape[1] == 0:
        return 1.0
    spacing = math.sqrt(np.median(squared[:, 0]))
    if not spacing > 0.0:
        raise InvalidArrayError(
            f"joint_positions must be apart, got {len(squared)} joints of which half coincide with others. "
            "Take them from select_joints."
        )
    return spacing


def _facing(
    points: NDArray[np.float64] | None, joints: NDArray[np.float64] | None, smallest_cosine: float
) -> Facing | None:
    """Return the test which joints ``ends``, ``(N, k)``, do not face apart from each point.

    Directions have unit length, or 0 where they are unknown: those go with all. None if either has no directions.
    """
    cosine = require_number("smallest_cosine", smallest_cosine, -1.0, 1.0)
    if points is None or joints is None:
        return None

    def together(ends: NDArray[np.int64]) -> NDArray[np.bool_]:
        cosines = np.einsum("nc,nkc->nk", points, joints[ends])
        known = (np.abs(points).max(axis=1) > 0.0)[:, None] & (np.abs(joints).max(axis=1) > 0.0)[ends]
        return (cosines >= cosine) | ~known

    return together


def _directions(name: str, value: ArrayLike | None, count: int) -> NDArray[np.float64] | None:
    """Return vectors of unit length, 0 where they are 0."""
    if value is None:
        return None
    vectors = require_array(name, value, (count, 3), np.float64)
    require_finite(name, vectors)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def _nearest(
    points: NDArray[np.float64], joints: NDArray[np.float64], count: int, facing: Facing | None, *, themselves: bool
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the nearest joints that go with each point, ``(N, count)``; ``themselves``: points are the joints."""
    if count == 0:
        return np.zeros((len(points), 0), np.int64), np.zeros((len(points), 0))
    looked_at = min((CANDIDATES if facing is not None else 1) * count + themselves, len(joints))
    distances, ends = cKDTree(joints).query(points, k=list(range(1, looked_at + 1)), workers=-1)
    squared = distances**2
    allowed = np.ones(ends.shape, bool)
    if themselves:
        allowed &= ends != np.arange(len(points))[:, None]
    if facing is not None:
        agree = allowed & facing(ends)
        allowed = np.where(agree.any(axis=1, keepdims=True), agree, allowed)
    squared = np.where(allowed, squared, np.inf)
    order = np.argsort(squared, axis=1, kind="stable")[:, :count]
    return np.take_along_axis(ends, order, axis=1), np.take_along_axis(squared, order, axis=1)
