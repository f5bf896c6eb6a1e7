"""How a kernel runs over a range: one launch on CUDA, chunks over threads on the CPU (one thread a launch there).

Every kernel launched here takes ``first: int`` as its first input and works on item ``first + wp.tid()``.
Items must write disjoint outputs; then the result has the same bits for every chunking and thread count. Kernels that
share outputs by atomics are launched ``in_order``.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

CHUNKS_PER_THREAD = 8
"""Several chunks a thread even out uneven work; each costs about 20 microseconds of launch."""

MIN_CHUNK = 1024
"""Below this many items a launch costs more than it saves."""


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
    """
    if count <= 0:
        return
    target = wp.get_device(device)
    if target.is_cuda:
        wp.launch(kernel, dim=count, inputs=[0, *inputs], outputs=list(outputs), device=target, block_dim=block_dim)
        return
    threads = 1 if in_order else thread_count()
    chunk = max(MIN_CHUNK, -(-count // (threads * CHUNKS_PER_THREAD)))
    starts = range(0, count, chunk)

    def run(start: int) -> None:
        wp.launch(
            kernel,
            dim=min(chunk, count - start),
            inputs=[start, *inputs],
            outputs=list(outputs),
            device=target,
            record_tape=False,
        )

    run(starts[0])  # alone, so that compiling and loading the module is not raced
    if len(starts) == 1:
        return
    if threads == 1:
        for start in starts[1:]:
            run(start)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(run, starts[1:]))
