"""Motion without texture: a body's points move, as rigidly as possible, onto a surface that may be far away.

The points are the centres of a mixture of Gaussians of width sigma, which explains the surface: each of its points is
shared out among the body's points that are near and face its way, and pulls them. Sigma shrinks from several distances
of neighbours to a fraction of one. Unlike nearest points, shares make sure that everything of the surface is explained:
a hand that has gone is pulled to where it is now, although hips are nearer to where it was.

Source: Myronenko and Song 2010, "Point Set Registration: Coherent Point Drift" (the mixture); Sorkine and Alexa 2007,
"As-Rigid-As-Possible Surface Modeling" (what holds the points together, in place of a smooth field).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from beam_warp.reconstruction.joints.graph import JointGraph

FloatArray = NDArray[np.float64]

WIDTHS = (3.0, 0.3)
"""Sigma in the first and in the last round, in distances of neighbours."""

GIVE = 0.3
"""Deviation of an edge from a rigid motion that counts as much as a distance of sigma, in distances of neighbours."""

FACING = 0.5
"""Deviation of normals, as the length between them."""

STRAY = 0.05
"""Share of a point of the surface that nothing explains, where a point of the body that lies on it has 1."""

ROUNDS = 30
"""Rounds in which shares are found anew."""

TURNS = 3
"""Times that points are moved, and turned as their neighbours moved, in each round."""


def register(
    graph: JointGraph,
    rest: FloatArray,
    normals: FloatArray,
    surface: FloatArray,
    surface_normals: FloatArray,
    start: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return rotations ``(M, 3, 3)`` and places ``(M, 3)`` of a body's points that have moved to a surface.

    Args:
        graph: Graph of the points; its spacing is the unit of length.
        rest: Points of the body before, ``(M, 3)``.
        normals: Unit outward normals there, ``(M, 3)``; 0 where unknown.
        surface: Points, evenly spread over the surface now, ``(K, 3)``.
        surface_normals: Unit outward normals of these, ``(K, 3)``.
        start: Rotations and places that are expected.
    """
    rotations, places = start
    edges = _Edges(graph, rest)
    for step in range(ROUNDS):
        width = WIDTHS[0] * (WIDTHS[1] / WIDTHS[0]) ** (step / (ROUNDS - 1))
        turned = np.einsum("nij,nj->ni", rotations, normals)
        shares = _shares(places, turned, surface, surface_normals, width * graph.spacing)
        held = shares.sum(axis=1)
        goal = shares @ surface / np.maximum(held, 1e-12)[:, None]
        held *= len(rest) / len(surface)
        rotations, places = edges.settle(places, goal, held, (width / GIVE) ** 2)
    return rotations, places


def _shares(
    places: FloatArray, normals: FloatArray, surface: FloatArray, surface_normals: FloatArray, width: float
) -> FloatArray:
    """Return what part of each point of the surface every point of the body explains, ``(M, K)``."""
    squared = (places**2).sum(axis=1)[:, None] - 2.0 * places @ surface.T + (surface**2).sum(axis=1)
    shares = np.exp(-0.5 * np.maximum(squared, 0.0) / width**2 - (1.0 - normals @ surface_normals.T) / FACING**2)
    return shares / (shares.sum(axis=0) + STRAY)


class _Edges:
    """Edges of a graph, alike both ways, and how they lie at rest."""

    def __init__(self, graph: JointGraph, rest: FloatArray) -> None:
        count, neighbors = graph.neighbors.shape
        starts = np.repeat(np.arange(count), neighbors)
        one_way = csr_array((graph.weights.ravel().astype(float), (starts, graph.neighbors.ravel())), (count, count))
        both = csr_array(0.5 * (one_way + one_way.T)).tocoo()
        self._starts, self._ends = both.coords
        self._rest = rest[self._ends] - rest[self._starts]
        self._sums = csr_array((both.data, (self._starts, np.arange(both.nnz))), (count, both.nnz))
        self._laplacian = csc_array(diags_array(both.sum(axis=1)) - both)

    def settle(
        self, places: FloatArray, goal: FloatArray, held: FloatArray, stiffness: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return rotations and places of points that goals pull, ``held`` times as much as edges per ``stiffness``."""
        pins = held + 1e-6  # what nothing pulls and no edge holds stays
        solve = splu(csc_array(stiffness * self._laplacian + diags_array(pins))).solve
        rotations = np.zeros((len(places), 3, 3))
        for _ in range(TURNS):
            now = places[self._ends] - places[self._starts]
            moments = self._sums @ (now[:, :, None] * self._rest[:, None, :]).reshape(-1, 9)
            rotations = _nearest_rotations(moments.reshape(-1, 3, 3))
            wanted = np.einsum("nij,nj->ni", rotations[self._starts] + rotations[self._ends], self._rest)
            pulled = held[:, None] * goal + 1e-6 * places
            places = solve(pulled - 0.5 * stiffness * (self._sums @ wanted))
        return rotations, places


def _nearest_rotations(matrices: FloatArray) -> FloatArray:
    """Return the rotations that are nearest to matrices, ``(N, 3, 3)``."""
    left, _, right = np.linalg.svd(matrices)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    return left @ right
