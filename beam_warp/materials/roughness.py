"""Perceptual roughness from photographs: which one explains best how a point's colour changes with the view.

Candidates are judged by how badly they explain what views show (`beam_warp.materials.roughness_profile`). Dielectrics
reflect four parts in a hundred, so a single Gaussian says next to nothing; what its surroundings say with it is weighed
by how well one half of the views predicts the other. The outcome is a distribution for every Gaussian, of which mean
and standard deviation are stated: where the data cannot tell, these are the prior's.

A lobe is seen as wide as it is and as normals scatter where a Gaussian is seen: one of roughness r looks like one of
(r^4 + a^2)^(1/4) if they scatter by an angle a. So a candidate's misfit is that of what it looks like.

The weights: a misfit A counts as evidence exp(-T A). With halves 1 and 2 of the views, each with a base colour of its
own, T maximises the sum over places of

    log sum_r p(r) exp(-T (A_1 + A_2)) - log sum_r p(r) exp(-T A_1) - log sum_r p(r) exp(-T A_2),

what knowing one half tells of the other. Whatever normalises exp(-T A) over data cancels; where halves contradict each
other, or fit everything, the maximum is at T = 0 and nothing is claimed. Errors that are the same in both halves (of
normals, above all) are not seen this way: evidence counts `SHARED` of what they agree on.

Sources: Varin et al. 2011 (composite likelihoods claim too much when errors are shared, and are to be scaled);
Bissiri, Holmes and Walker 2016 (evidence from a misfit, exp(-T A), and the choice of T); Olano and Baker 2010, "LEAN
mapping" (variances of slopes add up; alpha^2, r^4, is that of both directions together).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from beam_warp.checks import require_number
from beam_warp.errors import InvalidArrayError
from beam_warp.materials.roughness_profile import CANDIDATES, RoughnessProfile
from beam_warp.world.curve import morton_order

GRID = np.linspace(CANDIDATES[0], CANDIDATES[-1], 37)
"""Roughness at which distributions are held: steps of 0.025, below any error that is stated."""

CLUSTER = 4
"""Gaussians are asked together by so many."""

NEAR, WIDE = 4, 64
"""Clusters that make up a place and its surroundings: 16 and 256 Gaussians, 1 and 4 cm about on 100,000 of a person."""

PARENTS = 3
"""Clusters nearest to a Gaussian that it takes its distribution from."""

MOST_ASKED = 6_000
"""Places that weights are estimated from, evenly spread: their errors are far below those of what they stand for."""

PRECISIONS = np.geomspace(1e-3, 10.0, 25)
"""T that are tried. The largest takes residuals of 0.013 of a white surface for chance: no captured light is better."""

STEPS = np.array((0.0, 0.01, 0.02, 0.03, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.3))
"""Differences of a place from its surroundings (standard deviations) that are tried."""

SPREADS = np.geomspace(0.05, 0.4, 13)
"""Spreads of the prior that are tried: no subject is of one roughness to better than a twentieth."""

ANGLE_STEP = 0.01
"""Step of the angles of scatter that are told apart [rad]: a lobe of roughness 0.3 looks like one of 0.301 by it."""

PARTS_OF_SCATTER = (0.0, 0.125, 0.25, 0.5, 1.0)
"""Parts of it that are tried; between them the result is interpolated."""

COMPARED, MOST_COMPARED = 64, 1_000
"""Gaussians around a place whose halves are compared, few enough for one roughness, and about how many places."""

SHARED = 0.25
"""Part of the agreement of two halves of the views that counts: the rest is taken for errors that they share.

Measured against the truth of two captures, where 0.2 to 0.3 makes the distributions most probable, of 16 as of 256
Gaussians together (docs/materials.md)."""

LEAST_AGREEMENT = 2.0
"""Natural logarithm of the odds by which halves must agree rather than not, for any claim: e^2 is 7 to 1."""

INFORMED_PART = 0.9
"""Part of the prior's spread; a Gaussian whose distribution is wider is told by the prior."""

