"""Base colour from evidence: the least-squares solution, its standard error, flags and values of what is not measured.

Nothing is divided by a small number: what was hardly lit or never seen is flagged and filled from neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from beam_warp.materials.direct import ColorEvidence
from beam_warp.world.gaussians import GaussianCloud, Observability

UNLIT_PART = 0.01
"""A Gaussian is unlit below this part of the environment's mean unshadowed irradiance."""

SATURATED_PART = 0.5
"""Part of what was seen that was cut at a ceiling from which on a Gaussian counts as saturated."""

FACING_PART = 0.02
"""Part of what was seen that must not have been seen grazing."""

UNCERTAIN_NORMAL = 0.2
"""Confidence below which a normal counts as uncertain: fog has a median of 0.1, closed surfaces are above 0.5."""

FILL_NEIGHBORS = 8

PAIRED = 512
PAIR_GROUPS = 64
"""Gaussians whose pairs say how values differ with distance, and groups of as many pairs each by distance."""

POOLED_VIEWS = 1.0
"""Views of a typical Gaussian that count beside a Gaussian's own when it is asked how far views disagree: one view
alone cannot tell, and two agree by chance."""

SPECULAR_PART = 0.05
"""What an open dielectric reflects specularly over what a white diffuser would send: an error of the light is one of
the highlight that is subtracted too, so that black is not known better than this part of it."""

UNKNOWN = (0.5, 12.0**-0.5)
"""Base colour of which nothing is known, and its standard error: any in [0, 1] is as likely."""

MISSING = Observability.UNLIT | Observability.UNSEEN
"""Flags of Gaussians whose base colour cannot be measured."""


@dataclass(frozen=True, eq=False)
class BaseColor:
    """Solved base colour.

    Attributes:
        base_color: In [0, 1], scene-linear Rec.709, ``(N, 3)`` float32.
        standard_error: ``(N, 3)`` float32.
        observability: `Observability` flags, ``(N,)`` uint8.
        clipped_part: Part of the observed opacity with a channel cut at 1 by more than its standard error: a sign of
            light stated too dim.
    """

    base_color: NDArray[np.float32]
    standard_error: NDArray[np.float32]
    observability: NDArray[np.uint8]
    clipped_part: float

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return base colour, its standard error and observability by the names that a cloud has for them."""
        return {
            "base_color": self.base_color,
            "base_color_error": self.standard_error,
            "observability": self.observability,
        }


def solve_base_color(
    cloud: GaussianCloud, evidence: ColorEvidence, mean_irradiance: float, *, dispersion: float = 1.0
) -> BaseColor:
    """Solve the least-squares problem that the frames add up to.

    rho = sum w L_D (L_o - L_S) / sum w L_D^2, cut to [0, 1]. The standard error joins three independent parts: how
    badly one rho explains all views and frames; the error of the light, its noise and that of the normal it falls on,
    averaged over frames; and how far the Gaussians are from the images, which more views do not mend: what they cannot
    show of radiance they cannot show of base colour. Where nothing at all was measured, all are `UNKNOWN`.

    Args:
        cloud: The Gaussians, of any one of the frames, with the confidence of their normals.
        evidence: Of one frame, or the sum over frames of the same Gaussians.
        mean_irradiance: The environment's mean unshadowed irradiance [W/m^2].
        dispersion: By how much variances are larger than evidence states, as frames have shown; see
            `beam_warp.materials.changes`.

    Source: weighted linear least squares; BEAM Eq. 4 solved for the base colour.
    """
    flags = observability(cloud, evidence, mean_irradiance)
    missing = ((flags & np.uint8(MISSING)) != 0) | ~_has_evidence(evidence)
    raw, error = least_squares(evidence)
    base_color = np.clip(raw, 0.0, 1.0)
    error = np.hypot(error * np.sqrt(dispersion), misfit_error(evidence))
    weight = np.where(missing, 0.0, cloud.opacities)
    clipped = float((weight * (raw - error > 1.0).any(axis=1)).sum() / max(weight.sum(), 1e-12))
    base_color, error = fill_from_neighbors(cloud.positions, base_color, error, missing)
    if missing.all():
        base_color, error = (np.full_like(base_color, value) for value in UNKNOWN)
    flags[missing] |= np.uint8(Observability.FILLED)
    return BaseColor(base_color.astype(np.float32), error.astype(np.float32), flags, clipped)


def least_squares(
    evidence: ColorEvidence, *, bounds: tuple[float, float] = (0.0, 1.0)
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the unbounded solution and its standard error, ``(N, 3)`` each; 0 where there is no evidence.

    The error is that of the solution cut to ``bounds``: what is cut by them is a disagreement of all views with it.

    With v views of variance t^2 each, the variance of their mean is t^2 / v. What one Gaussian's views say of t^2 is
    joined with what is typical (the median over Gaussians), which counts for `POOLED_VIEWS` more views: an empirical
    Bayes estimate, as Smyth 2004 moderates variances of few samples.
    """
    numerator, denominator, observed = (
        np.asarray(array, dtype=np.float64) for array in (evidence.numerator, evidence.denominator, evidence.observed)
    )
    known = denominator > 0.0
    safe = np.where(known, denominator, 1.0)
    raw = np.where(known, numerator / safe, 0.0)
    bounded = np.clip(raw, *bounds)
    residual = np.maximum(observed - 2.0 * bounded * numerator + bounded**2 * denominator, 0.0)
    views = np.asarray(evidence.views, np.float64)[:, None]
    degrees = np.maximum(views - 1.0, 0.0)
    scatter = residual / safe * views  # squared residuals of views, in base colour
    told = known.all(axis=1) & (degrees[:, 0] >= 1.0)
    # the median of a chi-squared variable over its mean, Wilson and Hilferty 1931
    middle = degrees[told] * (1.0 - 2.0 / (9.0 * degrees[told])) ** 3
    typical = np.median(scatter[told] / middle, axis=0) if told.any() else np.zeros(3)
    variance = (scatter + POOLED_VIEWS * typical) / (degrees + POOLED_VIEWS) / np.maximum(views, 1.0)
    noise = np.asarray(evidence.noise, np.float64) / measured_frames(evidence) ** 2
    # rho = L_o / (E d) - s / d for light E times shares d and s: an error of E moves it by (rho + s / d) / E
    light = (bounded + SPECULAR_PART) ** 2 * noise[:, None]
    return raw, np.where(known, np.sqrt(variance + light), 0.0)


