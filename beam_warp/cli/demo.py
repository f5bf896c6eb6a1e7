"""``beam demo``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Demo:
    """Demo."""


def demo(args: Demo) -> int:
    """Demo."""
    return 0
