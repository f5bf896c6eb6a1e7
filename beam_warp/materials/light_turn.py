"""Fine questions to shading: by which small turn a stated light fits best, and whether it fits at all.

Under the right light, observed colours divided by irradiance are base colours, in which most neighbours are alike. The
light is turned about the up axis by small steps, and the least misfit found by a parabola; the standard error comes
from leaving out one part of the surface after the other. What hides the sky sends light itself: without this bounce
the turn of a walking figure is off by two to four degrees, because the sides of its limbs that face each other are
brighter than the sky alone makes them.

Changes from view to view tell the turn of the same figures less well than shading does, because their places depend on
the roughness that is assumed, and are left out; tilts about level axes are as uncertain, and are not looked for.

A light that no turn mends is that of another place. What such a light lacks changes smoothly with the normal.

Source: see `beam_warp.materials.light_fits`; the jackknife, Efron and Stein 1981.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import stdtrit

from beam_warp.materials.light_fits import (
    CHANCE,
    LEAST_GAIN,
    LEAST_POINTS,
    LEAST_VIEWS,
    LIGHT_COLUMNS,
    LIGHT_ROWS,
    NEIGHBORS,
    LightEvidence,
    cell_angles,
    cell_directions,
    mean_colors,
    neighbor_differences,
    neighbor_pairs,
    parts_of,
    well_shown,
)
from beam_warp.world.environment import EnvironmentMap

TURNS = np.linspace(-15.0, 15.0, 21)
"""Turns that are tried [degree], 1.5 apart."""

REACH = 4
"""Turns to each side of the least misfit that the parabola goes through, ±6 degrees: misfits between neighbouring
turns are rough, because some pairs of neighbours straddle edges of shadows."""

TURN_NEIGHBORS = 32
"""Neighbours that a point is compared with: over twice as many as the coarse check takes, the standard error is a tenth
less; paint differs more, and shading more still."""

SPLIT = 8
"""Texels on the side of a cell between which a source is told apart, 1.4 degrees each."""

CERTAIN = 3.0
"""Standard errors from which on a turn is beyond doubt."""

SYSTEMATIC = 1.0
"""Standard deviation of what the jackknife does not see [degree]: errors of normals that the whole surface shares. With
it, estimates with the right light are off by one standard error in the root mean square."""

LEAST_TURN = 4.0
"""Turn that matters [degree]. Two degrees cost base colours nothing that is seen, and estimates with the right light
are off by up to three."""

LARGEST_TURN = 10.0
"""Turn up to which a light is taken to be mounted askew [degree]; beyond, it follows another convention."""

LEAST_EXPLAINED = 0.02
LEAST_MISSING = 0.15
"""Gain and size from which on a smooth missing light means that the stated one is that of another place. The right
light gains up to 0.01 and its harmonics have a size of up to 0.08; of others, up to 0.14 and 0.6."""

MOST_ALIKE = 0.8
"""Part of normals that places may tell: all on a ball, half or less on figures."""

ROUNDS = 8
SMALLEST_DIFFERENCE = 0.02
PULL = 1e-3
"""Rounds of reweighting to least absolute errors, difference of logarithms below which all count alike, and pull
towards no correction, in parts of the evidence."""

LEAST_COLOR = 1e-3
LEAST_LIGHT = 0.01
"""Parts of the median colour and of the median irradiance that every point has at least, before logarithms."""

FLAT = 1e-7
"""Bend of the misfit, of itself for a degree squared, below which all turns are alike up to rounding."""


@dataclass(frozen=True)
class LightTurn:
    """Turn by which a light explains a capture best.

    Attributes:
        degrees: The turn, as `EnvironmentMap.rotated` takes it; NaN where nothing tells it.
        standard_error: Of the same [degree]; infinite where nothing tells it.
    """

    degrees: float = float("nan")
    standard_error: float = float("inf")

    @property
    def is_certain(self) -> bool:
        """Whether the light is turned beyond doubt, by more than hardly shows and no more than is mounted askew."""
        return LEAST_TURN <= abs(self.degrees) <= LARGEST_TURN and abs(self.degrees) > CERTAIN * self.standard_error

    def __str__(self) -> str:
        """Return the turn with its standard error, in degrees."""
        return f"{self.degrees:+.1f} ± {self.standard_error:.1f} degrees"


def find_turn(evidence: LightEvidence, environment: EnvironmentMap) -> LightTurn:
    """Find the small turn of a light that explains a capture best.

    Args:
        evidence: What well-seen Gaussians show, in the units of the light: what they reflect onto each other depends
            on it.
        environment: The light as stated.

    Returns:
        The turn that undoes the error; unknown where too little is seen, where all turns are alike, or where the best
        is further away than is looked.
    """
    shown = well_shown(evidence)
    if len(shown.positions) < LEAST_POINTS or len(shown.weights) < LEAST_VIEWS or not environment.radiance.any():
        return LightTurn()
    parts = parts_of(shown.positions)
    base = shown_colors(shown)[:, None] - log_irradiance(shown, turned_cells(environment, TURNS))
    apart, pairs = neighbor_differences(shown, base.reshape(len(base), -1), parts, TURN_NEIGHBORS)
    apart = apart.reshape(len(apart), len(TURNS), 3).sum(axis=2)
    left_out = (apart.sum(axis=0) - apart) / np.maximum(pairs.sum() - pairs, 1.0)
    found = np.array([_least(misfit) for misfit in left_out])
    turn = _least(apart.sum(axis=0) / max(float(pairs.sum()), 1.0))
    if not np.isfinite([turn, *found]).all():
        return LightTurn()
    return LightTurn(turn, float(np.sqrt(SYSTEMATIC**2 + (len(found) - 1) * found.var())))


def turned_cells(environment: EnvironmentMap, degrees: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the irradiance that each cell of a turned light sends [W/m²], ``(L, turns, 3)``.

    Each texel is shared between the two nearest cells of a row, so that a small source does not jump from cell to cell.
    """
    columns = SPLIT * LIGHT_COLUMNS
    fine = environment.resized(SPLIT * LIGHT_ROWS, columns)
    power = (fine.radiance * fine.solid_angles()[..., None]).reshape(LIGHT_ROWS, SPLIT, columns, 3).sum(axis=1)
    place = (np.arange(columns) + 0.5) / SPLIT - 0.5 - np.asarray(degrees)[:, None] * (LIGHT_COLUMNS / 360.0)
    lower = np.floor(place)
    shares = np.zeros((len(degrees), columns, LIGHT_COLUMNS))
    turn, column = np.indices(place.shape)
    for near, share in ((lower, 1.0 - (place - lower)), (lower + 1.0, place - lower)):
        shares[turn, column, near.astype(np.int64) % LIGHT_COLUMNS] = share
    cells = np.einsum("rfc,tfk->rktc", power, shares, optimize=True)
    return cells.reshape(LIGHT_ROWS * LIGHT_COLUMNS, len(degrees), 3).astype(np.float32)


