"""Third step of the main job: the light of the capture, with its exposure, and whether it fits what was captured."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.findings import Finding
from beam_warp.decomposition.options import ESTIMATE, RunOptions
from beam_warp.decomposition.seen import SeenFrame
from beam_warp.decomposition.source import Source
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.agreement import judge_clipping, judge_environment, match_silhouettes, require_match
from beam_warp.materials.exposure import estimate_exposure
from beam_warp.materials.light import judge_light, possible_scales
from beam_warp.materials.light_turn import LightTurn, find_turn
from beam_warp.materials.roughness_source import stated_roughness
from beam_warp.world.environment import EnvironmentMap

EXPOSURE_ROUGHNESS = 0.5
"""Assumed while the exposure of the light is looked for, where roughness is yet to be found."""

NOTHING_IN_COMMON = 0.05
"""Overlap of silhouettes below which a sequence cannot be of a capture, whatever it says."""

SILHOUETTES = 6
"""Views, evenly chosen, in which silhouettes are compared."""


@dataclass(frozen=True, eq=False)
class CaptureLight:
    """The light that a sequence was captured under.

    Attributes:
        environment: The given one times the exposure, and turned if it was askew.
        prepared: The same, prepared on the job's device.
        stops: The exposure, as a power of two.
        is_fitted: Whether the exposure was found, because the captured colour has no scale of its own.
        turn: By which turn the light as given explains the capture best; unknown of a light that did not come with it.
        turned_by: By how much it was turned [degree].
        scales: Least and largest factor that all base colours could have and be those of dielectrics; NaN where nothing
            was asked.
        scale_errors: Relative standard errors of the scale of red, green and blue, which all base colours have in
            common, as far as differences between cameras tell them; 0 where they tell nothing.
    """

    environment: EnvironmentMap
    prepared: PreparedEnvironment
    stops: float
    is_fitted: bool
    turn: LightTurn
    turned_by: float
    scales: tuple[float, float]
    scale_errors: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, environment: EnvironmentMap, found: Mapping[str, NDArray[Any]], source: Source) -> CaptureLight:
        """Prepare an environment, given what `find_light` found about it."""
        degrees, error, turned_by, low, high, stops, is_fitted = found["numbers"].tolist()
        turned = environment.rotated(turned_by) if turned_by else environment
        with source.log.timer("prepare light"):
            prepared = PreparedEnvironment(turned, source.device).scaled(2.0**stops)
        turn, scales = LightTurn(degrees, error), (low * 2.0**stops, high * 2.0**stops)
        errors = source.images.scale_errors() if source.has_light and source.images is not None else cls.scale_errors
        return cls(turned.scaled(2.0**stops), prepared, stops, bool(is_fitted), turn, turned_by, scales, errors)

    @property
    def findings(self) -> list[Finding]:
        """What is to be said about a light that is askew, and about its scale."""
        return self._askew() + self._scale()

    def _scale(self) -> list[Finding]:
        """Return a note on how far base colours are known; none where nothing was asked."""
        if not np.isfinite(self.scales).all():
            return []
        least, most = self.scales
        what = (
            "the scale of the light is as stated, and nothing in the images checks it closely: under a brighter or "
            f"dimmer one, base colours would be {least:.2g} to {most:.2g} times as bright"
        )
        if any(self.scale_errors):
            part = 100.0 * float(np.mean(self.scale_errors))
            what += f"; if it was measured no better than cameras were exposed, {part:.0f} % is one standard error"
        remedy = "Base colours are as sure as the light's exposure: a grey card in the images would check it."
        return [Finding("note", "base-color-scale", what, remedy=remedy)]

    def _askew(self) -> list[Finding]:
        """Return a warning about a light that is turned."""
        if not self.turn.is_certain:
            return []
        done, remedy = "it was turned by that", "Keep it as it is by --no-turn-light, if it was measured better."
        if not self.turned_by:
            done, remedy = "it was kept as it is", f"Turn it by --rotate {self.turn.degrees:+.1f}."
        what = f"environment explains the capture best turned by {self.turn} about the up axis; {done}"
        return [Finding("warning", "environment-turned", what, remedy=remedy)]

    def as_record(self) -> dict[str, Any]:
        """Return turn and scale for a report, JSON-able; None where nothing tells them."""
        degrees, error = (value if np.isfinite(value) else None for value in vars(self.turn).values())
        scales = list(self.scales) if np.isfinite(self.scales).all() else None
        return {
            "light_turn": {"degrees": degrees, "standard_error": error, "turned_by": self.turned_by},
            "base_color_scales": scales,
            "base_color_scale_errors": list(self.scale_errors),
        }


def find_light(environment: EnvironmentMap, source: Source) -> dict[str, NDArray[Any]]:
    """Find whether an environment is askew, its exposure, and whether it fits; return what `CaptureLight.of` takes.

    Args:
        environment: The light as it was given.
        source: What was captured, and the exposure that is stated or to be found.

    Raises:
        InvalidOptionError: The light is black, or the images show something else than the Gaussians.
    """
    options, turned = source.options, [float("nan"), float("inf"), 0.0, float("nan"), float("nan")]
    if source.has_light and environment.radiance.any():
        turned = _turn(source.first, environment, turns_light=options.turn_light)
    stops, is_fitted = 0.0, options.exposure == "auto" and source.is_display_referred()
    if options.exposure != "auto":
        stops = float(options.exposure)
    elif is_fitted:
        with source.log.timer("prepare light"):
            given = PreparedEnvironment(environment.rotated(turned[2]) if turned[2] else environment, source.device)
        stops = _exposure_stops(source.first, given, options)
        is_fitted = bool(stops) or not source.has_light
    numbers = np.array([*turned, stops, float(is_fitted)])
    light = CaptureLight.of(environment, {"numbers": numbers}, source)
    with source.log.timer("check"):
        findings = [*_judge(source.first, light.environment), *light.findings]
    text = json.dumps([vars(finding) for finding in findings])
    return {"numbers": numbers, "findings": np.frombuffer(text.encode(), np.uint8)}


def _turn(frame: SeenFrame, environment: EnvironmentMap, *, turns_light: bool) -> list[float]:
    """Return the turn of a light, its standard error, by how much the light is to be turned, and possible scales.

    A light that does not fit at all, or far better under another turn, has no small error.
    """
    evidence = frame.light_evidence
    turn = find_turn(evidence, environment)
    if turn.is_certain and not judge_light(evidence, environment).is_near:
        turn = LightTurn()
    turned_by = turn.degrees if turns_light and turn.is_certain else 0.0
    return [turn.degrees, turn.standard_error, turned_by, *possible_scales(evidence, environment)]


def _exposure_stops(frame: SeenFrame, light: PreparedEnvironment, options: RunOptions) -> float:
    """Return the stops by which the light explains a frame best."""
    scene, points = frame.scene, frame.points
    # Highlights cannot be told from the light before its exposure is known.
    stated = EXPOSURE_ROUGHNESS if options.roughness == ESTIMATE else options.roughness
    roughness = stated_roughness(frame.original, stated)
    with frame.log.timer("exposure"):
        return float(
            np.log2(
                estimate_exposure(
                    frame.cloud,
                    scene,
                    points,
                    roughness,
                    light,
                    options=options.gathering,
                    views=frame.views,
                    is_measured=frame.capture is not None and frame.capture.has_light,
                )
            )
        )


def _judge(frame: SeenFrame, environment: EnvironmentMap) -> list[Finding]:
    """Find what is wrong with the light and the images."""
    findings = judge_environment(environment)
    capture, views = frame.capture, frame.views
    if capture is None or views is None:
        return findings
    images = frame.images()
    some = images[:: max(1, len(images) // SILHOUETTES)]
    match = match_silhouettes(frame.cloud, some, options=capture.raster, device=frame.device)
    # Gaussians that say which frames they were made from may be poorly fitted, but hardly lie elsewhere.
    if not capture.is_stated or not match.overlap > NOTHING_IN_COMMON:
        require_match(match)
    findings += [match.finding] if match.finding is not None else []
    findings += judge_clipping(images, capture.ceiling(frame.number, images))
    return findings + list(judge_light(frame.light_evidence, environment).findings)
