"""Progress of a long job: what its caller is told, and the seconds that its stages take."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp

from beam_warp.jobs.listeners import CountProgress, StageProgress


class StageTimer:
    """Seconds by stage. Each stage ends when the device is done, so that work is charged to the stage that started it.

    Attributes:
        seconds: By stage.
    """

    def __init__(self, device: Any) -> None:
        """Start with no stage; ``device`` is a Warp device."""
        self.seconds: dict[str, float] = {}
        self._device = device

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Charge what is done in this context to a stage."""
        start = time.perf_counter()
        yield
        wp.synchronize_device(self._device)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


class JobLog:
    """Progress and seconds of a job that works frame by frame.

    Attributes:
        timer: Seconds by stage.
    """

    def __init__(self, progress: StageProgress, frame_count: int, device: Any) -> None:
        """Report to ``progress`` about that many frames on a Warp device."""
        self.timer = StageTimer(device)
        self._progress = progress
        self._frame_count = frame_count

    def report(self, stage: str, done: int, total: int) -> None:
        """Pass progress on."""
        self._progress(stage, done, total)

    def within(self, stage: str, frame: int) -> CountProgress:
        """Return a reporter of progress inside a frame, which counts the Gaussians of all frames."""
        frames = self._frame_count
        return lambda done, total: self._progress(stage, frame * total + done, frames * total)
