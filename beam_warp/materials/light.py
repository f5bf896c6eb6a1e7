"""Check that a stated environment fits its capture: its turn, its handedness, its scale, its range.

Every verdict compares the light as stated with another one (`beam_warp.materials.light_fits`). It is given only where
chance would hardly give it once in twenty captures, whichever of the other lights fits best. Otherwise the check is
silent: an even light has no turn, a matt ball under a broad light says little.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.findings import Finding, count_of
from beam_warp.checks import require_count
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import linear_to_srgb
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.materials.light_fits import (
    EVEN,
    LEAST_POINTS,
    LEAST_VIEWS,
    LIGHT_COLUMNS,
    LightEvidence,
    LightFits,
    cell_directions,
    irradiance_over_pi,
    mean_colors,
    turned_lights,
    well_shown,
)
from beam_warp.materials.light_turn import missing_light, turned_cells, weaker_explains
from beam_warp.materials.normals import SurfacePoints
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import visibility
from beam_warp.world.environment import EnvironmentMap

ASKED = 2048
"""Most Gaussians to ask, spread evenly over the cloud."""

MOST_VIEWS = 12
"""Views that gloss is looked at in: what more of them say costs more than it tells."""

WELL_SEEN = 2.0
AGREEMENT = 0.9
UNCUT = 0.1
"""Pixels by blending weights, agreement of normals and largest saturated part of Gaussians that are asked."""

NEAR = 1
"""Turns, in columns, that count as none: neither lights nor normals are known better than by a cell."""

WELL_LIT = 0.5
BRIGHT, BRIGHTEST = 0.75, 0.95
"""Part of the mean irradiance from which on a Gaussian counts as well lit; quantiles of the largest channel of base
colour over those Gaussians."""

TOO_BRIGHT = 1.1
TOO_DARK = 0.05
PLAUSIBLE = 0.7
DARKEST = 0.04
"""Quantile `BRIGHT` above which light is stated too dim, `BRIGHTEST` below which too bright, and what the proposed
exposure makes of the former. The former is 0.66 to 0.99 with the true light, on a figure in white clothes too; nothing
but charcoal is below 0.05. `DARKEST` is what the surface of a dielectric reflects, whatever is below it."""


FEW_VALUES = 16
EIGHT_BIT = 256
CUT_PART = 1e-3
STEP_SLACK = 0.07
"""Distinct values up to which a map is a drawing, and up to which it may come from 8 bits; part of a map at its largest
value from which on it was cut: a high-dynamic-range map has a texel or two there, of thousands; how far values may be
from whole steps of 8 bits: a half float, rounded by 2^-12 of its value, is off by up to 255 / 2^12 = 0.06 steps where
files are linear and 0.03 in sRGB."""


@dataclass(frozen=True, kw_only=True)
class LightCheck:
    """Fit of an environment to a capture.

    Attributes:
        best_rotation_degrees: Turn by which it fits best, as `EnvironmentMap.rotated` takes it, in (-180, 180]; of
            the mirrored map if ``is_mirrored``.
        is_mirrored: Whether it fits best with its columns in reverse order.
        spread_best: Mean absolute difference of the logarithms of neighbours' base colours at the best turn.
        spread_even: The same under a light that is the same from all sides.
        gloss_best: Correlation of what changes from view to view with the gloss expected at the best turn; 0 where
            nothing does.
        misfit_as_given: Logarithm of how much is left unexplained by either, above the best turn's.
        certainty: Difference of misfit between the light as stated, or nearly so, and the best of all others, over the
            difference that chance may make; above 1 the light is not the one that was stated.
        exposure_stops: Exposure that base colours as a whole ask for; 0 where they are plausible as they are.
        point_count: How many Gaussians were asked.
        findings: What is wrong; a check that could judge nothing says here why, and is 0 elsewhere.
    """

    best_rotation_degrees: float = 0.0
    is_mirrored: bool = False
    spread_best: float = 0.0
    spread_even: float = 0.0
    gloss_best: float = 0.0
    misfit_as_given: float = 0.0
    certainty: float = 0.0
    exposure_stops: float = 0.0
    point_count: int
    findings: tuple[Finding, ...] = ()

    @property
    def is_near(self) -> bool:
        """Whether the light fits as it is or turned by a few degrees: it explains, and no other turn does better."""
        codes = {finding.code for finding in self.findings}
        return not codes & {"environment-black", "environment-turned", "environment-unexplained", "light-unchecked"}


def check_light(
    scene: Scene, points: SurfacePoints, views: ViewEvidence, environment: EnvironmentMap, *, subset: int = ASKED
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


def light_evidence(scene: Scene, points: SurfacePoints, views: ViewEvidence, subset: int = ASKED) -> LightEvidence:
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
    cells = cell_directions()
    point, cell = np.nonzero(normals @ cells.T > 0.0)
    openness = np.zeros((len(rows), len(cells)), np.float32)
    openness[point, cell] = visibility(scene, origins[point].astype(np.float32), cells[cell], options=points.tracing)
    return LightEvidence(
        positions=points.positions.numpy()[rows],
        normals=normals,
        openness=openness,
        colors=seen[..., :3],
        weights=seen[..., 3],
        directions=views.directions.numpy()[chosen][:, rows],
    )


def judge_light(evidence: LightEvidence, environment: EnvironmentMap) -> LightCheck:
    """Compare an environment with its turns, its mirror images and an even light."""
    shown = well_shown(evidence)
    count, views = len(shown.normals), len(shown.weights)
    if not environment.radiance.any():
        remedy = "Check its exposure and the file; nothing can be measured without light."
        finding = Finding("error", "environment-black", "environment is black", remedy=remedy)
        return LightCheck(point_count=count, findings=(finding,))
    if count < LEAST_POINTS or views < LEAST_VIEWS:
        what = (
            f"environment is not checked: {count} Gaussians are seen well in {count_of(views, 'view')}, "
            f"{LEAST_POINTS} and {LEAST_VIEWS} are needed"
        )
        remedy = "More views, or views from nearer, would allow it."
        return LightCheck(point_count=count, findings=(Finding("note", "light-unchecked", what, remedy=remedy),))
    lights = turned_lights(environment)
    fits = LightFits.of(shown, lights)
    here, there = _best(fits, np.arange(LIGHT_COLUMNS)), _best(fits, np.arange(LIGHT_COLUMNS, EVEN))
    best, other = (there, here) if fits.clearly(there, here) > 1.0 else (here, there)
    near = np.arange(-NEAR, NEAR + 1) % LIGHT_COLUMNS
    rival = _best(fits, np.setdiff1d(np.arange(EVEN), near))
    check = LightCheck(
        best_rotation_degrees=_refined(fits, best),
        is_mirrored=best >= LIGHT_COLUMNS,
        spread_best=float(fits.spreads[best]),
        spread_even=float(fits.spreads[EVEN]),
        gloss_best=float(fits.gloss[best]),
        misfit_as_given=float(fits.misfits[0] - fits.misfits[best]),
        certainty=fits.clearly(rival, _best(fits, near)),
        exposure_stops=_exposure_stops(mean_colors(shown), irradiance_over_pi(shown, lights[best])),
        point_count=count,
    )
    is_unlike = all(_is_unlike(shown, fits, way, lights[way], environment) for way in (here, there))
    ways = [best] if fits.clearly(best, other) > 1.0 else [best, other]
    told = [f"{'mirrored and ' if way >= LIGHT_COLUMNS else ''}turned by {_refined(fits, way):+.0f}" for way in ways]
    return replace(check, findings=tuple(_findings(check, is_unlike, " degrees, or ".join(told))))


def _is_unlike(
    shown: LightEvidence, fits: LightFits, way: int, cells: NDArray[np.float64], environment: EnvironmentMap
) -> bool:
    """Return whether a light, at its best turn, leaves shading between neighbours that another light explains."""
    if weaker_explains(shown, cells) > 1.0:
        return True
    light = EnvironmentMap(environment.radiance[:, ::-1].copy()) if way >= LIGHT_COLUMNS else environment
    return missing_light(shown, turned_cells(light, np.array([_refined(fits, way)]))[:, 0]).is_certain


def possible_scales(evidence: LightEvidence, environment: EnvironmentMap) -> tuple[float, float]:
    """Return the least and the largest factor that all base colours could have under a light of another scale.

    Nothing reflects more than it gets, and a dielectric reflects no less than `DARKEST` of it. Only this bounds the
    scale of a light: highlights, which do not depend on base colour, would tell it, but how bright they are depends on
    roughness and on normals far more than a light that was measured is off.

    Returns:
        Factors by which base colours under this light may be multiplied; NaN where too little is seen.
    """
    shown = well_shown(evidence)
    if len(shown.normals) < LEAST_POINTS:
        return float("nan"), float("nan")
    base = _lit_colors(mean_colors(shown), irradiance_over_pi(shown, turned_lights(environment)[0]))
    darkest, brightest = np.quantile(base.max(axis=1), (1.0 - BRIGHTEST, BRIGHTEST))
    return float(DARKEST / max(darkest, 1e-9)), float(1.0 / max(brightest, 1e-9))


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


def _best(fits: LightFits, turns: NDArray[np.integer]) -> int:
    """Return which of some turns fits best."""
    return int(turns[np.argmin(fits.misfits[turns])])


def _refined(fits: LightFits, best: int) -> float:
    """Return the turn of the least misfit [degree], by a parabola through the best and its neighbours."""
    hand, turn = divmod(best, LIGHT_COLUMNS)
    misfits = fits.misfits[hand * LIGHT_COLUMNS :][:LIGHT_COLUMNS]
    before, here, after = (misfits[(turn + step) % LIGHT_COLUMNS] for step in (-1, 0, 1))
    bend = before - 2.0 * here + after
    finer = turn + (0.5 * (before - after) / bend if bend > 0.0 else 0.0)
    degrees = float(finer * 360.0 / LIGHT_COLUMNS)
    return degrees - 360.0 if degrees > 180.0 else degrees


def _exposure_stops(colors: NDArray[np.float64], irradiance: NDArray[np.float32]) -> float:
    """Return the exposure of the light that makes base colours plausible [stops]."""
    base = _lit_colors(colors, irradiance).max(axis=1)
    if not len(base):
        return 0.0
    bright, brightest = (max(float(value), 1e-9) for value in np.quantile(base, (BRIGHT, BRIGHTEST)))
    if bright > TOO_BRIGHT:
        return float(np.log2(bright / PLAUSIBLE))
    return float(np.log2(brightest / PLAUSIBLE)) if brightest < TOO_DARK else 0.0


def _lit_colors(colors: NDArray[np.float64], irradiance: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return base colours of the points that get at least `WELL_LIT` of the mean light, ``(M, 3)``."""
    mean = irradiance.mean(axis=1)
    lit = mean > WELL_LIT * mean.mean()
    return colors[lit] / np.maximum(irradiance[lit], 1e-12)


def _findings(check: LightCheck, is_unlike: bool, told: str) -> list[Finding]:
    """Return findings about a light; if it does not fit at all, neither its turn nor its exposure mean anything.

    Args:
        check: What was found.
        is_unlike: Whether a light of another kind explains the capture better than any turn.
        told: The turns that explain it best, in words, without the unit of the last.
    """
    if is_unlike:
        return [
            Finding(
                "warning",
                "environment-unexplained",
                "environment does not explain the capture under any turn: another light leaves less shading between "
                f"neighbours, whose base colours differ by {check.spread_best:.2f} under this one and by "
                f"{check.spread_even:.2f} under one that is the same from all sides",
                remedy="Check that it is the light of this capture.",
            )
        ]
    findings = []
    if check.certainty > 1.0:
        findings.append(
            Finding(
                "warning",
                "environment-turned",
                f"environment explains the capture {np.exp(check.misfit_as_given):.2f} times better "
                f"{told} degrees about the up axis",
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
