"""One picture of an asset: what was captured, what was found, and two relightings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.files import display_image
from beam_warp.image.panels import MARGIN, TITLE_HEIGHT, Panel, display_color, gray, lay_out, over_background
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.pixel_means import PixelMeans
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import samples_of_images
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import UNSHADOWED
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.shot import Shot

WHITE_IRRADIANCE = 0.85 * np.pi
"""Relightings are exposed so that a white surface facing the light's strongest side comes to 0.85."""


@dataclass(frozen=True, eq=False)
class Relighting:
    """A light to show the asset under.

    Attributes:
        title: Title of its panel.
        light: An environment; one that is prepared, on the device that draws, is not prepared again.
        degrees: The angle about z by which it is turned, as in `beam_warp.world.shot.Shot`.
    """

    title: str
    light: EnvironmentMap | PreparedEnvironment
    degrees: float = 0.0

    @property
    def environment(self) -> EnvironmentMap:
        """The light as it is before it is turned."""
        return self.light.environment if isinstance(self.light, PreparedEnvironment) else self.light


def display_exposure(environment: EnvironmentMap) -> float:
    """Return the stops that bring a white surface, at its best-lit orientation, to just below display white."""
    brightest = float(environment.default_irradiance.max())
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

    Pixels have the samples of `beam_warp.raster.resolution.samples_of_images`.

    Args:
        cloud: Relightable, with captured radiance, axes "rfu".
        camera: Sees each panel.
        relightings: One panel each.
        options: How splats are drawn: as they were when the Gaussians were fitted.
        device: Warp device.

    Returns:
        8-bit sRGB, ``(H, W, 3)``.
    """
    names = ("radiance", "base_color", "roughness", "ambient_occlusion", "normals")
    side = samples_of_images(cloud, [camera], options or RasterOptions())
    samples = rasterize(cloud, camera.supersampled(side), channels=names, options=options, device=device)
    seen = PixelMeans.of(samples, side)
    captured, base_color, roughness, occlusion, normals = (seen.channels[name] for name in names)
    alpha = seen.alpha[..., None]
    if cloud.radiance_color_space != DISPLAY_SRGB:
        captured = display_image(captured) / 255.0
    panels = [
        ("captured", over_background(np.clip(captured, 0.0, 1.0), alpha)),
        ("ambient occlusion (white is open)", over_background(gray(occlusion), alpha)),
        ("base colour", over_background(display_image(base_color) / 255.0, alpha)),
        ("roughness (white is 1)", over_background(gray(roughness), alpha)),
        ("normals (x, y, z as r, g, b)", over_background(0.5 * normals + 0.5, alpha)),
    ]
    prepared = [relighting.light for relighting in relightings if isinstance(relighting.light, PreparedEnvironment)]
    renderer = DeferredRenderer(replace(UNSHADOWED, samples=side), raster=options, device=device, prepared=prepared)
    for relighting in relightings:
        light = relighting.environment
        image = renderer.draw(
            Shot(cloud=cloud, camera=camera, environment=light, environment_rotation=relighting.degrees)
        )
        shown = display_color(image.rgb, seen.alpha, display_exposure(light))
        panels.append((relighting.title, over_background(shown, alpha)))
    return _grid(panels)


def _grid(panels: Sequence[Panel]) -> NDArray[np.uint8]:
    """Lay panels out with their titles, close to 16:9 and with few empty places."""
    height, width = panels[0][1].shape[:2]
    cell = (height + TITLE_HEIGHT + MARGIN, width + MARGIN)

    def cost(columns: int) -> float:
        rows = -(-len(panels) // columns)
        aspect = columns * cell[1] / (rows * cell[0])
        return abs(float(np.log(aspect * 9.0 / 16.0))) + 0.3 * (rows * columns - len(panels))

    return lay_out(panels, min(range(1, len(panels) + 1), key=cost))
