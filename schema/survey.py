"""First pass over a sequence, before it is written: which arrays exist, which vary, and which precision is safe.

OpenUSD needs these answers before the first frame: an attribute has one precision and one spherical-harmonics degree,
and is either constant or sampled. The pass holds one frame at a time. Parts of a sequence may be surveyed by several
processes, for surveys of parts add up.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.digests import array_digest
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB, linear_to_srgb, srgb_to_linear
from beam_warp.schema.keys import departure
from beam_warp.schema.layout import CHANNELS, UP_AXES
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.harmonics import SH_C0


@dataclass(frozen=True)
class Survey:
    """Properties of a whole sequence.

    Attributes:
        axes: Axes code of every frame.
        counts: Number of Gaussians in each frame.
        names: Arrays to write, in file order; ``radiance`` is always among them.
        varying: Arrays that are not the same in every frame.
        half: Arrays for which half precision is safe.
        captured: True if ``radiance`` was captured; False if it is a substitute for viewers that cannot relight.
        color_space: Colour space of ``radiance``.
        sh_degree: Highest degree of ``radiance`` in any frame.
    """

    axes: str
    counts: tuple[int, ...]
    names: tuple[str, ...]
    varying: frozenset[str]
    half: frozenset[str]
    captured: bool
    color_space: str
    sh_degree: int

    @classmethod
    def of(cls, found: FramesSurvey, sequence: GaussianSequence) -> Survey:
        """Return the properties of a sequence, given those of all its frames.

        Raises:
            InvalidOptionError: A stage cannot state the axes, or the count changes although the topology is constant.
        """
        require_upright(found.axes)
        same_count = _have_one_count(found.counts, sequence)
        return cls(
            axes=found.axes,
            counts=found.counts,
            names=tuple(name for name in CHANNELS if name in found.digests),
            varying=frozenset(found.varying - (sequence.constant if same_count else set())),
            half=frozenset(
                name for name in found.digests if CHANNELS[name].half_is_safe(found.largest[name], found.smallest[name])
            ),
            captured=found.captured,
            color_space=found.color_space or DISPLAY_SRGB,
            sh_degree=found.sh_degree,
        )


@dataclass(frozen=True)
class FramesSurvey:
    """Properties of some frames in a row, from which those of a whole sequence follow; see `Survey.of`.

    Attributes:
        axes: Axes code of the frames.
        color_space: Colour space of their radiance; None for the default.
        captured: Whether they have captured radiance.
        counts: Number of Gaussians in each frame.
        sh_degree: Highest degree of ``radiance``.
        digests: Digest of each array that is the same in all of these frames, empty for the others.
        largest: Largest magnitude in each array.
        smallest: Smallest magnitude other than 0 in each array whose small values count, else infinity.
    """

    axes: str
    color_space: str | None
    captured: bool
    counts: tuple[int, ...]
    sh_degree: int
    digests: Mapping[str, str]
    largest: Mapping[str, float]
    smallest: Mapping[str, float]

    @classmethod
    def of(cls, cloud: GaussianCloud, undigested: Container[str] = ()) -> FramesSurvey:
        """Return the properties of one frame; arrays that are known to vary need no digest."""
        arrays = stored_arrays(cloud)
        ranges = {name: _magnitudes(name, array) for name, array in arrays.items()}
        return cls(
            axes=cloud.axes,
            color_space=cloud.radiance_color_space,
            captured=cloud.radiance is not None,
            counts=(len(cloud),),
            sh_degree=cloud.sh_degree or 0,
            digests={name: "" if name in undigested else array_digest(array) for name, array in arrays.items()},
            largest={name: largest for name, (largest, _) in ranges.items()},
            smallest={name: smallest for name, (_, smallest) in ranges.items()},
        )

    def __add__(self, other: FramesSurvey) -> FramesSurvey:
        """Return the properties of these frames and those that follow.

        Raises:
            InvalidOptionError: They differ in axes or colour space.
            InvalidArrayError: They differ in which arrays they hold.
        """
        _require_same_kind(self, other)
        return FramesSurvey(
            axes=self.axes,
            color_space=self.color_space,
            captured=self.captured,
            counts=self.counts + other.counts,
            sh_degree=max(self.sh_degree, other.sh_degree),
            digests={name: it if it == other.digests[name] else "" for name, it in self.digests.items()},
            largest={name: max(it, other.largest[name]) for name, it in self.largest.items()},
            smallest={name: min(it, other.smallest[name]) for name, it in self.smallest.items()},
        )

    @property
    def varying(self) -> set[str]:
        """Names of the arrays that are not the same in all of these frames."""
        return {name for name, digest in self.digests.items() if not digest}


def survey_sequence(sequence: GaussianSequence, bounds: Mapping[str, float] | None = None) -> Survey:
    """Read every frame once and return the properties of the sequence.

    Args:
        sequence: The sequence.
        bounds: How far each array may be from its original: one that is never further from its first frame counts as
            constant. None for arrays that must be the same.

    Raises:
        InvalidOptionError: A stage cannot state the axes, frames differ in axes or colour space, or the count changes
            although the topology is constant.
        InvalidArrayError: Frames differ in which arrays they hold.
    """
    first = sequence[0]
    found, left = FramesSurvey.of(first), set[str]()
    require_upright(found.axes)
    held = {} if bounds is None else stored_arrays(first)
    for frame in range(1, len(sequence)):
        cloud = sequence[frame]
        found += FramesSurvey.of(cloud, found.varying | sequence.constant)
        arrays = stored_arrays(cloud) if bounds is not None else {}
        left |= {
            name
            for name in found.varying & held.keys() - left
            if not _is_near(name, held[name], arrays[name], (bounds or {}).get(name, 0.0))
        }
    survey = Survey.of(found, sequence)
    return survey if bounds is None else replace(survey, varying=survey.varying & left)


def _is_near(name: str, one: NDArray[Any], other: NDArray[Any], bound: float) -> bool:
    """Return whether two arrays are within a bound of each other, in each precision that a file may hold them in."""
    if not departure(name, one, other) <= bound:
        return False
    channel = CHANNELS[name]
    if channel.half_type_name is None or channel.position_like or other.dtype.kind != "f":
        return True
    with np.errstate(over="ignore", invalid="ignore"):
        return departure(name, one.astype(np.float16), other.astype(np.float16)) <= bound


def require_upright(axes: str) -> None:
    """Refuse axes that a stage cannot state.

    Raises:
        InvalidOptionError: It cannot.
    """
    if axes not in UP_AXES:
        raise InvalidOptionError(
            f"axes must be rub (y up) or rfu (z up) in a USD asset, got {axes!r}. Convert the axes first."
        )


def _magnitudes(name: str, array: NDArray[Any]) -> tuple[float, float]:
    """Return the largest magnitude of an array, and the smallest other than 0 if small values count."""
    if array.dtype.kind != "f" or not array.size:
        return 0.0, np.inf
    smallest = float(np.abs(array[array != 0]).min(initial=np.inf)) if CHANNELS[name].relative else np.inf
    return max(0.0, float(array.max()), -float(array.min())), smallest


def stored_arrays(cloud: GaussianCloud) -> dict[str, NDArray[Any]]:
    """Return the arrays of a cloud as a file holds them, with a substitute for radiance if none was captured."""
    arrays = cloud.arrays()
    if cloud.radiance is None:
        arrays["radiance"] = _fallback_radiance(cloud)
    return arrays


def display_color(cloud: GaussianCloud) -> NDArray[np.float32]:
    """Return the mean colour of a cloud weighted by opacity, scene-linear Rec.709, ``(3,)``."""
    if not len(cloud) or cloud.opacities.sum() <= 0.0:
        return np.full(3, 0.5, np.float32)
    if cloud.base_color is not None:
        color = cloud.base_color.astype(np.float64)
    else:
        color = np.clip(0.5 + SH_C0 * stored_arrays(cloud)["radiance"][:, 0].astype(np.float64), 0.0, 1.0)
        if cloud.radiance_color_space in (None, DISPLAY_SRGB):
            color = srgb_to_linear(color)
    return np.average(color, axis=0, weights=cloud.opacities).astype(np.float32)


def albedo_radiance(cloud: GaussianCloud) -> NDArray[np.float32]:
    """Return coefficients of degree 0, ``(N, 3)``, that show a cloud's base colour without occlusion, scene-linear."""
    if cloud.base_color is None:
        raise InvalidArrayError("base_color must be given, got none. Decompose the asset first.")
    return ((cloud.base_color.astype(np.float64) - 0.5) / SH_C0).astype(np.float32)


