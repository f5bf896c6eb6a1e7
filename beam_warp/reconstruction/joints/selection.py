"""Selection of the Gaussians that become joints: some that cover the surface evenly."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from beam_warp.checks import require_array, require_count, require_finite, require_range
from beam_warp.errors import InvalidArrayError

OVERSAMPLING = 5
"""Least number of candidates for a joint: with 5, the farthest of them is near the farthest point of all."""

NEIGHBORS = 8
"""Neighbours that a Gaussian of a surface must have."""

FAINTEST = 0.1
"""Opacity below which a Gaussian is no joint, as DualGS prunes them (Jiang et al. 2024, released code)."""


def select_joints(positions: ArrayLike, count: int, *, opacities: ArrayLike | None = None) -> NDArray[np.int64]:
    """Return rows of Gaussians that cover the surface evenly, however densely it is covered by all of them.

    One candidate stands for each of some 5 ``count`` cells of a grid; of these, each joint is the farthest from those
    before it. So all joints are about one spacing from their nearest, and the first few of them are spread out, too.
    A Gaussian is isolated if its eighth neighbour is farther than two joint spacings (or than four times what is usual,
    where joints are as dense as Gaussians); neither those nor faint ones become joints.

    Args:
        positions: ``(N, 3)``.
        count: Joints wanted, at most N.
        opacities: In [0, 1], ``(N,)``; Gaussians below 0.1 are left out.

    Returns:
        Distinct rows, ``(M,)`` int64; no two at one place. M is ``count``, or less where less qualify. Same input,
        same rows.

    Raises:
        InvalidArrayError: An array has another shape, is not finite, or nothing qualifies.
        InvalidOptionError: ``count`` is out of range.

    Source: Gonzalez 1985 (farthest-point sampling).
    """
    points = require_array("positions", positions, (None, 3), np.float64)
    require_finite("positions", points)
    require_count("count", count, 1, max(len(points), 1))
    rows = np.arange(len(points))
    if opacities is not None:
        opacity = require_array("opacities", opacities, (len(points),))
        require_range("opacities", opacity, 0.0, 1.0)
        rows = np.flatnonzero(opacity >= FAINTEST)
    if not len(rows):
        raise InvalidArrayError(
            f"positions must hold Gaussians of an opacity of at least {FAINTEST}, got none of {len(points)}. "
            "Pass what is visible."
        )
    points = points[rows]
    candidates = _candidates(points, OVERSAMPLING * count)
    candidates = candidates[_on_surface(points, candidates, count)]
    return rows[candidates[_farthest(points[candidates], count)]]


def _candidates(points: NDArray[np.float64], least: int) -> NDArray[np.int64]:
    """Return rows, one for each occupied cell of a grid of at least ``least`` (and hardly more than 1.5 times that)."""
    if len(points) <= 1.5 * least:
        return np.arange(len(points))
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    if not extent > 0.0:
        return np.zeros(1, np.int64)
    # Occupied cells grow as the square of their number along an edge, for points on a surface, up to one a point.
    edge_cells = math.sqrt(least / 3.0)
    small, large = 0.0, math.inf
    for _ in range(16):
        cells = _cells(points, low, extent, edge_cells)
        occupied = len(np.unique(cells))
        if least <= occupied <= 1.5 * least:
            break
        if occupied < least:
            small = edge_cells
        else:
            large = edge_cells
        edge_cells *= math.sqrt(1.2 * least / occupied)
        if not small < edge_cells < large:
            edge_cells = 0.5 * (small + large) if math.isfinite(large) else 2.0 * small
        if edge_cells > 2.0**20:
            break  # points that coincide
    # of each cell the point nearest to the middle; ties by the row
    cells = _cells(points, low, extent, edge_cells)
    scaled = (points - low) * (edge_cells / extent)
    off_middle = ((scaled - np.floor(scaled) - 0.5) ** 2).sum(axis=1)
    order = np.lexsort((off_middle, cells))
    first = np.concatenate([[True], cells[order][1:] != cells[order][:-1]])
    return np.sort(order[first])


def _cells(
    points: NDArray[np.float64], low: NDArray[np.float64], extent: float, edge_cells: float
) -> NDArray[np.int64]:
    """Return the cell of each point as one number."""
    x, y, z = np.floor((points - low) * (edge_cells / extent)).astype(np.int64).T
    return (x << 42) | (y << 21) | z


def _on_surface(points: NDArray[np.float64], candidates: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    """Return which candidates have neighbours enough; all if there are hardly any points."""
    neighbors = min(NEIGHBORS, len(points) - 1)
    if neighbors < 2:
        return np.ones(len(candidates), bool)
    # of evenly spread candidates, so that a dense face does not decide what is usual on a coat
    distance = cKDTree(points).query(points[candidates], k=[neighbors + 1], workers=-1)[0][:, 0]
    usual = float(np.median(distance))
    # Eight points in a disc of that radius, len(points) on the surface: its area for each joint, and the side of that.
    spacing = usual * math.sqrt(math.pi * len(points) / (neighbors * count))
    return distance <= max(4.0 * usual, 2.0 * spacing)


def _farthest(points: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return at most ``count`` rows, each the farthest from those before it; the first the farthest from the mean."""
    centered = points - points.mean(axis=0)
    extent = float(np.abs(centered).max())
    # float32 halves the time, and only has to tell the farther of two points
    x, y, z = np.ascontiguousarray((centered / (extent if extent > 0.0 else 1.0)).T.astype(np.float32))
    distance = x * x + y * y + z * z
    row = int(distance.argmax())
    distance[:] = np.inf
    chosen = np.empty(min(count, len(points)), np.int64)
    for i in range(len(chosen)):
        chosen[i] = row
        offset = x - x[row]
        squared = offset * offset
        np.subtract(y, y[row], out=offset)
        squared += np.multiply(offset, offset, out=offset)
        np.subtract(z, z[row], out=offset)
        squared += np.multiply(offset, offset, out=offset)
        np.minimum(distance, squared, out=distance)
        row = int(distance.argmax())
        if not distance[row] > 0.0:
            return chosen[: i + 1]
    return chosen
