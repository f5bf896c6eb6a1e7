"""How a kernel runs over a range: one launch on CUDA, chunks over threads on the CPU (one thread a launch there).

Every kernel launched here takes ``first: int`` as its first input and works on item ``first + wp.tid()``.
Items must write disjoint outputs; then the result has the same bits for every chunking and thread count. Kernels that
share outputs by atomics are launched ``in_order``.

A generic kernel takes structures as ``Any``. Warp would keep all of its forms in one module and compile that module
anew with each new form, so that the order of calls decides what is compiled; here each form has a module of its own.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from types import FunctionType
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
    if kernel.is_generic:
        given = zip(kernel.adj.arg_types.values(), (None, *inputs, *outputs), strict=True)
        kernel = kernel_for(kernel, tuple(value._cls for template, value in given if template is Any))

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


def launcher(
    kernel: Any, *, block_dim: int = 256, in_order: bool = False, min_chunk: int | None = None
) -> Callable[..., None]:
    """Return the function that launches a kernel: ``(item count, *arguments, device)``; options as for `launch`.

    Arguments are those of the kernel after ``first``, in its order; names that begin with ``out_`` are outputs.
    """
    names = list(kernel.adj.arg_types)[1:]
    input_count = sum(not name.startswith("out_") for name in names)

    def launch_kernel(count: int, *arguments_and_device: Any) -> None:
        *arguments, device = arguments_and_device
        launch(
            kernel,
            count,
            inputs=arguments[:input_count],
            outputs=arguments[input_count:],
            device=device,
            block_dim=block_dim,
            in_order=in_order,
            min_chunk=min_chunk,
        )

    return launch_kernel


@cache
def kernel_for(kernel: Any, structures: tuple[Any, ...]) -> Any:
    """Return the form of a generic kernel that takes these structures, in a module of its own.

    Args:
        kernel: A kernel with arguments of type ``Any``.
        structures: Warp structures, one for each of those arguments.
    """
    generic = [name for name, template in kernel.adj.arg_types.items() if template is Any]
    function = kernel.func
    form = FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    form.__qualname__ = function.__qualname__
    form.__annotations__ = function.__annotations__ | dict(zip(generic, structures, strict=True))
    return wp.kernel(form, module="unique", module_options=dict(kernel.module.options), **kernel.options)


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
