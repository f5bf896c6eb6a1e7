"""Dropping and splitting of Gaussians: second halves take the rows of those that were dropped."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.reconstruction.parameters import DEAD_LOGIT

SPLIT_OFFSET = 0.6
"""Distance of either half of a split Gaussian from its centre, in its longest deviations."""

SPLIT_SHRINK = 0.65
"""Longest deviation of a half, as a part of the longest of the split Gaussian: variance offset^2 + shrink^2 is 0.8 of
what it was, for halves are composited over one another and so look wider than their sum."""


def prune(rows: dict[str, NDArray[Any]], unused: NDArray[np.bool_]) -> None:
    """Remove the Gaussians of some rows, in place: the rows wait for another."""
    rows["logits"][unused] = DEAD_LOGIT
    rows["orientations"][unused] = 0.0
    rows["radiance"][unused] = 0.0


def split(rows: dict[str, NDArray[Any]], sources: NDArray[np.int64], targets: NDArray[np.int64]) -> None:
    """Replace Gaussians by two halves along their longest axis: one in their own row, one in another; in place.

    Args:
        rows: As `beam_warp.reconstruction.parameters.GaussianParameters.rows` returns them.
        sources: Rows of Gaussians, each once, ``(K,)``.
        targets: Rows for their second halves, ``(K,)``.
    """
    for array in rows.values():
        array[targets] = array[sources]
    scales = rows["log_scales"][sources]
    axis = scales.argmax(axis=1)
    picked = np.arange(len(sources))
    offset = np.zeros_like(rows["positions"][sources])
    offset[picked, axis] = SPLIT_OFFSET * np.exp(scales[picked, axis])
    moved = _rotate(rows["orientations"][sources], offset)
    for places, sign in ((sources, 1.0), (targets, -1.0)):
        rows["positions"][places] += np.float32(sign) * moved
        rows["log_scales"][places, axis] += np.float32(np.log(SPLIT_SHRINK))


def hidden(shares: NDArray[np.floating], part: float) -> NDArray[np.bool_]:
    """Return the rows that show least, as many as together show at most a part of what all show, ``(N,)``."""
    order = np.argsort(shares, kind="stable")
    total = np.cumsum(shares[order])
    result = np.zeros(len(shares), bool)
    result[order[total <= part * total[-1]]] = True
    return result


def largest_gradients(gradients: NDArray[np.floating], eligible: NDArray[np.bool_], count: int) -> NDArray[np.int64]:
    """Return the rows of largest gradients among those that may be split, at most ``count``; ties by row.

    Args:
        gradients: Mean length of the gradients of each row's position, ``(N,)``; rows of 0 and NaN are not chosen.
        eligible: Which rows may be split, ``(N,)``.
        count: Most rows.
    """
    candidates = np.flatnonzero(eligible & (gradients > 0.0))
    order = np.argsort(-gradients[candidates], kind="stable")
    return candidates[order[:count]]


def refine(
    rows: dict[str, NDArray[Any]],
    alive: NDArray[np.bool_],
    unwanted: NDArray[np.bool_],
    gradients: NDArray[np.floating],
    split_fraction: float,
) -> NDArray[np.bool_]:
    """Drop Gaussians and split others into free rows, in place; return which rows changed, ``(N,)``.

    Args:
        rows: As `beam_warp.reconstruction.parameters.GaussianParameters.rows` returns them.
        alive: Which rows hold a Gaussian, ``(N,)``.
        unwanted: Which of those are dropped, ``(N,)``; none where it would be all of them.
        gradients: As for `largest_gradients`.
        split_fraction: Most of the remaining Gaussians that are split.
    """
    if unwanted.sum() == alive.sum():  # nothing to go on from
        unwanted = np.zeros_like(unwanted)
    prune(rows, unwanted)
    alive = alive & ~unwanted
    free = np.flatnonzero(~alive)
    most = min(len(free), int(np.ceil(split_fraction * alive.sum())))
    sources = largest_gradients(gradients, alive, most)
    targets = free[: len(sources)]
    split(rows, sources, targets)
    changed = unwanted.copy()
    changed[sources] = changed[targets] = True
    return changed


def with_more_rows(
    rows: dict[str, NDArray[Any]], gradients: NDArray[np.floating], count: int
) -> dict[str, NDArray[Any]]:
    """Return rows of Gaussians with those of largest gradients split, ``count`` in all, at most twice as many."""
    present = len(gradients)
    sources = largest_gradients(gradients + 1e-30, np.ones(present, bool), max(count - present, 0))
    grown = {name: np.concatenate([array, array[sources]]) for name, array in rows.items()}
    split(grown, sources, present + np.arange(len(sources)))
    return grown


def _rotate(quaternions: NDArray[np.floating], vectors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Rotate vectors by quaternions xyzw of any length."""
    unit = quaternions.astype(np.float64)
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-12)
    axis, w = unit[:, :3], unit[:, 3:]
    twice = 2.0 * np.cross(axis, vectors)
    return (vectors + w * twice + np.cross(axis, twice)).astype(np.float32)
