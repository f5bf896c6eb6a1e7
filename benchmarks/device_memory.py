"""The most memory that work takes of a CUDA device: the high mark of the pool that Warp allocates from."""

from __future__ import annotations

import ctypes
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp

USED_MEM_HIGH = 8
"""CU_MEMPOOL_ATTR_USED_MEM_HIGH."""


@contextmanager
def peak_memory(device: Any) -> Iterator[dict[str, Any]]:
    """Fill a record with the peak of what is done inside, what was allocated before included [bytes].

    ``peak_device_bytes`` on CUDA, with ``peak_is_of_process`` where the driver could not set the mark back;
    ``peak_host_bytes`` is the process's so far.
    """
    found: dict[str, Any] = {}
    reset = device.is_cuda and set_back(device)
    if device.is_cuda:
        found["device_bytes_before"] = wp.get_mempool_used_mem_current(device)
    yield found
    if device.is_cuda:
        wp.synchronize_device(device)
        found["peak_device_bytes"] = wp.get_mempool_used_mem_high(device)
        if not reset:
            found["peak_is_of_process"] = True
    found["peak_host_bytes"] = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def set_back(device: Any) -> bool:
    """Set the high mark of a CUDA device's pool to what is used now; returns whether the driver did it."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
        pool, zero, number = ctypes.c_void_p(), ctypes.c_uint64(0), ctypes.c_int()
        calls = (
            lambda: driver.cuDeviceGet(ctypes.byref(number), ctypes.c_int(device.ordinal)),
            lambda: driver.cuDeviceGetDefaultMemPool(ctypes.byref(pool), number),
            lambda: driver.cuMemPoolSetAttribute(pool, ctypes.c_int(USED_MEM_HIGH), ctypes.byref(zero)),
        )
        return all(call() == 0 for call in calls)
    except (OSError, AttributeError):
        return False
