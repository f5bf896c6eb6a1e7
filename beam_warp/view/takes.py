"""Takes that are made while they are played: a block is packed when a page asks for it, or the one before it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from beam_warp.converters.common.options import WriteOptions
from beam_warp.converters.delivery.decoder import MANIFEST
from beam_warp.converters.delivery.writer import Take, archive_bytes, json_bytes
from beam_warp.view.server import Content
from beam_warp.world.gaussians import GaussianSequence

SEGMENT_FRAMES = 6
"""Frames of a segment: few, so that the first one is there soon."""

LEVEL = 1
"""Level of zlib: a tenth more bytes than the smallest, in a thirtieth of the time."""

AHEAD = 2
"""Blocks that are made after the newest one that was asked for."""

HELD_BYTES, HELD_LEAST = 2**29, 16
"""Blocks are kept up to this size, but never fewer."""

FILE = "take.b4d"
"""Name of a take that is a file."""

_UNKNOWN = {"offset": 0, "bytes": 1, "unpacked": 4, "sha256": ""}
"""What a manifest says of a block that is not made yet: the least there is, for players that check."""

Made = TypeVar("Made")


class MadeAhead(Generic[Made]):
    """Things that take a while, each made when it is asked for, by one thread; the newest wish comes first."""

    def __init__(self, count: int, make: Callable[[int], Made], size: Callable[[Made], int]) -> None:
        """Start the thread.

        Args:
            count: How many there are.
            make: Makes one by its number, in the thread.
            size: Returns what one takes [byte].
        """
        self._count, self._make, self._size = count, make, size
        self._changed = threading.Condition()
        self._wanted: list[int] = []
        self._newest = 0
        self._made: OrderedDict[int, Made | Exception] = OrderedDict()
        self._is_closed = False
        threading.Thread(target=self._run, name="beam-view-blocks", daemon=True).start()

    def __getitem__(self, number: int) -> Made:
        """Return one, and wait until it is made; raises what its making raised, and tries again the next time."""
        with self._changed:
            if isinstance(self._made.get(number), Exception):
                del self._made[number]
            self._newest = number
            if number not in self._made:
                self._wanted.append(number)
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_closed or number in self._made)
            found = self._made.get(number, TimeoutError("the viewer was closed"))
        if isinstance(found, Exception):
            raise found
        return found

    def close(self) -> None:
        """End the thread after what it is at; who waits is told."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _next(self) -> int | None:
        """Return what to make: the newest wish, else what will be wished next."""
        self._wanted = [number for number in self._wanted if number not in self._made]
        if self._wanted:
            return self._wanted.pop()
        ahead = range(self._newest, min(self._newest + AHEAD + 1, self._count))
        return next((number for number in ahead if number not in self._made), None)

    def _run(self) -> None:
        while True:
            with self._changed:
                number = None
                while not self._is_closed and (number := self._next()) is None:
                    self._changed.wait()
            if self._is_closed or number is None:
                return
            try:
                made: Made | Exception = self._make(number)
            except Exception as error:
                made = error
            with self._changed:
                self._made[number] = made
                self._forget()
                self._changed.notify_all()

    def _forget(self) -> None:
        """Drop what was made first, where there is too much."""
        sizes = [0 if isinstance(made, Exception) else self._size(made) for made in self._made.values()]
        while len(sizes) > HELD_LEAST and sum(sizes) > HELD_BYTES:
            self._made.popitem(last=False)
            del sizes[0]


class SegmentedTake:
    """A take whose frames hold the same Gaussians: a container whose segments are made on demand."""

    def __init__(self, sequence: GaussianSequence) -> None:
        """Read the first frame, and begin with the first segment."""
        self._take = Take.of(sequence, WriteOptions())
        self._static = self._take.static_block(LEVEL)
        self._names = [f"{first:06d}" for first in range(0, len(sequence), SEGMENT_FRAMES)]
        self._blocks = MadeAhead(
            len(self._names),
            lambda number: self._take.segment_block(number * SEGMENT_FRAMES, SEGMENT_FRAMES, LEVEL),
            lambda block: len(block.content),
        )
        self.settings: dict[str, Any] = {"url": MANIFEST}
        self.close = self._blocks.close

    def find(self, name: str) -> Content | None:
        """Return a file of the container, or, as JSON, what its manifest would say of a segment."""
        if name == MANIFEST:
            return Content(self._manifest(), "application/json")
        if name == "static.bin":
            return Content(self._static.content)
        stem, _, suffix = name.partition(".")
        if stem not in self._names or suffix not in ("bin", "json"):
            return None
        block = self._blocks[self._names.index(stem)]
        return Content(block.content if suffix == "bin" else json_bytes(block.entry | {"offset": 0}))

    def _manifest(self) -> bytes:
        count = self._take.sequence.frame_count
        segments = [
            {
                "first": first,
                "frames": min(SEGMENT_FRAMES, count - first),
                "file": f"{name}.bin",
                "described": f"{name}.json",
                **_UNKNOWN,
            }
            for first, name in zip(range(0, count, SEGMENT_FRAMES), self._names, strict=True)
        ]
        return json_bytes(self._take.manifest() | {"static": self._static.entry | {"offset": 0}, "segments": segments})


class FrameTakes:
    """A take whose frames have nothing in common: a container for each, made on demand."""

    def __init__(self, sequence: GaussianSequence) -> None:
        """Begin with the first frame."""
        self._archives = MadeAhead(
            len(sequence),
            lambda frame: archive_bytes(
                replace(sequence, frame_count=1, read_frame=lambda _: sequence[frame]), WriteOptions(), LEVEL
            ),
            len,
        )
        self._files = {f"frames/{frame}.b4d": frame for frame in range(len(sequence))}
        self.settings: dict[str, Any] = {
            "url": "frames/0.b4d",
            "frames": len(sequence),
            "rate": sequence.frames_per_second,
        }
        self.close = self._archives.close

    def find(self, name: str) -> Content | None:
        """Return the container of a frame."""
        return Content(self._archives[self._files[name]]) if name in self._files else None


class FileTake:
    """A take that is a file already: pages read ranges of it."""

    def __init__(self, path: Path) -> None:
        """Take the file's name."""
        self._path = path
        self.settings: dict[str, Any] = {"url": FILE}

    def find(self, name: str) -> Content | None:
        """Return the file."""
        return Content(self._path) if name == FILE else None

    def close(self) -> None:
        """Leave the file as it is."""
