"""How well lights explain what a capture shows, and how much of the difference between two of them chance may make.

Two criteria need no base colours. Observed colours divided by the shading of the right light are base colours, in which
most neighbours are alike; under another light, its shading is left between them. Changes of a point's colour from view
to view are gloss: whatever the base colour, they must follow the light that the views see mirrored. Both are linear in
the light, so that all turns of an environment cost two matrix products.

Two lights are compared on the same points: what paint, noise and normals do to both cancels. The standard error of
the difference comes from leaving out one part of the surface after the other.

Source: shading removed by division, as in intrinsic images; sparse changes of paint, Land and McCann 1971; the
jackknife, Efron and Stein 1981.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import stdtrit

from beam_warp.image.color import LUMINANCE
from beam_warp.world.environment import EnvironmentMap, texel_directions

LIGHT_ROWS, LIGHT_COLUMNS = 16, 32
"""Cells that the light is averaged over; a turn by one column is 11.25 degrees, turns between are interpolated."""

LEAST_POINTS = 64
"""Fewest Gaussians that say anything about light."""

LEAST_VIEWS = 4
"""Fewest views: one side of a subject alone is explained by many lights."""

EVEN = 2 * LIGHT_COLUMNS
"""Number of the even light among those that are compared: turns and their mirror images come first."""

GLOSS_ROUGHNESS = 0.5
"""Roughness of the lobe that light is mirrored in. True ones of 0.3 to 0.9 correlate with it, only less."""

LEAST_LIGHT = 0.01
"""Part of the median irradiance that reaches every point at least, from other surfaces."""

LARGEST_CHANGE = 0.5
"""Changes from view to view are cut at this part of a point's own luminance: beyond are errors of matching."""

NEIGHBORS = 16
"""Neighbours that a point is compared with: over a few, shading hardly changes; over many, paint does."""

BLOCKS = 32
LEAST_IN_BLOCK = 8
"""Parts of the surface that are left out in turn, and fewest points in one: parts much larger than the distance of
neighbours err independently."""

CHANCE = 0.05
"""Probability of a wrong verdict about a light that is right."""

LEAST_GAIN = 0.01
"""Difference of misfit that matters: a light that explains a capture 1 % better is as good."""

VIEW_THREADS = 8
"""Views whose highlights are worked out at a time."""

