"""How arrays on a device are checked, and seen as rows of floats or as images."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from beam_warp.checks import require_array
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError


def require_device_array(name: str, value: Any, shape: tuple[int, ...], device: Any) -> wp.array:
    """Return ``value`` after checking that it is a float32 warp array of a shape, on a device; strides may be any.

    Raises:
        InvalidArrayError: It is not.
    """
    if not isinstance(value, wp.array):
        raise InvalidArrayError(
            f"{name} must be a warp array on {device}, got {type(value).__name__}. Upload it with wp.array."
        )
    if value.dtype is not wp.float32 or value.shape != shape or value.device != device:
        raise InvalidArrayError(
            f"{name} must be a warp array of float32 of shape {shape} on {device}, got dtype "
            f"{value.dtype.__name__}, shape {value.shape}, on {value.device}. Convert, reshape or move it."
        )
    return value


def device_array(name: str, value: Any, shape: tuple[int, ...], device: Any) -> wp.array:
    """Return an input on the device: a warp array passes through unread, anything else is uploaded.

    Raises:
        InvalidArrayError: It has another type, shape or device.
    """
    if isinstance(value, wp.array):
        return require_device_array(name, value, shape, device)
    return upload(require_array(name, value, shape, np.float32), float, device)


def float_rows(array: wp.array) -> wp.array:
    """Return a view ``(N, K)`` of float32 of an array of N rows: floats, vectors, quaternions, ``(N, K)`` floats.

    ``(N, K)`` floats may be strided, such as some columns of wider rows; others are contiguous.

    Raises:
        InvalidArrayError: It is not made of float32, or not contiguous.
    """
    scalar = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
    if scalar is wp.float32 and array.dtype is scalar and array.ndim == 2:
        return array
    if scalar is not wp.float32 or not array.is_contiguous or array.ndim == 0:
        raise InvalidArrayError(
            f"array must hold contiguous rows of float32, got dtype {array.dtype.__name__}, shape {array.shape}, "
            f"strides {array.strides}. Convert or copy it."
        )
    floats = array.view(wp.float32)
    return floats.reshape((array.shape[0], math.prod(floats.shape[1:])))


def pixel_channels(rows: wp.array, height: int, width: int, first: int, count: int) -> wp.array:
    """Return channels ``first`` to ``first + count`` of rows of channels, one a pixel, as an image ``(H, W, count)``.

    Args:
        rows: ``(H * W,)`` vectors of float32, row-major, contiguous.
        height: H.
        width: W.
        first: The first channel.
        count: How many.

    Raises:
        InvalidArrayError: The rows are not as many as the pixels, or have fewer channels.
    """
    floats = float_rows(rows)
    fits = floats.shape[0] == height * width and 0 <= first <= first + count <= floats.shape[1]
    if not (fits and floats.is_contiguous):
        raise InvalidArrayError(
            f"rows must be {height} x {width}, contiguous, with channels {first} to {first + count}, got "
            f"{floats.shape} with strides {floats.strides}. Pass one row per pixel."
        )
    return floats.reshape((height, width, floats.shape[1]))[:, :, first : first + count]


def require_vectors(name: str, value: Any, count: int, width: int, device: Any) -> wp.array:
    """Return ``count`` contiguous vectors on a device: vec3 as they are, quaternions and vec4 as vec4.

    Raises:
        InvalidArrayError: The array has another type, length or device, or is not contiguous.
    """
    kinds = (wp.vec3,) if width == 3 else (wp.quat, wp.vec4)
    if not (
        isinstance(value, wp.array)
        and value.dtype in kinds
        and value.shape == (count,)
        and value.device == device
        and value.is_contiguous
    ):
        got = type(value).__name__
        if isinstance(value, wp.array):
            got = f"{value.dtype.__name__} {value.shape} on {value.device}, strides {value.strides}"
        raise InvalidArrayError(
            f"{name} must be a contiguous warp array of {count} {'vec3' if width == 3 else 'quat'} on {device}, "
            f"got {got}. Upload, convert or copy it."
        )
    return value if width == 3 else value.view(wp.vec4)
