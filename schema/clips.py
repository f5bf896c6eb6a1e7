"""Value clips of long assets: how many frames one holds, and its name. Importing this loads no USD."""

from __future__ import annotations

MAX_FRAMES_IN_ONE_LAYER = 60
"""Most frames of a ``.usda`` or ``.usdz`` asset without value clips."""

CLIP_FRAMES = 30
"""Frames in one value clip."""


def clip_name(stem: str, start: int) -> str:
    """Return the name of the clip that begins with a frame."""
    return f"{stem}.{start:06d}.usdc"
