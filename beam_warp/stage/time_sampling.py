"""Sampling of a sequence of Gaussians at any time, between frames too."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_choice, require_number
from beam_warp.world.gaussians import ATTRIBUTES, GaussianCloud, GaussianSequence
from beam_warp.world.quaternions import slerp

SNAP = 1e-6
"""A time this close to a frame is that frame's [frame]: k / fps * fps is k but for rounding."""

Ends = Literal["hold", "loop"]
Blend = Literal["identified", "rows", "nearest"]


class Moment(NamedTuple):
    """Where a time falls: a share of the way from one frame to another; both are the same on a frame."""

    frame: int
    following: int
    fraction: float

    @property
    def nearest(self) -> int:
        """The nearer frame."""
        return self.frame if self.fraction < 0.5 else self.following


class TimeSampler:
    """Reads a sequence at fractional frames.

    Positions, opacities, materials, their errors and radiance go linearly, orientations by `slerp`, scales by their
    logarithm, normals linearly and back to unit length; flags are the nearer frame's. What is the same array in both
    frames is passed on as it is. At a frame, its very cloud is returned.

    Frames are read when they are needed, and the last two are kept.

    Args:
        sequence: Frames to read.
        ends: Behaviour before the first and after the last frame: ``hold`` them, or ``loop``, where the first frame
            follows the last one, and times between the two are blended like others.
        blend: ``identified`` blends two frames if their Gaussians are known to correspond: by equal ids, or by the
            sequence's topology. ``rows`` takes row i of both for the same wherever counts agree. ``nearest`` never
            blends. Frames that are not blended are shown as they are, the nearer one, and `notes` say so.

    Raises:
        InvalidOptionError: An option is no such word.
    """

    def __init__(self, sequence: GaussianSequence, *, ends: Ends = "hold", blend: Blend = "identified") -> None:
        """Read nothing yet."""
        require_choice("ends", ends, ("hold", "loop"))
        require_choice("blend", blend, ("identified", "rows", "nearest"))
        self.sequence = sequence
        self.ends = ends
        self.blend = blend
        self._held: tuple[tuple[int, GaussianCloud], ...] = ()  # replaced, never changed: threads may share a sampler
        self._notes: dict[str, None] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """What could not be blended so far, and why; each reason once."""
        return tuple(self._notes)

    def moment(self, frame: float) -> Moment:
        """Return which frames a fractional frame is between, reading none.

        Raises:
            InvalidOptionError: It is not finite.
        """
        count = len(self.sequence)
        place = require_number("frame", frame, -1e12, 1e12)
        if count == 1:
            return Moment(0, 0, 0.0)
        if self.ends == "loop":
            place %= count
        else:
            place = min(max(place, 0.0), count - 1.0)
        whole = round(place)
        if abs(place - whole) <= SNAP:
            return Moment(whole % count, whole % count, 0.0)
        lower = int(np.floor(place))
        return Moment(lower % count, (lower + 1) % count, place - lower)

    def at(self, frame: float) -> GaussianCloud:
        """Return the cloud at a fractional frame, counted from 0.

        Raises:
            InvalidOptionError: It is not finite.
            BeamError: A frame cannot be read.
        """
        return self.at_moment(self.moment(frame))

    def at_moment(self, moment: Moment) -> GaussianCloud:
        """Return the cloud at a place that `moment` found."""
        if moment.frame == moment.following:
            return self._read(moment.frame)[0]
        if self.blend == "nearest":
            return self._read(moment.nearest)[0]
        first, second = self._read(moment.frame, moment.following)
        reason = self._hindrance(first, second)
        if reason:
            self._notes.setdefault(f"{reason}: the nearer frame is shown between frames")
            return first if moment.nearest == moment.frame else second
        return blend_clouds(first, second, moment.fraction)

    def _read(self, *frames: int) -> list[GaussianCloud]:
        """Return one or two frames, kept or read; they are the ones kept then, one of them with the newer of before."""
        held = dict(self._held)
        found = {frame: held[frame] if frame in held else self.sequence[frame] for frame in frames}
        others = [entry for entry in self._held if entry[0] not in found]
        self._held = (*found.items(), *others)[:2]
        return list(found.values())

    def _hindrance(self, first: GaussianCloud, second: GaussianCloud) -> str:
        """Say why two frames cannot be blended; nothing if they can."""
        if len(first) != len(second):
            return "frames have different numbers of Gaussians"
        if set(first.arrays()) != set(second.arrays()) or first.sh_degree != second.sh_degree:
            return "frames hold different arrays"
        if (first.axes, first.radiance_color_space) != (second.axes, second.radiance_color_space):
            return "frames have different axes or colour spaces"
        if self.blend == "rows" or self.sequence.topology == "constant":
            return ""
        if first.ids is None or second.ids is None:
            return "Gaussians of different frames are not known to correspond (they have no ids)"
        if not (_is_same(first.ids, second.ids) or np.array_equal(first.ids, second.ids)):
            return "frames hold Gaussians of different ids"
        return ""


def blend_clouds(first: GaussianCloud, second: GaussianCloud, fraction: float) -> GaussianCloud:
    """Return what lies between two clouds whose rows correspond; see `TimeSampler`.

    Args:
        first: Cloud at fraction 0.
        second: Cloud at fraction 1; as many Gaussians with the same arrays, in the same axes.
        fraction: Part of the way, in [0, 1].

    Raises:
        InvalidOptionError: The fraction is out of range.
    """
    share = require_number("fraction", fraction, 0.0, 1.0)
    ends: Mapping[str, NDArray[Any]] = second.arrays()
    changes = {
        name: _blend(name, array, ends[name], share)
        for name, array in first.arrays().items()
        if not (_is_same(array, ends[name]) or np.array_equal(array, ends[name]))
    }
    return first.with_arrays(**changes) if changes else first


def _blend(name: str, start: NDArray[Any], end: NDArray[Any], share: float) -> NDArray[Any]:
    """Return one array between two."""
    if start.dtype.kind != "f":
        return start if share < 0.5 else end
    if name == "orientations":
        return slerp(start, end, share).astype(np.float32)
    if name == "scales":
        return _between_logarithms(start, end, share)
    mixed = start + np.float32(share) * (end - start)
    if name == "normals":
        length = np.linalg.norm(mixed, axis=1, keepdims=True)
        nearer = start if share < 0.5 else end
        return np.where(length > 1e-6, mixed / np.maximum(length, 1e-6), nearer)  # opposite ones have no middle
    return np.clip(mixed, ATTRIBUTES[name].low, ATTRIBUTES[name].high)  # rounding may leave the range by one bit


def _between_logarithms(start: NDArray[Any], end: NDArray[Any], share: float) -> NDArray[Any]:
    """Return geometric means; arithmetic ones beside a 0, whose logarithm is none, and of equals, which stay."""
    flat = (start <= 0.0) | (end <= 0.0) | (start == end)
    first, second = np.where(flat, 1.0, start).astype(np.float64), np.where(flat, 1.0, end).astype(np.float64)
    geometric = np.exp((1.0 - share) * np.log(first) + share * np.log(second))
    return np.where(flat, start + np.float32(share) * (end - start), geometric).astype(np.float32)


def _is_same(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Say whether two arrays are the same memory: clouds hold views of what they are given."""
    one, other = first.__array_interface__, second.__array_interface__
    return one["data"] == other["data"] and first.shape == second.shape and first.strides == second.strides
