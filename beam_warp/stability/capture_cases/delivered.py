"""Stress captures as studios deliver them: every camera is a little wrong, and none is to blame."""

from __future__ import annotations

import tempfile
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from beam_warp.stability.capture_cases.alterations import AlteredRecord
from beam_warp.stability.capture_cases.case import CaptureStress
from beam_warp.stability.capture_cases.studio import StressStudio
from beam_warp.stability.flaws.write import STUDIO, write_flawed
from beam_warp.stability.suite import stability_case


@stability_case(
    "as a studio delivers it",
    "all of these at once: backdrop in the outlines, colours that no two cameras share, and noise fitted as texture",
    "reconstructed; what is lost against the sound capture is told",
    large=True,
)
def as_delivered(at: StressStudio) -> CaptureStress:
    """Exposure and white balance, noise and 8 bits, masks, poses and the light are off, each by its nominal size."""
    return _flawed(at, STUDIO)


@stability_case(
    "masks a pixel off",
    "masks that are too large show backdrop, those that are too small carve the hull",
    "reconstructed; what is lost against the sound capture is told",
    large=True,
)
def masks_off(at: StressStudio) -> CaptureStress:
    """Half of the masks are a pixel too large, the others too small, in photographs before a grey wall."""
    return _flawed(at, ["masks"])


@stability_case(
    "poses a third of a pixel off",
    "what cameras disagree about is blurred, or explained by colour that depends on direction",
    "reconstructed; what is lost against the sound capture is told",
    large=True,
)
def poses_off(at: StressStudio) -> CaptureStress:
    """Every pose is off by 0.3 pixel of rotation and 1 mm."""
    return _flawed(at, ["poses"])


def _flawed(at: StressStudio, flaws: Collection[str]) -> CaptureStress:
    """Write a flawed copy of a capture's first frames; its test records are the clean ones, in the copy's units."""
    base = at.brief()
    copy = write_flawed(base, Path(tempfile.mkdtemp(dir=at.folder)), flaws, frames=base.frames)
    tests = [AlteredRecord.of(record, 1.0 / copy.white, 1.0) for record in base.select(split="test")]
    return CaptureStress(capture=replace(base, records=(*copy.capture.records, *tests)), may_blame=True)
