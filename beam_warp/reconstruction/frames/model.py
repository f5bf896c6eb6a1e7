"""One frame's Gaussians: tracked from the frame before, or fitted to the frame's images alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from beam_warp.capture.views import CapturedView
from beam_warp.jobs.listeners import NotedProgress
from beam_warp.reconstruction.frames.protocols import FrameSteps, FrameTrack, StepProgress
from beam_warp.reconstruction.frames.report import known_numbers


@dataclass(frozen=True, eq=False)
class FrameModel:
    """A frame that has been found.

    Attributes:
        track: Its Gaussians, and all that the next frame needs.
        report: What the steps report, JSON-able, with ``frame``, ``kind`` ("key" or "tracked"), ``segment`` (the
            segment's key frame), ``lost``, ``gaussians`` and ``findings``.
    """

    track: FrameTrack
    report: dict[str, Any]


def model_frame(
    steps: FrameSteps,
    frame: int,
    views: Sequence[CapturedView],
    previous: tuple[FrameTrack, int] | None,
    progress: NotedProgress,
    *,
    is_refitted: bool = True,
) -> FrameModel:
    """Find the Gaussians of a frame; a frame in which tracking is lost is fitted as a key frame.

    Args:
        steps: How they are found.
        frame: Its number.
        views: Its images.
        previous: Track of the frame before, and the key frame of its segment; None for a key frame.
        progress: Called with (stage, done, total, note), the stages "track" and "fit".
        is_refitted: Whether a frame in which tracking is lost is fitted; else it is returned as it is, and said lost.
    """
    lost, segment = "", frame
    track, report = None, {}
    findings: list[Any] = []
    if previous is not None:
        before, segment = previous
        track, report = steps.advance(before, views, within(progress, "track", frame))
        lost = str(report.get("lost", ""))
        findings = list(report.get("findings", []))
    if track is None or (lost and is_refitted):
        track, report = steps.begin(views, within(progress, "fit", frame))
        findings += [finding for finding in report.get("findings", []) if finding not in findings]
        segment = frame
    kept = {name: value for name, value in report.items() if name != "seconds"}
    return FrameModel(
        track,
        {
            **_plain(kept),
            "frame": frame,
            "kind": "key" if segment == frame else "tracked",
            "segment": segment,
            "lost": lost,
            "gaussians": len(track.cloud),
            "findings": _plain(findings),
        },
    )


def within(progress: NotedProgress, stage: str, frame: int) -> StepProgress:
    """Return a reporter of progress inside a frame."""

    def report(done: int, total: int, facts: Mapping[str, float] = MappingProxyType({})) -> None:
        progress(stage, done, total, ", ".join([f"frame {frame}", *known_numbers(facts)]))

    return report


def _plain(value: Any) -> Any:
    """Return a report's value as JSON holds it: None for a number that is not finite."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