GLOSSY_PART = 0.01
"""Change of luminance from view to view, of what is seen, above which gloss can be told from noise: 0.07 to 0.09 in
captures."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LightEvidence:
    """Evidence of some points on the light; cells are those of a lat-long grid, row-major.

    Attributes:
        positions: Of the points [m], ``(M, 3)``.
        normals: Unit, ``(M, 3)``.
        openness: Visibility towards each of `LIGHT_ROWS` x `LIGHT_COLUMNS` cells, in [0, 1], ``(M, L)``.
        colors: Scene-linear radiance towards each view, ``(V, M, 3)``.
        weights: Of the same, 0 where a view does not see the point, ``(V, M)``.
        directions: Unit, towards each view, ``(V, M, 3)``.
    """

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    openness: NDArray[np.float32]
    colors: NDArray[np.float32]
    weights: NDArray[np.float32]
    directions: NDArray[np.float32]

    def some(self, rows: NDArray[Any] | slice) -> LightEvidence:
        """Return the evidence of some of the points."""
        by_point = {name: getattr(self, name)[rows] for name in ("positions", "normals", "openness")}
        by_view = {name: getattr(self, name)[:, rows] for name in ("colors", "weights", "directions")}
        return LightEvidence(**by_point, **by_view)


@dataclass(frozen=True, eq=False)
class LightFits:
    """Fits of some lights to evidence.

    Attributes:
        spreads: Mean absolute difference of the logarithms of neighbours' base colours, ``(lights,)``.
        gloss: Correlation of changes from view to view with those expected, ``(lights,)``; 0 where nothing changes.
        misfits: log(spread) + log(1 - gloss²) / 2, logarithms of what is left unexplained of either, ``(lights,)``.
        left_out: The same without each of some parts of the surface, ``(parts, lights)``.
    """

    spreads: NDArray[np.float64]
    gloss: NDArray[np.float64]
    misfits: NDArray[np.float64]
    left_out: NDArray[np.float64]

    @classmethod
    def of(cls, shown: LightEvidence, lights: NDArray[np.float64]) -> LightFits:
        """Fit lights of ``(lights, L, 3)`` radiance to points that views show, at least `LEAST_IN_BLOCK` of them."""
        blocks = parts_of(shown.positions)
        apart, pairs = neighbor_differences(shown, _base_colors(shown, lights), blocks, NEIGHBORS)
        sums = BlockSums(apart, pairs, *glossy_sums(shown, lights, blocks))
        left_out = np.stack([sums.misfits(without=block) for block in range(len(apart))])
        return cls(sums.spreads(), sums.gloss(), sums.misfits(), left_out)

    def clearly(self, better: int, worse: int) -> float:
        """Return how much better a light fits than another, over what chance may make of it: above 1 is a verdict."""
        differences = self.left_out[:, worse] - self.left_out[:, better]
        count = len(differences)
        deviation = np.sqrt((count - 1) * differences.var())
        # Whichever of the lights fits best by chance.
        chance = stdtrit(count - 1, 1.0 - CHANCE / len(self.misfits)) * deviation
        return float((self.misfits[worse] - self.misfits[better]) / max(chance, LEAST_GAIN))


@dataclass(frozen=True, eq=False)
class BlockSums:
    """Sums over the points of each part of the surface under each light; of all parts they give its misfit.

    Attributes:
        apart: Absolute differences of neighbours' base colours, ``(B, lights)``.
        pairs: How many neighbours they are of, ``(B, 1)``.
        met: Products of changes from view to view with those expected, ``(B, lights)``.
        expected: Squares of those expected, ``(B, lights)``.
        seen: Squares of those seen, ``(B, 1)``.
    """

    apart: NDArray[np.float64]
    pairs: NDArray[np.float64]
    met: NDArray[np.float64]
    expected: NDArray[np.float64]
    seen: NDArray[np.float64]

    def spreads(self, *, without: int | None = None) -> NDArray[np.float64]:
        """Return the mean difference of neighbours' base colours, ``(lights,)``, with or without a part."""
        return _total(self.apart, without) / np.maximum(_total(self.pairs, without), 1.0)

    def gloss(self, *, without: int | None = None) -> NDArray[np.float64]:
        """Return the correlation of changes from view to view with those expected, ``(lights,)``."""
        power = _total(self.expected, without) * _total(self.seen, without)
        return _total(self.met, without) / np.sqrt(np.maximum(power, 1e-30))

    def misfits(self, *, without: int | None = None) -> NDArray[np.float64]:
        """Return log(spread) + log(1 - gloss²) / 2: logarithms of what is left unexplained of either."""
        spread = np.log(np.maximum(self.spreads(without=without), 1e-6))
        return spread + 0.5 * np.log1p(-(np.clip(self.gloss(without=without), 0.0, 0.999) ** 2))


def _total(sums: NDArray[np.float64], without: int | None) -> NDArray[np.float64]:
    """Return the sum over all parts, or all but one."""
    return sums.sum(axis=0) - (0.0 if without is None else sums[without])


