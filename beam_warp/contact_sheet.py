"""One picture of an asset: what was captured, what was found, and two relightings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from beam_warp.assets import DISPLAY_SRGB, GaussianCloud
from beam_warp.cameras import Camera
from beam_warp.deferred import EnvironmentLighting, relight
from beam_warp.environments import EnvironmentMap
from beam_warp.images import display_image
from beam_warp.raster_records import RasterOptions
from beam_warp.rasterizing import rasterize

BACKGROUND = 0.13
"""Display grey behind the subject: dark subjects stay visible, and white ones too."""

MARGIN = 8
TITLE_HEIGHT = 30
TITLE_SIZE = 16
WHITE_IRRADIANCE = 0.85 * np.pi
"""Relightings are exposed so that a white surface facing the light's strongest side comes to 0.85."""


Panel = tuple[str, NDArray[np.uint8]]
"""A title and 8-bit sRGB pixels."""


@dataclass(frozen=True, eq=False)
class Relighting:
    """A light to show the asset under; one that is prepared, on the device that draws, is not prepared again."""

    title: str
    light: EnvironmentMap | EnvironmentLighting


def display_exposure(lighting: EnvironmentLighting) -> float:
    """Return the stops that bring a white surface, at its best-lit orientation, to just below display white."""
    brightest = float(lighting.light.irradiance.numpy().max())
    return float(np.log2(WHITE_IRRADIANCE / max(brightest, 1e-12)))


def contact_sheet(
    cloud: GaussianCloud,
    camera: Camera,
    relightings: Sequence[Relighting],
    *,
    options: RasterOptions | None = None,
    device: str | None = None,
) -> NDArray[np.uint8]:
    """Draw the captured colour, ambient occlusion, base colour, roughness, normals, and the relightings.

    Args:
        cloud: Relightable, with captured radiance, axes "rfu".
        camera: Sees each panel.
        relightings: One panel each.
        options: How splats are drawn: as they were when the Gaussians were fitted.
        device: Warp device.

    Returns:
        8-bit sRGB, ``(H, W, 3)``.
    """
    names = ("base_color", "roughness", "ambient_occlusion", "normals")
    buffer = rasterize(cloud, camera, channels=("radiance", *names), options=options, device=device)
    alpha = buffer.alpha[..., None]
    captured = buffer.channels["radiance"]
    if cloud.radiance_color_space != DISPLAY_SRGB:
        captured = display_image(captured) / 255.0
    panels = [
        ("captured", over_background(np.clip(captured, 0.0, 1.0), alpha)),
        ("ambient occlusion (white is open)", over_background(_gray(buffer.channels["ambient_occlusion"]), alpha)),
        ("base colour", over_background(display_image(buffer.channels["base_color"]) / 255.0, alpha)),
        ("roughness (white is 1)", over_background(_gray(buffer.channels["roughness"]), alpha)),
        ("normals (x, y, z as r, g, b)", over_background(0.5 * buffer.channels["normals"] + 0.5, alpha)),
    ]
    for relighting in relightings:
        lighting = relighting.light
        if isinstance(lighting, EnvironmentMap):
            lighting = EnvironmentLighting.from_environment(lighting, device=device)
        radiance = relight(buffer, lighting)
        straight = np.divide(radiance, alpha, out=np.zeros_like(radiance), where=alpha > 0.0)
        shown = display_image(straight, display_exposure(lighting)) / 255.0
        panels.append((relighting.title, over_background(shown, alpha)))
    return _grid(panels)


def _gray(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.repeat(np.clip(values, 0.0, 1.0)[..., None], 3, axis=-1)


def over_background(display: NDArray[np.floating], alpha: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Composite straight display colour ``(H, W, 3)`` in [0, 1] with coverage ``(H, W, 1)`` onto the background."""
    return np.rint(255.0 * (display * alpha + BACKGROUND * (1.0 - alpha))).astype(np.uint8)


def _grid(panels: Sequence[Panel]) -> NDArray[np.uint8]:
    """Lay panels out with their titles, close to 16:9 and with few empty places."""
    height, width = panels[0][1].shape[:2]
    cell = (height + TITLE_HEIGHT + MARGIN, width + MARGIN)

    def cost(columns: int) -> float:
        rows = -(-len(panels) // columns)
        aspect = columns * cell[1] / (rows * cell[0])
        return abs(float(np.log(aspect * 9.0 / 16.0))) + 0.3 * (rows * columns - len(panels))

    return lay_out(panels, min(range(1, len(panels) + 1), key=cost))


def lay_out(panels: Sequence[Panel], columns: int) -> NDArray[np.uint8]:
    """Return one image of panels of equal size with their titles, row by row."""
    height, width = panels[0][1].shape[:2]
    cell = (height + TITLE_HEIGHT + MARGIN, width + MARGIN)
    rows = -(-len(panels) // columns)
    shade_of_frame = round(255 * BACKGROUND * 0.7)
    sheet = PillowImage.new("RGB", (columns * cell[1] + MARGIN, rows * cell[0] + MARGIN), (shade_of_frame,) * 3)
    draw = ImageDraw.Draw(sheet)
    for number, (title, pixels) in enumerate(panels):
        left = MARGIN + number % columns * cell[1]
        top = MARGIN + number // columns * cell[0]
        size = TITLE_SIZE
        while draw.textlength(title, font=ImageFont.load_default(size=size)) > width and size > 8:
            size -= 1
        draw.text((left + 2, top + 5), title, fill=(225, 225, 225), font=ImageFont.load_default(size=size))
        sheet.paste(PillowImage.fromarray(pixels), (left, top + TITLE_HEIGHT))
    return np.asarray(sheet)
