"""Listeners to long work: how a function tells its caller how far it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

CountProgress = Callable[[int, int], None]
"""Called with (done, total) of the one thing that is worked on."""

StageProgress = Callable[[str, int, int], None]
"""Called with (stage, done, total)."""


class NotedProgress(Protocol):
    """Hears how far a stage is, and about its latest step; a stage that starts over begins at less than it had."""

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Take ``done`` of ``total`` steps of a stage, and words about the latest one."""


def no_progress(*step: Any, **facts: Any) -> None:
    """Report to nobody."""
