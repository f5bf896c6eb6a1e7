"""How a sequence's metadata, which is text by key, says what programs act on: how it is drawn, which frames it shows.

Whoever writes or reads these keys does so here, so that every file format and every viewer means the same by them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from beam_warp.checks import require_choice, require_number
from beam_warp.errors import InvalidOptionError

RASTER_ANTIALIASED = "raster_antialiased"
"""``true`` or ``false``: whether a splat keeps its total opacity when the low-pass widens it."""

RASTER_LOW_PASS = "raster_low_pass"
"""Variance of the pixel filter that splats are widened by [pixel^2]."""

CAPTURE_FRAMES = "capture_frames"
"""The capture's number of every frame: ``0 1 2``."""

UNSTATED_RASTER = (False, 0.3)
"""What holds where nothing is stated: the rasteriser of 3D Gaussian Splatting (Kerbl et al. 2023)."""

LOW_PASS_RANGE = (1e-6, 1e6)
"""Variances that a low-pass may have [pixel^2]."""


def raster_metadata(antialiased: bool, low_pass: float) -> dict[str, str]:
    """Return what states that Gaussians are to be drawn so, as they were when they were fitted.

    Args:
        antialiased: See `RASTER_ANTIALIASED`.
        low_pass: See `RASTER_LOW_PASS`; kept to the precision of float32, which files and kernels have.
    """
    return {RASTER_ANTIALIASED: "true" if antialiased else "false", RASTER_LOW_PASS: str(np.float32(low_pass))}


def stated_raster(metadata: Mapping[str, str]) -> tuple[bool, float] | None:
    """Return whether Gaussians are to be drawn antialiased, and with which low-pass [pixel^2].

    Returns:
        Both, of `UNSTATED_RASTER` what is not stated; None if neither is.

    Raises:
        InvalidOptionError: What is stated is no such value.
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
    """Return what states which frames of a capture a sequence shows, in its order."""
    return {CAPTURE_FRAMES: " ".join(str(frame) for frame in frames)}


def stated_capture_frames(metadata: Mapping[str, str], frame_count: int) -> tuple[int, ...] | None:
    """Return the capture's number of every frame of a sequence; None if it is not stated.

    Args:
        metadata: Of the sequence.
        frame_count: Its length.

    Raises:
        InvalidOptionError: What is stated is not one number, at least 0, for each frame.
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
    """Return by which number a capture knows every frame of a sequence: as stated, else counted from 0.

    Raises:
        InvalidOptionError: As `stated_capture_frames`.
    """
    stated = stated_capture_frames(metadata, frame_count)
    return tuple(range(frame_count)) if stated is None else stated