def _fallback_radiance(cloud: GaussianCloud) -> NDArray[np.float32]:
    """Return radiance of degree 0 that shows base colour times ambient occlusion, or mid grey without base colour."""
    if cloud.base_color is None:
        return np.zeros((len(cloud), 1, 3), np.float32)
    color = cloud.base_color.astype(np.float64)
    if cloud.ambient_occlusion is not None:
        color = color * cloud.ambient_occlusion[:, None]
    return ((linear_to_srgb(color) - 0.5) / SH_C0).astype(np.float32)[:, None, :]


def _require_same_kind(first: FramesSurvey, other: FramesSurvey) -> None:
    """Refuse frames that cannot be stored in the same prim as those before them."""
    frame = len(first.counts)
    if first.digests.keys() != other.digests.keys() or first.captured != other.captured:
        names = {"radiance"} if first.captured != other.captured else set()
        names |= first.digests.keys() ^ other.digests.keys()
        raise InvalidArrayError(
            f"frames must hold the same arrays, got a difference in {', '.join(sorted(names))} at frame {frame}. "
            "Fill or drop these arrays everywhere."
        )
    for label, wanted, got in (
        ("axes", first.axes, other.axes),
        ("radiance_color_space", first.color_space, other.color_space),
    ):
        if got != wanted:
            raise InvalidOptionError(
                f"{label} must be the same in every frame, got {got!r} after {wanted!r} at frame {frame}. "
                "Convert the frames to one form."
            )


def _have_one_count(counts: tuple[int, ...], sequence: GaussianSequence) -> bool:
    """Return whether all frames have as many Gaussians, which a constant topology demands."""
    frame = next((frame for frame, count in enumerate(counts) if count != counts[0]), None)
    if frame is not None and (sequence.topology == "constant" or "positions" in sequence.constant):
        raise InvalidOptionError(
            f"topology must be perFrame where counts change, got {counts[frame]} Gaussians after {counts[0]} at frame "
            f"{frame}. Build the sequence with topology='perFrame' and no constant arrays."
        )
    return frame is None
