"""What a stress capture is: a capture with something wrong, and what a reconstruction must detect about it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from beam_warp.capture.capture import Capture
from beam_warp.capture.findings import Finding

BLACK_IMAGE = "black-image"
EMPTY_MASK = "empty-mask"
MISSING_IMAGE = "missing-image"
FRAME_LACKS_CAMERAS = "frame-lacks-cameras"
CAMERA_EXPOSURE = "camera-exposure"
FEW_CAMERAS = "few-cameras"
TRACKING_LOST = "tracking-lost"
NEW_SURFACE = "new-surface"
FAST_MOTION = "fast-motion"
"""Codes of detections, as the inspection of a capture and tracking name them."""


@dataclass(frozen=True)
class Detection:
    """Something that a reconstruction noticed about its input or about itself.

    Attributes:
        code: Name of the kind.
        camera: Name of the camera that it is about; None if it is about no single one.
        frame: Number of the frame that it is about; None if it is about no single one.
    """

    code: str
    camera: str | None = None
    frame: int | None = None

    def covers(self, other: Detection) -> bool:
        """Whether this has the other's kind, and its camera and frame where the other names them."""
        return (
            self.code == other.code
            and (other.camera is None or self.camera == other.camera)
            and (other.frame is None or self.frame == other.frame)
        )

    def __str__(self) -> str:
        """Return the detection in words: ``camera-exposure of train_03 in frame 2``."""
        of = "" if self.camera is None else f" of {self.camera}"
        return f"{self.code}{of}" + ("" if self.frame is None else f" in frame {self.frame}")


def detections_of(said: Iterable[Finding], cameras: Sequence[str]) -> tuple[Detection, ...]:
    """Return findings as detections: one for each camera that a finding names, or one without a camera."""
    found = []
    for finding in said:
        text = f"{finding.where} {finding.what}"
        named = [name for name in cameras if re.search(rf"(?<!\w){re.escape(name)}(?![A-Za-z0-9])", text)]
        found += [Detection(finding.code, name) for name in named] or [Detection(finding.code)]
    return tuple(found)


def in_words(detections: Sequence[Detection]) -> tuple[str, ...]:
    """Return detections in words, those of the same kind and camera as one: ``new-surface in frame 2, 3``."""
    frames: dict[tuple[str, str | None], list[int | None]] = {}
    for found in detections:
        frames.setdefault((found.code, found.camera), []).append(found.frame)
    words = []
    for (code, camera), numbers in frames.items():
        known = sorted({number for number in numbers if number is not None})
        words.append(str(Detection(code, camera)) + (f" in frame {', '.join(map(str, known))}" if known else ""))
    return tuple(words)


@dataclass(frozen=True, kw_only=True)
class CaptureStress:
    """A capture with something wrong, and what must be detected in it.

    Attributes:
        capture: What is reconstructed. Nothing is wrong with its test records: they are for scores.
        required: What must be detected.
        may_refuse: Whether a clear error before anything is optimised counts as detection too.
        is_sound: Whether nothing is wrong: then nothing may be detected.
        may_blame: Whether every camera is a little wrong, so that any of them may be named.
    """

    capture: Capture
    required: tuple[Detection, ...] = ()
    may_refuse: bool = False
    is_sound: bool = False
    may_blame: bool = False
