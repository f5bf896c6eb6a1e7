"""The renderers that relit images are scored with, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeAlias

from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.world.shot import Renderer

PATHS_PER_PIXEL = 256
"""Paths of a pixel when the path tracer is scored: four times as many add 0.2 dB on reconstructions of two captures."""

Relighter: TypeAlias = Callable[[RasterOptions, int, str | None], Renderer]
"""Makes a renderer of how splats are drawn, the side of the square of samples of a pixel, and the device."""


def deferred_relighter(raster: RasterOptions, samples: int, device: str | None) -> Renderer:
    """Return a renderer that lights a G-buffer as real-time renderers do, with shadow maps."""
    return DeferredRenderer(DeferredOptions(samples=samples, layers=()), raster=raster, device=device)


def path_relighter(raster: RasterOptions, samples: int, device: str | None) -> Renderer:
    """Return the path tracer. It meets Gaussians as they are: ``raster`` and ``samples`` have no effect."""
    return PathRenderer(PathOptions(samples=PATHS_PER_PIXEL), device=device)


RELIGHTERS: Mapping[str, Relighter] = {"deferred": deferred_relighter, "path": path_relighter}
"""Relighters by the name that `beam evaluate` gives them."""
