"""Keys: the frames whose arrays need time samples, because OpenUSD's interpolation between others is not near enough.

OpenUSD itself interpolates here, between values as they are stored: linearly, quaternions by slerp, integers not at
all. So what a reader sees between two keys is what was compared, half precision included.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd

LEAST_LENGTH = 2.0**-5
"""Length below which a blended normal in half precision hardly says where it points."""

_PATH = Sdf.Path("/Keys.values")


def departure(name: str, shown: NDArray[Any], wanted: NDArray[Any]) -> float:
    """Return how far an array is from what it should be: the root mean square over Gaussians; integers must be equal.

    Orientations and normals are off by an angle [rad], scales by a share, and all others by differences of components.
    """
    if shown.shape != wanted.shape or (wanted.dtype.kind != "f" and not np.array_equal(shown, wanted)):
        return np.inf
    if wanted.dtype.kind != "f" or not wanted.size:
        return 0.0
    off = _distances(name, shown.astype(np.float32), wanted.astype(np.float32))
    return float(np.sqrt(np.mean(np.square(off), dtype=np.float64)))


def _distances(name: str, shown: NDArray[np.float32], wanted: NDArray[np.float32]) -> NDArray[np.float32]:
    if name in ("orientations", "normals"):
        length = np.linalg.norm(shown, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = shown / length[:, None], wanted / np.linalg.norm(wanted, axis=1, keepdims=True)
        chord = np.linalg.norm(ends[0] - ends[1], axis=1)
        if name == "orientations":
            chord = np.minimum(chord, np.linalg.norm(ends[0] + ends[1], axis=1))
        angle = (4.0 if name == "orientations" else 2.0) * np.arcsin(np.minimum(0.5 * chord, 1.0))
        return np.where(length >= LEAST_LENGTH, angle, np.inf)
    off = np.abs(shown - wanted)
    return np.divide(off, wanted, out=np.where(off > 0.0, np.inf, 0.0), where=wanted > 0.0) if name == "scales" else off


def key_times(name: str, type_name: str, values: Mapping[float, Any], bound: float) -> list[float]:
    """Return the times at which an array needs samples: the first, the last, and few between, chosen greedily.

    Each key is as late as the bound lets it be: with it and the key before, no time between is further off, and so
    it is with every earlier choice of it.

    Args:
        name: Of the array, in `beam_warp.schema.layout.CHANNELS`.
        type_name: USD type of its attribute.
        values: The USD array at each time, as it would be stored, ascending.
        bound: Largest `departure`.
    """
    layer = Sdf.Layer.CreateAnonymous()
    prim = Sdf.CreatePrimInLayer(layer, _PATH.GetPrimPath())
    prim.specifier = Sdf.SpecifierDef
    Sdf.AttributeSpec(prim, _PATH.name, Sdf.ValueTypeNames.Find(type_name))
    stage = Usd.Stage.Open(layer)
    attribute = stage.GetAttributeAtPath(_PATH)
    times = list(values)

    def within(first: int, last: int) -> bool:
        layer.SetTimeSample(_PATH, times[last], values[times[last]])
        between = sorted(times[first + 1 : last], key=lambda time: abs(time - 0.5 * (times[first] + times[last])))
        near = all(
            departure(name, np.asarray(attribute.Get(time)), np.asarray(values[time])) <= bound for time in between
        )
        layer.EraseTimeSample(_PATH, times[last])
        return near

    keys = [0]
    while keys[-1] < len(times) - 1:
        first = last = keys[-1]
        layer.SetTimeSample(_PATH, times[first], values[times[first]])
        last += 1
        while last + 1 < len(times) and within(first, last + 1):
            last += 1
        layer.EraseTimeSample(_PATH, times[first])
        keys.append(last)
    return [times[key] for key in keys]
