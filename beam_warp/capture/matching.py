"""Correspondence between the frames of an asset and those of a capture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from beam_warp.capture.capture import Capture
from beam_warp.errors import InvalidOptionError
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.metadata import numbers_of_frames


def match_frames(sequence: GaussianSequence, numbers: Sequence[int] | None = None) -> dict[int, int]:
    """Map the capture's frame numbers to the indices of the asset's frames that show them.

    Args:
        sequence: The asset.
        numbers: The capture's number of every frame; None takes what the asset's metadata states, else 0, 1, 2, ….

    Raises:
        InvalidOptionError: There is not one number for each frame, or one occurs twice.
    """
    if numbers is None:
        numbers = numbers_of_frames(sequence.metadata, len(sequence))
    if len(numbers) != len(sequence):
        raise InvalidOptionError(
            f"capture-frames must be one number for each of {len(sequence)} frames of the asset, got {len(numbers)}. "
            "Name the capture's frame of every one, in order."
        )
    if len(set(numbers)) < len(numbers):
        raise InvalidOptionError(
            f"capture-frames must name each frame of the capture once, got {' '.join(map(str, numbers[:20]))}. "
            "Give each frame of the asset another number."
        )
    return {number: index for index, number in enumerate(numbers)}


def scored_frames(capture: Capture, matched: Mapping[int, int], *, split: str = "test") -> tuple[int, ...]:
    """Return the capture's frames that the asset shows and whose exact channels are known, ascending.

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
    """List frame numbers; of many, only the first four and the last."""
    words = [str(frame) for frame in frames]
    return ", ".join(words) if len(words) <= 6 else f"{', '.join(words[:4])}, …, {words[-1]}"
