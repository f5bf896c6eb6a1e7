"""Evidence in the shape of a subject for or against the axes that a reader assumes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beam_warp.world.axes import AXIS_CODES, handedness
from beam_warp.world.gaussians import GaussianCloud

TALL = 1.3
"""A subject that stands is at least so many times as tall as it is wide."""

STANDS = 0.1
"""A subject stands at 0 if one end is at most so far from 0, in parts of the distance of the other end."""

SAMPLE = 2**17
"""About so many Gaussians are looked at, evenly spread over the rows."""

CONTRADICTION = "the shape contradicts"
"""Beginning of the note on a subject that seems to stand in other axes."""

_USUAL = ("rdf", "rub", "rfu")
"""Axes that files have most often: 3DGS training; USD, glTF and SPZ; Blender and CAD."""


@dataclass(frozen=True)
class Vertical:
    """Which way a subject seems to stand.

    Attributes:
        low: Lower end of the middle 98 % of the centres along x, y and z.
        high: The upper end.
        axis: Number of the axis along which the subject is tall; None if it is not.
        points: ``u`` if that axis points up, ``d`` if down, of a subject that stands at 0; None if it does not.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    axis: int | None
    points: str | None


def vertical_of(cloud: GaussianCloud) -> Vertical | None:
    """Return how the subject seems to stand, or None of fewer than two Gaussians."""
    if len(cloud) < 2:
        return None
    sample = cloud.positions[:: max(1, len(cloud) // SAMPLE)]
    low, high = np.quantile(sample, [0.01, 0.99], axis=0).astype(np.float64)
    size = high - low
    axis = int(np.argmax(size))
    ends = tuple(low.tolist()), tuple(high.tolist())
    if not size[axis] > TALL * np.delete(size, axis).max():
        return Vertical(*ends, None, None)
    near, far = sorted((abs(low[axis]), abs(high[axis])))
    down = abs(high[axis]) == near
    return Vertical(*ends, axis, ("d" if down else "u") if near < STANDS * far else None)


def likely_axes(vertical: Vertical) -> str:
    """Return the most usual right-handed axes in which a subject stands upright."""
    codes = (*_USUAL, *AXIS_CODES)
    upright = (code for code in codes if vertical.axis is not None and code[vertical.axis] == vertical.points)
    return next(code for code in upright if handedness(code) == "right")


def contradictions(cloud: GaussianCloud) -> list[str]:
    """Return a note if the subject seems to stand in other axes than the cloud's, which were assumed."""
    vertical = vertical_of(cloud)
    if vertical is None or vertical.axis is None or vertical.points in (None, cloud.axes[vertical.axis]):
        return []
    name, low, high = "xyz"[vertical.axis], vertical.low[vertical.axis], vertical.high[vertical.axis]
    way = "up" if vertical.points == "u" else "down"
    return [
        f"{CONTRADICTION} {cloud.axes}: it is tallest along {name}, from {low:.2f} to {high:.2f}, so {name} points "
        f"{way} if it stands at 0; pass --source-axes {likely_axes(vertical)} if it does"
    ]
