"""Exposures of views against each other, by the points of the surface that several of them see.

They are found before anything is optimised: a fit paints the difference into colours that depend on direction, and
little of it is left to be found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.findings import Finding
from beam_warp.capture.views import CapturedView
from beam_warp.image.color import LUMINANCE
from beam_warp.reconstruction.initial import view_samples
from beam_warp.reconstruction.targets import crop_views
from beam_warp.world.gaussians import GaussianCloud

EXPOSURE_STOPS = 0.3
"""Exposures further than this from the middle one are reported and undone [stop].

Of sound captures (walker, runner, demo figure) no view is off by more than 0.11 with 8 cameras or more, 0.19 with 4 or
6. One view that is wrong by half a stop is found at 0.40 to 0.55 with 8 or more, whichever it is, one by a stop at 0.72
or more with 4; the others then at 0.28 at most with 4 and 0.10 with 8 (`docs/reconstruction.md`)."""

CLEAR_OF_RESIDUALS = 2.0
"""Least ratio of a reported exposure to the median of the differences that its view's points are left with.

Where views share few points, at grazing angles or after much motion, these differences are as large as the exposures
(four cameras, five frames on: 0.69 of 0.47)."""

LARGEST_SIDE = 320
"""Pixels of a side at which views are compared, about: each sample is the mean of some."""

MOST_POINTS = 4_096
"""Most Gaussians that are compared, evenly chosen: an exposure is the middle of hundreds of samples then."""

DARKEST = 1e-3
"""Luminance below which a sample is left out: its logarithm is that of noise."""

ROUNDS = 60
"""Rounds of reweighting, at most."""

SETTLED = 1e-4
"""Change of exposures at which rounds end [stop]."""

LEAST_RESIDUAL = 0.02
"""Differences below it count by their squares: about a tenth of those of samples of one point [stop]."""


@dataclass(frozen=True, eq=False)
class ViewGains:
    """Brightness of views against each other.

    Attributes:
        stops: Exposure of each view over that of the middle one, as a power of two, ``(V,)``; NaN of a view that
            shares no point with others.
        residuals: Median of what is left of each view's differences [stop], ``(V,)``; NaN likewise.
        views_of_points: How many views see each Gaussian, ``(N,)`` int.
    """

    stops: NDArray[np.float64]
    residuals: NDArray[np.float64]
    views_of_points: NDArray[np.int64]

    @property
    def off(self) -> NDArray[np.bool_]:
        """Whether each view's exposure is wrong, ``(V,)``."""
        return np.abs(self.stops) > np.maximum(EXPOSURE_STOPS, CLEAR_OF_RESIDUALS * self.residuals)


def view_gains(
    cloud: GaussianCloud, normals: NDArray[np.floating], views: Sequence[CapturedView], *, device: str | None = None
) -> ViewGains:
    """Compare views by what they show of the same Gaussians.

    Sample L[v, i], the logarithm of the luminance that view v shows of Gaussian i, is s[v] + a[i] and what depends on
    the direction: s and a are those of least absolute error, weighted by how squarely the view faces the Gaussian. So
    light from one side makes no difference, which it does to the mean brightness of views; and a few wrong views do
    not move the others.

    Args:
        cloud: Gaussians near the surface.
        normals: Side from which each Gaussian is seen, ``(N, 3)``; all sides where it is 0.
        views: Photographs of one moment.
        device: Warp device; None takes the first CUDA device, or the CPU.

    Source: iteratively reweighted least squares, Holland and Welsch 1977.
    """
    factors = [max(1, min(view.camera.width, view.camera.height) // LARGEST_SIDE) for view in views]
    reduced = crop_views(views, factors)
    samples = view_samples(reduced, cloud, normals, device=device).numpy()
    seen = (samples[..., 3] > 0.0).sum(axis=0)
    picked = samples[:, np.linspace(0, len(cloud) - 1, min(len(cloud), MOST_POINTS)).astype(int)].astype(np.float64)
    luminance, weights = picked[..., :3] @ LUMINANCE, picked[..., 3]
    stops, residuals = agree_exposures(
        np.log2(np.maximum(luminance, DARKEST)), np.where(luminance > DARKEST, weights, 0.0)
    )
    return ViewGains(stops, residuals, seen)


def judge_gains(gains: ViewGains, views: Sequence[CapturedView]) -> list[Finding]:
    """Return the findings about views whose exposure is off, one for each."""
    return [
        Finding(
            "warning",
            "camera-exposure",
            f"a view is {abs(stops):.1f} stops {'brighter' if stops > 0.0 else 'darker'} than the others show the same "
            "points, and was matched to them",
            view.name,
            "Match exposures before.",
        )
        for view, stops, is_off in zip(views, gains.stops, gains.off, strict=True)
        if is_off
    ]


def matched(views: Sequence[CapturedView], gains: ViewGains) -> list[CapturedView]:
    """Return the views with the brightness of those that `judge_gains` names undone; the others as they are."""
    return [
        view.brightened(2.0**-stops) if is_off else view
        for view, stops, is_off in zip(views, gains.stops, gains.off, strict=True)
    ]


def agree_exposures(
    levels: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the exposure of each row over the middle one, and the median of what is left of its differences.

    Both are NaN for rows that share no column with another.

    Args:
        levels: Row by column, a sum of one number for the row and one for the column, mostly, ``(V, N)``.
        weights: Weight of each level, 0 where there is none, ``(V, N)``.
    """
    shared = (weights > 0.0).sum(axis=0) >= 2
    levels, weights = levels[:, shared], weights[:, shared]
    known = weights.sum(axis=1) > 0.0
    stops, left, factors = np.zeros(len(levels)), np.zeros_like(levels), weights
    for _ in range(ROUNDS):
        before = stops
        stops = _least_squares(levels, factors, known)
        columns = (factors * (levels - stops[:, None])).sum(axis=0) / np.maximum(factors.sum(axis=0), 1e-300)
        left = np.abs(levels - stops[:, None] - columns)
        factors = weights / np.maximum(left, LEAST_RESIDUAL)
        if np.abs(stops - before).max(initial=0.0) < SETTLED:
            break
    if known.any():
        stops = stops - np.median(stops[known])
    residuals = np.full(len(levels), np.nan)
    for row in np.flatnonzero(known):
        residuals[row] = np.median(left[row, weights[row] > 0.0])
    return np.where(known, stops, np.nan), residuals


def _least_squares(
    levels: NDArray[np.float64], factors: NDArray[np.float64], known: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the rows' numbers of least weighted square error, columns' eliminated, of mean 0."""
    totals = np.maximum(factors.sum(axis=0), 1e-300)
    matrix = np.diag(factors.sum(axis=1)) - (factors / totals) @ factors.T
    right = (factors * levels).sum(axis=1) - (factors / totals) @ (factors * levels).sum(axis=0)
    # Only differences are determined, of views that are linked by common points: the least of all solutions.
    found = np.zeros(len(levels))
    found[known] = np.linalg.lstsq(matrix[np.ix_(known, known)], right[known], rcond=1e-12)[0]
    return found
