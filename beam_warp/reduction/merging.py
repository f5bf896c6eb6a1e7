"""Which Gaussians become one: clusters in the order of what their merging costs in relit images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from beam_warp.device.arrays import resolve_device
from beam_warp.kernels.reduction.pair_costs import Clusters as PairedClusters
from beam_warp.kernels.reduction.pair_costs import launch_pair_costs
from beam_warp.reduction.sensitivity import Sensitivity, material_rows
from beam_warp.world.gaussians import GaussianCloud

NEIGHBORS = 8
"""Nearest clusters that a cluster may merge with."""

SPREAD = 0.25
"""Cost of a spread along the surface over that of one across it."""

FLOOR = 1e-3
"""Squared slope of images that is taken for granted everywhere [1/pixel^2]: what is near is merged first."""

MERGED_AT_ONCE = 0.5
"""Share of the pairs that choose each other, cheapest first, that merge before costs are found anew."""

FloatArray = NDArray[np.float64]


class MergeOrder:
    """The order in which Gaussians of a sequence merge: any number of clusters can be asked for.

    In every round, clusters choose the neighbour that is cheapest to merge with, and the cheaper half of the pairs that
    choose each other merge. With visible pixels W1 and W2, a pair whose materials differ by d costs
    W1 W2 / (W1 + W2) d^T M d, M being the mean quadratic form of `Sensitivity`: what Ward's method is for variances,
    this is for relit images. A distance in space costs the same way, by the squared slope of images.

    Source: Ward 1963; Murtagh 1983 (mutual nearest neighbours).
    """

    def __init__(self, clouds: Sequence[GaussianCloud], found: Sensitivity, device: Any = None) -> None:
        """Begin with every Gaussian by itself.

        Args:
            clouds: Some frames of a constant topology, in the world's axes.
            found: What their images depend on.
            device: Warp device on which costs are found.
        """
        count = len(clouds[0])
        self._pixel, self._count, self._device = found.pixel, count, resolve_device(device)
        self._weights = found.visible.astype(np.float64) + 1e-6 * (1.0 + float(found.visible.mean()))
        self._edges = found.edges + FLOOR * self._weights
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
        some = pairs[mutual[: max(1, int(np.ceil(MERGED_AT_ONCE * len(mutual))))]]
        first = np.full(len(self._heads), len(some))
        for side in some.T:
            np.minimum.at(first, side, np.arange(len(some)))
        chosen = some[(first[some] == np.arange(len(some))[:, None]).all(axis=1)]  # equal costs may share a cluster
        kept, gone = chosen.T
        self._merges = np.concatenate([self._merges, self._heads[chosen]])
        share = self._weights[gone] / (self._weights[kept] + self._weights[gone])
        for means in (self._materials, self._places):
            means[:, kept] += share[:, None] * (means[:, gone] - means[:, kept])
        for sums in (self._weights, self._edges, self._forms):
            sums[kept] += sums[gone]
        left = np.ones(len(self._heads), bool)
        left[gone] = False
        self._heads, self._weights = self._heads[left], self._weights[left]
        self._edges, self._forms = self._edges[left], self._forms[left]
        self._materials, self._places = self._materials[:, left], self._places[:, left]

    def _costs(self) -> tuple[NDArray[np.int64], FloatArray]:
        """Return pairs of neighbours, ``(P, 2)``, and what merging each costs."""
        count = len(self._heads)
        near = cKDTree(self._places[0]).query(self._places[0], k=min(NEIGHBORS + 1, count), workers=-1)[1]
        one, two = np.repeat(np.arange(count), near.shape[1]), near.reshape(-1)
        low, high = np.minimum(one, two), np.maximum(one, two)
        keys = np.sort((low * count + high)[low < high])
        keys = keys[np.diff(keys, prepend=-1) > 0]  # as by np.unique, which hashes and takes far longer
        pairs = np.stack([keys // count, keys % count], axis=1)
        clusters, device = PairedClusters(), self._device
        for name in ("weights", "edges", "forms", "materials"):
            setattr(clusters, name, wp.array(getattr(self, f"_{name}"), dtype=float, device=device))
        clusters.places = wp.array(self._places, dtype=wp.vec3, device=device)
        costs = wp.empty(len(pairs), dtype=float, device=device)
        at = wp.array(pairs.astype(np.int32), dtype=wp.vec2i, device=device)
        launch_pair_costs(len(pairs), at, clusters, self._pixel, SPREAD, costs, device)
        return pairs, costs.numpy().astype(np.float64)
