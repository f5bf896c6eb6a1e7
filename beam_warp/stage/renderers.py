"""Both renderers as renderers of the frames of a sequence; see `beam_warp.stage.jobs.FrameRenderer`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from beam_warp.raster.channels import ERROR_CHANNELS
from beam_warp.raster.drawn_part import drawn_part
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.pixel_means import PixelMeans
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import DeferredOptions
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.stage.jobs import FrameContext
from beam_warp.world.shot import RenderedImage, Shot

SEED_STEP = 0x9E3779B9
"""Difference between the seeds of two frames, modulo 2^32. It is odd, so that no two frames share a seed."""


class DeferredFrames:
    """The deferred renderer, with the standard errors that an asset holds as further layers."""

    def __init__(
        self, options: DeferredOptions, *, raster: RasterOptions, errors: bool = False, device: str | None = None
    ) -> None:
        """Take the options of both, and whether errors are drawn."""
        self._renderer = DeferredRenderer(options, raster=raster, device=device)
        self._samples = options.samples
        self._raster, self._errors, self._device = raster, errors, device
        self.decisive: tuple[Any, ...] = ("deferred", options, raster)

    def draw(self, shot: Shot, context: FrameContext) -> RenderedImage:
        """Render one frame; without triangles, the part of it that shows something."""
        if shot.mesh is not None:
            return self._drawn(shot)
        camera = shot.camera
        part = drawn_part(shot.cloud, camera, self._raster)
        image = self._drawn(replace(shot, camera=camera.cropped(*part)))
        layers = {name: part.placed(layer, camera) for name, layer in image.layers.items()}
        return RenderedImage(part.placed(image.rgb, camera), part.placed(image.alpha, camera), layers)

    def _drawn(self, shot: Shot) -> RenderedImage:
        """Render a shot with the errors of what it shows."""
        image = self._renderer.draw(shot)
        names = [name for name in ERROR_CHANNELS if self._errors and getattr(shot.cloud, name) is not None]
        if not names or not len(shot.cloud):
            return image
        camera = shot.camera.supersampled(self._samples)
        drawn = rasterize(shot.cloud, camera, channels=names, options=self._raster, device=self._device)
        return replace(image, layers={**image.layers, **PixelMeans.of(drawn, self._samples).channels})


class PathFrames:
    """The path tracer; noise differs from frame to frame, else it would stand still like a dirty pane."""

    def __init__(self, options: PathOptions, *, device: str | None = None) -> None:
        """Take the options; their seed is that of frame 0."""
        self._options = options
        self._renderer = PathRenderer(options, device=device)
        self.decisive: tuple[Any, ...] = ("path", options)

    def draw(self, shot: Shot, context: FrameContext) -> RenderedImage:
        """Render one frame, or go on where it was stopped."""
        seed = (self._options.seed + SEED_STEP * context.number) % 2**32
        self._renderer.options = replace(self._options, seed=seed)
        return self._renderer.draw(shot, checkpoint=context.checkpoint, report=context.report)
