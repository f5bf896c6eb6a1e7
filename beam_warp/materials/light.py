"""Check that a stated environment fits its capture: its turn, its handedness, its scale, its range.

Two criteria need no base colours. Observed colours divided by the shading of the right light are base colours, in which
most neighbours are alike; under another light, its shading is left between them. Changes of a point's colour from view
to view are gloss: whatever the base colour, they must follow the light that the views see mirrored. Both are linear in
the light, so that all turns of an environment cost two matrix products.

Every verdict compares the light as stated with another one on the same points: what paint, noise and normals do to both
cancels. The standard error of the difference comes from leaving out one part of the surface after the other. A verdict
is given only where chance would hardly give it once in twenty captures, whichever of the other lights fits best.
Otherwise the check is silent: an even light has no turn, a matt ball under a broad light says little.

Source: shading removed by division, as in intrinsic images; sparse changes of paint, Land and McCann 1971; the
jackknife, Efron and Stein 1981.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import t as student

from beam_warp.capture.findings import Finding, count_of
from beam_warp.checks import require_count
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import LUMINANCE, linear_to_srgb
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.materials.normals import SurfacePoints
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import visibility
from beam_warp.world.environment import EnvironmentMap, texel_directions

LIGHT_ROWS, LIGHT_COLUMNS = 16, 32
"""Cells that the light is averaged over; a turn by one column is 11.25 degrees, turns between are interpolated."""

LEAST_POINTS = 64
"""Fewest Gaussians that say anything about light."""

LEAST_VIEWS = 4
"""Fewest views: one side of a subject alone is explained by many lights."""

MOST_VIEWS = 12
"""Views that gloss is looked at in: what more of them say costs more than it tells."""

WELL_SEEN = 2.0
AGREEMENT = 0.9
UNCUT = 0.1
"""Pixels by blending weights, agreement of normals and largest saturated part of Gaussians that are asked."""

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

NEAR = 1
"""Turns, in columns, that count as none: neither lights nor normals are known better than by a cell."""

GLOSSY_PART = 0.01
"""Change of luminance from view to view, of what is seen, above which gloss can be told from noise: 0.07 to 0.09 in
captures."""

WELL_LIT = 0.5
BRIGHT, BRIGHTEST = 0.75, 0.95
"""Part of the mean irradiance from which on a Gaussian counts as well lit; quantiles of the largest channel of base
colour over those Gaussians."""

TOO_BRIGHT = 1.1
TOO_DARK = 0.05
PLAUSIBLE = 0.7
"""Quantile `BRIGHT` above which light is stated too dim, `BRIGHTEST` below which too bright, and what the proposed
exposure makes of the former. The former is 0.66 to 0.99 with the true light, on a figure in white clothes too; nothing
but charcoal is below 0.05."""


FEW_VALUES = 16
EIGHT_BIT = 256
CUT_PART = 1e-3
STEP_SLACK = 0.07
"""Distinct values up to which a map is a drawing, and up to which it may come from 8 bits; part of a map at its largest
value from which on it was cut: a high-dynamic-range map has a texel or two there, of thousands; how far values may be
from whole steps of 8 bits: a half float, rounded by 2^-12 of its value, is off by up to 255 / 2^12 = 0.06 steps where
files are linear and 0.03 in sRGB."""


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


@dataclass(frozen=True, kw_only=True)
class LightCheck:
    """Fit of an environment to a capture.

    Attributes:
        best_rotation_degrees: Turn by which it fits best, as `EnvironmentMap.rotated` takes it, in (-180, 180]; of
            the mirrored map if ``is_mirrored``.
        is_mirrored: Whether it fits best with its columns in reverse order.
        spread_as_given: Mean absolute difference of the logarithms of neighbours' base colours.
        spread_best: The same at the best turn.
        spread_even: The same under a light that is the same from all sides.
        gloss_as_given: Correlation of what changes from view to view with the gloss expected; 0 where nothing does.
        gloss_best: The same at the best turn.
        misfit_as_given: Logarithm of how much is left unexplained by either, above the best turn's.
        certainty: Difference of misfit between the light as stated, or nearly so, and the best of all others, over the
            difference that chance may make; above 1 the light is not the one that was stated.
        exposure_stops: Exposure that base colours as a whole ask for; 0 where they are plausible as they are.
        point_count: How many Gaussians were asked.
        findings: What is wrong; a check that could judge nothing says here why, and is 0 elsewhere.
    """

    best_rotation_degrees: float = 0.0
    is_mirrored: bool = False
    spread_as_given: float = 0.0
    spread_best: float = 0.0
    spread_even: float = 0.0
    gloss_as_given: float = 0.0
    gloss_best: float = 0.0
    misfit_as_given: float = 0.0
    certainty: float = 0.0
    exposure_stops: float = 0.0
    point_count: int
    findings: tuple[Finding, ...] = ()


def check_light(
    scene: Scene, points: SurfacePoints, views: ViewEvidence, environment: EnvironmentMap, *, subset: int = 1024
) -> LightCheck:
    """Ask well-seen Gaussians whether an environment is the light that they were captured under.

    Args:
        scene: The Gaussians, uploaded.
        points: Their points on the surface.
        views: What views show of them, with images.
        environment: The light as stated.
        subset: Most Gaussians to ask, spread evenly over the cloud.

    Raises:
        InvalidArrayError: There are no images.
        InvalidOptionError: ``subset`` is out of range.
    """
    require_count("subset", subset, LEAST_POINTS, 65_536)
    if not views.colors.shape[0]:
        raise InvalidArrayError("views must have images to check the light, got none. Give the captured images.")
    return judge_light(light_evidence(scene, points, views, subset), environment)


def light_evidence(scene: Scene, points: SurfacePoints, views: ViewEvidence, subset: int) -> LightEvidence:
    """Collect what well-seen Gaussians show, and towards which cells of the sphere they are open."""
    good = views.seen & (views.weight > WELL_SEEN) & (points.confidence > AGREEMENT) & (views.saturated < UNCUT)
    rows = np.flatnonzero(good)
    if len(rows) > subset:
        rows = rows[np.linspace(0, len(rows) - 1, subset).astype(np.int64)]
    count = views.colors.shape[0]
    chosen = np.unique(np.linspace(0, count - 1, min(count, MOST_VIEWS)).astype(np.int64))
    seen = views.colors.numpy()[chosen][:, rows]
    normals = points.normals.numpy()[rows]
    origins = points.positions.numpy()[rows] + normals * points.offsets.numpy()[rows][:, None]
    cells = _cell_directions()
    point, cell = np.nonzero(normals @ cells.T > 0.0)
    openness = np.zeros((len(rows), len(cells)), np.float32)
    openness[point, cell] = visibility(scene, origins[point].astype(np.float32), cells[cell])
    return LightEvidence(
        positions=points.positions.numpy()[rows],
        normals=normals,
        openness=openness,
        colors=seen[..., :3],
        weights=seen[..., 3],
        directions=views.directions.numpy()[chosen][:, rows],
    )


def judge_light(evidence: LightEvidence, environment: EnvironmentMap) -> LightCheck:
    """Compare an environment with its turns and mirror images.

    The misfit is log(spread) + log(1 - gloss²) / 2: logarithms of what is left unexplained of either.
    """
    facing = np.einsum("vmk,mk->vm", evidence.directions, evidence.normals)
    weights = evidence.weights * np.clip((facing - 0.2) / 0.3, 0.0, 1.0)
    luminance = evidence.colors @ LUMINANCE.astype(np.float32)
    total = weights.sum(axis=0)
    observed = (weights * luminance).sum(axis=0) / np.maximum(total, 1e-12)
    asked = (total > 0.0) & (observed > 0.0)
    count = int(asked.sum())
    if not environment.radiance.any():
        remedy = "Check its exposure and the file; nothing can be measured without light."
        finding = Finding("error", "environment-black", "environment is black", remedy=remedy)
        return LightCheck(point_count=count, findings=(finding,))
    if count < LEAST_POINTS or len(weights) < LEAST_VIEWS:
        what = (
            f"environment is not checked: {count} Gaussians are seen well in {count_of(len(weights), 'view')}, "
            f"{LEAST_POINTS} and {LEAST_VIEWS} are needed"
        )
        remedy = "More views, or views from nearer, would allow it."
        return LightCheck(point_count=count, findings=(Finding("note", "light-unchecked", what, remedy=remedy),))
    weights, total, observed, luminance = weights[:, asked], total[asked], observed[asked], luminance[:, asked]
    normals, openness = evidence.normals[asked], evidence.openness[asked]
    lights = _turns(environment)
    tree = cKDTree(evidence.positions[asked])
    blocks = np.empty(count, np.int64)
    parts = np.array_split(tree.indices, min(BLOCKS, count // LEAST_IN_BLOCK))
    for number, rows in enumerate(parts):
        blocks[rows] = number
    # what each cell's radiance adds to the irradiance of each point
    diffuse = np.maximum(normals @ _cell_directions().T, 0.0) * openness * _cell_angles()
    irradiance = diffuse @ (lights @ LUMINANCE).T.astype(np.float32) / np.float32(np.pi)
    apart, pairs = _differences(tree, normals, _base_colors(observed, irradiance), blocks)
    # Relative to what a point shows on the whole: bright points must not decide alone.
    relative = 1.0 / np.maximum(observed, 0.02 * np.median(observed))
    changes = _cut(_centered(luminance, weights, total) * relative)
    seen = _by_block((weights * changes**2).sum(axis=0)[:, None], blocks)
    met, expected_power = np.zeros_like(apart), np.zeros_like(apart)
    if seen.sum() > GLOSSY_PART**2 * float(weights.sum()):
        mirrored = _mirrored(normals, openness, evidence.directions[:, asked], lights)
        for index in range(len(lights)):
            expected = _cut(_centered(mirrored[..., index], weights, total) * relative)
            both = np.stack([(weights * expected * changes).sum(axis=0), (weights * expected**2).sum(axis=0)], axis=1)
            met[:, index], expected_power[:, index] = _by_block(both, blocks).T
    sums = BlockSums(apart, pairs, met, expected_power, seen)
    whole, left_out = sums.misfits(), np.stack([sums.misfits(without=block) for block in range(len(parts))])

    def clearly(better: int, worse: int) -> float:
        """Return how much better a light fits than another, over what chance may make of it."""
        differences = left_out[:, worse] - left_out[:, better]
        deviation = np.sqrt((len(parts) - 1) * differences.var())
        chance = student.ppf(1.0 - CHANCE / len(lights), len(parts) - 1) * deviation
        return float((whole[worse] - whole[better]) / max(chance, LEAST_GAIN))

    here, there = int(np.argmin(whole[:LIGHT_COLUMNS])), LIGHT_COLUMNS + int(np.argmin(whole[LIGHT_COLUMNS:EVEN]))
    best, other = (there, here) if clearly(there, here) > 1.0 else (here, there)
    near = np.arange(-NEAR, NEAR + 1) % LIGHT_COLUMNS
    stated = int(near[np.argmin(whole[near])])
    others = np.setdiff1d(np.arange(EVEN), near)
    rival = int(others[np.argmin(whole[others])])
    spread, gloss = sums.spreads(), sums.gloss()
    turns = {
        turn: _refined(whole[:EVEN].reshape(2, -1)[turn // LIGHT_COLUMNS], turn % LIGHT_COLUMNS)
        for turn in (best, other)
    }
    check = LightCheck(
        best_rotation_degrees=turns[best],
        is_mirrored=best >= LIGHT_COLUMNS,
        spread_as_given=float(spread[0]),
        spread_best=float(spread[best]),
        spread_even=float(spread[EVEN]),
        gloss_as_given=float(gloss[0]),
        gloss_best=float(gloss[best]),
        misfit_as_given=float(whole[0] - whole[best]),
        certainty=clearly(rival, stated),
        exposure_stops=_exposure_stops(
            (weights[..., None] * evidence.colors[:, asked]).sum(axis=0) / total[:, None],
            diffuse @ lights[best].astype(np.float32) / np.float32(np.pi),
        ),
        point_count=count,
    )
    is_unlike = min(clearly(EVEN, here), clearly(EVEN, there)) > 1.0
    fits = [best] if clearly(best, other) > 1.0 else [best, other]
    return replace(check, findings=tuple(_findings(check, is_unlike, [(t >= LIGHT_COLUMNS, turns[t]) for t in fits])))


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


def _differences(
    tree: cKDTree, normals: NDArray[np.float32], base: NDArray[np.float64], blocks: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sums of absolute differences of neighbours' base colours by block, and how many neighbours there are.

    Neighbours that face away from each other are on two sides of a thin part, which are painted apart.
    """
    _, near = tree.query(tree.data, k=min(NEIGHBORS + 1, tree.n))
    pairs = np.stack([np.repeat(np.arange(tree.n), near.shape[1]), near.reshape(-1)], axis=1)
    first, second = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0).T
    facing = (normals[first] * normals[second]).sum(axis=1) > 0.0
    first, second = first[facing], second[facing]
    apart = np.zeros((int(blocks.max()) + 1, base.shape[1]))
    for light in range(base.shape[1]):
        apart[:, light] = np.bincount(blocks[first], np.abs(base[first, light] - base[second, light]), len(apart))
    return apart, np.bincount(blocks[first], minlength=len(apart)).astype(np.float64)[:, None]


