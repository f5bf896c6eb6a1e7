"""Fine questions to shading: by which small turn a stated light fits best, and whether it fits at all.

Under the right light, observed colours divided by irradiance are base colours, in which most neighbours are alike. The
light is turned about the up axis by small steps, and the least misfit found by a parabola; the standard error comes
from leaving out one part of the surface after the other. What hides the sky sends light itself: without this bounce
the turn of a walking figure is off by two to four degrees, because the sides of its limbs that face each other are
brighter than the sky alone makes them.

Changes from view to view tell the turn of the same figures three times less well than shading does, and are left out;
tilts about level axes are as uncertain, and are not looked for.

Source: see `beam_warp.materials.light_fits`; the jackknife, Efron and Stein 1981.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.materials.light_fits import (
    LEAST_POINTS,
    LEAST_VIEWS,
    LIGHT_COLUMNS,
    LIGHT_ROWS,
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


def unexplained_part(shown: LightEvidence, cells: NDArray[np.float32]) -> tuple[float, float]:
    """Return how much of neighbours' differences a smooth light beside the stated one explains, with standard error.

    Whatever light is missing or wrong, irradiance changes smoothly with the normal: its ratio to the stated one is
    fitted by harmonics up to the second degree. Under the right light nothing is left for them to explain. Each part of
    the surface is explained by what the others give, so that what is fitted to chance explains nothing.

    Args:
        shown: Well-shown points, at least `LEAST_POINTS`.
        cells: Irradiance that each cell sends [W/m²], ``(L, 3)``.

    Returns:
        The logarithm of differences without over those with the harmonics, and its jackknife's standard error.

    Source: nine harmonics hold all but a few percent of irradiance, Ramamoorthi and Hanrahan 2001.
    """
    parts = parts_of(shown.positions)
    first, second = neighbor_pairs(shown, TURN_NEIGHBORS)
    base = shown_colors(shown) - log_irradiance(shown, cells[:, None])[:, 0]
    smooth = _harmonics(shown.normals.astype(np.float64))
    differences, terms, groups = base[first] - base[second], smooth[first] - smooth[second], parts[first]
    after = np.stack([_unexplained(differences[:, k], terms, groups) for k in range(3)], axis=1)
    before_parts, after_parts = (
        np.bincount(groups, np.abs(values).sum(axis=1), parts.max() + 1) for values in (differences, after)
    )
    left_out = np.log((before_parts.sum() - before_parts) / np.maximum(after_parts.sum() - after_parts, 1e-12))
    gain = float(np.log(max(before_parts.sum(), 1e-12) / max(after_parts.sum(), 1e-12)))
    return gain, float(np.sqrt((len(left_out) - 1) * left_out.var()))


def _harmonics(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return harmonics of the first and second degree, up to factors, ``(M, 8)``."""
    x, y, z = normals.T
    return np.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, 3.0 * z * z - 1.0], axis=1)


def _unexplained(
    differences: NDArray[np.float64], terms: NDArray[np.float64], groups: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return what least absolute errors leave of differences ``(P,)``, each group fitted by all others."""
    weights = np.ones(len(differences))
    squares, products = np.zeros((0, 0, 0)), np.zeros((0, 0))
    for _ in range(ROUNDS):
        squares, products = _normal_equations(terms, differences, weights, groups)
        found = np.linalg.solve(squares.sum(axis=0), products.sum(axis=0))
        weights = 1.0 / np.maximum(np.abs(differences - terms @ found), SMALLEST_DIFFERENCE)
    others = np.linalg.solve(squares.sum(axis=0) - squares, (products.sum(axis=0) - products)[..., None])[..., 0]
    return differences - np.einsum("pk,pk->p", terms, others[groups])


def _normal_equations(
    terms: NDArray[np.float64], values: NDArray[np.float64], weights: NDArray[np.float64], groups: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return each group's weighted normal equations, ``(B, K, K)`` and ``(B, K)``, a little pulled towards none."""
    count, size = int(groups.max()) + 1, terms.shape[1]
    weighted = terms * weights[:, None]
    squares = np.stack([weighted[groups == group].T @ terms[groups == group] for group in range(count)])
    products = np.stack([weighted[groups == group].T @ values[groups == group] for group in range(count)])
    return squares + PULL * np.eye(size) * squares.trace(axis1=1, axis2=2)[:, None, None] / size, products


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
