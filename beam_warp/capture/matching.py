"""Which frame of an asset shows which frame of a capture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from beam_warp.capture.capture import Capture
from beam_warp.errors import InvalidOptionError
from beam_warp.world.gaussians import GaussianSequence

CAPTURE_FRAMES = "capture_frames"
"""The key of a sequence's metadata that states the capture's number of every frame: ``0 1 2``."""


def match_frames(sequence: GaussianSequence, numbers: Sequence[int] | None = None) -> dict[int, int]:
    """Return by the capture's frame number the index of the asset's frame that shows it.

    Args:
        sequence: The asset.
        numbers: The capture's number of every frame; None takes what the asset's metadata states, else 0, 1, 2, ….

    Raises:
        InvalidOptionError: The numbers are not one for each frame, or one stands twice.
    """
    if numbers is None:
        stated = sequence.metadata.get(CAPTURE_FRAMES)
        if stated is None:
            return {index: index for index in range(len(sequence))}
        words = stated.split()
        numbers = [int(word) for word in words if word.isascii() and word.isdigit()]
        if len(numbers) != len(words):
            raise InvalidOptionError(
                f"{CAPTURE_FRAMES} must be frame numbers, got {stated[:40]!r} in the asset's metadata. State them anew."
            )
    if len(numbers) != len(sequence):
        raise InvalidOptionError(
            f"capture-frames must be one number for each of {len(sequence)} frames of the asset, got {len(numbers)}. "
            "Name the capture's frame of every one, in order."
        )
    if len(set(numbers)) < len(numbers):
        raise InvalidOptionError(
            f"capture-frames must be other numbers for other frames, got {' '.join(map(str, numbers[:20]))}. "
            "Name each frame once."
        )
    return {number: index for index, number in enumerate(numbers)}


def scored_frames(capture: Capture, matched: Mapping[int, int], *, split: str = "test") -> tuple[int, ...]:
    """Return the capture's frames that have exact channels and that the asset shows, ascending.

    Raises:
        InvalidOptionError: The capture has no exact channels, or the asset shows none of those frames.
    """
    known = sorted({record.frame for record in capture.select(split=split) if record.truth_path is not None})
    if not known:
        raise InvalidOptionError(
            f"truth must be a capture whose {split} views have exact channels, got none with 'truth' in "
            f"{capture.folder}. Name a synthetic capture."
        )
    shown = tuple(frame for frame in known if frame in matched)
    if not shown:
        raise InvalidOptionError(
            f"asset must show a frame whose truth is known ({_listed(known)}), got one of the frames "
            f"{_listed(sorted(matched))}. Say with --capture-frames which frames of the capture it shows."
        )
    return shown


def _listed(frames: Sequence[int]) -> str:
    """Name frames, of many the first and the last."""
    words = [str(frame) for frame in frames]
    return ", ".join(words) if len(words) <= 6 else f"{', '.join(words[:4])}, …, {words[-1]}"
