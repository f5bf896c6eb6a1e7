"""The renderer of a viewer that shades at once, and images as a display shows them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beam_warp.device.arrays import resolve_device
from beam_warp.image.tone import ViewTransform, display_over
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import DeferredOptions
from beam_warp.view.state import Color
from beam_warp.world.shot import RenderedImage, Shot

QUICK_MAP_SIZE = 256
"""Side of shadow maps of lamps while something moves, where there is no GPU [texel]."""


class DeferredPair:
    """Renders at once: thoroughly, or quickly where shadows of the environment would take seconds."""

    def __init__(self, raster: RasterOptions, device: str | None) -> None:
        """Choose renderers; on a GPU, what is thorough is quick."""
        self._is_fast = bool(resolve_device(device).is_cuda)
        self._lit: object = None
        plain = DeferredOptions(layers=(), environment_shadows=0, bounces=0)
        if not self._is_fast:
            plain = replace(plain, light_map_size=QUICK_MAP_SIZE)
        self._quick = DeferredRenderer(plain, raster=raster, device=device)
        self._thorough = DeferredRenderer(DeferredOptions(layers=()), raster=raster, device=device)

    def draw(self, shot: Shot, *, lighting: object, is_thorough: bool, is_quick: bool) -> RenderedImage:
        """Render a shot.

        Args:
            shot: Shot to render.
            lighting: Values that light depends on; light that was found for the same values is used again.
            is_thorough: Whether the environment is to cast shadows.
            is_quick: Whether something moves.
        """
        if not is_thorough or (is_quick and not self._is_fast and lighting != self._lit):
            return self._quick.draw(shot)
        image = self._thorough.draw(shot)
        self._lit = lighting
        return image


def displayed(image: RenderedImage, transform: ViewTransform, stops: float, background: Color) -> NDArray[np.uint8]:
    """Return an image over a display colour as a display shows it, ``(H, W, 3)``; see `tone.display_over`."""
    behind = np.asarray(background, np.uint8)
    shown = np.broadcast_to(behind, image.rgb.shape).copy()
    rows, columns = (np.flatnonzero((image.alpha > 0.0).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return shown
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)  # the rest is background
    rgb, alpha = image.rgb[part], image.alpha[part]
    shown[part] = display_over(rgb, alpha, transform, stops, behind / 255.0)
    return shown
