"""Keys of a sequence's metadata that programs act on: how it is drawn, and which frames of a capture it shows.

Metadata are text by key. These keys are written and read here only, so that they mean the same in every file format
and viewer.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from beam_warp.checks import require_choice, require_number
from beam_warp.errors import InvalidOptionError

RASTER_ANTIALIASED = "raster_antialiased"
"""Key for ``true`` or ``false``: whether a splat keeps its total opacity when the low-pass widens it."""

RASTER_LOW_PASS = "raster_low_pass"
"""Key for the variance of the pixel filter that widens splats [pixel^2]."""

CAPTURE_FRAMES = "capture_frames"
"""Key for the capture's number of every frame: ``0 1 2``."""

UNSTATED_RASTER = (False, 0.3)
"""Antialiasing and low-pass if nothing is stated, as in 3D Gaussian Splatting (Kerbl et al. 2023)."""

LOW_PASS_RANGE = (1e-6, 1e6)
"""Range of the low-pass' variance [pixel^2]."""


def raster_metadata(antialiased: bool, low_pass: float) -> dict[str, str]:
    """Return the metadata that state how Gaussians were drawn when they were fitted, and so are to be drawn.

    Args:
        antialiased: See `RASTER_ANTIALIASED`.
        low_pass: See `RASTER_LOW_PASS`; kept to the precision of float32, which files and kernels have.
    """
    return {RASTER_ANTIALIASED: "true" if antialiased else "false", RASTER_LOW_PASS: str(np.float32(low_pass))}


def stated_raster(metadata: Mapping[str, str]) -> tuple[bool, float] | None:
    """Return whether Gaussians are to be drawn antialiased, and with which low-pass [pixel^2].

    Returns:
        Both, with `UNSTATED_RASTER` for one that is not stated; None if neither is stated.

    Raises:
        InvalidOptionError: A stated value is out of range.
    """
    antialiased, low_pass = metadata.get(RASTER_ANTIALIASED), metadata.get(RASTER_LOW_PASS)
    if antialiased is None and low_pass is None:
        return None
    return (
        UNSTATED_RASTER[0]
        if antialiased is None
        else require_choice(RASTER_ANTIALIASED, antialiased, ("true", "false")) == "true",
        UNSTATED_RASTER[1] if low_pass is None else require_number(RASTER_LOW_PASS, low_pass, *LOW_PASS_RANGE),  # type: ignore[arg-type]
    )


def capture_frames_metadata(frames: Sequence[int]) -> dict[str, str]:
    """Return the metadata that state which frame of a capture each frame of a sequence shows."""
    return {CAPTURE_FRAMES: " ".join(str(frame) for frame in frames)}


def stated_capture_frames(metadata: Mapping[str, str], frame_count: int) -> tuple[int, ...] | None:
    """Return the capture's number of every frame of a sequence; None if it is not stated.

    Args:
        metadata: Metadata of the sequence.
        frame_count: Number of frames of the sequence.

    Raises:
        InvalidOptionError: The text is not one number, at least 0, for each frame.
    """
    text = metadata.get(CAPTURE_FRAMES)
    if text is None:
        return None
    words = text.split()
    if len(words) != frame_count or not all(re.fullmatch(r"\d{1,9}", word) for word in words):
        got = repr(text[:40]) if len(words) == frame_count else f"{len(words)} in {text[:40]!r}"
        raise InvalidOptionError(
            f"{CAPTURE_FRAMES} must be a number for each of {frame_count} frames, got {got}. State the capture's frame "
            "numbers in the order of the sequence, or leave them out."
        )
    return tuple(int(word) for word in words)


def numbers_of_frames(metadata: Mapping[str, str], frame_count: int) -> tuple[int, ...]:
    """Return the capture's number of every frame of a sequence, as stated, or else 0, 1, 2, ….

    Raises:
        InvalidOptionError: See `stated_capture_frames`.
    """
    stated = stated_capture_frames(metadata, frame_count)
    return tuple(range(frame_count)) if stated is None else stated