MODEL_ERROR = 0.04
"""Error of roughness that no misfit shows: what is pooled is not of one roughness. Under a sky of five soft lights,
where roughness changes by 0.25 over the subject, 95 % of places come back within two stated errors, 85 % with 0.015.
Of one roughness, fourteen from 0.16 to 0.91 come back 0.012 off in root mean square: half a step of `GRID`."""

TINY = 1e-300


@dataclass(frozen=True)
class RoughnessPrior:
    """Prior distribution of roughness: normal, cut to the range of `CANDIDATES`.

    Attributes:
        mean: Mean, perceptual.
        spread: Standard deviation.

    Raises:
        InvalidOptionError: A value is out of range.
    """

    mean: float = 0.5
    spread: float = 0.25

    def __post_init__(self) -> None:
        """Check values once."""
        require_number("mean", self.mean, 0.0, 1.0)
        require_number("spread", self.spread, 0.01, 1.0)


@dataclass(frozen=True, eq=False)
class RoughnessEstimate:
    """Estimated roughness.

    Attributes:
        roughness: Mean of each Gaussian's distribution, perceptual, ``(N,)`` float32.
        standard_error: Its standard deviation, joined with `MODEL_ERROR`, ``(N,)`` float32.
        informed: False where the data adds little to the prior, ``(N,)`` bool.
        prior: What all Gaussians together say, or what was given.
        report: How it came about, JSON-ready: ``informed_part``, ``median_error``, ``frames``; the ``prior_mean`` and
            ``prior_spread`` that a Gaussian without evidence gets; ``step``, by how much places differ from their
            surroundings; ``scatter_part``, the part of their scatter by which normals make lobes wider; ``near`` and
            ``wide``, each with the ``precision`` T and the ``agreement`` of halves of the views, a natural logarithm
            of odds.
    """

    roughness: NDArray[np.float32]
    standard_error: NDArray[np.float32]
    informed: NDArray[np.bool_]
    prior: RoughnessPrior
    report: dict[str, Any]


