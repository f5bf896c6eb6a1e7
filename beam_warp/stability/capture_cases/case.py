"""What a stress capture is: a capture with something wrong, and what a reconstruction must detect about it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from beam_warp.capture.capture import Capture
from beam_warp.capture.findings import Finding
from beam_warp.stability.capture_cases.studio import StressStudio

BLACK_IMAGE = "black-image"
EMPTY_MASK = "empty-mask"
MISSING_IMAGE = "missing-image"
FRAME_LACKS_CAMERAS = "frame-lacks-cameras"
CAMERA_EXPOSURE = "camera-exposure"
FEW_CAMERAS = "few-cameras"
TRACKING_LOST = "tracking-lost"
NEW_SURFACE = "new-surface"
FAST_MOTION = "fast-motion"
"""Codes of what must be detected: of the inspection of a capture, and of tracking."""


@dataclass(frozen=True)
class Detection:
    """Something that a reconstruction noticed about its input or about itself.

    Attributes:
        code: Names the kind.
        camera: Which camera, where it is about one.
        frame: Which frame, where it is about one.
    """

    code: str
    camera: str | None = None
    frame: int | None = None

    def covers(self, other: Detection) -> bool:
        """Whether this says what the other asks for: its kind, and its camera and frame where it names them."""
        return (
            self.code == other.code
            and (other.camera is None or self.camera == other.camera)
            and (other.frame is None or self.frame == other.frame)
        )

    def __str__(self) -> str:
        """Return it in words: ``camera-exposure of train_03 in frame 2``."""
        of = "" if self.camera is None else f" of {self.camera}"
        return f"{self.code}{of}" + ("" if self.frame is None else f" in frame {self.frame}")


def detections_of(said: Iterable[Finding], cameras: Sequence[str]) -> tuple[Detection, ...]:
    """Return what an inspection says as detections: one for each camera that it names, or one without."""
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
    """A capture with something wrong, and what must be found out about it.

    Attributes:
        capture: What is reconstructed; its test records are as they should be, for scores.
        required: What must be detected.
        may_refuse: Whether refusing it, by a clear error before anything is optimised, counts as detected too.
        is_sound: Whether nothing is wrong with it: then nothing must be detected.
    """

    capture: Capture
    required: tuple[Detection, ...] = ()
    may_refuse: bool = False
    is_sound: bool = False


@dataclass(frozen=True)
class CaptureCase:
    """A stress capture by name, how reconstructions fail on it, and how it is made.

    Attributes:
        name: Short and unique.
        fails: How a reconstruction without precautions fails here.
        must: What must come of it.
        build: Makes the capture; the same each time.
        traced: Whether it shows something else than the given capture, and needs the demo figure.
    """

    name: str
    fails: str
    must: str
    build: Callable[[StressStudio], CaptureStress]
    traced: bool


def capture_case(
    name: str, fails: str, must: str, *, traced: bool = False
) -> Callable[[Callable[[StressStudio], CaptureStress]], CaptureCase]:
    """Make a case of the function below it."""
    return lambda build: CaptureCase(name, fails, must, build, traced)
