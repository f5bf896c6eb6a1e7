"""Steps that are taken again and again: as CUDA graphs where there are some, one after the other elsewhere."""

from __future__ import annotations

import gc
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp


class StepGraphs:
    """Launches of steps, recorded once for each key and then replayed.

    A step must allocate nothing and wait for nothing, and its arrays must live as long as it is replayed.
    """

    def __init__(self, device: Any) -> None:
        """Begin without a recording."""
        self._device = device
        self._graphs: dict[Hashable, Any] = {}

    def clear(self) -> None:
        """Forget all recordings: whenever an array that a step uses is another one, or an option changed."""
        self._graphs.clear()

    def run(self, key: Hashable, step: Callable[[], Any]) -> None:
        """Take a step; the first time of each key its launches are recorded."""
        if not self._device.is_cuda:
            step()
            return
        if key not in self._graphs:
            with _garbage_kept(), wp.ScopedCapture(self._device) as capture:
                step()
            self._graphs[key] = capture.graph
        wp.capture_launch(self._graphs[key])


@contextmanager
def _garbage_kept() -> Iterator[None]:
    """Keep the garbage collector from freeing arrays on the device, which must not happen while a step is recorded."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