def looks_like_ldr(environment: EnvironmentMap) -> Finding | None:
    """Detect a display-referred picture that was given as light: cut at white, or from 8 bits whatever its scale.

    Uniform maps and those of a few colours are taken for what they are.
    """
    radiance = environment.radiance
    brightest = float(radiance.max())
    values = np.unique(radiance)
    at_top = float((radiance.max(axis=-1) >= brightest).mean())
    if len(values) <= FEW_VALUES:
        return None
    if brightest <= 1.0 and at_top >= CUT_PART:
        why = f"never exceeds {brightest:.3g}, and {at_top:.1%} of it is exactly at that: it was cut at white"
    elif len(values) <= EIGHT_BIT and any(
        np.abs(steps - np.round(steps)).max() < STEP_SLACK
        for steps in (255.0 * values / brightest, 255.0 * linear_to_srgb(values / brightest))
    ):
        why = f"has no more than {len(values)} values, in the steps of an 8-bit picture"
    else:
        return None
    return Finding(
        "warning",
        "ldr-environment",
        f"environment {why}",
        remedy="Its light sources are missing. Use the high-dynamic-range file that it was made from; without one "
        "shadows are too soft and base colours too bright, whatever its --exposure.",
    )


def _cell_directions() -> NDArray[np.float32]:
    return texel_directions(LIGHT_ROWS, LIGHT_COLUMNS).reshape(-1, 3).astype(np.float32)