def solve_roughness(
    positions: NDArray[np.floating[Any]], profile: RoughnessProfile, *, prior: RoughnessPrior | None = None
) -> RoughnessEstimate:
    """Turn profiles into a roughness for every Gaussian, with its standard error.

    A place, `NEAR` clusters of Gaussians, is told by its own misfit, by that of its surroundings and by the prior. The
    weights of both come from how far halves of the views agree on them; how far a place may differ from its
    surroundings is what makes the misfits of all places most probable. So places that speak clearly are told by
    themselves, others by what is around them, and what nothing tells keeps the prior with its spread.

    Args:
        positions: Of the Gaussians [m], in any one of the frames, ``(N, 3)``.
        profile: Of one frame, or the sum over frames of the same Gaussians.
        prior: Taken as it is; None takes what makes the misfits of all surroundings most probable.

    Raises:
        InvalidArrayError: Positions and profile are not of as many Gaussians.
    """
    places = np.asarray(positions, np.float64)
    if places.shape != (len(profile.views), 3):
        raise InvalidArrayError(
            f"positions must have shape ({len(profile.views)}, 3), got {places.shape}. Take those of one of the frames."
        )
    known = np.flatnonzero(profile.views > 0.0)
    if not len(known):
        chosen = prior or RoughnessPrior()
        moments = _moments(_log_prior(chosen))
        means, errors = (np.full(len(places), value) for value in (moments[0], np.hypot(moments[1], MODEL_ERROR)))
        nothing = _Evidence(0.0, 0.0)
        report = {"near": nothing, "wide": nothing, "step": 0.0, "scatter_part": 0.0, "frames": profile.frames}
        return _estimate(means, errors, np.zeros(len(places), bool), chosen, moments, report)
    seen = places[known]
    tree = cKDTree(seen[_along_curve(seen)][::CLUSTER])
    cluster = tree.query(seen, workers=-1)[1]
    scatter = np.broadcast_to(profile.scatter, len(places))[known] / profile.views[known]
    misfit = np.asarray(profile.misfit, np.float64)[:, known]

    def pooled(part: float, *counts: int) -> list[NDArray[np.float64]]:
        clusters = _cluster_sums(as_seen(misfit, part * scatter), cluster, tree.n)
        return [_sums_around(tree, clusters, count) for count in counts]

    asked = slice(None, None, -(-tree.n // MOST_ASKED))
    counted = tree.n / len(range(tree.n)[asked])  # how many places each one that is asked stands for
    (looks,) = pooled(0.0, NEAR)
    worth = _worth(_log_prior(prior or RoughnessPrior()), looks[:, asked], counted / NEAR)
    part = part_of_scatter(seen, misfit[0], scatter, worth.precision)
    near, wide = pooled(part, NEAR, WIDE)
    chosen, near_evidence, wide_evidence = _weigh(near[:, asked], wide[:, asked], counted, prior)
    outside = _normalized(_log_prior(chosen) - wide_evidence.precision * (wide[0] - near[0]))
    inside = -near_evidence.precision * near[0]
    step = _most_probable_step(outside[asked], inside[asked])
    distribution = _normalized(_widened(outside, step) + inside)
    mean, spread = _moments(distribution)
    moments = _moments(_widened(_log_prior(chosen), step))
    weight, index = _nearest(tree, places)
    roughness = (weight * mean[index]).sum(axis=1)
    error = np.sqrt((weight * np.square(spread)[index]).sum(axis=1) + MODEL_ERROR**2)
    informed = (weight * spread[index]).sum(axis=1) < INFORMED_PART * moments[1]
    report = {
        "near": near_evidence,
        "wide": wide_evidence,
        "step": step,
        "scatter_part": part,
        "frames": profile.frames,
    }
    return _estimate(roughness, error, informed, chosen, moments, report)


def evenly_spread(positions: NDArray[np.floating[Any]], count: int) -> NDArray[np.intp]:
    """Return about so many rows of positions, spread evenly along a curve through them, or all; ascending."""
    order = _along_curve(np.asarray(positions, np.float64))
    return np.sort(order[:: max(len(order) // count, 1)])


def as_seen(misfit: NDArray[np.float64], scatter: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return misfits of roughnesses on `GRID`, each that of what it looks like at normals that scatter.

    Args:
        misfit: Of what is seen, at `CANDIDATES`, ``(P, N, 12)``.
        scatter: Mean square of the angle, in both directions together [rad^2], ``(N,)``.
    """
    from scipy.interpolate import CubicSpline  # with scipy.optimize; a take starts without them

    spline = CubicSpline(CANDIDATES, np.eye(len(CANDIDATES)))
    level = np.rint(np.sqrt(scatter) / ANGLE_STEP)
    found = np.empty((*misfit.shape[:2], len(GRID)))
    for step in np.unique(level):
        looks = (GRID**4 + (step * ANGLE_STEP) ** 2) ** 0.25
        found[:, level == step] = misfit[:, level == step] @ spline(np.minimum(looks, GRID[-1])).T
    return found


def part_of_scatter(
    places: NDArray[np.float64], misfit: NDArray[np.float64], scatter: NDArray[np.floating[Any]], precision: float
) -> float:
    """Return the part of their scatter by which normals make lobes wider, in [0, 1].

    The rest is noise of what pixels show of the normals, which mirrors nothing. Around a place roughness is the same,
    however much normals scatter. So the half of its surroundings whose normals scatter more must not look rougher than
    the other one: the part is the least at which a difference of roughness between both makes no data more probable,
    by the derivative of all places' evidence.

    Args:
        places: Positions of Gaussians [m], ``(N, 3)``.
        misfit: Of all their views, at `CANDIDATES`, ``(N, 12)``.
        scatter: As for `as_seen`.
        precision: What misfits are worth; if 0, so is the part.
    """
    count = min(COMPARED, len(places)) // 2
    if not (precision > 0.0 and count and scatter.any()):
        return 0.0
    near = cKDTree(places).query(places[evenly_spread(places, MOST_COMPARED)], k=2 * count, workers=-1)[1]
    near = np.take_along_axis(near, np.argsort(scatter[near], axis=1, kind="stable"), axis=1)

    def pull(part: float) -> float:
        seen = as_seen(misfit[None, near.ravel()], part * scatter[near.ravel()])[0]
        less, more = seen.reshape(len(near), 2, count, -1).sum(axis=2).transpose(1, 0, 2)
        chance = np.exp(_normalized(-precision * (less + more)))
        return float((chance * np.gradient(less - more, GRID, axis=1)).sum())

    last, above = 0.0, 0.0
    for part in PARTS_OF_SCATTER:
        found = pull(part)
        if not found > 0.0:
            return float(np.interp(0.0, (found, above), (part, last)))
        last, above = part, found
    return last


class _Evidence(NamedTuple):
    """Weight of misfits, exp(-precision misfit), and the logarithm of the odds that halves of the views agree."""

    precision: float
    agreement: float


def _estimate(
    roughness: NDArray[np.float64],
    error: NDArray[np.float64],
    informed: NDArray[np.bool_],
    prior: RoughnessPrior,
    prior_moments: tuple[Any, Any],
    report: dict[str, Any],
) -> RoughnessEstimate:
    """Return an estimate with its report; ``prior_moments`` are what a Gaussian without evidence gets."""
    report = {name: value._asdict() if isinstance(value, _Evidence) else value for name, value in report.items()}
    report["prior_mean"], report["prior_spread"] = (float(value) for value in prior_moments)
    report["informed_part"] = float(informed.mean()) if len(informed) else 0.0
    report["median_error"] = float(np.median(error)) if len(error) else 0.0
    return RoughnessEstimate(roughness.astype(np.float32), error.astype(np.float32), informed, prior, report)


def _weigh(
    near: NDArray[np.float64], wide: NDArray[np.float64], counted: float, prior: RoughnessPrior | None
) -> tuple[RoughnessPrior, _Evidence, _Evidence]:
    """Return the prior, and what misfits of places and of surroundings are worth.

    Halves are asked how far they agree before anything is known: where all places are alike, the prior that these make
    leaves nothing to agree on.

    The prior's mean is taken from evidence as far as it counts. Its spread is taken from evidence at its word: cut to
    a quarter, evidence hardly tells places apart, and the spread of two captures came out a third too small.
    """
    start = prior or RoughnessPrior()
    near_evidence = _worth(_log_prior(start), near, counted / NEAR)
    wide_evidence = _worth(_log_prior(start), wide, counted / WIDE)
    if prior is not None or wide_evidence.precision == 0.0:
        return start, near_evidence, wide_evidence
    mean = _most_probable_prior(wide[0], wide_evidence.precision, counted / WIDE, start).mean
    spread = _most_probable_prior(wide[0], wide_evidence.precision / SHARED, counted / WIDE, start).spread
    return RoughnessPrior(mean, spread), near_evidence, wide_evidence


def _worth(log_prior: NDArray[np.float64], parts: NDArray[np.float64], counted: float) -> _Evidence:
    """Return the precision at which halves of the views tell most of each other; 0 if they do not."""
    _, even, odd = parts
    both = even + odd

    def agree(precision: float) -> float:
        together, *halves = (_log_evidence(log_prior, misfit, precision) for misfit in (both, even, odd))
        return counted * float((together - halves[0] - halves[1]).sum())

    with ThreadPoolExecutor() as pool:
        agreement = list(pool.map(agree, PRECISIONS))
    best = int(np.argmax(agreement))
    if not agreement[best] > LEAST_AGREEMENT:
        return _Evidence(0.0, agreement[best])
    return _Evidence(SHARED * float(PRECISIONS[best]), agreement[best])


def _most_probable_prior(
    misfit: NDArray[np.float64], precision: float, counted: float, start: RoughnessPrior
) -> RoughnessPrior:
    """Return the prior that makes misfits most probable; ``start`` counts as much as one place."""
    means, spreads = np.meshgrid(GRID, SPREADS, indexing="ij")
    means, spreads = means.ravel(), spreads.ravel()
    priors = np.exp(_normalized(-0.5 * np.square((GRID - means[:, None]) / spreads[:, None])))
    likelihood = np.exp(-precision * (misfit - misfit.min(axis=1, keepdims=True)))
    gain = counted * np.log(likelihood @ priors.T + TINY).sum(axis=0)
    gain -= 0.5 * np.square((means - start.mean) / start.spread)
    gain -= 0.5 * np.square(np.log2(spreads / start.spread))
    best = int(np.argmax(gain))
    return RoughnessPrior(float(means[best]), float(spreads[best]))


def _most_probable_step(outside: NDArray[np.float64], inside: NDArray[np.float64]) -> float:
    """Return by how much places differ from their surroundings: what makes their own misfit most probable."""
    likelihood = np.exp(inside - inside.max(axis=1, keepdims=True))
    gains = [np.log((np.exp(_widened(outside, step)) * likelihood).sum(axis=1) + TINY).sum() for step in STEPS]
    return float(STEPS[int(np.argmax(gains))])


def _log_prior(prior: RoughnessPrior) -> NDArray[np.float64]:
    """Return the prior's logarithm on the grid."""
    return _normalized(-0.5 * np.square((GRID - prior.mean) / prior.spread))


def _normalized(logarithms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return logarithms whose exponentials add up to one over the grid."""
    top = logarithms.max(axis=-1, keepdims=True)
    return logarithms - top - np.log(np.exp(logarithms - top).sum(axis=-1, keepdims=True))


def _log_evidence(log_prior: NDArray[np.float64], misfit: NDArray[np.float64], precision: float) -> NDArray[np.float64]:
    """Return log sum_r p(r) exp(-T A(r)) of every place."""
    least = misfit.min(axis=-1)
    return np.log(np.exp(log_prior - precision * (misfit - least[:, None])).sum(axis=-1) + TINY) - precision * least


def _widened(log_distribution: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Blur distributions on the grid, whose ends nothing leaves by."""
    if step == 0.0:
        return log_distribution
    kernel = np.exp(-0.5 * np.square((GRID[:, None] - GRID) / step))
    return np.log(np.exp(log_distribution) @ (kernel / kernel.sum(axis=1, keepdims=True)) + TINY)


def _moments(log_distribution: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and standard deviation."""
    p = np.exp(log_distribution)
    mean = p @ GRID
    return mean, np.sqrt((p * np.square(GRID - mean[..., None])).sum(axis=-1))


def _cluster_sums(misfit: NDArray[np.float64], cluster: NDArray[np.integer[Any]], count: int) -> NDArray[np.float64]:
    """Add up the misfits of each cluster's Gaussians, in their order: ``(3, N, G)`` to ``(3, count, G)``."""
    sums = [np.stack([np.bincount(cluster, column, count) for column in part.T], axis=1) for part in misfit]
    return np.stack(sums).astype(np.float64)


def _sums_around(tree: cKDTree, clusters: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Add up the misfits of every cluster and its nearest ones, ``count`` in all."""
    count = min(count, tree.n)
    near = tree.query(tree.data, k=count, workers=-1)[1].ravel()
    starts = np.arange(0, len(near) + 1, count)
    sums = csr_array((np.ones(len(near)), near, starts), shape=(tree.n, tree.n))
    return np.stack([sums @ part for part in clusters])


def _nearest(tree: cKDTree, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.integer[Any]]]:
    """Return the weights and indices of the clusters nearest to places, ``(N, PARENTS)`` each."""
    count = min(PARENTS, tree.n)
    distance, index = (found.reshape(len(places), count) for found in tree.query(places, k=count, workers=-1))
    weight = 1.0 / np.maximum(distance, 1e-3 * distance[:, -1:] + 1e-12)
    return weight / weight.sum(axis=1, keepdims=True), index


def _along_curve(points: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the order of points along a space-filling curve of 1024 cells a side."""
    low = points.min(axis=0)
    cells = (points - low) * (1023.0 / max(float(np.ptp(points, axis=0).max()), 1e-30))
    return morton_order(cells.astype(np.uint32))
