"""Workers by the words of a command line: a number of processes, one for each GPU, or a cluster."""

from __future__ import annotations

import os

from beam_warp.errors import InvalidOptionError
from beam_warp.jobs.listeners import NotedProgress
from beam_warp.plan.processes import Processes
from beam_warp.plan.steps import Plan
from beam_warp.plan.workers import Crew, Terms, Workers, in_process

MOST_PROCESSES = 256
"""Processes of one machine, at most."""

AUTO, GPUS, RAY = "auto", "gpus", "ray"

SHARING = 2
"""Processes that share a GPU unless the caller says how many: one follows a segment from frame to frame, and the other
one does what it leaves."""


def crew_of(words: str, device: str | None) -> Crew:
    """Return who does the work.

    Args:
        words: A number of processes; ``gpus`` for one on each GPU; ``ray`` for the Ray cluster that this machine is in;
            ``ray://HOST:PORT`` for one that is reached as a Ray client. With a number before, ``3@gpus`` or ``3@ray``,
            so many share each GPU. ``auto``: `SHARING` processes on one GPU, or this process where there is none.
        device: The device that steps are told to use; None lets every worker have its own.

    Raises:
        InvalidOptionError: They mean nothing, or contradict the device.
        MissingPackageError: Ray is not installed.
    """
    if words == AUTO:
        return lambda plan, kind, progress: (
            _processes(SHARING, device, gpus=slice(1)) if kind == "cuda" else in_process
        )(plan, kind, progress)
    shared, at, place = words.rpartition("@")
    each = int(shared) if shared.isdecimal() and len(shared) < 4 else 0 if at else 1
    if each and (place == RAY or place.startswith(f"{RAY}:")):
        from beam_warp.plan.cluster import cluster_at

        return cluster_at(place, each)
    if each and place == GPUS:
        if device is not None:
            raise InvalidOptionError(f"device must be left out with workers gpus, got {device}. Drop one of them.")
        return _processes(each, device, on_each=True)
    if not (words.isdecimal() and 1 <= int(words) <= MOST_PROCESSES):
        raise InvalidOptionError(
            f"workers must be auto, a number from 1 to {MOST_PROCESSES}, gpus, ray or ray://HOST:PORT, got {words}. "
            "Write 4 for four processes, or 3@gpus for three on each GPU."
        )
    return in_process if int(words) == 1 else _processes(int(words), device)


def visible_gpus() -> list[str]:
    """Return what ``CUDA_VISIBLE_DEVICES`` calls each GPU that this process may use."""
    from beam_warp.device.arrays import cuda_device_count

    named = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    return named[: cuda_device_count()] or [str(number) for number in range(cuda_device_count())]


def _processes(count: int, device: str | None, *, on_each: bool = False, gpus: slice = slice(None)) -> Crew:
    """Return processes that share some of the GPUs evenly, or on a CPU its cores; as many on each GPU, if asked for."""

    def crew(plan: Plan, kind: str, progress: NotedProgress) -> Workers:
        shared = visible_gpus()[gpus]
        total = min(count * len(shared) if on_each else count, len(plan.steps))
        if total == 0 or (kind == "cuda" and not shared):
            raise InvalidOptionError("workers must be a number on a machine without GPUs, got gpus. Write 2.")
        settings: list[dict[str, str]] = [{} for _ in range(total)]
        for number, setting in enumerate(settings):
            if kind == "cuda" and device is None:
                setting["CUDA_VISIBLE_DEVICES"] = shared[number % len(shared)]
            if kind == "cpu":
                setting["BEAM_WARP_THREADS"] = str(max((os.cpu_count() or 1) // total, 1))
        return Processes(plan.works, Terms.of(plan.folder, kind), settings, progress)

    return crew
