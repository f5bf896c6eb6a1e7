"""Rules about the arrays of one frame: lengths, finiteness, ranges, unit lengths, and what may change between frames.

A value that is not finite breaks one rule only: the other rules ignore it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import UNIT_TOLERANCE
from beam_warp.schema.validation.rules import Fault, Rule, entering
from beam_warp.world.gaussians import Observability

KNOWN_FLAGS = sum(Observability)

FRAME_RULES: list[Rule] = []


@dataclass(frozen=True)
class FrameArrays:
    """Arrays of a prim in one frame, as stored.

    Attributes:
        arrays: Arrays by their names in `beam_warp.schema.layout.CHANNELS`, without those that have no value.
        changed: Names of the arrays that can differ from the previous frame; in the first frame, all.
        attributes: Name of the authored variant of each array.
        extent: Box ``(2, 3)``, or None.
        sh_degree: Degree as authored, or None.
        constant_topology: True if the asset states that rows keep their identity.
        previous: Arrays of the previous frame, or None.
    """

    arrays: Mapping[str, NDArray[Any]]
    changed: frozenset[str]
    attributes: Mapping[str, str]
    extent: NDArray[Any] | None
    sh_degree: int | None
    constant_topology: bool
    previous: Mapping[str, NDArray[Any]] | None

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.arrays.get("positions", ()))

    def to_check(self, *names: str) -> Iterator[tuple[str, NDArray[Any]]]:
        """Yield attribute name and array of each named channel that exists and may have changed; by default of all."""
        for name in names or tuple(self.arrays):
            if name in self.changed and name in self.arrays:
                yield self.attributes[name], self.arrays[name]


@entering(FRAME_RULES, "BEAM-GEO-010", "error")
def _lengths(frame: FrameArrays) -> Iterator[Fault]:
    """Every array has one element for each position; USD ignores shorter arrays."""
    for name, array in frame.arrays.items():
        if name != "radiance" and len(array) != frame.count:
            yield Fault(
                f"the array must have {frame.count} elements, got {len(array)}. Write one each.", frame.attributes[name]
            )


@entering(FRAME_RULES, "BEAM-GEO-011", "error")
def _finite(frame: FrameArrays) -> Iterator[Fault]:
    """No array holds NaN or infinity."""
    for name, array in frame.to_check():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            row = np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1))[0]
            yield Fault(f"values must be finite, got NaN or infinity at element {row}. Drop that Gaussian.", name)


@entering(FRAME_RULES, "BEAM-GEO-015", "error", "positions")
def _extent(frame: FrameArrays) -> Iterator[Fault]:
    """extent is a box that contains every position."""
    if frame.extent is None or not frame.count:
        return
    positions = frame.arrays["positions"]
    held = positions[np.isfinite(positions).all(axis=1)]
    whole = frame.extent.shape == (2, 3)
    if not whole or (len(held) and not ((held >= frame.extent[0]) & (held <= frame.extent[1])).all()):
        yield Fault("extent must contain every position, got one outside. Compute it for each frame.", "extent")


@entering(FRAME_RULES, "BEAM-GEO-016", "warning", "positions")
def _not_empty(frame: FrameArrays) -> Iterator[Fault]:
    """A frame holds at least one Gaussian."""
    if not frame.count:
        yield Fault("a frame should hold Gaussians, got none. Leave the frame out, or hide the prim.", "positions")


@entering(FRAME_RULES, "BEAM-SH-002", "error", "radiance")
def _sh_size(frame: FrameArrays) -> Iterator[Fault]:
    """There are (degree + 1)^2 spherical-harmonics coefficients for each Gaussian."""
    if "radiance" in frame.arrays and frame.sh_degree is not None:
        wanted, got = frame.count * (frame.sh_degree + 1) ** 2, len(frame.arrays["radiance"])
        if got != wanted:
            yield Fault(
                f"there must be {wanted} coefficients, got {got}. Mend the degree.", frame.attributes["radiance"]
            )


@entering(FRAME_RULES, "BEAM-MAT-017", "warning", "observability")
def _observability(frame: FrameArrays) -> Iterator[Fault]:
    """Observability has only flags that the schema defines."""
    for name, array in frame.to_check("observability"):
        unknown = array & (255 - KNOWN_FLAGS)
        if unknown.any():
            row = np.flatnonzero(unknown)[0]
            yield Fault(
                f"flags should be in [0, {KNOWN_FLAGS}], got {array[row]} at element {row}. Clear others.", name
            )


@entering(FRAME_RULES, "BEAM-SEQ-005", "error", "positions")
def _constant_count(frame: FrameArrays) -> Iterator[Fault]:
    """The number of Gaussians does not change under constant topology."""
    if frame.constant_topology and frame.previous is not None and len(frame.previous["positions"]) != frame.count:
        before = len(frame.previous["positions"])
        yield Fault(f"the count must be constant, got {frame.count} after {before}. Say perFrame.", "positions")


@entering(FRAME_RULES, "BEAM-SEQ-006", "error", "ids")
def _unique_ids(frame: FrameArrays) -> Iterator[Fault]:
    """Identities are unique within a frame."""
    for name, array in frame.to_check("ids"):
        if len(np.unique(array)) != len(array):
            yield Fault("ids must be unique, got one twice. Number the Gaussians anew.", name)


@entering(FRAME_RULES, "BEAM-SEQ-007", "error", "ids")
def _constant_ids(frame: FrameArrays) -> Iterator[Fault]:
    """The identity of each row does not change under constant topology."""
    if frame.constant_topology and frame.previous is not None and "ids" in frame.changed:
        ids, before = frame.arrays.get("ids"), frame.previous.get("ids")
        if ids is not None and before is not None and len(ids) == len(before) and not np.array_equal(ids, before):
            yield Fault("ids must be the same in every frame, got other ones. Say perFrame.", frame.attributes["ids"])


@entering(FRAME_RULES, "BEAM-SEQ-008", "warning", "orientations")
def _continuous_quaternions(frame: FrameArrays) -> Iterator[Fault]:
    """Quaternions keep their sign under constant topology; engines that blend components would spin the Gaussians."""
    if not frame.constant_topology or frame.previous is None or "orientations" not in frame.changed:
        return
    now, before = frame.arrays.get("orientations"), frame.previous.get("orientations")
    if now is not None and before is not None and now.shape == before.shape:
        flipped = np.einsum("nk,nk->n", now.astype(np.float32), before.astype(np.float32)) < 0.0
        if flipped.any():
            row = np.flatnonzero(flipped)[0]
            yield Fault(
                f"quaternions should not change sign, got {flipped.sum()} that do, first at {row}. Negate them.",
                frame.attributes["orientations"],
            )


def _out_of_range(
    frame: FrameArrays, *, names: tuple[str, ...], low: float = 0.0, high: float = 1.0
) -> Iterator[Fault]:
    """Find values outside an interval."""
    for name, array in frame.to_check(*names):
        bad = np.isfinite(array) & ~((array >= low) & (array <= high))
        if bad.any():
            row = np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))[0]
            worst = array[bad].flat[0]
            yield Fault(
                f"values must lie in [{low:g}, {high:g}], got {worst:g} at element {row}. Clip or rescale them.", name
            )


def _not_unit(frame: FrameArrays, *, names: tuple[str, ...]) -> Iterator[Fault]:
    """Find vectors or quaternions whose length is not 1."""
    for name, array in frame.to_check(*names):
        length = np.linalg.norm(array.astype(np.float32), axis=1)
        bad = np.isfinite(length) & ~(np.abs(length - 1.0) <= UNIT_TOLERANCE)
        if bad.any():
            row = np.flatnonzero(bad)[0]
            yield Fault(f"vectors must have unit length, got {length[row]:.4g} at element {row}. Normalise them.", name)


_ERRORS = ("ambient_occlusion_error", "base_color_error", "roughness_error")
_not_negative = partial(_out_of_range, high=np.inf)

FRAME_RULES += [
    Rule(rule_id, "error", text, partial(check, names=names), names)
    for rule_id, text, check, names in (
        ("BEAM-GEO-012", "Orientations are unit quaternions.", _not_unit, ("orientations",)),
        ("BEAM-GEO-013", "Scales are linear and not negative (logarithms would be).", _not_negative, ("scales",)),
        ("BEAM-GEO-014", "Opacities are linear, in [0, 1] (logits are not).", _out_of_range, ("opacities",)),
        ("BEAM-MAT-010", "Base colour is in [0, 1].", _out_of_range, ("base_color",)),
        ("BEAM-MAT-011", "Roughness is in [0, 1].", _out_of_range, ("roughness",)),
        ("BEAM-MAT-012", "Ambient occlusion is a visibility in [0, 1].", _out_of_range, ("ambient_occlusion",)),
        ("BEAM-MAT-013", "Metallic is in [0, 1].", _out_of_range, ("metallic",)),
        ("BEAM-MAT-014", "Normals are unit vectors.", _not_unit, ("normals",)),
        ("BEAM-MAT-015", "Normal confidence is in [0, 1].", _out_of_range, ("normal_confidence",)),
        ("BEAM-MAT-016", "Standard errors are not negative.", _not_negative, _ERRORS),
    )
]
