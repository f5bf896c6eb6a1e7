"""How long work takes on a machine that others use too, and what that machine is.

Repeats are interleaved, ratios are taken within a turn, one CPU thread is timed by process CPU time.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

Name = TypeVar("Name", bound=Hashable)


@dataclass(frozen=True)
class Task:
    """Something to time.

    Attributes:
        run: Does the work once; may return before a CUDA device has finished.
        threaded: Whether ``BEAM_WARP_THREADS`` makes a difference, on the CPU.
    """

    run: Callable[[], Any]
    threaded: bool = True


@dataclass(frozen=True)
class Times:
    """Seconds of one task, one entry a repeat; entries of the same index were measured one right after the other.

    Attributes:
        alone: Wall-clock time until the device has finished, on CUDA. The process's CPU time of one thread, which other
            processes disturb least, on the CPU.
        one_thread: Wall-clock time of one thread; None on CUDA.
        two_threads: Wall-clock time of two threads; None on CUDA and for work that has only one.
    """

    alone: NDArray[np.float64]
    one_thread: NDArray[np.float64] | None = None
    two_threads: NDArray[np.float64] | None = None

    def faster_than(self, other: Times) -> float:
        """Return how many times faster than another task: the median over repeats of the ratio within each."""
        return float(np.median(other.alone / self.alone))

    def thread_gain(self) -> float | None:
        """Return how many times faster two threads are than one, as the median ratio of wall-clock times within a turn.

        None where two threads were not measured.
        """
        if self.one_thread is None or self.two_threads is None:
            return None
        return float(np.median(self.one_thread / self.two_threads))


def spread(values: NDArray[np.float64]) -> dict[str, float]:
    """Return median and range over repeats."""
    return {"median": float(np.median(values)), "lowest": float(values.min()), "highest": float(values.max())}


@contextmanager
def launch_threads(count: int) -> Iterator[None]:
    """Let CPU launches use this many threads."""
    before = os.environ.get("BEAM_WARP_THREADS")
    os.environ["BEAM_WARP_THREADS"] = str(count)
    try:
        yield
    finally:
        del os.environ["BEAM_WARP_THREADS"]
        if before is not None:
            os.environ["BEAM_WARP_THREADS"] = before


def take_turns(
    tasks: Mapping[Name, Task], repeats: int, device: Any, *, two_threads: bool = False
) -> dict[Name, Times]:
    """Time tasks in turn, after one unmeasured round, so that a busy machine is equally busy for all of them.

    Every second round runs backwards: no task always follows the same one.

    Args:
        tasks: Tasks by name.
        repeats: Measured rounds.
        device: Where they run.
        two_threads: Whether to time two threads by wall clock as well, on the CPU.
    """
    names = list(tasks)
    rows: dict[Name, list[tuple[float, float, float]]] = {name: [] for name in names}
    for repeat in range(-1, repeats):
        for name in names if repeat % 2 else reversed(names):
            row = _timed_on_cuda(tasks[name], device) if device.is_cuda else _timed_on_cpu(tasks[name], two_threads)
            if repeat >= 0:
                rows[name].append(row)
    found = {}
    for name, task in tasks.items():
        alone, one, two = np.array(rows[name]).T
        on_cpu = not device.is_cuda
        found[name] = Times(alone, one if on_cpu else None, two if on_cpu and two_threads and task.threaded else None)
    return found


def _timed_on_cuda(task: Task, device: Any) -> tuple[float, float, float]:
    wp.synchronize_device(device)
    started = time.perf_counter()
    task.run()
    wp.synchronize_device(device)
    return time.perf_counter() - started, np.nan, np.nan


def _timed_on_cpu(task: Task, two_threads: bool) -> tuple[float, float, float]:
    with launch_threads(1):
        cpu, wall = time.process_time(), time.perf_counter()
        task.run()
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    if not (two_threads and task.threaded):
        return cpu, wall, np.nan
    with launch_threads(2):
        both = time.perf_counter()
        task.run()
        both = time.perf_counter() - both
    return cpu, wall, both


def machine(device: Any) -> dict[str, Any]:
    """Return what a timing depends on: processor, cores, load and, on CUDA, GPU and driver."""
    facts: dict[str, Any] = {
        "device": "cpu" if device.is_cpu else device.name,
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "load_average": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,
        "platform": platform.platform(),
    }
    if device.is_cuda:
        facts["cuda_driver"] = ".".join(str(part) for part in wp.get_cuda_driver_version())
        facts["cuda_arch"] = device.arch
    return facts


def processor_name() -> str:
    """Return the processor's marketing name where the system tells it."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown"
