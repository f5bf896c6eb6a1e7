"""Moments that the images of a sequence show: frames as they are, or moments between them."""

from __future__ import annotations

import re
from dataclasses import dataclass

from beam_warp.checks import require_number
from beam_warp.errors import InvalidOptionError

MAX_IMAGES = 1_000_000
"""More images than this are a mistake."""

SPEED_RANGE = (1e-3, 1e3)
"""Speeds at which a sequence may play."""

SECONDS_RANGE = (1e-3, 1e7)
"""How long it may play [s]."""

_RANGE = re.compile(r"(-?\d+)?:(-?\d+)?(?::(\d+))?")


@dataclass(frozen=True)
class FrameTimes:
    """Images in order.

    Attributes:
        numbers: Number of each image.
        times: Time of each image on the stage [s].
        rate: Images a second at which they play.
    """

    numbers: tuple[int, ...]
    times: tuple[float, ...]
    rate: float


def frame_times(
    frame_count: int,
    frame_rate: float,
    *,
    frames: str | None = None,
    seconds: float | None = None,
    fps: float | None = None,
    speed: float | None = None,
) -> FrameTimes:
    """Return which images to render.

    Without ``seconds``, ``fps`` and ``speed``, images are frames, numbered as they are; with a step they play as much
    slower, so that motion keeps its pace. With one of these, images are moments at ``fps`` from the first frame on,
    numbered from 0.

    Args:
        frame_count: Number of frames of the stage.
        frame_rate: Frames a second of the stage [1/s].
        frames: ``A:B`` or ``A:B:STEP``, half-open, negative from the end, any of them left out; all frames if None.
        seconds: Length of the film [s]; if None, until the last frame has been seen.
        fps: Images a second; ``frame_rate`` if None.
        speed: Seconds of the stage that pass in one second of the film.

    Raises:
        InvalidOptionError: A number is out of range, or frames are asked for that there are not.
    """
    first, end, step = _parse(frames, frame_count)
    if seconds is None and fps is None and speed is None:
        _require_few(len(range(first, end, step)))
        numbers = tuple(range(first, end, step))
        return FrameTimes(numbers, tuple(number / frame_rate for number in numbers), frame_rate / step)
    if step != 1:
        raise InvalidOptionError(
            f"frames must have no step with seconds, fps or speed, got {frames}. State the images' rate with fps."
        )
    rate = require_number("fps", frame_rate if fps is None else fps, 0.01, 1000.0)
    pace = require_number("speed", 1.0 if speed is None else speed, *SPEED_RANGE)
    length = (end - first) / (frame_rate * pace) if seconds is None else seconds
    require_number("seconds", length, *SECONDS_RANGE)
    count = max(1, round(length * rate))
    _require_few(count)
    start = first / frame_rate
    return FrameTimes(tuple(range(count)), tuple(start + number / rate * pace for number in range(count)), rate)


def _require_few(count: int) -> None:
    if count > MAX_IMAGES:
        raise InvalidOptionError(f"seconds must hold at most {MAX_IMAGES} images, got {count}. Choose fewer.")


def _parse(words: str | None, count: int) -> tuple[int, int, int]:
    """Return the first frame, the one after the last, and the step."""
    if words is None:
        return 0, count, 1
    match = _RANGE.fullmatch(words)
    step = int(match[3] or 1) if match else 0
    if match is None or step < 1:
        raise InvalidOptionError(
            f"frames must be A:B or A:B:STEP, got {words}. Write 0:10 for the first ten, --frames=-10: for the last."
        )
    low, high = (default if word is None else int(word) for word, default in ((match[1], 0), (match[2], count)))
    first, end = (count + number if number < 0 else number for number in (low, high))
    if not 0 <= first < end <= count:
        raise InvalidOptionError(
            f"frames must be some of the {count} that there are, 0:{count}, got {words}. Leave out those that are not."
        )
    return first, end, step
