"""Changes of a capture that write nothing: images altered as they are read, and cameras or frames left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.views import CapturedView
from beam_warp.errors import InvalidArrayError
from beam_warp.image.files import Image


@dataclass(frozen=True, eq=False, kw_only=True)
class AlteredRecord(CaptureRecord):
    """A record whose image is changed as it is read; its truth is not.

    Attributes:
        gain: Factor of the colour.
        coverage: Factor of alpha.
    """

    gain: float = 1.0
    coverage: float = 1.0

    @classmethod
    def of(cls, record: CaptureRecord, gain: float, coverage: float) -> AlteredRecord:
        """Return a record that changes its image."""
        known = {entry.name: getattr(record, entry.name) for entry in fields(CaptureRecord)}
        return cls(**known, gain=gain, coverage=coverage)

    def image(self) -> Image:
        """Read the image and change it."""
        image = super().image()
        factors = {**dict.fromkeys("RGBY", self.gain), "A": self.coverage}
        return replace(
            image,
            channels={name: values * np.float32(factors.get(name, 1.0)) for name, values in image.channels.items()},
        )

    def view(self) -> CapturedView:
        """Read the view and change it."""
        view = super().view()
        alpha = None if view.alpha is None else view.alpha * np.float32(self.coverage)
        return replace(view, color=view.color * np.float32(self.gain), alpha=alpha)


def training_cameras(capture: Capture) -> tuple[str, ...]:
    """Return the names of the cameras that train, in file order."""
    return tuple(dict.fromkeys(record.camera_name for record in capture.select(split="train")))


def with_cameras(capture: Capture, kept: Sequence[str]) -> Capture:
    """Return a capture with some of its training cameras; test cameras stay."""
    return replace(capture, records=tuple(r for r in capture.records if r.split != "train" or r.camera_name in kept))


def with_every(capture: Capture, step: int) -> Capture:
    """Return a capture with its first frame and every ``step``-th after it, under their own numbers and times.

    Raises:
        InvalidArrayError: Only one frame would be left.
    """
    frames = capture.frames[::step]
    if len(frames) < 2:
        raise InvalidArrayError(
            f"capture must have more than {step} frames to leave out all but every {step}th, "
            f"got {len(capture.frames)}. Choose a longer one."
        )
    return replace(capture, records=capture.select(frames=frames))


def with_altered(capture: Capture, camera: str, *, gain: float = 1.0, coverage: float = 1.0) -> Capture:
    """Return a capture in which one camera's images are changed as they are read."""
    return replace(
        capture,
        records=tuple(AlteredRecord.of(r, gain, coverage) if r.camera_name == camera else r for r in capture.records),
    )


def evenly(names: Sequence[str], count: int) -> tuple[str, ...]:
    """Return some of the names, evenly spread over all of them.

    Raises:
        InvalidArrayError: There are fewer names than ``count``.
    """
    if count > len(names):
        raise InvalidArrayError(f"capture must have {count} training cameras, got {len(names)}. Choose a larger one.")
    return tuple(names[index * len(names) // count] for index in range(count))
