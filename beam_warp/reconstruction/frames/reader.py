"""Images of a capture, a frame at a time: the next frame is read while the present one is worked on."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self

from beam_warp.capture.capture import CaptureRecord
from beam_warp.capture.digests import CaptureDigests
from beam_warp.capture.views import CapturedView

LOADING_THREADS = 8
"""Images decoded at a time."""


class FrameReader:
    """Digests and images of frames; as a context manager it ends its threads."""

    def __init__(self, records: Mapping[int, Sequence[CaptureRecord]], digests: CaptureDigests) -> None:
        """Start the threads that read.

        Args:
            records: The records of each frame.
            digests: What is known of their files.
        """
        self._records = records
        self._digests = digests
        self._pool = ThreadPoolExecutor(min(LOADING_THREADS, os.cpu_count() or 1))
        self._ahead = ThreadPoolExecutor(1)
        self._expected: tuple[int, Future[list[CapturedView]]] | None = None

    def __enter__(self) -> Self:
        """Return the reader."""
        return self

    def __exit__(self, *error: object) -> None:
        """End the threads, what is read ahead first."""
        self._ahead.shutdown(wait=True, cancel_futures=True)
        self._pool.shutdown()

    def expect(self, frame: int) -> None:
        """Begin to read a frame that is likely to be asked for next."""
        self._expected = (frame, self._ahead.submit(self._prepare, frame))

    def digest(self, frame: int) -> str:
        """Return the digest of a frame's records and files."""
        return self._digests.of(frame, self._records[frame], self._pool)

    def views(self, frame: int) -> list[CapturedView]:
        """Return the images of a frame, one view for each record."""
        expected, self._expected = self._expected, None
        if expected is not None and expected[0] == frame:
            return expected[1].result()
        return self._read(frame)

    def _prepare(self, frame: int) -> list[CapturedView]:
        self.digest(frame)  # is remembered
        return self._read(frame)

    def _read(self, frame: int) -> list[CapturedView]:
        return list(self._pool.map(lambda record: record.view(), self._records[frame]))  # kinds of records differ
