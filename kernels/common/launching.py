"""How a kernel runs over a range: one launch on CUDA, chunks over threads on the CPU (one thread a launch there).

Every kernel launched here takes ``first: int`` as its first input and works on item ``first + wp.tid()``.
Items must write disjoint outputs; then the result has the same bits for every chunking and thread count. Kernels that
share outputs by atomics are launched ``in_order``.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import warp as wp

CHUNKS_PER_THREAD = 8
"""Several chunks a thread even out uneven work; each costs about 20 microseconds of launch."""

MIN_CHUNK = 1024
"""Below this many items a launch costs more than it saves."""

WORTH_SPREADING = 2e-4
"""Work that the first chunk shows to be shorter than this is done at once: waking a thread takes about as long [s]."""


def thread_count() -> int:
    """Return how many threads CPU launches use: ``BEAM_WARP_THREADS``, else the cores this process may run on."""
    setting = os.environ.get("BEAM_WARP_THREADS", "")
    if setting.isdecimal() and int(setting) > 0:
        return int(setting)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def launch(
    kernel: Any,
    count: int,
    *,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    device: Any,
    block_dim: int = 256,
    in_order: bool = False,
    min_chunk: int | None = None,
) -> None:
    """Run ``kernel`` for items 0 … count - 1.

    Args:
        kernel: Takes ``first`` and then ``inputs`` and ``outputs``.
        count: Number of items; 0 does nothing.
        inputs: Kernel inputs after ``first``.
        outputs: Kernel outputs.
        device: Where the arrays are.
        block_dim: CUDA block size.
        in_order: Use one thread on the CPU. Kernels with atomics need it: there Warp's atomics are plain additions,
            made for its own launches of one thread.
        min_chunk: Fewest items of one launch on the CPU, less for items of much work; None for the usual.
    """
    target = wp.get_device(device)

    def run(start: int, length: int) -> None:
        wp.launch(
            kernel,
            dim=length,
            inputs=[start, *inputs],
            outputs=list(outputs),
            device=target,
            block_dim=block_dim,
            record_tape=False,
        )

    _run_in_chunks(run, range(count), target, 1 if in_order else thread_count(), min_chunk or MIN_CHUNK)


def launch_adjoint(
    kernel: Any,
    items: range,
    *,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    input_gradients: Sequence[Any],
    output_gradients: Sequence[Any],
    device: Any,
) -> None:
    """Run the adjoint that Warp makes of ``kernel`` for some items; it adds to ``input_gradients``.

    Warp's adjoint adds to gradients by atomics, which are plain additions on the CPU: no two items of one call may read
    the same element of an input that has a gradient. Then sums have one order, and the same bits every time.
    """
    target = wp.get_device(device)

    def run(start: int, length: int) -> None:
        wp.launch(
            kernel,
            dim=length,
            inputs=[start, *inputs],
            outputs=list(outputs),
            adj_inputs=[None, *input_gradients],
            adj_outputs=list(output_gradients),
            adjoint=True,
            device=target,
            record_tape=False,
        )

    _run_in_chunks(run, items, target, thread_count(), MIN_CHUNK)


def _run_in_chunks(run: Callable[[int, int], None], items: range, device: Any, threads: int, min_chunk: int) -> None:
    """Call ``run(first, count)`` over ``items``: once on CUDA, for chunks over threads on the CPU."""
    if not items:
        return
    if device.is_cuda:
        run(items.start, len(items))
        return
    chunk = max(min_chunk, -(-len(items) // (threads * CHUNKS_PER_THREAD)))
    started = time.perf_counter()
    first = min(chunk, len(items))
    run(items.start, first)  # alone, so that compiling and loading the module is not raced
    left = items[first:]
    if not left:
        return
    expected = (time.perf_counter() - started) * len(left) / first
    if threads == 1 or expected < WORTH_SPREADING:
        run(left.start, len(left))
        return
    starts = deque(left[::chunk])

    def run_chunks() -> None:
        while starts:
            try:
                start = starts.popleft()
            except IndexError:  # another thread took the last one
                return
            run(start, min(chunk, items.stop - start))

    helpers = [_pool(threads - 1).submit(run_chunks) for _ in range(min(threads, len(starts)) - 1)]
    try:
        run_chunks()
    finally:
        starts.clear()
        for helper in helpers:
            if not helper.cancel():
                helper.result()


@lru_cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return threads that stay: starting them for every launch takes longer than most launches."""
    return ThreadPoolExecutor(threads, thread_name_prefix="beam-launch")


if hasattr(os, "register_at_fork"):  # a forked process has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
