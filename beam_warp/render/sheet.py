"""One picture of an asset: what was captured, what was found, and two relightings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.files import display_image
from beam_warp.image.panels import MARGIN, TITLE_HEIGHT, Panel, lay_out, over_background
from beam_warp.light.prefiltered import EnvironmentLighting
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.render.split_sum import relight
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud

WHITE_IRRADIANCE = 0.85 * np.pi
"""Relightings are exposed so that a white surface facing the light's strongest side comes to 0.85."""


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


def _grid(panels: Sequence[Panel]) -> NDArray[np.uint8]:
    """Lay panels out with their titles, close to 16:9 and with few empty places."""
    height, width = panels[0][1].shape[:2]
    cell = (height + TITLE_HEIGHT + MARGIN, width + MARGIN)

    def cost(columns: int) -> float:
        rows = -(-len(panels) // columns)
        aspect = columns * cell[1] / (rows * cell[0])
        return abs(float(np.log(aspect * 9.0 / 16.0))) + 0.3 * (rows * columns - len(panels))

    return lay_out(panels, min(range(1, len(panels) + 1), key=cost))
