"""How many rays each point needs: told by the first rays of its neighbours, so that means stay unbiased.

Stopping where a point's own few rays agree favours points whose rays all missed what is in the way: too much light
would be stated (docs/sampling.md). Here a point's number of rays depends on other points' rays only, which are drawn
independently. Given the number, its estimate is therefore that of a fixed number of rays: nothing is chosen by what it
shows. The first rays are the beginning of the longer set, and are not traced again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

REACH = 8
"""Neighbours along the Morton curve, on either side, whose errors tell that of a point between them. With 4 or 16 the
same error takes as many rays within 4 % (walker and robot, 40,000 Gaussians)."""

RATE = 0.75
"""The error of n scrambled points falls as n to the power -3/4 where visibility has an edge: of n strata, the square
root of n meet the edge, and each of these has a variance of 1/n^2 (He and Wang 2015)."""

SHARE = 2.0 / (1.0 + 2.0 * RATE)
"""Numbers of rays in proportion to the error to this power leave the least squares of all that cost as much: an error s
at one ray leaves s^2 n^(-2 RATE), and one more ray must lower each point's square as much as any other's (Neyman 1934,
for RATE = 1/2)."""


def rays_needed(
    error: NDArray[np.floating[Any]], first: int, most: int, *, count: int, target: float
) -> NDArray[np.int32]:
    """Return how many rays points need: those with larger errors more, so that the squares of all fall fastest.

    Args:
        error: Standard error of each point's first rays, along a curve on which neighbours are near each other,
            ``(N,)``.
        first: How many rays these were.
        most: Rays of a point, at most.
        count: Rays of a point whose error with so many is the target.
        target: That error.

    Returns:
        ``first`` times the power of two that is nearest, at most ``most``, ``(N,)``. A point alone gets ``most``.
    """
    squares = error.astype(np.float64) ** 2
    sums = np.concatenate([[0.0], np.cumsum(squares)])
    place = np.arange(len(error))
    low, high = np.maximum(place - REACH, 0), np.minimum(place + REACH + 1, len(error))
    others = (sums[high] - sums[low] - squares) / np.maximum(high - low - 1, 1)
    expected = np.where(high - low > 1, np.sqrt(np.maximum(others, 0.0)), np.inf) * (first / count) ** RATE
    doublings = np.rint(np.log2(np.maximum(count / first * (expected / target) ** SHARE, 1.0)))
    return (first * 2 ** np.minimum(doublings, np.floor(np.log2(most / first)))).astype(np.int32)


def economy(
    error: NDArray[np.floating[Any]], rays: NDArray[np.integer[Any]], most: int, *, share: Any = 1.0
) -> dict[str, Any]:
    """Return what giving each point the rays it needs has left out, as sums that add up over frames.

    Args:
        error: Stated standard error of each point, ``(N,)``.
        rays: Rays of each, ``(N,)``.
        most: Rays that each could have had.
        share: Which part of all light these rays gather, ``(N,)``.
    """
    squares = error.astype(np.float64) ** 2
    return {
        "points": len(error),
        "rays": int(rays.sum()),
        "left_out": int((most - rays).sum()),
        "squares": float(squares.sum()),
        "squares_of_most": float((squares * (rays / most) ** (2.0 * RATE)).sum()),
        "shares": float(np.square(np.broadcast_to(share, squares.shape), dtype=np.float64).sum()),
    }


def summary(found: list[Mapping[str, Mapping[str, Any]]]) -> dict[str, float]:
    """Return what `economy` said of frames, by light and bounce, as a report says it; empty if no rays were traced.

    ``share`` is the root mean square of what leaving these rays out altogether would change of the light.
    """
    said: dict[str, float] = {}
    for name in ("light", "bounce"):
        keys = ("points", "rays", "left_out", "squares", "squares_of_most", "shares")
        points, rays, left_out, *squares = (sum(one.get(name, {}).get(key, 0) for one in found) for key in keys)
        if rays:
            error, fewest, share = (float(np.sqrt(each / points)) for each in squares)
            said[f"{name}_rays_per_gaussian"] = rays / points
            said[f"{name}_rays_left_out"] = left_out
            said[f"{name}_error"] = error
            said[f"{name}_error_with_all_rays"] = fewest
            said |= {"bounce_share": share} if name == "bounce" else {}
    return said