def misfit_error(evidence: ColorEvidence) -> NDArray[np.float64]:
    """Return by how much base colour is off where images and Gaussians differ, root mean square, ``(N, 3)``.

    At most as much as any base colour can be.
    """
    squares = np.asarray(evidence.misfit, np.float64) / measured_frames(evidence)[:, None]
    return np.minimum(np.sqrt(squares), 1.0)


def measured_frames(evidence: ColorEvidence) -> NDArray[np.float64]:
    """Return in how many frames each Gaussian was measured, at least 1, ``(N,)``: the others add nothing to sums."""
    return np.maximum(evidence.frames - np.asarray(evidence.unseen, np.float64), 1.0)


def observability(cloud: GaussianCloud, evidence: ColorEvidence, mean_irradiance: float) -> NDArray[np.uint8]:
    """Return why Gaussians are less than measured: `Observability` flags, ``(N,)``.

    Unlit is what was measured and found dark; of what no view shows, or shows in no pixel that counts, that is not
    known.
    """
    assert cloud.normal_confidence is not None
    measured = measured_frames(evidence)
    irradiance = np.asarray(evidence.irradiance).mean(axis=1) / measured
    hidden = ~(np.asarray(evidence.unseen) < evidence.frames)
    saturated = np.asarray(evidence.saturated) / evidence.frames > SATURATED_PART
    unlit = ~hidden & ~(irradiance > UNLIT_PART * mean_irradiance)
    # What was cut, or seen at grazing angles alone, is without evidence for that reason.
    grazing = ~hidden & ~saturated & ~(np.asarray(evidence.facing) / measured > FACING_PART)
    unseen = hidden | (~unlit & ~saturated & ~grazing & ~_has_evidence(evidence))
    flags = np.zeros(len(irradiance), np.uint8)
    for mask, flag in (
        (unlit, Observability.UNLIT),
        (unseen, Observability.UNSEEN),
        (saturated, Observability.SATURATED),
        (~(cloud.normal_confidence > UNCERTAIN_NORMAL), Observability.UNCERTAIN_NORMAL),
        (grazing, Observability.GRAZING),
    ):
        flags[mask] |= np.uint8(flag)
    return flags


