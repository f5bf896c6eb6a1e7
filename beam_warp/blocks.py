"""Work on many rows, a block at a time: blocks stay in a core's cache, and NumPy computes several of them at once."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

BLOCK_ROWS = 1 << 13
"""Rows of a block; 60 float32 a row are 2 MB."""


def for_each_block(work: Callable[[slice], object], row_count: int) -> None:
    """Call a function for slices that together cover all rows, on as many threads as there are cores.

    Args:
        work: Called once for each slice, in any order. It writes only to the rows of its slice, so the result does not
            depend on the order. Overflow and invalid operations in it do not warn: they leave infinity and NaN, which
            a cloud refuses.
        row_count: Number of rows.

    Raises:
        Exception: What the first slice that failed has raised; slices that have not begun are left out.
    """

    def quietly(part: slice) -> None:
        with np.errstate(over="ignore", invalid="ignore"):  # each thread has a state of its own
            work(part)

    parts = [slice(start, min(start + BLOCK_ROWS, row_count)) for start in range(0, row_count, BLOCK_ROWS)]
    if min(len(parts), _core_count()) < 2:
        deque(map(quietly, parts), maxlen=0)
        return
    running = [_pool(_core_count()).submit(quietly, part) for part in parts]
    try:
        for one in running:
            one.result()
    finally:
        for one in running:
            one.cancel()
        wait(running)


def replace_rows(function: Callable[[NDArray[Any]], NDArray[Any]], array: NDArray[Any]) -> None:
    """Replace the rows of an array by a function of them that treats each row alone."""

    def work(part: slice) -> None:
        array[part] = function(array[part])

    for_each_block(work, len(array))


@lru_cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return threads that stay: to start them for every array takes as long as most arrays do."""
    return ThreadPoolExecutor(threads, thread_name_prefix="beam-blocks")


if hasattr(os, "register_at_fork"):  # a forked process has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def _core_count() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
