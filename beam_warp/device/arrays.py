"""Which device work runs on, and how arrays get there and back."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_array, require_finite, require_unit
from beam_warp.errors import DeviceError, InvalidArrayError

wp.config.log_level = max(wp.config.log_level, wp.LOG_ERROR)  # a library prints no banner

KEPT_BYTES = 2**28
"""Memory of a CUDA device that is kept for the next arrays rather than given back whenever the device is waited for,
since the driver takes long to find it again."""


def resolve_device(device: str | None = None) -> Any:
    """Return the Warp device of a name; None takes the first CUDA device, or the CPU where there is none.

    Raises:
        DeviceError: There is no such device.
    """
    _init_warp()
    if device is None:
        device = "cuda:0" if wp.is_cuda_available() else "cpu"
    try:
        found = wp.get_device(device)
    except Exception as error:
        known = ", ".join(str(d) for d in wp.get_devices())
        raise DeviceError(f"device must be one of {known}, got {device!r}. Choose one of them.") from error
    if found.is_cuda and wp.is_mempool_enabled(found) and not wp.get_mempool_release_threshold(found):
        wp.set_mempool_release_threshold(found, KEPT_BYTES)
    return found


def cuda_device_count() -> int:
    """Return how many GPUs this process may use."""
    _init_warp()
    return int(wp.get_cuda_device_count())


def device_label(device: Any) -> str:
    """Return what a table calls a device: ``cpu``, or the name of a GPU."""
    return str(device.name) if device.is_cuda else str(device)


@cache
def _init_warp() -> None:
    """Initialise Warp without its line on stderr that a machine has no GPU: half of our users have none, and know it.

    The line comes from native code that no setting reaches, hence the detour by the file descriptor.
    """
    try:
        kept = os.dup(2)
    except OSError:  # no stderr at all
        wp.init()
        return
    with tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        held.seek(0)
        said = [line for line in held.read().decode(errors="replace").splitlines() if "CUDA driver" not in line]
    if said:
        print("\n".join(said), file=sys.stderr)


def upload_vectors(name: str, value: Any, device: Any, *, unit_length: bool = False) -> wp.array:
    """Bring ``(N, 3)`` float32 vectors to a device; arrays that are there already pass through unread."""
    if isinstance(value, wp.array):
        return require_rows(name, value, wp.vec3, device)
    array = require_array(name, value, (None, 3))
    require_finite(name, array)
    if unit_length:
        require_unit(name, array)
    return wp.array(array, dtype=wp.vec3, device=device)


def require_rows(name: str, value: wp.array, dtype: Any, device: Any) -> wp.array:
    """Return a warp array after checking that it is one-dimensional, of a type and on a device; it is not read.

    Raises:
        InvalidArrayError: It is not.
    """
    if value.dtype is not dtype or value.ndim != 1 or value.device != device:
        raise InvalidArrayError(
            f"{name} must be a one-dimensional warp array of {dtype.__name__} on {device}, got dtype "
            f"{value.dtype.__name__}, {value.ndim} dimensions, on {value.device}. Convert it or pass a NumPy array."
        )
    return value


def zero_struct(structure: Any, count: int, device: Any, *, allocate: Callable[..., wp.array] = wp.zeros) -> Any:
    """Return a struct of kernels whose one-dimensional arrays have ``count`` rows on a device.

    They hold zeros, or anything with `wp.empty` to ``allocate`` them.
    """
    result = structure()
    for name, variable in structure.vars.items():
        if getattr(variable.type, "ndim", 0) == 1:
            setattr(result, name, allocate(count, dtype=variable.type.dtype, device=device))
    return result


def members(struct: Any) -> dict[str, Any]:
    """Return the members of a struct of kernels by name."""
    return {name: getattr(struct, name) for name in struct._cls.vars}


def download_like(result: wp.array, *inputs: Any) -> Any:
    """Return a result in the kind of its inputs: a warp array if they were, else NumPy."""
    return result if any(isinstance(value, wp.array) for value in inputs) else result.numpy()


def upload(array: NDArray[Any], dtype: Any, device: Any) -> wp.array:
    """Bring a NumPy array to a device."""
    return wp.array(np.ascontiguousarray(array), dtype=dtype, device=device)
