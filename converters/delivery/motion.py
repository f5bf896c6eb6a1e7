"""Arrays over the frames of a segment as few planes: what the Gaussians have in common in time, and the rest in steps.

Values of a segment are a matrix: a row for each frame and component, a column for each Gaussian. The directions in
which its columns vary most (Karhunen and Loève's transform) carry nearly all of a motion: a plane each, of whole
multiples of a step. What is left at each frame is rounded to multiples of twice the bound, so that no value is further
from its original than the bound. Where the first planes do well, those of the rest are nearly empty, and take no space.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MOST_DIRECTIONS = 24
"""Most planes that all frames use; each costs a player a multiplication for every component and Gaussian."""

STEPS = (1.0, 2.0)
"""Steps of these planes that are tried, in steps of the rest: the sum of their errors is below that of one of them."""

SAMPLE_RUNS, SAMPLE_ROWS = 8, 1024
"""Runs of neighbouring Gaussians on which choices are compared, and Gaussians of each."""

SLACK = 1.0 - 2.0**-8
"""Part of the bound that rounding may use; the rest is for single precision."""


@dataclass(frozen=True, eq=False)
class Planes:
    """One array of a block.

    Attributes:
        weights: ``(F, C, 1 + S + P)`` float32: at frame f, a component is the first plus the others times the planes.
        summed: ``(S, N)`` int32; stored as differences of neighbours.
        plain: ``(P, N)`` int32.
    """

    weights: NDArray[np.float32]
    summed: NDArray[np.int32]
    plain: NDArray[np.int32]

    def values(self) -> NDArray[np.float32]:
        """Return what a decoder makes of them, ``(F, C, N)``."""
        planes = np.concatenate([self.summed, self.plain]).astype(np.float32)
        return self.weights[..., 1:] @ planes + self.weights[..., :1]


def still(values: NDArray[np.float32], bound: float) -> Planes:
    """Return an array of one moment ``(C, N)`` as planes, a component each."""
    step = 2.0 * SLACK * bound
    center = 0.5 * (values.min(axis=1) + values.max(axis=1)) if values.size else np.zeros(len(values))
    weights = np.concatenate([center[:, None], step * np.eye(len(values))], axis=1)[None].astype(np.float32)
    return Planes(weights, _multiples(values - weights[0, :, :1], step), np.empty((0, values.shape[1]), np.int32))


def moving(values: NDArray[np.float32], bound: float) -> Planes:
    """Return an array of a segment ``(F, C, N)`` as planes; no value is further off than the bound.

    The number of directions and their step are those that take the fewest bytes on a sample of the Gaussians.
    """
    frames, components, count = values.shape
    rows = values.reshape(frames * components, count)
    sample = _sample(count)
    mean = rows.mean(axis=1, dtype=np.float64).astype(np.float32)[:, None]
    directions = _directions(rows - mean)
    step = 2.0 * SLACK * bound
    some = rows[:, sample]
    choices = [
        (_packed(*_coded(some, mean, directions[:, :number], factor * step, step)), number, factor)
        for number in _numbers(min(MOST_DIRECTIONS, len(rows)))
        for factor in (STEPS if number else STEPS[:1])
    ]
    _, number, factor = min(choices)
    basis = directions[:, :number]
    summed, rest = _coded(rows, mean, basis, factor * step, step)
    used = np.flatnonzero(rest.any(axis=1))
    weights = np.concatenate([mean, factor * step * basis, step * np.eye(len(rows))[:, used]], axis=1)
    return Planes(weights.reshape(frames, components, -1).astype(np.float32), summed, rest[used])


def _numbers(most: int) -> Iterator[int]:
    """Yield how many directions are tried."""
    yield from (number for number in (0, 1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24) if number <= most)


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


def _packed(summed: NDArray[np.int32], plain: NDArray[np.int32]) -> int:
    """Return about how many bytes planes take."""
    planes = [*map(differences, summed), *plain[plain.any(axis=1)]]
    return sum(len(zlib.compress(stored(plane, width(plane)), 1)) for plane in planes)


def differences(plane: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return each number less the one before it; the first one as it is."""
    return np.diff(plane, prepend=np.int32(0))


def width(plane: NDArray[np.int32]) -> int:
    """Return how many bytes a number of a plane takes, 1 to 4."""
    return max(1, (int(zigzag(plane).max(initial=0)).bit_length() + 7) // 8)


def zigzag(plane: NDArray[np.int32]) -> NDArray[np.uint32]:
    """Return 0, -1, 1, -2, 2 … as 0, 1, 2, 3, 4 …."""
    return ((plane << 1) ^ (plane >> 31)).view(np.uint32)


def stored(plane: NDArray[np.int32], size: int) -> bytes:
    """Return a plane as its bytes of each order, the lowest first."""
    octets = zigzag(plane).astype("<u4").view(np.uint8).reshape(-1, 4)
    return np.ascontiguousarray(octets[:, :size].T).tobytes()