@dataclass(frozen=True)
class MissingLight:
    """Smooth light beside a stated one that explains differences between neighbours.

    Attributes:
        gain: Logarithm of neighbours' differences without it over those with it, smooth paint taken out of both.
        gain_error: Standard error of the same.
        size: Standard deviation over the points of its logarithm, of irradiance.
    """

    gain: float
    gain_error: float
    size: float

    @property
    def is_certain(self) -> bool:
        """Whether the stated light lacks so much, beyond doubt, that it is another one."""
        return self.size > LEAST_MISSING and self.gain > max(LEAST_EXPLAINED, CERTAIN * self.gain_error)


def missing_light(shown: LightEvidence, cells: NDArray[np.float32]) -> MissingLight:
    """Find the smooth light that explains most of neighbours' differences.

    Whatever light is missing or wrong, irradiance changes smoothly with the normal: its ratio to the stated one is
    fitted by harmonics up to the second degree. Under the right light nothing is left for them to explain. What places
    explain, up to the second degree, may be paint: on a ball that is all, and nothing is known. Each part of the
    surface is explained by what the others give, so that what is fitted to chance explains nothing.

    A normal that is off makes a point too bright or too dark for it, as if another light fell there. So points are
    compared under their own normals, but harmonics are those of mean normals around them, whose errors are others.

    Args:
        shown: Well-shown points, at least `LEAST_POINTS`.
        cells: Irradiance that each cell sends [W/m²], ``(L, 3)``.

    Source: nine harmonics hold all but a few percent of irradiance, Ramamoorthi and Hanrahan 2001; split-sample
    instruments against errors in variables, Angrist and Krueger 1995.
    """
    parts = parts_of(shown.positions)
    first, second, around = _halves(shown, NEIGHBORS)
    base = (shown_colors(shown) - log_irradiance(shown, cells[:, None])[:, 0]).mean(axis=1)
    places = shown.positions.astype(np.float64) - shown.positions.mean(axis=0)
    of_places = _harmonics(places / max(float(places.std()), 1e-12), squares=3)
    of_normals = _harmonics(around.normals.astype(np.float64))
    if _alike(of_places, of_normals) > MOST_ALIKE:
        return MissingLight(0.0, float("inf"), 0.0)
    differences, groups = base[first] - base[second], parts[first]

    def fitted(smooth: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        terms = smooth[first] - smooth[second]
        whole, others = _fitted(differences, terms, groups)
        left = np.abs(differences - (terms * others[groups]).sum(axis=1))
        return whole, np.bincount(groups, left, parts.max() + 1).astype(np.float64)

    before = fitted(of_places)[1]
    whole, after = fitted(np.hstack([of_places, of_normals]))
    left_out = np.log((before.sum() - before) / np.maximum(after.sum() - after, 1e-12))
    error = float(np.sqrt((len(left_out) - 1) * left_out.var()))
    size = float((of_normals @ whole[of_places.shape[1] :]).std())
    return MissingLight(float(np.log(before.sum() / max(after.sum(), 1e-12))), error, size)


def _halves(shown: LightEvidence, count: int) -> tuple[NDArray[np.int64], NDArray[np.int64], LightEvidence]:
    """Return pairs of neighbours within either half of the points, and the points with normals of the other half.

    Args:
        shown: The points.
        count: Neighbours that each point is compared with.

    Returns:
        Rows of the one and the other of each pair, ``(P,)`` each, and the points with the mean normals of the nearest
        ones of the other half that do not face away; with their own where all do.
    """
    halves = [np.arange(half, len(shown.positions), 2) for half in (0, 1)]
    pairs = [half[np.stack(neighbor_pairs(shown.some(half), count))] for half in halves]
    around = np.zeros_like(shown.normals)
    for half, others in (halves, halves[::-1]):
        near = cKDTree(shown.positions[others]).query(shown.positions[half], k=NEIGHBORS // 2, workers=-1)[1]
        normals = shown.normals[others[near]]
        facing = np.einsum("mki,mi->mk", normals, shown.normals[half]) > 0.0
        around[half] = np.einsum("mki,mk->mi", normals, facing)
    length = np.linalg.norm(around, axis=1, keepdims=True)
    normals = np.divide(around, length, out=shown.normals.copy(), where=length > 0.0)
    first, second = np.concatenate(pairs, axis=1)
    return first, second, replace(shown, normals=normals)


def _harmonics(vectors: NDArray[np.float64], *, squares: int = 2) -> NDArray[np.float64]:
    """Return polynomials of the first and second degree, ``(M, 6 + squares)``; of unit vectors, two squares are all."""
    x, y, z = vectors.T
    return np.stack([x, y, z, x * y, y * z, z * x, x * x, y * y, z * z][: 6 + squares], axis=1)


def _alike(places: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    """Return which part of the variance of the one, ``(M, K)``, the other explains."""
    terms = np.hstack([np.ones((len(places), 1)), places])
    left = normals - terms @ np.linalg.lstsq(terms, normals)[0]
    return 1.0 - float(left.var(axis=0).sum() / max(float(normals.var(axis=0).sum()), 1e-12))


def _fitted(
    differences: NDArray[np.float64], terms: NDArray[np.float64], groups: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit differences ``(P,)`` in least absolute errors: factors of all, ``(K,)``, and of all but each group."""
    pull, whole = PULL * np.square(terms).sum(axis=0).mean() * np.eye(terms.shape[1]), np.zeros(terms.shape[1])
    weights = np.ones(len(differences))
    for _ in range(ROUNDS):
        weighted = terms * weights[:, None]
        whole = np.linalg.solve(weighted.T @ terms + weights.mean() * pull, weighted.T @ differences)
        weights = 1.0 / np.maximum(np.abs(differences - terms @ whole), SMALLEST_DIFFERENCE)
    weighted = terms * weights[:, None]
    rows = [np.flatnonzero(groups == group) for group in range(int(groups.max()) + 1)]
    squares = np.stack([weighted[some].T @ terms[some] for some in rows])
    products = np.stack([weighted[some].T @ differences[some] for some in rows])[..., None]
    left = squares.sum(axis=0) - squares + weights.mean() * pull
    return whole, np.linalg.solve(left, products.sum(axis=0) - products)[..., 0]


def weaker_explains(shown: LightEvidence, light: NDArray[np.float64]) -> float:
    """Return how clearly a light of half the contrast explains what is shown better: above 1 is a verdict.

    Shading of the right light, raised to a power, leaves neighbours' base colours most alike at a power of 1. Another
    light is right about some of the shading at best, so that less of it explains more. So it is of normals that are
    off, under the right light too: the shading that is raised is what mean normals around the points, whose errors are
    others, predict of it.

    Args:
        shown: Well-shown points, at least `LEAST_POINTS`.
        light: Radiance of the cells, ``(L, 3)``.
    """
    parts, colors = parts_of(shown.positions), shown_colors(shown)
    cells = (light * cell_angles()[:, None])[:, None].astype(np.float32)
    first, second, around = _halves(shown, TURN_NEIGHBORS)
    logs = (colors, log_irradiance(shown, cells)[:, 0], log_irradiance(around, cells)[:, 0])
    seen, own, smooth = (values[first] - values[second] for values in logs)
    shading = smooth * ((smooth * own).sum(axis=0) / np.maximum(np.square(smooth).sum(axis=0), 1e-12))
    full, half = (
        np.bincount(parts[first], np.abs(seen - power * shading).sum(axis=1), parts.max() + 1) for power in (1.0, 0.5)
    )
    left_out = np.log(np.maximum(full.sum() - full, 1e-6) / np.maximum(half.sum() - half, 1e-6))
    chance = stdtrit(len(full) - 1, 1.0 - CHANCE) * float(np.sqrt((len(full) - 1) * left_out.var()))
    gain = float(np.log(max(full.sum(), 1e-6) / max(half.sum(), 1e-6)))
    return gain / max(float(chance), LEAST_GAIN)


def shown_colors(shown: LightEvidence) -> NDArray[np.float64]:
    """Return logarithms of the points' colours, ``(M, 3)``."""
    colors = mean_colors(shown)
    return np.log(np.maximum(colors, np.maximum(LEAST_COLOR * np.median(colors, axis=0), 1e-12)))


def log_irradiance(shown: LightEvidence, cells: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return logarithms of irradiance over pi, one bounce included, of cells ``(L, K, 3)`` of power, ``(M, K, 3)``."""
    cosine = np.maximum(shown.normals @ cell_directions().T, 0.0)
    sky = ((cosine * shown.openness) @ cells.reshape(len(cells), -1)).reshape(len(cosine), -1, 3)
    hidden = (cosine * (1.0 - shown.openness)) @ cell_angles()
    light = (sky + hidden[:, None, None] * mean_colors(shown).mean(axis=0)) / np.pi
    return np.log(np.maximum(light, np.maximum(LEAST_LIGHT * np.median(light, axis=0), 1e-12)))


def _least(misfit: NDArray[np.float64]) -> float:
    """Return the turn of the least misfit [degree] by a parabola around it; NaN where there is none within reach."""
    best = int(np.argmin(misfit))
    near = slice(max(best - REACH, 0), best + REACH + 1)
    bend, slope, _ = np.polyfit(TURNS[near] - TURNS[best], misfit[near], 2)
    if not bend > FLAT * misfit[best]:
        return float("nan")
    turn = float(TURNS[best]) - float(slope) / (2.0 * float(bend))
    return turn if abs(turn) < float(TURNS[-1]) else float("nan")
