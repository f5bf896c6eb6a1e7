"""Which device work runs on, and how arrays get there and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_array, require_finite, require_unit
from beam_warp.errors import DeviceError, InvalidArrayError

wp.config.log_level = max(wp.config.log_level, wp.LOG_ERROR)  # a library prints no banner, nor that there is no GPU


def resolve_device(device: str | None = None) -> Any:
    """Return the Warp device of a name; None takes the first CUDA device, or the CPU where there is none.

    Raises:
        DeviceError: There is no such device.
    """
    wp.init()
    if device is None:
        return wp.get_device("cuda:0" if wp.is_cuda_available() else "cpu")
    try:
        return wp.get_device(device)
    except Exception as error:
        known = ", ".join(str(d) for d in wp.get_devices())
        raise DeviceError(f"device must be one of {known}, got {device!r}. Choose one of them.") from error


def upload_vectors(name: str, value: Any, device: Any, *, unit_length: bool = False) -> wp.array:
    """Bring ``(N, 3)`` float32 vectors to a device; arrays that are there already pass through unread."""
    if isinstance(value, wp.array):
        if value.dtype is not wp.vec3 or value.ndim != 1 or value.device != device:
            raise InvalidArrayError(
                f"{name} must be a one-dimensional warp array of vec3 on {device}, got dtype {value.dtype.__name__}, "
                f"{value.ndim} dimensions, on {value.device}. Convert it or pass a NumPy array."
            )
        return value
    array = require_array(name, value, (None, 3))
    require_finite(name, array)
    if unit_length:
        require_unit(name, array)
    return wp.array(array, dtype=wp.vec3, device=device)


def download_like(result: wp.array, *inputs: Any) -> Any:
    """Return a result in the kind of its inputs: a warp array if they were, else NumPy."""
    return result if any(isinstance(value, wp.array) for value in inputs) else result.numpy()


def upload(array: NDArray[Any], dtype: Any, device: Any) -> wp.array:
    """Bring a NumPy array to a device."""
    return wp.array(np.ascontiguousarray(array), dtype=dtype, device=device)
