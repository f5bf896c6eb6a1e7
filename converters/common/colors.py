"""Colours of a file in viewers that ignore materials."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.converters.common.activations import color_from_dc, dc_from_color
from beam_warp.image.color import DISPLAY_SRGB, linear_to_srgb
from beam_warp.world.gaussians import GaussianCloud

CAPTURED = "captured"
BASE_COLOR_ONLY = "baseColorOnly"
NO_COLOR = "none"

_TOE = 0.0031308


def _srgb_slope(linear: ArrayLike) -> NDArray[np.float64]:
    """Return the derivative of `linear_to_srgb`; on the toe, and below 0, the toe's slope."""
    value = np.asarray(linear, dtype=np.float64)
    return np.where(value <= _TOE, 12.92, 1.055 / 2.4 * np.maximum(value, _TOE) ** (1.0 / 2.4 - 1.0))


def display_radiance(cloud: GaussianCloud) -> tuple[NDArray[np.float32], str]:
    """Return spherical harmonics in display sRGB, ``(N, K, 3)``, and their meaning.

    Captured radiance is kept; if it is linear, its mean colour is encoded exactly and the higher bands to first order
    about it (an encoding is not linear, so no finite set of bands is exact). Without radiance, the colour is the
    sRGB-encoded product of base colour and ambient occlusion; without either, mid grey.
    """
    if cloud.radiance is not None:
        if cloud.radiance_color_space == DISPLAY_SRGB:
            return cloud.radiance, CAPTURED
        mean = color_from_dc(cloud.radiance[:, :1])
        encoded = _srgb_slope(mean) * cloud.radiance
        encoded[:, :1] = dc_from_color(linear_to_srgb(np.maximum(mean, 0.0)))
        return encoded.astype(np.float32), CAPTURED
    if cloud.base_color is None:
        return np.zeros((len(cloud), 1, 3), np.float32), NO_COLOR
    shade = 1.0 if cloud.ambient_occlusion is None else cloud.ambient_occlusion[:, None].astype(np.float64)
    return dc_from_color(linear_to_srgb(cloud.base_color * shade))[:, None], BASE_COLOR_ONLY


def resize_bands(radiance: NDArray[np.float32], degree: int | None) -> NDArray[np.float32]:
    """Return coefficients ``(N, (degree + 1)^2, 3)``, cut or padded with zeros; None keeps them."""
    if degree is None or radiance.shape[1] == (degree + 1) ** 2:
        return radiance
    resized = np.zeros((len(radiance), (degree + 1) ** 2, 3), np.float32)
    kept = min(radiance.shape[1], resized.shape[1])
    resized[:, :kept] = radiance[:, :kept]
    return resized
