"""Which Gaussians become one: clusters in the order of what their merging costs in relit images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from beam_warp.reduction.sensitivity import MATERIALS, Sensitivity, material_rows
from beam_warp.world.gaussians import GaussianCloud

NEIGHBORS = 8
"""Nearest clusters that a cluster may merge with."""

SPREAD = 0.5
"""Cost of a spread along the surface over that of one across it."""

FLOOR = 5e-3
"""Squared slope of images that is taken for granted everywhere [1/pixel^2]: what is near is merged first."""

MERGED_AT_ONCE = 0.5
"""Share of the pairs that choose each other, cheapest first, that merge before costs are found anew."""

NORMAL = slice(MATERIALS - 3, MATERIALS)

FloatArray = NDArray[np.float64]


class MergeOrder:
    """The order in which Gaussians of a sequence merge: any number of clusters can be asked for.

    In every round, clusters choose the neighbour that is cheapest to merge with, and the cheaper half of the pairs that
    choose each other merge. With visible pixels W1 and W2, a pair whose materials differ by d costs
    W1 W2 / (W1 + W2) d^T M d, M being the mean quadratic form of `Sensitivity`: what Ward's method is for variances,
    this is for relit images. A distance in space costs the same way, by the squared slope of images.

    Source: Ward 1963; Murtagh 1983 (mutual nearest neighbours).
    """

    def __init__(self, clouds: Sequence[GaussianCloud], found: Sensitivity) -> None:
        """Begin with every Gaussian by itself.

        Args:
            clouds: Some frames of a constant topology, in the world's axes.
            found: What their images depend on.
        """
        count = len(clouds[0])
        self._pixel, self._count = found.pixel, count
        self._weight = found.visible.astype(np.float64) + 1e-6 * (1.0 + float(found.visible.mean()))
        self._edges = found.edges + FLOOR * self._weight
        self._forms = found.materials.copy()
        self._materials = np.stack([material_rows(cloud) for cloud in clouds]).astype(np.float64)
        self._places = np.stack([cloud.positions for cloud in clouds]).astype(np.float64)
        self._heads = np.arange(count)
        self._merges = np.zeros((0, 2), np.int64)

    def labels(self, count: int) -> NDArray[np.int64]:
        """Return the cluster of every Gaussian, 0 … ``count`` - 1; ``count`` is at least 1 and at most theirs."""
        while len(self._heads) > count:
            self._merge_round()
        first, second = self._merges[: self._count - count].T
        graph = coo_array((np.ones(len(first)), (first, second)), shape=(self._count, self._count))
        return connected_components(graph, directed=False)[1].astype(np.int64)

    def _merge_round(self) -> None:
        """Merge some pairs of clusters."""
        pairs, costs = self._costs()
        best = np.full(len(self._heads), np.inf)
        for side in pairs.T:
            np.minimum.at(best, side, costs)
        mutual = np.flatnonzero((costs <= best[pairs[:, 0]]) & (costs <= best[pairs[:, 1]]))
        mutual = mutual[np.argsort(costs[mutual], kind="stable")]
        chosen, taken = [], np.zeros(len(self._heads), bool)
        for index in mutual[: max(1, int(np.ceil(MERGED_AT_ONCE * len(mutual))))]:
            if not taken[pairs[index]].any():  # pairs of equal cost may share a cluster
                taken[pairs[index]] = True
                chosen.append(index)
        kept, gone = pairs[chosen].T
        self._merges = np.concatenate([self._merges, self._heads[pairs[chosen]]])
        share = self._weight[gone] / (self._weight[kept] + self._weight[gone])
        for means in (self._materials, self._places):
            means[:, kept] += share[:, None] * (means[:, gone] - means[:, kept])
        for sums in (self._weight, self._edges, self._forms):
            sums[kept] += sums[gone]
        left = np.ones(len(self._heads), bool)
        left[gone] = False
        self._heads, self._weight = self._heads[left], self._weight[left]
        self._edges, self._forms = self._edges[left], self._forms[left]
        self._materials, self._places = self._materials[:, left], self._places[:, left]

    def _costs(self) -> tuple[NDArray[np.int64], FloatArray]:
        """Return pairs of neighbours, ``(P, 2)``, and what merging each costs."""
        count = len(self._heads)
        near = cKDTree(self._places[0]).query(self._places[0], k=min(NEIGHBORS + 1, count), workers=-1)[1]
        one, two = np.repeat(np.arange(count), near.shape[1]), near.reshape(-1)
        pairs = np.unique(np.sort(np.stack([one, two], axis=1)[one != two], axis=1), axis=0)
        one, two = pairs.T
        total = self._weight[one] + self._weight[two]
        share = self._weight[one] * self._weight[two] / total
        form = (self._forms[one] + self._forms[two]) / total[:, None, None]
        slope = (self._edges[one] + self._edges[two]) / total
        costs = np.zeros(len(pairs))
        for materials, places in zip(self._materials, self._places, strict=True):
            away, apart = materials[one] - materials[two], places[one] - places[two]
            normal = materials[one, NORMAL] + materials[two, NORMAL]
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
            across = np.einsum("pk,pk->p", apart, normal) ** 2
            along = np.square(apart).sum(axis=1) - across
            shift = (across + SPREAD * along) / self._pixel**2
            costs += np.einsum("pi,pij,pj->p", away, form, away, optimize=True) + slope * shift
        return pairs, costs * share
