"""A number of every Gaussian over the frames of a segment, as few planes: what all do in time, and the rest.

The numbers are a matrix: a row for each frame, a column for each Gaussian. The directions in which its columns vary
most (the transform of Karhunen and Loève) carry nearly all of a motion: a plane each, of whole multiples of a step.
What is left at each frame is rounded to multiples of twice the bound, so that no number is further from its original
than the bound. Where the first planes do well, those of the rest are nearly empty, and take no space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MOST_DIRECTIONS = 12
"""Most planes that all frames use; each costs a player a multiplication for every Gaussian."""

STEPS = (1.0, 2.0)
"""Steps of these planes that are tried, in steps of the rest: errors of several planes partly cancel."""

SAMPLE_RUNS, SAMPLE_ROWS = 8, 1024
"""Runs of neighbouring Gaussians on which choices are compared, and Gaussians of each."""

SLACK = 1.0 - 2.0**-8
"""Part of the bound that rounding may use; the rest is for single precision."""


@dataclass(frozen=True, eq=False)
class Planes:
    """One component of an array of a block.

    Attributes:
        weights: ``(F, 1 + S + P)`` float32: at frame f, it is the first plus the others times the planes.
        summed: ``(S, N)`` int32; stored as differences of neighbours.
        plain: ``(P, N)`` int32.
    """

    weights: NDArray[np.float32]
    summed: NDArray[np.int32]
    plain: NDArray[np.int32]

    def values(self) -> NDArray[np.float32]:
        """Return what a decoder makes of them, ``(F, N)``."""
        planes = np.concatenate([self.summed, self.plain]).astype(np.float32)
        return self.weights[:, 1:] @ planes + self.weights[:, :1]


def still(values: NDArray[np.float32], bound: float) -> Planes:
    """Return numbers ``(N,)`` of one moment as a plane."""
    step = 2.0 * SLACK * bound
    center = 0.5 * (values.min() + values.max()) if len(values) else 0.0
    weights = np.array([[center, step]], np.float32)
    return Planes(weights, _multiples(values[None] - weights[0, 0], step), np.empty((0, len(values)), np.int32))


def moving(values: NDArray[np.float32], bound: float) -> Planes:
    """Return numbers of a segment ``(F, N)`` as planes; none is further off than the bound.

    The number of directions and their step are those that take the fewest bits on a sample of the Gaussians.
    """
    frames, count = values.shape
    sample = values[:, _sample(count)]
    mean = values.mean(axis=1, dtype=np.float64).astype(np.float32)[:, None]
    directions = _directions(values - mean)
    step = 2.0 * SLACK * bound
    choices = [
        (_bits(*_coded(sample, mean, directions[:, :number], factor * step, step)), number, factor)
        for number in range(min(MOST_DIRECTIONS, frames) + 1)
        for factor in (STEPS if number else STEPS[:1])
    ]
    _, number, factor = min(choices)
    basis = directions[:, :number]
    summed, rest = _coded(values, mean, basis, factor * step, step)
    used = np.flatnonzero(rest.any(axis=1))
    weights = np.concatenate([mean, factor * step * basis, step * np.eye(frames)[:, used]], axis=1)
    return Planes(weights.astype(np.float32), summed, rest[used])


def _directions(centered: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return orthonormal directions as columns, that of the largest variance first."""
    covariance = centered.astype(np.float32) @ centered.T
    return np.linalg.eigh(covariance.astype(np.float64))[1][:, ::-1].astype(np.float32)


def _coded(
    rows: NDArray[np.float32], mean: NDArray[np.float32], basis: NDArray[np.float32], coarse: float, fine: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the planes along the directions, and those of the rest at each frame and component."""
    summed = _multiples(basis.T @ (rows - mean), coarse)
    decoded = (np.float32(coarse) * basis) @ summed.astype(np.float32) + mean
    return summed, _multiples(rows - decoded, fine)


def _multiples(values: NDArray[np.floating], step: float) -> NDArray[np.int32]:
    return np.rint(values / step).astype(np.int32)


def _sample(count: int) -> NDArray[np.intp]:
    """Return the numbers of some runs of Gaussians."""
    if count <= SAMPLE_RUNS * SAMPLE_ROWS:
        return np.arange(count)
    starts = np.linspace(0, count - SAMPLE_ROWS, SAMPLE_RUNS).astype(np.intp)
    return (starts[:, None] + np.arange(SAMPLE_ROWS)).ravel()


def _bits(summed: NDArray[np.int32], plain: NDArray[np.int32]) -> float:
    """Return about how many bits planes take: the entropy of their bytes."""
    planes = [*map(differences, summed), *plain[plain.any(axis=1)]]
    counts = [np.bincount(octets) for plane in planes for octets in _octets(plane)]
    return float(sum(-(n * np.log2(np.maximum(n, 1) / n.sum())).sum() for n in counts))


def differences(plane: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return each number less the one before it; the first one as it is."""
    return np.diff(plane, prepend=np.int32(0))


def width(plane: NDArray[np.int32]) -> int:
    """Return how many bytes a number of a plane takes, 1 to 4."""
    return max(1, (int(zigzag(plane).max(initial=0)).bit_length() + 7) // 8)


def zigzag(plane: NDArray[np.int32]) -> NDArray[np.uint32]:
    """Return 0, -1, 1, -2, 2 … as 0, 1, 2, 3, 4 …."""
    return ((plane << 1) ^ (plane >> 31)).view(np.uint32)


def stored(plane: NDArray[np.int32]) -> bytes:
    """Return a plane as its bytes of each order, the lowest first."""
    return np.ascontiguousarray(_octets(plane)).tobytes()


def _octets(plane: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return the bytes of each order of a plane, ``(width, N)``."""
    return zigzag(plane).astype("<u4").view(np.uint8).reshape(-1, 4).T[: width(plane)]
