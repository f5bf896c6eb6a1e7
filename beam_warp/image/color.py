"""Names of colour spaces, and the sRGB transfer function."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

DISPLAY_SRGB = "srgb_rec709_display"
"""Display-referred sRGB, composited in gamma space: the colour space of usual 3DGS training."""

LINEAR_REC709 = "lin_rec709_scene"
"""Scene-linear Rec.709: the colour space of all material channels and of lighting."""

COLOR_SPACES = (DISPLAY_SRGB, LINEAR_REC709)

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec.709 weights of linear R, G and B in luminance."""


def straight(premultiplied: NDArray[Any], alpha: ArrayLike) -> NDArray[Any]:
    """Return colour that was multiplied by its alpha, which is broadcast; 0 where alpha is 0."""
    return np.divide(premultiplied, alpha, out=np.zeros_like(premultiplied), where=np.greater(alpha, 0.0))


def srgb_to_linear(srgb: ArrayLike) -> NDArray[Any]:
    """Decode display sRGB to linear light (IEC 61966-2-1), any shape, odd about zero so that all values have inverses.

    The knee is 12.92 × 0.0031308, the image of `linear_to_srgb`'s, so that each is the exact inverse of the other.
    """
    value = np.asarray(srgb)
    value = value if value.dtype.kind == "f" else value.astype(np.float64)
    size = np.abs(value)
    low = size <= 12.92 * 0.0031308
    return np.copysign(np.where(low, size / 12.92, ((size + 0.055) / 1.055) ** 2.4), value)


def linear_to_srgb(linear: ArrayLike) -> NDArray[Any]:
    """Encode linear light as display sRGB (IEC 61966-2-1), any shape, odd about zero; values above 1 stay above 1."""
    value = np.asarray(linear)
    value = value if value.dtype.kind == "f" else value.astype(np.float64)
    size = np.abs(value)
    low = size <= 0.0031308
    return np.copysign(np.where(low, size * 12.92, 1.055 * np.maximum(size, 0.0031308) ** (1 / 2.4) - 0.055), value)
