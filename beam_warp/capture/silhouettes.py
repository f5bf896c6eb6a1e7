"""Which silhouettes do not fit the others: what a fit cannot tell once they have carved its start away.

Points of a grid are counted by the silhouettes that hold them. Those of most are a volume that each silhouette should
show again. A view that does not is set aside, and the volume is taken anew from the others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.rigs import frustum_volume
from beam_warp.capture.views import CapturedView

SIDE = 40
"""Points along a side of the grid, over the common volume and then over the subject."""

SHARES = (0.7, 0.8, 0.9)
"""Part of the views that see a point which have to hold it in their silhouettes, over the largest of any point: that
makes the volume of most, round by round."""

LEAST_FIT = 0.7
"""A silhouette contradicts the others if it fits by less than this part of how the middle one does."""


def contradicting(views: Sequence[CapturedView]) -> NDArray[np.bool_]:
    """Return which views' silhouettes contradict those of most others, ``(V,)``.

    None do if there is no volume that most hold: then nothing tells who is right.

    Args:
        views: At least three, with coverage.
    """
    low, high = frustum_volume([view.camera for view in views])
    is_kept = np.ones(len(views), bool)
    for share in SHARES:
        points = _grid(low, high)
        seen, held = np.stack([_seen_held(view, points) for view in views], axis=1)[:, is_kept].sum(axis=1)
        part = np.where(seen > 0.5 * is_kept.sum(), held / np.maximum(seen, 1), 0.0)
        if not part.max() > 0.0:
            return np.zeros(len(views), bool)
        volume = points[part >= share * part.max()]
        size = float((high - low).max()) / SIDE
        fits = np.array([_fit(view, volume, size) for view in views])
        is_kept = fits >= LEAST_FIT * np.median(fits[is_kept])
        low, high = volume.min(axis=0) - 2.0 * size, volume.max(axis=0) + 2.0 * size
    return ~is_kept


def _grid(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points on a cubic grid over a box, ``(N, 3)``."""
    size = float((high - low).max()) / SIDE
    axes = [np.arange(start + 0.5 * size, end, size) for start, end in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _seen_held(view: CapturedView, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points a view sees, and which of them its silhouette holds, ``(2, N)``."""
    assert view.alpha is not None
    seen, columns, rows = _pixels(view, points)
    held = np.zeros(len(points), bool)
    held[seen] = view.alpha[rows, columns] > 0.5
    return np.stack([seen, held])


def _pixels(
    view: CapturedView, points: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Return which points a view sees, and the columns and rows of those."""
    x, y, z = view.camera.project(points).T
    seen = (z > 0.0) & (x >= 0.0) & (y >= 0.0) & (x < view.camera.width) & (y < view.camera.height)
    return seen, x[seen].astype(np.int64), y[seen].astype(np.int64)


def _fit(view: CapturedView, volume: NDArray[np.float64], size: float) -> float:
    """Return the intersection over the union of a silhouette and that of a volume, in pixels as large as its cells."""
    assert view.alpha is not None
    distance = float(np.median((volume - view.camera.position) @ view.camera.forward))
    pixel = max(1, round(1.5 * size * view.camera.focal_x / max(distance, size)))
    _, *shown = _pixels(view, volume)
    held = np.nonzero(view.alpha > 0.5)[::-1]
    cells = [{*zip(*((part // pixel).tolist() for part in places), strict=True)} for places in (shown, held)]
    return len(cells[0] & cells[1]) / max(len(cells[0] | cells[1]), 1)
