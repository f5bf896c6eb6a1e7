"""Frames of the main job: given as a sequence, read from a file by every worker, or reconstructed by the same plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

from beam_warp.capture.capture import Capture
from beam_warp.reconstruction.job import ReconstructionWork
from beam_warp.world.gaussians import GaussianSequence


class Frames(Protocol):
    """Frames with captured radiance, and the images that they were made from.

    Attributes:
        are_made: Whether they are there before any step is done.
    """

    are_made: bool

    @property
    def have_images(self) -> bool:
        """Whether there are images of a capture."""
        ...

    @property
    def may_be_constant(self) -> bool:
        """Whether the topology may turn out to be constant."""
        ...

    def numbers(self) -> tuple[int, ...]:
        """Return what the frames are called."""
        ...

    def step(self, number: int) -> tuple[str, ...]:
        """Return the names of the steps that make a frame; nothing for one that is there."""
        ...

    def sequence(self) -> GaussianSequence:
        """Return the frames, to be read when they are made; what is said of their topology may be too little."""
        ...

    def whole(self) -> GaussianSequence:
        """Return the frames when all are made."""
        ...

    def capture(self) -> Capture | None:
        """Return the images, with the cameras that the frames were fitted with, when the first frame is made."""
        ...


@dataclass(eq=False)
class GivenFrames:
    """Frames that are there.

    Attributes:
        read: Returns them; picklable, if other processes are to read them.
        seen: Images that they were made from.
    """

    are_made = True
    read: Callable[[], GaussianSequence]
    seen: Capture | None

    def numbers(self) -> tuple[int, ...]:
        """Return the frames' places."""
        return tuple(range(len(self.sequence())))

    @property
    def have_images(self) -> bool:
        """Whether images were given."""
        return self.seen is not None

    @property
    def may_be_constant(self) -> bool:
        """Whether the topology is constant."""
        return self.sequence().topology == "constant"

    def step(self, number: int) -> tuple[str, ...]:
        """Return nothing: every frame is there."""
        return ()

    @cached_property
    def _sequence(self) -> GaussianSequence:
        return self.read()

    def sequence(self) -> GaussianSequence:
        """Return the frames."""
        return self._sequence

    whole = sequence

    def capture(self) -> Capture | None:
        """Return the images."""
        return self.seen

    def __getstate__(self) -> dict[str, Any]:
        """Return what other processes read the frames with."""
        return {"read": self.read, "seen": self.seen}


@dataclass(eq=False)
class ReconstructedFrames:
    """Frames that steps of the same plan make.

    Attributes:
        work: What makes them.
        frames_per_second: Playback rate [1/s]; None for the capture's.
    """

    are_made, have_images = False, True
    work: ReconstructionWork
    frames_per_second: float | None

    def numbers(self) -> tuple[int, ...]:
        """Return the capture's numbers of the frames."""
        return tuple(self.work.frames.records)

    @property
    def may_be_constant(self) -> bool:
        """Whether there is one segment alone; in it, tracking may still be lost."""
        return self.work.may_be_constant

    def step(self, number: int) -> tuple[str, ...]:
        """Return the names of the steps that make a frame."""
        return self.work.makers(number)

    def sequence(self) -> GaussianSequence:
        """Return the frames without looking whether their topology is constant."""
        return self._played(self.work.sequence(is_constant=False))

    def whole(self) -> GaussianSequence:
        """Return the frames when all are made."""
        return self._played(self.work.sequence())

    def _played(self, sequence: GaussianSequence) -> GaussianSequence:
        """Return a sequence with the rate that was asked for."""
        rate = sequence.frames_per_second if self.frames_per_second is None else self.frames_per_second
        return replace(sequence, frames_per_second=rate)

    def capture(self) -> Capture:
        """Return the images, with corrected cameras."""
        return self.work.seen()
