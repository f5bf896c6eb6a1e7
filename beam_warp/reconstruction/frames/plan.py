"""Plan of a reconstruction: the records of each frame, and the segments that frames are worked on in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.digests import require_files
from beam_warp.capture.findings import Finding
from beam_warp.capture.inspect import SPLIT, require_reconstructable
from beam_warp.errors import InvalidOptionError


@dataclass(frozen=True, eq=False)
class FramePlan:
    """The frames of a capture that are reconstructed.

    Attributes:
        records: Training records of each frame: frames ascending, cameras in file order.
        segments: Numbers of the frames, those of each segment in their order; its first frame is a key frame.
        findings: Warnings about the capture.
    """

    records: Mapping[int, tuple[CaptureRecord, ...]]
    segments: tuple[tuple[int, ...], ...]
    findings: tuple[Finding, ...]


def plan_frames(capture: Capture, frames: Sequence[int] | None, segment_length: int) -> FramePlan:
    """Choose the training records of some frames, those of missing images left out.

    Args:
        capture: Images and cameras.
        frames: Numbers of the frames, ascending; None for all of the training split.
        segment_length: Frames from one key frame to the next; 0 for a key frame at the start only.

    Raises:
        InvalidOptionError: The capture has no such frame.
        MissingFileError: Too few images are there.
        AssetFormatError: Nothing can be reconstructed from these records: the message says why.
    """
    ready = require_reconstructable(_selected(capture, frames))
    records: dict[int, list[CaptureRecord]] = {}
    for record in sorted(ready.capture.select(split=SPLIT), key=lambda record: record.frame):
        records.setdefault(record.frame, []).append(record)
    require_files(record for found in records.values() for record in found)
    return FramePlan(
        {frame: tuple(found) for frame, found in records.items()},
        plan_segments(tuple(records), segment_length),
        tuple(finding for finding in ready.fallbacks if finding.severity == "warning"),
    )


def plan_segments(frames: Sequence[int], length: int) -> tuple[tuple[int, ...], ...]:
    """Return the frames in segments of a length, the last one perhaps shorter; length 0 makes one segment."""
    step = length or len(frames)
    return tuple(tuple(frames[start : start + step]) for start in range(0, len(frames), step))


def plan_fades(segments: Sequence[Sequence[int]], length: int) -> dict[int, float]:
    """Return the frames after each seam in which the segment before goes on, and its share in each of them.

    A new key frame has other errors than the frame before it, which would flicker; so one segment is faded into the
    next, by equal steps.

    Args:
        segments: Numbers of the frames of each segment.
        length: Most frames that a fade takes.
    """
    after = (segment[:length] for segment in segments[1:])
    return {frame: 1.0 - place / (len(faded) + 1) for faded in after for place, frame in enumerate(faded, 1)}


def _selected(capture: Capture, frames: Sequence[int] | None) -> Capture:
    """Return the capture with no other records than the training records of the frames that are asked for."""
    there = sorted({record.frame for record in capture.select(split=SPLIT)})
    if not there:
        raise InvalidOptionError(
            f"capture must have records of the split {SPLIT}, got {', '.join(capture.splits)}. Call them so."
        )
    wanted = there if frames is None else frames
    absent = sorted(set(wanted) - set(there))
    if absent or not wanted:
        raise InvalidOptionError(
            f"frames must be some of the capture's {len(there)} from {there[0]} to {there[-1]}, got "
            f"{absent[0] if absent else 'none'}. Choose among them."
        )
    return Capture(**{**vars(capture), "records": capture.select(split=SPLIT, frames=set(wanted))})
