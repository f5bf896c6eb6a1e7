"""Which renderers a viewer has: one that lights at once, and one that traces paths where it is installed."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from beam_warp.deferred import EnvironmentLighting, shade
from beam_warp.devices import resolve_device
from beam_warp.images import display_image, srgb_to_linear
from beam_warp.raster_records import RasterOptions
from beam_warp.rasterizing import rasterize
from beam_warp.shots import ImageRenderer, RenderedImage, Shot
from beam_warp.view_state import Color, rotation_of

QUICK_MAP_SIZE = 256
"""Side of shadow maps of lamps while something moves, where there is no GPU [texel]."""


class Progress(Protocol):
    """A picture to which paths are added."""

    sample_count: int

    def advance(self, samples: int) -> Any:
        """Add paths to every pixel."""
        ...

    def image(self) -> RenderedImage:
        """Return what there is so far."""
        ...


class PathTracer(Protocol):
    """Begins pictures to which paths are added."""

    def start(self, shot: Shot) -> Progress:
        """Begin a picture."""
        ...


class EnvironmentRenderer:
    """Lights a G-buffer by its environment: no lamps, no meshes."""

    def __init__(self, *, raster: RasterOptions | None = None, device: str | None = None) -> None:
        """Start with no light made ready."""
        self._raster = raster
        self._device = str(resolve_device(device))
        self._lighting: EnvironmentLighting | None = None

    def draw(self, shot: Shot) -> RenderedImage:
        """Draw a shot; the light is turned by turning what it falls on the other way."""
        buffer = rasterize(shot.cloud, shot.camera, options=self._raster, device=self._device)
        layers = {**buffer.channels, "depth": buffer.depth}
        if shot.environment is None:
            return RenderedImage(np.zeros((*buffer.alpha.shape, 3), np.float32), buffer.alpha, layers)
        if self._lighting is None or self._lighting.environment is not shot.environment:
            self._lighting = EnvironmentLighting.from_environment(shot.environment, device=self._device)
        half = np.radians(0.5 * shot.environment_rotation)
        turn = rotation_of((np.cos(half), 0.0, 0.0, np.sin(half)))  # a row times it is turned back
        rgb = shade(
            base_color=buffer.channels["base_color"],
            roughness=buffer.channels["roughness"],
            ambient_occlusion=buffer.channels["ambient_occlusion"],
            normals=buffer.channels["normals"] @ turn,
            alpha=buffer.alpha,
            view_directions=shot.camera.directions() @ turn,
            lighting=self._lighting,
        )
        return RenderedImage(rgb, buffer.alpha, layers)


class DeferredPair:
    """Renders at once: thoroughly, or quickly where shadows of the environment would take seconds.

    Attributes:
        has_lamps: Whether lamps and meshes are drawn.
    """

    def __init__(self, raster: RasterOptions, device: str | None) -> None:
        """Choose renderers; on a GPU, what is thorough is quick."""
        found = _module("deferred_rendering")
        self.has_lamps = found is not None
        self._is_fast = bool(resolve_device(device).is_cuda)
        self._lit: object = None
        if found is None:
            self._quick: ImageRenderer = EnvironmentRenderer(raster=raster, device=device)
            self._thorough = self._quick
            return
        options = _module("deferred_options").DeferredOptions
        plain = options(layers=(), environment_shadows=0, bounces=0)
        if not self._is_fast:
            plain = replace(plain, light_map_size=QUICK_MAP_SIZE)
        self._quick = found.DeferredRenderer(plain, raster=raster, device=device)
        self._thorough = found.DeferredRenderer(options(layers=()), raster=raster, device=device)

    def draw(self, shot: Shot, *, lighting: object, is_thorough: bool, is_quick: bool) -> RenderedImage:
        """Render a shot.

        Args:
            shot: What is rendered.
            lighting: What light depends on: where it is what it was, what was found for it is there.
            is_thorough: Whether the environment is to cast shadows.
            is_quick: Whether something moves.
        """
        if not is_thorough or (is_quick and not self._is_fast and lighting != self._lit):
            return self._quick.draw(shot)
        image = self._thorough.draw(shot)
        self._lit = lighting
        return image


def path_tracer(device: str | None) -> PathTracer | None:
    """Return what traces paths; None where there is none."""
    found = _module("path_rendering")
    return None if found is None else found.PathRenderer(found.PathOptions(samples=2**20), device=device)


def _module(name: str) -> Any:
    """Return a module of this package; None where it is not there."""
    full = f"beam_warp.{name}"
    return importlib.import_module(full) if importlib.util.find_spec(full) else None


def view_transforms() -> tuple[str, ...]:
    """Return the names of what turns scene-linear light into display colours; the first one is the default."""
    found = _module("tone_mapping")
    return ("standard",) if found is None else tuple(found.TRANSFORMS)


def displayed(image: RenderedImage, transform: str, stops: float, background: Color) -> NDArray[np.uint8]:
    """Return what a display shows of an image over a display colour, ``(H, W, 3)``: see `tone_mapping.display_over`."""
    behind = np.asarray(background, np.uint8)
    shown = np.broadcast_to(behind, image.rgb.shape).copy()
    rows, columns = (np.flatnonzero((image.alpha > 0.0).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return shown
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)  # the rest is background
    rgb, alpha = image.rgb[part], image.alpha[part]
    found = _module("tone_mapping")
    if found is not None:
        shown[part] = found.display_over(rgb, alpha, transform, stops, behind / 255.0)
    else:
        opacity = alpha[..., None]
        straight = np.divide(rgb, opacity, out=np.zeros_like(rgb), where=opacity > 0.0)
        bright = np.clip(straight * np.float32(2.0**stops), 0.0, 1.0)
        shown[part] = display_image(opacity * bright + (1.0 - opacity) * srgb_to_linear(behind / np.float32(255.0)))
    return shown
