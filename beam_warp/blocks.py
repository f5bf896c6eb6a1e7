"""Work on many rows, a block at a time: blocks stay in a core's cache, and NumPy computes several of them at once."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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
    threads = min(len(parts), _core_count())
    if threads < 2:
        deque(map(quietly, parts), maxlen=0)
        return
    with ThreadPoolExecutor(threads) as pool:
        deque(pool.map(quietly, parts), maxlen=0)


def replace_rows(function: Callable[[NDArray[Any]], NDArray[Any]], array: NDArray[Any]) -> None:
    """Replace the rows of an array by a function of them that treats each row alone."""

    def work(part: slice) -> None:
        array[part] = function(array[part])

    for_each_block(work, len(array))


def _core_count() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
