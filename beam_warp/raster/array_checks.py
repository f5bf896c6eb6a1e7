"""Refusing cameras and arrays that the rasteriser's kernels would misread."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.raster.layout import ChannelRanges
from beam_warp.raster.records import COEFFICIENT_COUNTS, GaussianArrays
from beam_warp.world.camera import Camera


def require_cameras(cameras: Any) -> None:
    """Refuse anything but a sequence of at least one camera."""
    if not isinstance(cameras, Sequence):
        raise InvalidOptionError(
            f"cameras must be a sequence of cameras, got {type(cameras).__name__}. Put a single one in a list."
        )
    if not cameras:
        raise InvalidOptionError("cameras must hold at least one camera, got none. Pass what sees the scene.")
    for i, camera in enumerate(cameras):
        if not isinstance(camera, Camera):
            raise InvalidOptionError(
                f"cameras must hold cameras, got {type(camera).__name__} at place {i}. Make it a beam_warp.Camera."
            )


def require_sizes(cameras: Sequence[Camera], like: Sequence[Camera]) -> None:
    """Refuse cameras of another number or other sizes, for which other arrays would be needed."""
    sizes = [(camera.width, camera.height) for camera in like]
    given = [(camera.width, camera.height) for camera in cameras]
    if given != sizes:
        raise InvalidOptionError(f"cameras must have the sizes {sizes}, got {given}. Make another Rasterizer.")


def require_gaussians(gaussians: GaussianArrays, count: int, channels: ChannelRanges, device: wp.Device) -> None:
    """Refuse Gaussians of another number, type or place, or without the channels that are drawn."""
    rows, values = (count,), (len(channels.values),)
    # The type of each array, and the lengths that each of its sides may have.
    wanted: dict[str, tuple[Any, tuple[tuple[int, ...], ...]]] = {
        "positions": (wp.vec3, (rows,)),
        "orientations": (wp.quat, (rows,)),
        "scales": (wp.vec3, (rows,)),
        "opacities": (wp.float32, (rows,)),
    }
    if channels.values:
        wanted["values"] = (wp.float32, (rows, values))
    if channels.colors:
        wanted["radiance"] = (wp.vec3, (rows, COEFFICIENT_COUNTS))
    for name, (dtype, sides) in wanted.items():
        array = getattr(gaussians, name)
        fits = isinstance(array, wp.array) and array.dtype is dtype and array.device == device
        if not (fits and _has_sides(array.shape, sides)):
            size = " x ".join(" or ".join(map(str, lengths)) for lengths in sides)
            raise InvalidArrayError(
                f"{name} must be a warp array of {dtype.__name__}, {size}, on {device}, got {_described(array)}. "
                "Convert it."
            )


def require_matrix(name: str, array: Any, count: int, lengths: tuple[int, ...], device: wp.Device) -> None:
    """Refuse anything but a compact matrix of float32 with ``count`` rows of one of ``lengths``, or of any if empty."""
    fits = isinstance(array, wp.array) and array.dtype is wp.float32 and array.device == device
    fits = fits and array.is_contiguous and array.ndim == 2
    if not (fits and _has_sides(array.shape, ((count,), lengths or array.shape[1:]))):
        part = ", a part of another array" if isinstance(array, wp.array) and not array.is_contiguous else ""
        raise InvalidArrayError(
            f"{name} must be a compact warp array of float32, {count} x {' or '.join(map(str, lengths)) or 'K'}, on "
            f"{device}, got {_described(array)}{part}. Convert it."
        )


def _has_sides(shape: tuple[int, ...], sides: tuple[tuple[int, ...], ...]) -> bool:
    """Tell whether each side of a shape has one of the lengths that it may have."""
    return len(shape) == len(sides) and all(n in lengths for n, lengths in zip(shape, sides, strict=True))


def _described(array: Any) -> str:
    """Describe an array, or what came instead of one, in an error."""
    if isinstance(array, wp.array):
        return f"{array.dtype.__name__} {array.shape} on {array.device}"
    return "none" if array is None else type(array).__name__