def _by_block(values: NDArray[np.floating], blocks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Add up rows of ``(M, K)`` values by the part of the surface that they belong to, ``(B, K)``."""
    sums = np.zeros((int(blocks.max()) + 1, values.shape[1]))
    np.add.at(sums, blocks, values)
    return sums


def parts_of(positions: NDArray[np.float32], most: int = BLOCKS) -> NDArray[np.int64]:
    """Return which part of the surface each point belongs to, ``(M,)``: at most ``most``, none of them small."""
    tree = cKDTree(positions)
    blocks = np.zeros(tree.n, np.int64)
    for number, rows in enumerate(np.array_split(tree.indices, max(1, min(most, tree.n // LEAST_IN_BLOCK)))):
        blocks[rows] = number
    return blocks


def neighbor_differences(
    shown: LightEvidence, base: NDArray[np.float64], blocks: NDArray[np.int64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sums of absolute differences of neighbours' base colours by block, and how many neighbours there are.

    Neighbours that face away from each other are on two sides of a thin part, which are painted apart.

    Args:
        shown: The points.
        base: Logarithms of their base colours under some lights, ``(M, K)``.
        blocks: Part of the surface of each, ``(M,)``.
        count: Neighbours that each point is compared with.

    Returns:
        Sums ``(B, K)`` and counts ``(B, 1)``.
    """
    first, second = neighbor_pairs(shown, count)
    apart = np.zeros((int(blocks.max()) + 1, base.shape[1]))
    for light in range(base.shape[1]):
        apart[:, light] = np.bincount(blocks[first], np.abs(base[first, light] - base[second, light]), len(apart))
    return apart, np.bincount(blocks[first], minlength=len(apart)).astype(np.float64)[:, None]


def neighbor_pairs(shown: LightEvidence, count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of neighbours that do not face away from each other, each once: rows of the one and the other."""
    tree, normals = cKDTree(shown.positions), shown.normals
    _, near = tree.query(tree.data, k=min(count + 1, tree.n), workers=-1)
    ends = np.repeat(np.arange(tree.n), near.shape[1]), near.reshape(-1)
    first, second = np.divmod(np.unique(np.minimum(*ends) * tree.n + np.maximum(*ends)), tree.n)
    facing = (first != second) & ((normals[first] * normals[second]).sum(axis=1) > 0.0)
    return first[facing], second[facing]


def well_shown(evidence: LightEvidence) -> LightEvidence:
    """Return the points that views show, grazing views counting little."""
    facing = np.einsum("vmk,mk->vm", evidence.directions, evidence.normals)
    weights = evidence.weights * np.clip((facing - 0.2) / 0.3, 0.0, 1.0)
    asked = (weights.sum(axis=0) > 0.0) & ((weights * (evidence.colors @ LUMINANCE)).sum(axis=0) > 0.0)
    return replace(evidence, weights=weights).some(asked)


def mean_colors(shown: LightEvidence) -> NDArray[np.float64]:
    """Return the mean radiance of points over views, ``(M, 3)``."""
    return np.einsum("vm,vmc->mc", shown.weights, shown.colors) / shown.weights.sum(axis=0)[:, None]


def irradiance_over_pi(shown: LightEvidence, light: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return what a white diffuser at each point reflects of a light of ``(L, K)`` radiance, ``(M, K)``."""
    diffuse = np.maximum(shown.normals @ cell_directions().T, 0.0) * shown.openness * cell_angles()
    return diffuse @ light.astype(np.float32) / np.float32(np.pi)  # pyright: ignore[reportReturnType]  # float32: NumPy says float64 of a division


def turned_lights(environment: EnvironmentMap) -> NDArray[np.float64]:
    """Return an environment under every turn by whole cells, its mirror images, and an even light, ``(., L, 3)``."""
    cells = environment.resized(LIGHT_ROWS, LIGHT_COLUMNS).radiance.astype(np.float64)
    turns = [np.roll(hand, -turn, axis=1) for hand in (cells, cells[:, ::-1]) for turn in range(LIGHT_COLUMNS)]
    even = np.broadcast_to(environment.mean_radiance(), cells.shape)
    return np.stack([*turns, even]).reshape(len(turns) + 1, -1, 3)


def cell_directions() -> NDArray[np.float32]:
    """Return unit directions of the cells, ``(L, 3)``."""
    return texel_directions(LIGHT_ROWS, LIGHT_COLUMNS).reshape(-1, 3).astype(np.float32)


def cell_angles() -> NDArray[np.float32]:
    """Return solid angles of the cells [sr]."""
    rows = (2.0 * np.pi / LIGHT_COLUMNS) * -np.diff(np.cos(np.linspace(0.0, np.pi, LIGHT_ROWS + 1)))
    return np.repeat(rows, LIGHT_COLUMNS).astype(np.float32)


def mirrored(shown: LightEvidence, lights: NDArray[np.float64], roughness: float) -> NDArray[np.float32]:
    """Return the luminance that points mirror towards views under each light, ``(V, M, lights)``; GGX, n = 1.5.

    What hides the light is mirrored too, with the mean colour of all points.
    """
    cells = cell_directions()
    by_light = (lights @ LUMINANCE).T.astype(np.float32)
    hidden = np.float32(mean_colors(shown).mean(axis=0) @ LUMINANCE)
    reach = np.maximum(shown.normals @ cells.T, 0.0)
    angles, power = cell_angles(), np.float32(roughness**4)
    result = np.zeros((len(shown.directions), len(reach), len(lights)), np.float32)

    def show(view: int) -> None:
        rows = np.flatnonzero(shown.weights[view] > 0.0)
        toward, arriving, openness = shown.directions[view, rows], reach[rows], shown.openness[rows]
        # |v + l|² = 2 + 2 v.l, so that no half vector is formed
        double = np.sqrt(np.maximum(2.0 + 2.0 * (toward @ cells.T), 1e-6))
        cosine = np.maximum(np.einsum("mk,mk->m", shown.normals[rows], toward), 0.05)[:, None]
        n_h = np.minimum((cosine + arriving) / double, 1.0)
        lobe = power / (np.pi * (n_h * n_h * (power - 1.0) + 1.0) ** 2)
        masking = 0.5 / (
            arriving * np.sqrt(cosine**2 * (1.0 - power) + power)
            + cosine * np.sqrt(arriving**2 * (1.0 - power) + power)
        )
        transfer = lobe * masking * dielectric_fresnel(np.minimum(0.5 * double, 1.0)) * arriving * angles
        result[view, rows] = (transfer * openness) @ by_light
        result[view, rows] += hidden * (transfer * (1.0 - openness)).sum(axis=1)[:, None]

    with ThreadPoolExecutor(VIEW_THREADS) as pool:
        list(pool.map(show, range(len(result))))
    return result


def dielectric_fresnel(cosine: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the part of unpolarised light that a surface of index 1.5 reflects, by the cosine of incidence."""
    inner = np.sqrt(cosine * cosine + np.float32(1.25))
    across = (inner - cosine) / (inner + cosine)
    along = (cosine * (inner + cosine) - 1.0) / (cosine * (inner - cosine) + 1.0)
    return 0.5 * across**2 * (1.0 + along**2)


def _base_colors(shown: LightEvidence, lights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logarithm of base colour under each light, up to a constant, ``(M, lights)``."""
    irradiance = irradiance_over_pi(shown, (lights @ LUMINANCE).T)
    least = np.maximum(LEAST_LIGHT * np.median(irradiance, axis=0), 1e-12)
    observed = np.log(mean_colors(shown) @ LUMINANCE)
    return observed[:, None] - np.log(np.maximum(irradiance, least).astype(np.float64))


def glossy_sums(
    shown: LightEvidence, lights: NDArray[np.float64], blocks: NDArray[np.int64], roughness: float = GLOSS_ROUGHNESS
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return what `BlockSums` holds of changes from view to view: met, expected, seen."""
    weights, total = shown.weights, shown.weights.sum(axis=0)
    # Relative to what a point shows on the whole: bright points must not decide alone.
    observed = mean_colors(shown) @ LUMINANCE
    relative = 1.0 / np.maximum(observed, 0.02 * np.median(observed))

    def changes(luminance: NDArray[np.floating]) -> NDArray[np.floating]:
        mean = (weights * luminance).sum(axis=0) / total
        return np.clip((luminance - mean) * relative, -LARGEST_CHANGE, LARGEST_CHANGE)

    found = changes(shown.colors @ LUMINANCE)
    seen = _by_block((weights * found**2).sum(axis=0)[:, None], blocks)
    sums = np.zeros((2, len(seen), len(lights)))
    if seen.sum() > GLOSSY_PART**2 * float(weights.sum()):
        reflected = mirrored(shown, lights, roughness)
        for index in range(len(lights)):
            expected = changes(reflected[..., index])
            both = np.stack([(weights * expected * found).sum(axis=0), (weights * expected**2).sum(axis=0)], axis=1)
            sums[..., index] = _by_block(both, blocks).T
    return sums[0], sums[1], seen
