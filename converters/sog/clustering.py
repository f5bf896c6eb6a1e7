"""Codebooks: numbers or vectors that stand for many, with the least sum of squared distances that a few rounds find.

All results are determined by the input: the same values give the same codebook.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from threadpoolctl import threadpool_limits

_SEED = 0

_ROUNDS_OF_SHARING = 8
_ROUNDS_OF_NUMBERS = 100
_ROUNDS_OF_VECTORS = 8

_ROUNDING = 1e-5
"""Squared distance over squared length that float32 cannot tell from 0."""

_MOST_COMPARED = 2**27
"""Most comparisons of a group's members with its entries in a round, so that no palette takes minutes."""

_SAMPLE = 2**16
"""Vectors that the coarse division of a palette is found from."""


def codebook(values: NDArray[np.floating], size: int = 256) -> NDArray[np.float32]:
    """Return ``size`` ascending numbers that stand for many.

    Up to ``size`` different values are kept exactly. Others are the means of their neighbourhoods (Lloyd 1982), found
    on sorted values from prefix sums. The start has neighbourhoods of equal squared error, which is best in the limit
    of many codes (Panter and Dite 1951); a code that stands for nothing later moves to where the error is greatest.

    Args:
        values: Finite numbers of any shape.
        size: Number of codes.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    different = ordered[np.flatnonzero(np.diff(ordered, prepend=-np.inf))]
    if len(different) <= size:
        last = different[-1:] if len(different) else np.zeros(1)
        return np.concatenate([different, np.repeat(last, size - len(different))]).astype(np.float32)
    cells = _Cells.of(ordered)
    ends = np.rint(np.linspace(0, len(ordered), size + 1)).astype(np.intp)
    for _ in range(_ROUNDS_OF_SHARING):
        mass = np.concatenate([[0.0], np.cumsum(np.cbrt(cells.errors(ends)))])
        ends = np.rint(np.interp(np.linspace(0.0, mass[-1], size + 1), mass, ends)).astype(np.intp)
    codes = cells.means(ends, ordered[np.minimum(ends[:-1], len(ordered) - 1)] - cells.middle)
    for _ in range(_ROUNDS_OF_NUMBERS):
        ends = np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2.0 + cells.middle)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        moved = cells.means(ends, codes)
        if (empty := np.diff(ends) == 0).any():
            errors = cells.errors(ends)
            worst = np.argsort(-errors, kind="stable")[: np.count_nonzero(empty)]
            moved[empty] = moved[worst] + np.sqrt(errors[worst] / np.maximum(np.diff(ends)[worst], 1))
            moved.sort()
        if np.array_equal(moved, codes):
            break
        codes = moved
    return (codes + cells.middle).astype(np.float32)


@dataclass(frozen=True)
class _Cells:
    """Sums of sorted values between any two ranks, from prefix sums about their mean.

    Attributes:
        middle: Mean of the values.
        sums: Sum of the values before each rank, less their mean.
        squares: Sum of the squares of the same.
    """

    middle: float
    sums: NDArray[np.float64]
    squares: NDArray[np.float64]

    @classmethod
    def of(cls, ordered: NDArray[np.float64]) -> _Cells:
        centered = ordered - ordered.mean()
        prefixes = (np.concatenate([[0.0], np.cumsum(terms)]) for terms in (centered, centered**2))
        return cls(float(ordered.mean()), *prefixes)

    def means(self, ends: NDArray[np.intp], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mean of each cell, and a given number for those without values."""
        counts = np.diff(ends)
        return np.where(counts > 0, np.diff(self.sums[ends]) / np.maximum(counts, 1), otherwise)

    def errors(self, ends: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the sum of squared distances from the mean of each cell."""
        sums = np.diff(self.sums[ends])
        return np.maximum(np.diff(self.squares[ends]) - sums * sums / np.maximum(np.diff(ends), 1), 0.0)


def nearest_codes(codes: NDArray[np.float32], values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return for every value the place of the nearest of up to 256 ascending codes."""
    middles = (codes[1:].astype(np.float64) + codes[:-1]) / 2.0
    return np.searchsorted(middles, values).astype(np.uint8)


def palette(vectors: NDArray[np.float32], size: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return up to ``size`` vectors ``(size, D)`` that stand for many ``(N, D)``, and for each its number ``(N,)``.

    The vectors are divided coarsely by k-means into sqrt(size) groups, and each group by k-means into entries in
    proportion to the sum of its distances, so that no vector is compared with all entries.
    """
    if len(vectors) <= size:
        return vectors, np.arange(len(vectors))
    with threadpool_limits(1, "blas"):  # many small products: threads inside of each cost more than they save
        return _divided(vectors, size)


def _divided(vectors: NDArray[np.float32], size: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Divide the vectors into groups, and these into entries."""
    rng = np.random.default_rng(_SEED)
    coarse = max(1, round(np.sqrt(size)))
    sample = vectors[rng.choice(len(vectors), min(_SAMPLE, len(vectors)), replace=False)]
    different = rng.permutation(np.unique(sample, axis=0))  # equal starts would leave most vectors in one group
    centers = _means(sample, different[:coarse])[0]
    coarse = len(centers)
    groups, distances = _nearest(vectors, centers)
    order = np.argsort(groups, kind="stable")
    ends = np.cumsum(np.bincount(groups, minlength=coarse))
    shares = _shares(np.bincount(groups, np.sqrt(distances), minlength=coarse), np.diff(ends, prepend=0), size)
    rows = np.split(order, ends[:-1])
    starts = [vectors[rng.choice(part, share, replace=False)] for part, share in zip(rows, shares, strict=True)]
    labels, entries = np.empty(len(vectors), np.intp), np.zeros((size, vectors.shape[1]), np.float32)

    def divide(rows: NDArray[np.intp], start: NDArray[np.float32], first: int) -> None:
        entries[first : first + len(start)], own = _means(vectors[rows], start)
        labels[rows] = first + own

    with ThreadPoolExecutor() as threads:
        list(threads.map(divide, rows, starts, np.cumsum(shares) - shares))
    return entries, labels


def _shares(weights: NDArray[np.number], counts: NDArray[np.integer], size: int) -> NDArray[np.intp]:
    """Divide entries among groups by weight; a group gets no more than it has members, and at least one if it has.

    A group without weight, whose members are equal, gets no more than one: entries may be left over.
    """
    shares = np.minimum(np.maximum(1, np.floor(weights / max(weights.sum(), 1e-300) * size)), counts).astype(np.intp)
    most = np.where(weights > 0.0, np.minimum(counts, _MOST_COMPARED // np.maximum(counts, 1)), np.minimum(1, counts))
    for group in np.argsort(-weights, kind="stable"):  # what remains, or is too much by the least of one
        shares[group] = np.clip(shares[group] + size - shares.sum(), min(1, counts[group]), most[group])
    return shares


def _means(vectors: NDArray[np.float32], centers: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Improve centres by rounds of k-means; return them and each vector's own."""
    labels, _ = _nearest(vectors, centers)
    for _ in range(_ROUNDS_OF_VECTORS):
        count = np.bincount(labels, minlength=len(centers))
        member = csr_array(
            (np.ones(len(labels), np.float32), labels, np.arange(len(labels) + 1)), (len(labels), len(centers))
        )
        sums = member.T @ vectors
        centers = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None].astype(np.float32), centers)
        labels, _ = _nearest(vectors, centers)
    return centers, labels


def _nearest(
    vectors: NDArray[np.float32], centers: NDArray[np.float32]
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return for every vector the number of the nearest centre and its squared distance."""
    half = 0.5 * np.einsum("ij,ij->i", centers, centers)
    labels, distances = np.empty(len(vectors), np.intp), np.empty(len(vectors), np.float32)
    block = max(1, 2**20 // max(len(centers), 1))
    for start in range(0, len(vectors), block):
        part = vectors[start : start + block]
        score = half - part @ centers.T  # half the squared distance, up to the vector's own square
        labels[start : start + block] = best = score.argmin(axis=1)
        distances[start : start + block] = 2.0 * score[np.arange(len(part)), best]
    squares = np.einsum("ij,ij->i", vectors, vectors)
    distances += squares
    return labels, np.where(distances > _ROUNDING * squares, distances, 0.0)
