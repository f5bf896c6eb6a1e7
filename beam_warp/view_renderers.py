"""Which renderers a viewer has: one that lights at once, and one that traces paths where it is installed."""

from __future__ import annotations

import importlib
import importlib.util
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


def deferred_renderer(raster: RasterOptions, device: str | None) -> tuple[ImageRenderer, bool]:
    """Return what lights at once, and whether it knows lamps and meshes."""
    found = _module("deferred_rendering")
    if found is None:
        return EnvironmentRenderer(raster=raster, device=device), False
    return found.DeferredRenderer(raster=raster, device=device), True


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
