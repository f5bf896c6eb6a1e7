"""Gaussians in memory: frozen NumPy records in canonical units, independent of devices and file formats.

Canonical form: metres, linear scales and opacities, quaternions xyzw, spherical harmonics ``(N, (degree + 1)^2, 3)``.
Axes are stated by a three-letter code (see `beam_warp.world.axes`), colour state by a colour-space token; neither is
guessed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntFlag
from itertools import permutations, product
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import (
    require_array,
    require_choice,
    require_count,
    require_finite,
    require_number,
    require_range,
    require_same_length,
    require_unit,
)
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import COLOR_SPACES

WORLD_AXES = "rfu"
"""Axes of the internal world: x right, y forward, z up; right-handed."""

_AXIS_CODES = {"".join(code) for ends in product("lr", "ud", "fb") for code in permutations(ends)}
"""Every way in which x, y and z can point."""

MATERIAL_CHANNELS = ("base_color", "roughness", "ambient_occlusion", "normals")
"""The channels that relighting reads."""

MAX_SH_DEGREE = 4


class Observability(IntFlag):
    """Reasons why a Gaussian's material was not fully measured; 0 is fully observed."""

    OBSERVED = 0
    UNLIT = 1  #: hardly any light of the capture reaches it
    UNSEEN = 2  #: buried or transparent: no view shows it
    SATURATED = 4  #: its captured colour is at the top of its range
    UNCERTAIN_NORMAL = 8  #: its neighbourhood does not determine a surface
    FILLED = 16  #: its value was taken from neighbours
    GRAZING = 32  #: it is only seen, or only lit, at grazing angles


@dataclass(frozen=True)
class Attribute:
    """Contract of one per-Gaussian array."""

    name: str
    trailing: tuple[int | None, ...]
    low: float = -np.inf
    high: float = np.inf
    unit_length: bool = False
    required: bool = False
    dtype: str = "float32"


ATTRIBUTES: Mapping[str, Attribute] = {
    attribute.name: attribute
    for attribute in (
        Attribute("positions", (3,), required=True),
        Attribute("orientations", (4,), unit_length=True, required=True),
        Attribute("scales", (3,), low=0.0, required=True),
        Attribute("opacities", (), low=0.0, high=1.0, required=True),
        Attribute("radiance", (None, 3)),
        Attribute("base_color", (3,), low=0.0, high=1.0),
        Attribute("roughness", (), low=0.0, high=1.0),
        Attribute("ambient_occlusion", (), low=0.0, high=1.0),
        Attribute("normals", (3,), unit_length=True),
        Attribute("normal_confidence", (), low=0.0, high=1.0),
        Attribute("ambient_occlusion_error", (), low=0.0),
        Attribute("base_color_error", (3,), low=0.0),
        Attribute("roughness_error", (), low=0.0),
        Attribute("observability", (), low=0, high=255, dtype="uint8"),
        Attribute("ids", (), dtype="int64"),
    )
}
"""Every per-Gaussian array that a cloud can hold, in the order in which files list them."""


@dataclass(frozen=True, eq=False)
class InvalidRows:
    """Rows that are no valid Gaussian, with counts by fault; a row with several faults counts for the first.

    Attributes:
        rows: Numbers of these rows, ascending, ``(K,)`` int64.
        not_finite: Rows with NaN or infinity in any array.
        negative_scales: Rows with a scale below 0.
        zero_quaternions: Rows with an orientation of length 0.
    """

    rows: NDArray[np.int64]
    not_finite: int
    negative_scales: int
    zero_quaternions: int

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.rows)

    def __str__(self) -> str:
        """Return the counts in words: ``2 not finite, 1 with a zero quaternion``; empty if there are none."""
        counts = (
            (self.not_finite, "not finite"),
            (self.negative_scales, "with a negative scale"),
            (self.zero_quaternions, "with a zero quaternion"),
        )
        return ", ".join(f"{count} {what}" for count, what in counts if count)


