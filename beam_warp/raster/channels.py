"""The channels that a cloud is drawn with: names, widths, and layers of image files."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from beam_warp.world.gaussians import ATTRIBUTES

RADIANCE = "radiance"
"""The channel that is evaluated towards the camera before it is composited."""

SURFACE_NORMALS = "surface_normals"
"""The channel of normals from geometry alone: those of the surface of largest response, towards the camera."""

CHANNELS = (
    RADIANCE,
    SURFACE_NORMALS,
    *(a.name for a in ATTRIBUTES.values() if a.dtype == "float32" and not a.required and a.name != RADIANCE),
)
"""Every channel that `rasterize` knows; a cloud may lack some."""

ERROR_CHANNELS = tuple(name for name in CHANNELS if name.endswith("_error"))
"""The channels of standard errors; a pixel shows their mean, as if all Gaussians that it sees erred the same way."""

UNIT_CHANNELS = ("normals", SURFACE_NORMALS)
"""Channels of directions: their mean is brought to unit length."""

_LAYER_PARTS = {"normals": ("normal", "XYZ"), SURFACE_NORMALS: ("surface_normal", "XYZ")}
"""Channels whose layers are named otherwise than NAME.R, NAME.G and NAME.B."""


def channel_layers(name: str, array: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """Return an image of a channel, ``(H, W)`` or ``(H, W, 3)``, as the layers of an image file."""
    prefix, parts = _LAYER_PARTS.get(name, (name, "RGB"))
    if array.ndim == 2:
        return {prefix: array}
    return {f"{prefix}.{part}": array[..., i] for i, part in enumerate(parts)}


def own_channels(channels: Sequence[str]) -> list[str]:
    """Return the channels that are Gaussians' own values: neither seen towards a camera nor of geometry."""
    return [name for name in channels if name not in (RADIANCE, SURFACE_NORMALS)]


def column_count(name: str) -> int:
    """Return how many columns a channel of the Gaussians' own values takes."""
    return math.prod(side or 1 for side in ATTRIBUTES[name].trailing)


def is_vector(name: str) -> bool:
    """Tell whether a pixel's value of a channel has a dimension of its own."""
    return name == SURFACE_NORMALS or bool(ATTRIBUTES[name].trailing)