def _has_evidence(evidence: ColorEvidence) -> NDArray[np.bool_]:
    """Return which Gaussians have any view that base colour follows from, in every channel."""
    return np.all(np.asarray(evidence.denominator) > 0.0, axis=1)


class Neighbors(NamedTuple):
    """The nearest observed rows of each that was not observed.

    Attributes:
        missing: Which rows were not observed, ``(N,)``.
        distance: Ascending, ``(M, K)`` [m]; K is 0 where none was.
        rows: Numbers of those neighbours, ``(M, K)``.
        weight: Of their mean, ``(M, K)``.
    """

    missing: NDArray[np.bool_]
    distance: NDArray[np.float64]
    rows: NDArray[np.int64]
    weight: NDArray[np.float64]

    @classmethod
    def of(cls, positions: NDArray[np.float32], missing: NDArray[np.bool_]) -> Neighbors:
        """Look for them, given the centres [m], ``(N, 3)``."""
        known = np.flatnonzero(~missing)
        k = min(FILL_NEIGHBORS, len(known)) if missing.any() else 0
        if k == 0:
            nothing = np.zeros((np.count_nonzero(missing), 0))
            return cls(missing, nothing, nothing.astype(np.int64), nothing)
        distance, index = cKDTree(positions[known]).query(positions[missing], k=k, workers=-1)
        distance, index = distance.reshape(-1, k), index.reshape(-1, k)
        weight = 1.0 / np.maximum(distance, 1e-9)
        weight /= weight.sum(axis=1, keepdims=True)
        return cls(missing, distance, known[index], weight)

    def fill(self, values: NDArray[Any]) -> NDArray[Any]:
        """Give what was not observed the mean of its neighbours, ``(N, C)``."""
        if not self.rows.size:
            return values
        filled = values.copy()
        filled[self.missing] = self._mean(values[self.rows])
        return filled

    def _mean(self, near: NDArray[Any]) -> NDArray[Any]:
        return np.einsum("nk,nkc->nc", self.weight, near)

    def spread(self, positions: NDArray[np.float32], values: NDArray[Any], errors: NDArray[Any]) -> NDArray[Any]:
        """Return the errors, ``(N, C)``, with those of what `fill` fills.

        These are the spread of the neighbours, or how much values differ at the distance from them if that is more, and
        their own error beside it.
        """
        if not self.rows.size:
            return errors
        near, spread, known = values[self.rows], errors.copy(), ~self.missing
        around = np.sqrt(np.einsum("nk,nkc->nc", self.weight, (near - self._mean(near)[:, None]) ** 2))
        away = _difference_at(self.distance[:, 0], positions[known], values[known])
        spread[self.missing] = np.maximum(around, away) + errors[known].mean(axis=0)
        return spread


def fill_from_neighbors(
    positions: NDArray[np.float32], values: NDArray[Any], errors: NDArray[Any], missing: NDArray[np.bool_]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return values and errors, ``(N, C)``, what is missing filled from its neighbours; see `Neighbors`."""
    near = Neighbors.of(positions, missing)
    return near.fill(values), near.spread(positions, values, errors)


def _difference_at(distance: NDArray[Any], positions: NDArray[np.float32], values: NDArray[Any]) -> NDArray[np.float64]:
    """Return by how much values that far from each other differ, root mean square, ``(M, C)``.

    The larger of what pairs of that distance and of any smaller one show; nearer than the nearest pairs, nothing.

    Source: the structure function (variogram) of geostatistics, Matheron 1963.
    """
    rows = np.unique(np.linspace(0, len(positions) - 1, min(len(positions), PAIRED)).astype(np.int64))
    one, two = np.triu_indices(len(rows), 1)
    if not len(one):
        return np.zeros((len(distance), values.shape[1]))
    place, value = positions[rows].astype(np.float64), values[rows].astype(np.float64)
    apart = np.linalg.norm(place[one] - place[two], axis=1)
    order = np.argsort(apart, kind="stable")
    groups = np.array_split(order, min(PAIR_GROUPS, len(order)))
    at = np.array([apart[group].mean() for group in groups])
    differ = np.array([np.sqrt(((value[one[group]] - value[two[group]]) ** 2).mean(axis=0)) for group in groups])
    differ = np.maximum.accumulate(differ, axis=0)
    at, differ = np.append(0.0, at), np.vstack([np.zeros(values.shape[1]), differ])
    return np.stack([np.interp(distance, at, differ[:, channel]) for channel in range(values.shape[1])], axis=1)