def _cell_angles() -> NDArray[np.float32]:
    """Return solid angles of the cells [sr]."""
    rows = (2.0 * np.pi / LIGHT_COLUMNS) * -np.diff(np.cos(np.linspace(0.0, np.pi, LIGHT_ROWS + 1)))
    return np.repeat(rows, LIGHT_COLUMNS).astype(np.float32)


def _turns(environment: EnvironmentMap) -> NDArray[np.float64]:
    """Return an environment under every turn by whole cells, its mirror images, and an even light, ``(., L, 3)``."""
    cells = environment.resized(LIGHT_ROWS, LIGHT_COLUMNS).radiance.astype(np.float64)
    turns = [np.roll(hand, -turn, axis=1) for hand in (cells, cells[:, ::-1]) for turn in range(LIGHT_COLUMNS)]
    even = np.broadcast_to(environment.mean_radiance(), cells.shape)
    return np.stack([*turns, even]).reshape(len(turns) + 1, -1, 3)


def _mirrored(
    normals: NDArray[np.float32],
    openness: NDArray[np.float32],
    directions: NDArray[np.float32],
    lights: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the luminance that points mirror towards views, under each light, ``(V, M, lights)``; GGX, F0 = 0.04."""
    cells = _cell_directions()
    by_light = (lights @ LUMINANCE).T.astype(np.float32)
    reach = np.maximum(normals @ cells.T, 0.0)
    power = np.float32(GLOSS_ROUGHNESS**4)
    result = np.empty((len(directions), len(normals), len(lights)), np.float32)
    for view, toward in enumerate(directions):
        # |v + l|² = 2 + 2 v.l, so that no half vector is formed
        double = np.sqrt(np.maximum(2.0 + 2.0 * (toward @ cells.T), 1e-6))
        cosine = np.maximum(np.einsum("mk,mk->m", normals, toward), 0.05)[:, None]
        n_h = (cosine + reach) / double
        fresnel = 0.04 + 0.96 * (1.0 - np.clip(0.5 * double, 0.0, 1.0)) ** 5
        lobe = power / (np.pi * (n_h * n_h * (power - 1.0) + 1.0) ** 2)
        masking = 0.5 / (
            reach * np.sqrt(cosine**2 * (1.0 - power) + power) + cosine * np.sqrt(reach**2 * (1.0 - power) + power)
        )
        transfer = lobe * masking * fresnel * reach * openness * _cell_angles()
        result[view] = transfer.astype(np.float32) @ by_light
    return result


def _centered(
    values: NDArray[np.float32], weights: NDArray[np.float32], total: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return what changes of ``(V, M)`` values from view to view."""
    return values - (weights * values).sum(axis=0) / total


def _cut(changes: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.clip(changes, -LARGEST_CHANGE, LARGEST_CHANGE)


def _base_colors(observed: NDArray[np.float32], irradiance: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the logarithm of base colour under each light, up to a constant, ``(M, lights)``."""
    least = np.maximum(LEAST_LIGHT * np.median(irradiance, axis=0), 1e-12)
    return np.log(observed.astype(np.float64))[:, None] - np.log(np.maximum(irradiance, least).astype(np.float64))


def _refined(misfits: NDArray[np.float64], best: int) -> float:
    """Return the turn of the least misfit [degree], by a parabola through the best and its neighbours."""
    before, here, after = (misfits[(best + step) % len(misfits)] for step in (-1, 0, 1))
    bend = before - 2.0 * here + after
    turn = best + (0.5 * (before - after) / bend if bend > 0.0 else 0.0)
    degrees = float(turn * 360.0 / LIGHT_COLUMNS)
    return degrees - 360.0 if degrees > 180.0 else degrees


def _exposure_stops(colors: NDArray[np.float32], irradiance: NDArray[np.float32]) -> float:
    """Return the exposure of the light that makes base colours plausible [stops]."""
    mean = irradiance.mean(axis=1)
    lit = mean > WELL_LIT * mean.mean()
    if not lit.any():
        return 0.0
    base = (colors[lit] / np.maximum(irradiance[lit], 1e-12)).max(axis=1)
    bright, brightest = (max(float(value), 1e-9) for value in np.quantile(base, (BRIGHT, BRIGHTEST)))
    if bright > TOO_BRIGHT:
        return float(np.log2(bright / PLAUSIBLE))
    return float(np.log2(brightest / PLAUSIBLE)) if brightest < TOO_DARK else 0.0


def _findings(check: LightCheck, is_unlike: bool, fits: Sequence[tuple[bool, float]]) -> list[Finding]:
    """Return findings about a light; if it does not fit at all, neither its turn nor its exposure mean anything.

    Args:
        check: What was found.
        is_unlike: Whether an even light explains the capture better than any turn.
        fits: Turns that explain it best, the best first: whether mirrored, and by how much [degree].
    """
    if is_unlike:
        return [
            Finding(
                "warning",
                "environment-unexplained",
                "environment does not explain the capture under any turn: a light that is the same from all sides "
                f"explains it better, with a spread of base colours of {check.spread_even:.2f}, not "
                f"{check.spread_best:.2f}",
                remedy="Check that it is the light of this capture.",
            )
        ]
    findings = []
    if check.certainty > 1.0:
        ways = [f"{'mirrored and ' if mirrored else ''}turned by {turn:+.0f} degrees" for mirrored, turn in fits]
        findings.append(
            Finding(
                "warning",
                "environment-turned",
                f"environment explains the capture {np.exp(check.misfit_as_given):.2f} times better "
                f"{', or '.join(ways)} about the up axis",
                remedy="Check its convention: the centre of the image is +x, its left quarter +y. Turn it by that; to "
                "mirror it, reverse its columns first.",
            )
        )
    if check.exposure_stops:
        dim = check.exposure_stops > 0.0
        findings.append(
            Finding(
                "warning",
                "environment-exposure",
                f"environment seems {abs(check.exposure_stops):.1f} stops too {'dim' if dim else 'bright'}: base "
                f"colours would be {'above 1' if dim else 'below 0.05'}",
                remedy="Scale it by --exposure, or use the high-dynamic-range file in the units of the images.",
            )
        )
    return findings
