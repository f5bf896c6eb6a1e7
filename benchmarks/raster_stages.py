"""Times of the stages of a frame, forwards and backwards.

On the CPU by the wall clock around each launcher. On CUDA by events around them, queued behind other work that keeps
the device busy, so that the host's launches are ahead of it and no wait for them is counted; sorts and scans, which
``wp.timing_begin`` does not list, are so measured like the rest. Each event takes a microsecond or two of the device,
which the time of the whole as a CUDA graph lacks. Kernels by name are those that ``wp.timing_begin`` lists.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import warp as wp
from raster_contenders import Clocked, Drawing, captured, digits, measure_in_turn, record_event, seconds_between

from beam_warp.raster import backward, forward, rasterizer

STAGES = {
    "launch_project": "project",
    "launch_evaluate_colors": "channels",
    "launch_gather_channels": "channels",
    "launch_key_splats": "depth keys",
    "launch_count_pairs": "count and emit",
    "launch_emit_pairs": "count and emit",
    "launch_find_ranges": "ranges",
    "launch_project_entries": "project",
    "launch_count_entries": "count and emit",
    "launch_plan_tiles": "ranges",
    "launch_emit_entries": "count and emit",
    "launch_composite_cpu": "composite",
    "launch_composite_cuda": "composite",
    "launch_composite_adjoint_cpu": "composite adjoint",
    "launch_composite_adjoint_cuda": "composite adjoint",
    "launch_back_project_cpu": "back-projection",
    "launch_back_project_cuda": "back-projection",
    "launch_find_slots": "sums over pairs",
    "launch_find_far_slots": "sums over pairs",
    "launch_sum_pairs": "sums over pairs",
    "launch_sum_views": "sums over pairs",
    "launch_resolve_sums": "sums over pairs",
    "launch_scatter_channels": "channels adjoint",
    "launch_evaluate_colors_adjoint": "channels adjoint",
    "launch_project_adjoint": "projection adjoint",
    "launch_sum_cameras": "projection adjoint",
}
"""Stage of each launcher of the rasteriser."""

SORT_AFTER = {"depth keys": "sort by depth", "count and emit": "sort by tile"}
"""Stage of a sort, by the stage before it."""

CLEAR = "clear gradients"
REST = "rest: fills, gaps"
FORWARD = (
    "project",
    "channels",
    "depth keys",
    "sort by depth",
    "count and emit",
    "sort by tile",
    "ranges",
    "composite",
)
BACKWARD = (CLEAR, "composite adjoint", "sums over pairs", "channels adjoint", "projection adjoint")

BUSY_SECONDS = 0.05
"""Work queued before a frame on CUDA; the host launches a frame in a tenth of it."""


def stage_launchers() -> dict[str, Any]:
    """Return every launcher that the rasteriser's modules import, with the module that calls it."""
    modules = (forward, backward, rasterizer)
    return {name: module for module in modules for name in vars(module) if name.startswith("launch_")}


class StageClock:
    """Marks when stages begin and end."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self._marks: list[tuple[str, Any, Any]] = []

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Wrap the rasteriser's launchers, sorts and scans."""
        with ExitStack() as patches:
            for name, owner in stage_launchers().items():
                self._wrap(patches, owner, name, STAGES[name])
            self._wrap(patches, wp.utils, "radix_sort_pairs", None)
            scan = "sums over pairs" if self.device.is_cuda else "count and emit"
            self._wrap(patches, wp.utils, "array_scan", scan)
            self._wrap(patches, backward.BackwardBuffers, "begin", CLEAR)
            yield

    def frame(self, work: Callable[[], Any]) -> dict[str, float]:
        """Return the seconds of each stage of a piece of work, and of what is left as `REST`."""
        self._marks.clear()
        begin = self._now()
        work()
        end = self._now()
        if self.device.is_cuda:
            wp.synchronize_device(self.device)
        found: dict[str, float] = defaultdict(float)
        for stage, started, ended in self._marks:
            found[stage] += self._between(started, ended)
        found[REST] = self._between(begin, end) - sum(found.values())
        return dict(found)

    def _wrap(self, patches: ExitStack, owner: Any, name: str, stage: str | None) -> None:
        original = getattr(owner, name)

        def watched(*args: Any, **kwargs: Any) -> Any:
            found = stage or SORT_AFTER[self._marks[-1][0]]
            begin = self._now()
            result = original(*args, **kwargs)
            self._marks.append((found, begin, self._now()))
            return result

        patches.enter_context(patch.object(owner, name, watched))

    def _now(self) -> Any:
        return record_event(self.device) if self.device.is_cuda else time.perf_counter()

    def _between(self, begin: Any, end: Any) -> float:
        return seconds_between(begin, end) if self.device.is_cuda else end - begin


def measure_stages(make: Callable[[], Drawing], repeats: int, device: Any) -> dict[str, Any]:
    """Return the milliseconds of each stage and their shares, medians over repeats; ``make`` draws a scene."""
    clock = StageClock(device)
    rows: dict[str, list[dict[str, float]]] = {"forward": [], "backward": []}
    unwatched = make() if device.is_cuda else None
    keep_busy = (lambda: None) if unwatched is None else _busy(unwatched, device)
    with clock.watching():
        drawing = make()
        works = {"forward": drawing.forward, "backward": drawing.backward}
        for work in works.values():
            work()
        for _ in range(repeats):
            for name, work in works.items():
                keep_busy()
                rows[name].append(clock.frame(work))
    found: dict[str, Any] = {}
    for name, order in (("forward", FORWARD), ("backward", BACKWARD)):
        stages = [stage for stage in (*order, REST) if stage in rows[name][0]]
        milliseconds = {stage: 1e3 * float(np.median([row[stage] for row in rows[name]])) for stage in stages}
        total = 1e3 * float(np.median([sum(row.values()) for row in rows[name]]))
        found[name] = {
            "total_ms": digits(total),
            "ms": {stage: digits(value) for stage, value in milliseconds.items()},
            "share": {stage: round(value / total, 3) for stage, value in milliseconds.items()},
            "bottleneck": max(milliseconds, key=lambda stage: milliseconds[stage]),
        }
    if unwatched is not None:
        for name, work in (("forward", unwatched.forward), ("backward", unwatched.backward)):
            launch = Clocked.on(device, captured(work, device))
            found[name]["graph"] = measure_in_turn({name: launch}, repeats, device)[name].summary()
        found["kernels"] = measure_kernels(unwatched, repeats)
    return found


def measure_kernels(drawing: Drawing, repeats: int) -> dict[str, dict[str, float]]:
    """Return what ``wp.timing_begin`` lists of a frame forwards and backwards: launches, and milliseconds of all."""
    listed: dict[str, list[float]] = defaultdict(list)
    drawing.training()
    for _ in range(repeats):
        wp.timing_begin(cuda_filter=wp.TIMING_ALL)
        drawing.training()
        for entry in wp.timing_end():
            listed[entry.name].append(entry.elapsed)
    ordered = sorted(listed.items(), key=lambda item: -sum(item[1]))
    return {name: {"launches": len(values) // repeats, "ms": digits(sum(values) / repeats)} for name, values in ordered}


def _busy(drawing: Drawing, device: Any) -> Callable[[], None]:
    """Return what queues `BUSY_SECONDS` of work on a CUDA device."""
    launch = captured(drawing.forward, device)
    launch()
    wp.synchronize_device(device)
    started = time.perf_counter()
    launch()
    wp.synchronize_device(device)
    count = min(500, int(BUSY_SECONDS / (time.perf_counter() - started)) + 1)

    def queue() -> None:
        for _ in range(count):
            launch()

    return queue
