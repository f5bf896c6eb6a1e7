"""Test whether base colour changes over time: one colour for all frames unless the data says otherwise.

Frame f of a Gaussian has the colour rho_f with the standard error s_f. If it is the same in every frame,
Q = sum over f of (rho_f - mean)^2 / s_f^2 follows a chi-squared distribution of one degree less than frames. Errors of
normals and of occlusion make Q larger than that: the bulk of the Gaussians tells by how much, and only what stands
out from it counts. Where colour does change, each frame's is drawn towards the mean as far as its error asks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special  # scipy.stats takes most of a second to import

from beam_warp.materials.base_color import BaseColor, least_squares, misfit_error
from beam_warp.materials.direct import ColorEvidence

FALSE_DISCOVERIES = 1e-3
"""Part of the Gaussians said to change that may not."""

LEAST_ERROR = 1e-3
"""Standard errors below it are those of rounding and of the model, not of the data."""

LEAST_CHANGE = 0.04
"""Standard deviation over time below which a change, however certain, is not worth a colour for every frame."""

REFERENCE_QUANTILE = 0.9
"""Errors are taken to be as much larger than stated as this quantile over Gaussians is: model errors are heavy-tailed,
and the middle does not show it. It holds as long as fewer than a tenth of the Gaussians change."""


@dataclass(frozen=True, eq=False)
class ColorChange:
    """Gaussians that change colour, and the mean that their frames are drawn towards.

    Attributes:
        changing: ``(N,)`` bool.
        mean: Weighted mean over frames, ``(N, 3)``.
        variance: Of the true colour over frames, ``(N, 3)``: the scatter less what errors explain.
        dispersion: By how much variances are larger than stated, on the bulk of the Gaussians; at least 1.
    """

    changing: NDArray[np.bool_]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    dispersion: float

    def frame_color(self, evidence: ColorEvidence) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the colour of one frame of every Gaussian and its standard error, ``(N, 3)`` each.

        Where nothing was seen in the frame, it is the mean.
        """
        color, variance, known = _frame(evidence)
        variance = variance * self.dispersion
        gain = np.where(known, self.variance / np.maximum(self.variance + variance, 1e-30), 0.0)
        return self.mean + gain * (color - self.mean), np.sqrt((1.0 - gain) * self.variance)


class ChangeTest:
    """Adds up frames of the same Gaussians, one after the other; memory does not grow with their number."""

    def __init__(self) -> None:
        """Start without frames."""
        self._sums = np.zeros((4, 1, 1))

    def add(self, evidence: ColorEvidence) -> None:
        """Count the evidence of one frame."""
        self.add_terms(self.terms(evidence))

    @staticmethod
    def terms(evidence: ColorEvidence) -> NDArray[np.float64]:
        """Return what `add_terms` adds for the evidence of one frame, ``(4, N, 3)``; threads may work it out."""
        color, variance, known = _frame(evidence)
        weight = np.where(known, 1.0 / variance, 0.0)
        return np.stack([known.astype(np.float64), weight, weight * color, weight * color**2])

    def add_terms(self, terms: NDArray[np.float64]) -> None:
        """Count one frame, given its terms."""
        self._sums = self._sums + terms

    def result(self) -> ColorChange:
        """Test every Gaussian; false discoveries are bounded over all of them (Benjamini and Hochberg 1995)."""
        frames, weights, sums, squares = self._sums
        mean = np.divide(sums, weights, out=np.zeros_like(weights), where=weights > 0.0)
        q = np.maximum(squares - mean * sums, 0.0)
        degrees = np.maximum(frames - 1.0, 0.0)
        total, freedom = q.sum(axis=1), degrees.sum(axis=1)
        tested = freedom > 0.0
        dispersion = 1.0
        if tested.any():
            excess = total[tested] / (2.0 * special.gammaincinv(freedom[tested] / 2.0, REFERENCE_QUANTILE))
            dispersion = max(float(np.quantile(excess, REFERENCE_QUANTILE)), 1.0)
        variance = np.zeros_like(mean)
        np.divide(
            np.maximum(q - degrees * dispersion, 0.0),
            weights * np.maximum(degrees, 1.0) / np.maximum(frames, 1.0),
            out=variance,
            where=(weights > 0.0) & (degrees > 0.0),
        )
        large = np.sqrt(variance.mean(axis=1)) >= LEAST_CHANGE
        changing = large & tested
        if tested.any():
            changing[tested] &= _discovered(special.chdtrc(freedom[tested], total[tested] / dispersion))
        return ColorChange(changing, mean, np.where(changing[:, None], variance, 0.0), dispersion)


def _discovered(chance: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which probabilities are discoveries, of which `FALSE_DISCOVERIES` at most are false (Benjamini and
    Hochberg)."""
    order = np.sort(chance)
    below = order <= FALSE_DISCOVERIES * np.arange(1, len(order) + 1) / len(order)
    return chance <= order[below].max(initial=-1.0)


def with_changes(constant: BaseColor, change: ColorChange, evidence: ColorEvidence) -> BaseColor:
    """Return the base colour of one frame: the constant one, but for Gaussians that change.

    Args:
        constant: Solved over all frames.
        change: What the frames' evidence says of changes.
        evidence: Of the frame.
    """
    if not change.changing.any():
        return constant
    rows = change.changing[:, None]
    color, error = change.frame_color(evidence)
    error = np.hypot(error, misfit_error(evidence))
    return replace(
        constant,
        base_color=np.where(rows, np.clip(color, 0.0, 1.0), constant.base_color).astype(np.float32),
        standard_error=np.where(rows, error, constant.standard_error).astype(np.float32),
    )


def _frame(evidence: ColorEvidence) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return a frame's colour, its variance, and where there is any."""
    raw, error = least_squares(evidence)
    known = (np.asarray(evidence.denominator) > 0.0).all(axis=1) & (np.asarray(evidence.unseen) == 0.0)
    return np.clip(raw, 0.0, 1.0), np.maximum(error, LEAST_ERROR) ** 2, np.broadcast_to(known[:, None], raw.shape)