@dataclass(frozen=True, eq=False, kw_only=True)
class GaussianCloud:
    """Gaussians of one moment.

    Attributes:
        positions: Centres [m], ``(N, 3)`` float32.
        orientations: Unit quaternions xyzw, local to world, ``(N, 4)`` float32.
        scales: Standard deviations along the local axes [m], linear, ``(N, 3)`` float32; 0 is allowed (a disc).
        opacities: Peak alpha in [0, 1], linear, ``(N,)`` float32.
        radiance: Captured colour as real spherical harmonics in the 3DGS basis and sign convention,
            ``(N, (degree + 1)^2, 3)`` float32; the colour in direction d is ``0.5 + sum_k Y_k(d) radiance[:, k]``
            with d from the camera to the Gaussian. Its colour space is ``radiance_color_space``.
        base_color: Diffuse reflectance in [0, 1], scene-linear Rec.709, ``(N, 3)`` float32.
        roughness: Perceptual roughness in [0, 1] (alpha = roughness^2), ``(N,)`` float32.
        ambient_occlusion: Hemispherical cosine-weighted visibility; 1 is open, ``(N,)`` float32.
        normals: Unit normals on the open side, ``(N, 3)`` float32.
        normal_confidence: 1 where the neighbourhood determines the normal, ``(N,)`` float32.
        ambient_occlusion_error: Standard error of ``ambient_occlusion``, ``(N,)`` float32.
        base_color_error: Standard error of ``base_color``, ``(N, 3)`` float32.
        roughness_error: Standard error of ``roughness``, ``(N,)`` float32.
        observability: `Observability` flags, ``(N,)`` uint8.
        ids: Persistent identities across frames, ``(N,)`` int64.
        axes: Which way x, y and z point, e.g. ``"rfu"`` (see `beam_warp.world.axes`).
        radiance_color_space: `DISPLAY_SRGB` or `LINEAR_REC709`; stated if and only if ``radiance`` is there.

    Raises:
        InvalidArrayError: An array's shape, type, finiteness, range or unit length breaks the contract.
        InvalidOptionError: The colour space is missing, superfluous or unknown.
    """

    positions: NDArray[np.float32]
    orientations: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    radiance: NDArray[np.float32] | None = None
    base_color: NDArray[np.float32] | None = None
    roughness: NDArray[np.float32] | None = None
    ambient_occlusion: NDArray[np.float32] | None = None
    normals: NDArray[np.float32] | None = None
    normal_confidence: NDArray[np.float32] | None = None
    ambient_occlusion_error: NDArray[np.float32] | None = None
    base_color_error: NDArray[np.float32] | None = None
    roughness_error: NDArray[np.float32] | None = None
    observability: NDArray[np.uint8] | None = None
    ids: NDArray[np.int64] | None = None
    axes: str = WORLD_AXES
    radiance_color_space: str | None = None

    def __post_init__(self) -> None:
        """Convert every array to its canonical type once and check it against its contract."""
        if not (isinstance(self.axes, str) and self.axes in _AXIS_CODES):
            raise InvalidOptionError(
                f"axes must name one of l/r, u/d and f/b each, got {self.axes!r}. Write a code such as rfu."
            )
        count = len(np.atleast_1d(np.asarray(self.positions)))
        for name, attribute in ATTRIBUTES.items():
            value: ArrayLike | None = getattr(self, name)
            if value is None:
                if attribute.required:
                    raise InvalidArrayError(f"{name} must be given, got None. Pass one row for each Gaussian.")
                continue
            array = require_array(name, value, (None, *attribute.trailing), np.dtype(attribute.dtype))
            require_same_length(name, array, "positions", count)
            if array.dtype.kind == "f":
                require_finite(name, array)
            if attribute.unit_length:
                require_unit(name, array)
            if np.isfinite(attribute.low) or np.isfinite(attribute.high):
                require_range(name, array, attribute.low, attribute.high)
            if array is value:
                array = array.view()  # protected without touching the caller's own array
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.radiance is not None:
            sh_degree_of(self.radiance.shape[1])
        if (self.radiance is None) != (self.radiance_color_space is None):
            raise InvalidOptionError(
                "radiance_color_space must be given if and only if radiance is, got "
                f"{self.radiance_color_space!r}. State the colour space of the spherical harmonics."
            )
        if self.radiance_color_space is not None:
            require_choice("radiance_color_space", self.radiance_color_space, COLOR_SPACES)

    @classmethod
    def leaving_out_invalid(cls, **fields: Any) -> tuple[GaussianCloud, InvalidRows]:
        """Make a cloud of the valid rows, and say which rows were left out.

        The constructor refuses an array with a broken row, since leaving a row out changes the numbers of those after
        it. This method is for training results, which have such rows: it leaves out rows with NaN or infinity in any
        array, negative scales, or zero quaternions. Faults of a whole array (its shape, its range, logits instead of
        opacities) are refused as by the constructor.

        Args:
            fields: The constructor's arguments.

        Returns:
            The cloud, and the rows that it lacks.

        Raises:
            InvalidArrayError: The constructor refuses the remaining rows.
            InvalidOptionError: The constructor refuses an option.
        """
        if any(fields.get(name) is None for name, attribute in ATTRIBUTES.items() if attribute.required):
            cls(**fields)  # refuses, in its own words
        arrays: dict[str, NDArray[Any]] = {}
        for name, attribute in ATTRIBUTES.items():
            if fields.get(name) is not None:
                with np.errstate(over="ignore"):  # beyond float32 is infinity, and so counted below
                    array = require_array(name, fields[name], (None, *attribute.trailing), np.dtype(attribute.dtype))
                arrays[name] = array
                require_same_length(name, array, "positions", len(arrays["positions"]))
        not_finite = np.zeros(len(arrays["positions"]), bool)
        for array in arrays.values():
            if array.dtype.kind == "f":
                not_finite |= ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        negative = ~not_finite & (arrays["scales"] < 0.0).any(axis=1)
        zero = ~not_finite & ~negative & (arrays["orientations"] == 0.0).all(axis=1)
        broken = not_finite | negative | zero
        counts = (int(np.count_nonzero(reason)) for reason in (not_finite, negative, zero))
        kept: dict[str, Any] = {name: array[~broken] for name, array in arrays.items()}
        return cls(**(fields | kept)), InvalidRows(np.flatnonzero(broken), *counts)

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.positions)

    @property
    def sh_degree(self) -> int | None:
        """Degree of the captured radiance, or None without one."""
        return None if self.radiance is None else sh_degree_of(self.radiance.shape[1])

    @property
    def is_relightable(self) -> bool:
        """True if every channel that relighting reads is there."""
        return all(getattr(self, name) is not None for name in MATERIAL_CHANNELS)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that are there, by name, in file order."""
        return {name: getattr(self, name) for name in ATTRIBUTES if getattr(self, name) is not None}

    def with_arrays(self, **changes: Any) -> GaussianCloud:
        """Return a copy with some fields replaced; the copy is checked like a new record."""
        return replace(self, **changes)

    def select(self, rows: ArrayLike) -> GaussianCloud:
        """Return the Gaussians that a mask or an index array picks, in its order."""
        index = np.asarray(rows)
        return replace(self, **{name: array[index] for name, array in self.arrays().items()})


def sh_degree_of(coefficient_count: int) -> int:
    """Return the spherical-harmonics degree of a coefficient count, refusing counts that are no full degree."""
    degree = round(np.sqrt(coefficient_count)) - 1
    if (degree + 1) ** 2 != coefficient_count or not (0 <= degree <= MAX_SH_DEGREE):
        raise InvalidArrayError(
            f"radiance must have (degree + 1)^2 coefficients with degree at most {MAX_SH_DEGREE}, "
            f"got {coefficient_count}. Drop the incomplete band."
        )
    return degree


Topology = Literal["constant", "perFrame"]


@dataclass(frozen=True, eq=False)
class GaussianSequence:
    """Gaussians over time, read frame by frame so that memory does not grow with the number of frames.

    Attributes:
        frame_count: Number of frames, at least 1.
        read_frame: Returns the cloud of frame 0 … ``frame_count - 1``; callable in any order, from any thread.
        frames_per_second: Playback rate [1/s].
        constant: Names of the arrays that are the same in every frame; they are stored once.
        topology: ``constant`` if row i is the same Gaussian in every frame, else ``perFrame``.
        metadata: Provenance as text (producer, roughness source, illuminant, …), how the Gaussians are to be drawn,
            and which frames of a capture they show; see `beam_warp.world.metadata`.
    """

    frame_count: int
    read_frame: Callable[[int], GaussianCloud] = field(repr=False)
    frames_per_second: float = 30.0
    constant: frozenset[str] = frozenset()
    topology: Topology = "perFrame"
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the counts and names; frames themselves are checked as they are read."""
        require_count("frame_count", self.frame_count)
        require_number("frames_per_second", self.frames_per_second, 1e-3, 1e6)
        require_choice("topology", self.topology, ("constant", "perFrame"))
        unknown = self.constant - set(ATTRIBUTES)
        if unknown:
            raise InvalidOptionError(
                f"constant must name attributes of a cloud, got {sorted(unknown)}. Known: {', '.join(ATTRIBUTES)}."
            )

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.frame_count

    def __getitem__(self, frame: int) -> GaussianCloud:
        """Read one frame."""
        if not (0 <= frame < self.frame_count):
            raise IndexError(f"frame must be in [0, {self.frame_count - 1}], got {frame}. Ask for a frame that exists.")
        return self.read_frame(frame)

    def __iter__(self) -> Iterator[GaussianCloud]:
        """Read every frame in order."""
        return (self[frame] for frame in range(self.frame_count))

    @classmethod
    def from_clouds(
        cls,
        clouds: Sequence[GaussianCloud],
        *,
        frames_per_second: float = 30.0,
        metadata: Mapping[str, str] | None = None,
    ) -> GaussianSequence:
        """Make a sequence of clouds in memory; which arrays are constant, and the topology, are found by comparison."""
        held = tuple(clouds)
        require_count("len(clouds)", len(held))
        first = held[0]
        same_rows = all(
            len(cloud) == len(first)
            and (cloud.ids is None) == (first.ids is None)
            and (first.ids is None or np.array_equal(cloud.ids, first.ids))  # type: ignore[arg-type]
            for cloud in held
        )
        constant = frozenset(
            name
            for name, array in first.arrays().items()
            if all(np.array_equal(array, cloud.arrays().get(name, ())) for cloud in held[1:])
        )
        # Equal counts alone are no identity: consumers would blend unrelated Gaussians at fractional times.
        identified = len(held) == 1 or first.ids is not None
        return cls(
            frame_count=len(held),
            read_frame=held.__getitem__,
            frames_per_second=frames_per_second,
            constant=constant if same_rows else frozenset(),
            topology="constant" if same_rows and identified else "perFrame",
            metadata=dict(metadata or {}),
        )
