"""The judge of stress materials: what the measurement found, flagged and stated, and how far it is off.

A case fails if what must be found or flagged was not, if something is found where nothing is wrong, if base colours are
wrong without a word, or if the run ends in anything but materials or a refusal where one is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.capture.findings import Finding
from beam_warp.device.arrays import device_label, resolve_device
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.agreement import (
    judge_clipping,
    judge_environment,
    largest_value,
    match_silhouettes,
    require_match,
)
from beam_warp.materials.base_color import BaseColor, solve_base_color
from beam_warp.materials.direct import measure_materials
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.light import check_light
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.materials.normals import SurfacePoints
from beam_warp.stability.material_cases import MaterialStress, MaterialStudio
from beam_warp.stability.suite import CaseOutcome, StabilityCase, attempt
from beam_warp.trace.scene import Scene
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import Observability

FLAGGED = 0.9
"""Least part of the Gaussians that a case is about that must have its flag."""

LIGHT_SUBSET = 256
"""Gaussians by which the light is checked: so many see all of it from a ball."""

WRONG = 0.1
STATED = 3.0
"""A base colour is wrong without a word if its error is above `WRONG` and above `STATED` stated standard errors, its
Gaussian has no flag, and nothing was found."""

SILENT_PART = 0.02
"""Part of all Gaussians that may be wrong without a word. On the sound ball 0.002 are: near its poles, which only
silhouettes show, and where photographs blur neighbours."""


@dataclass(frozen=True)
class ColorErrors:
    """How far base colours of some Gaussians are off, over channels.

    Attributes:
        count: How many Gaussians.
        median: Median absolute error.
        high: 95 % quantile of the absolute error.
        stated: Median of the stated standard error.
        within: Part of errors within two stated standard errors: 0.95 or more if those are honest.
        flags: Part of the Gaussians with each flag, by name; flags that none has are left out.
    """

    count: int
    median: float
    high: float
    stated: float
    within: float
    flags: Mapping[str, float]

    @classmethod
    def of(cls, solved: BaseColor, truth: NDArray[np.float32], rows: NDArray[np.bool_]) -> ColorErrors | None:
        """Measure some rows; None if there are none."""
        if not rows.any():
            return None
        error, stated = np.abs(solved.base_color - truth)[rows], solved.standard_error[rows]
        found = solved.observability[rows]
        parts = {flag.name or "": float((found & np.uint8(flag) != 0).mean()) for flag in Observability if flag}
        return cls(
            count=int(rows.sum()),
            median=float(np.median(error)),
            high=float(np.quantile(error, 0.95)),
            stated=float(np.median(stated)),
            within=float((error <= 2.0 * stated).mean()),
            flags={name: part for name, part in parts.items() if part > 0.0},
        )


@dataclass(frozen=True, kw_only=True)
class MaterialOutcome(CaseOutcome):
    """The outcome of measuring one case.

    Attributes:
        gaussians: Number of Gaussians.
        views: Number of photographs.
        found: Codes of the findings.
        refused: The error by which the case was refused; empty if it was measured.
        hit: Errors of the Gaussians that the case is about; None if it is about none, or was refused.
        rest: Errors of all others.
        silent: Part of all Gaussians that is wrong without a word.
    """

    gaussians: int
    views: int
    found: tuple[str, ...] = ()
    refused: str = ""
    hit: ColorErrors | None = None
    rest: ColorErrors | None = None
    silent: float = 0.0

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> MaterialOutcome:
        """Return what `as_dict` gave."""
        parts = {name: record[name] and ColorErrors(**record[name]) for name in ("hit", "rest")}
        return super().from_dict({**record, **parts})


@dataclass(frozen=True, eq=False)
class Bench:
    """A place to run cases, which prepares each light once.

    Attributes:
        studio: The source of the cases; they are measured on its device.
    """

    studio: MaterialStudio
    _lights: dict[EnvironmentMap, PreparedEnvironment] = field(default_factory=dict)

    def light(self, environment: EnvironmentMap) -> PreparedEnvironment:
        """Return a light prepared on the device."""
        if environment not in self._lights:
            self._lights[environment] = PreparedEnvironment(environment, resolve_device(self.studio.device))
        return self._lights[environment]


def run_material_case(bench: Bench, case: StabilityCase[MaterialStress]) -> MaterialOutcome:
    """Measure one case and judge it."""
    stress = case.build(bench.studio)
    tried = attempt(lambda: decompose(bench, stress))
    outcome = MaterialOutcome(
        case=case.name,
        device=device_label(wp.get_device(resolve_device(bench.studio.device))),
        gaussians=len(stress.cloud),
        views=len(stress.views),
        refused=tried.refused,
        faults=() if tried.refused and stress.refused else tried.faults,
        seconds=tried.seconds,
    )
    if tried.result is None:
        return outcome
    solved, findings = tried.result
    silent = 0.0 if any(finding.severity != "note" for finding in findings) else silent_part(solved, stress.base_color)
    return replace(
        outcome,
        found=tuple(finding.code for finding in findings),
        hit=ColorErrors.of(solved, stress.base_color, stress.hit),
        rest=ColorErrors.of(solved, stress.base_color, ~stress.hit),
        silent=silent,
        faults=tuple(_faults(stress, solved, findings, silent)),
    )


def decompose(bench: Bench, stress: MaterialStress) -> tuple[BaseColor, list[Finding]]:
    """Check and measure a case as `beam decompose` does with one frame.

    Raises:
        BeamError: The case is refused.
    """
    device = bench.studio.device
    ceiling = largest_value(stress.views, stress.color_space)
    match = match_silhouettes(stress.cloud, stress.views, device=device)
    require_match(match)
    findings = judge_environment(stress.environment) + judge_clipping(stress.views, ceiling)
    findings += [] if match.finding is None else [match.finding]
    cameras = [view.camera for view in stress.views]
    evidence = view_evidence(stress.cloud, cameras, stress.views, ceiling=ceiling, device=device)
    scene = Scene.from_gaussians(stress.cloud, device)
    points = SurfacePoints.seen_by(stress.cloud, evidence, scene)
    findings += check_light(scene, points, evidence, stress.environment, subset=LIGHT_SUBSET).findings
    light = bench.light(stress.environment)
    measured = measure_materials(
        stress.cloud, scene, points, stress.roughness, light, options=MaterialOptions(), views=evidence
    )
    normals = np.where(points.seen[:, None], evidence.normals.numpy(), np.array([0.0, 0.0, 1.0], np.float32))
    cloud = stress.cloud.with_arrays(normals=normals, normal_confidence=points.confidence)
    return solve_base_color(cloud, measured.evidence, light.mean_irradiance), findings


def silent_part(solved: BaseColor, truth: NDArray[np.float32]) -> float:
    """Return the part of all Gaussians that is wrong without a word."""
    error = np.abs(solved.base_color - truth)
    wrong = ((error > WRONG) & ~(error <= STATED * solved.standard_error)).any(axis=1)
    return float((wrong & (solved.observability == 0)).mean())


def _faults(stress: MaterialStress, solved: BaseColor, findings: Sequence[Finding], silent: float) -> list[str]:
    """Return the reasons why a case fails."""
    if stress.refused:
        return ["must be refused, and was not"]
    faults = []
    if not (np.isfinite(solved.base_color).all() and np.isfinite(solved.standard_error).all()):
        faults.append("base colours or errors are not finite")
    codes = {finding.code for finding in findings if finding.severity != "note"}
    if stress.finding and stress.finding not in codes:
        faults.append(f"not found: {stress.finding}")
    faults += [f"found where it is not: {code}" for code in sorted(codes - {stress.finding})]
    if stress.flags and stress.hit.any():
        flagged = float((solved.observability[stress.hit] & np.uint8(stress.flags) != 0).mean())
        if not flagged >= FLAGGED:
            faults.append(f"{flagged:.0%} flagged as {stress.flags.name}, {FLAGGED:.0%} must be")
    if not silent <= SILENT_PART:
        faults.append(f"{silent:.1%} wrong without a word")
    return faults


TITLES = (
    "case",
    "a decomposition without precautions",
    "must",
    "found",
    "flagged, of what it is about",
    "error there: median, 95 %",
    "stated there",
    "within 2 stated",
    "error elsewhere: median, 95 %",
    "within 2 stated",
    "wrong without a word",
    "verdict",
)


def cells(outcome: MaterialOutcome) -> tuple[str, ...]:
    """Return the cells of a case from *found* on."""
    hit, rest = outcome.hit, outcome.rest
    flags = {} if hit is None else hit.flags
    return (
        f"refused: {outcome.refused}" if outcome.refused else ", ".join(outcome.found) or "nothing",
        ", ".join(f"{name} {part:.0%}" for name, part in flags.items() if part >= 0.01) or "–",
        "–" if hit is None else f"{hit.median:.3f}, {hit.high:.3f}",
        "–" if hit is None else f"{hit.stated:.3f}",
        "–" if hit is None else f"{hit.within:.0%}",
        "–" if rest is None else f"{rest.median:.3f}, {rest.high:.3f}",
        "–" if rest is None else f"{rest.within:.0%}",
        "–" if outcome.refused else f"{outcome.silent:.1%}",
        "; ".join(outcome.faults) or "ok",
    )
