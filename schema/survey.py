"""First pass over a sequence, before it is written: which arrays exist, which vary, and which precision is safe.

OpenUSD needs these answers before the first frame: an attribute has one precision and one spherical-harmonics degree,
and is either constant or sampled. The pass holds two frames at a time, so memory does not grow with their number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB, linear_to_srgb, srgb_to_linear
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


def survey_sequence(sequence: GaussianSequence) -> Survey:
    """Read every frame once and return the properties of the sequence.

    Raises:
        InvalidOptionError: A stage cannot state the axes, frames differ in axes or colour space, or the count changes
            although the topology is constant.
        InvalidArrayError: Frames differ in which arrays they hold.
    """
    first = sequence[0]
    if first.axes not in UP_AXES:
        raise InvalidOptionError(
            f"axes must be rub (y up) or rfu (z up) in a USD asset, got {first.axes!r}. Convert the axes first."
        )
    held = stored_arrays(first)
    counts, varying, degree = [], set(), 0
    largest = dict.fromkeys(held, 0.0)
    smallest = dict.fromkeys(held, np.inf)
    for frame in range(len(sequence)):
        cloud = first if frame == 0 else sequence[frame]
        _require_same_kind(sequence, frame, cloud, first)
        counts.append(len(cloud))
        arrays = held if frame == 0 else stored_arrays(cloud)
        degree = max(degree, cloud.sh_degree or 0)
        for name, array in arrays.items():
            if frame and name in sequence.constant and len(array) == len(held[name]):
                continue
            if frame and name not in varying and not np.array_equal(array, held[name]):
                varying.add(name)
            if array.dtype.kind == "f" and array.size:
                largest[name] = max(largest[name], float(array.max()), -float(array.min()))
                if CHANNELS[name].relative:
                    smallest[name] = min(smallest[name], float(np.abs(array[array != 0]).min(initial=np.inf)))
    return Survey(
        axes=first.axes,
        counts=tuple(counts),
        names=tuple(name for name in CHANNELS if name in held),
        varying=frozenset(varying),
        half=frozenset(name for name in held if CHANNELS[name].half_is_safe(largest[name], smallest[name])),
        captured=first.radiance is not None,
        color_space=first.radiance_color_space or DISPLAY_SRGB,
        sh_degree=degree,
    )


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


def _fallback_radiance(cloud: GaussianCloud) -> NDArray[np.float32]:
    """Return radiance of degree 0 that shows base colour times ambient occlusion, or mid grey without base colour."""
    if cloud.base_color is None:
        return np.zeros((len(cloud), 1, 3), np.float32)
    color = cloud.base_color.astype(np.float64)
    if cloud.ambient_occlusion is not None:
        color = color * cloud.ambient_occlusion[:, None]
    return ((linear_to_srgb(color) - 0.5) / SH_C0).astype(np.float32)[:, None, :]


def _require_same_kind(sequence: GaussianSequence, frame: int, cloud: GaussianCloud, first: GaussianCloud) -> None:
    """Refuse a frame that cannot be stored in the same prim as frame 0."""
    names, wanted_names = set(cloud.arrays()), set(first.arrays())
    if names != wanted_names:
        raise InvalidArrayError(
            f"frames must hold the same arrays, got a difference in {', '.join(sorted(names ^ wanted_names))} "
            f"at frame {frame}. Fill or drop these arrays everywhere."
        )
    for label in ("axes", "radiance_color_space"):
        got, wanted = getattr(cloud, label), getattr(first, label)
        if got != wanted:
            raise InvalidOptionError(
                f"{label} must be the same in every frame, got {got!r} after {wanted!r} at frame {frame}. "
                "Convert the frames to one form."
            )
    if len(cloud) != len(first) and (sequence.topology == "constant" or "positions" in sequence.constant):
        raise InvalidOptionError(
            f"topology must be perFrame where counts change, got {len(cloud)} Gaussians after {len(first)} at frame "
            f"{frame}. Build the sequence with topology='perFrame' and no constant arrays."
        )
