"""Codebooks: numbers or vectors that stand for many, with the least sum of squared distances that a few rounds find.

All results are determined by the input: the same values give the same codebook.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

_SEED = 0

_ROUNDS_OF_NUMBERS = 200
_ROUNDS_OF_VECTORS = 8

_SAMPLE = 2**16
"""Vectors that the coarse division of a palette is found from."""


def codebook(values: NDArray[np.floating], size: int = 256) -> NDArray[np.float32]:
    """Return ``size`` ascending numbers that stand for many.

    Up to ``size`` different values are kept exactly. Others are the means of their neighbourhoods (Lloyd 1982), which
    are found on sorted values from prefix sums; the start has the density^(1/3) that is best in the limit of many
    codes (Panter and Dite 1951).

    Args:
        values: Finite numbers of any shape.
        size: Number of codes.
    """
    ordered = np.sort(values, axis=None).astype(np.float32)
    different = ordered[np.flatnonzero(np.diff(ordered, prepend=np.float32(-np.inf)))]
    if len(different) <= size:
        last = different[-1:] if len(different) else np.zeros(1, np.float32)
        return np.concatenate([different, np.repeat(last, size - len(different))])
    sums = np.concatenate([[0.0], np.cumsum(ordered, dtype=np.float64)])
    codes = _start(ordered, size)
    for _ in range(_ROUNDS_OF_NUMBERS):
        ends = np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2.0)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        counts = np.diff(ends)
        moved = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), codes)
        if np.array_equal(moved, codes):
            break
        codes = moved
    return np.sort(codes).astype(np.float32)


def _start(ordered: NDArray[np.float32], size: int) -> NDArray[np.float64]:
    """Return codes whose density is the cube root of that of the values."""
    counts, edges = np.histogram(ordered, bins=16 * size)
    mass = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    return np.interp((np.arange(size) + 0.5) / size * mass[-1], mass, edges)


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
    rng = np.random.default_rng(_SEED)
    coarse = max(1, round(np.sqrt(size)))
    sample = vectors[rng.choice(len(vectors), min(_SAMPLE, len(vectors)), replace=False)]
    centers = _means(sample, sample[:coarse].copy())[0]
    groups, distances = _nearest(vectors, centers)
    order = np.argsort(groups, kind="stable")
    ends = np.cumsum(np.bincount(groups, minlength=coarse))
    entries: list[NDArray[np.float32]] = []
    labels = np.empty(len(vectors), np.intp)
    shares = _shares(np.bincount(groups, np.sqrt(distances), minlength=coarse), np.diff(ends, prepend=0), size)
    taken = 0
    for rows, share in zip(np.split(order, ends[:-1]), shares, strict=True):
        if not share:
            continue
        members = vectors[rows]
        start = members[rng.choice(len(members), share, replace=False)]
        found, labels[rows] = _means(members, start)
        labels[rows] += taken
        entries.append(found)
        taken += share
    return np.concatenate(entries), labels


def _shares(weights: NDArray[np.float64], counts: NDArray[np.integer], size: int) -> NDArray[np.intp]:
    """Divide entries among groups by weight; a group gets no more than it has members, and at least one if it has."""
    shares = np.minimum(np.maximum(1, np.floor(weights / max(weights.sum(), 1e-300) * size)), counts).astype(np.intp)
    for group in np.argsort(-weights, kind="stable"):  # what remains, or is too much by the least of one
        shares[group] = np.clip(shares[group] + size - shares.sum(), min(1, counts[group]), counts[group])
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
    distances += np.einsum("ij,ij->i", vectors, vectors)
    return labels, np.maximum(distances, 0.0)
