"""The real-time renderer: deferred shading of Gaussians and meshes under an environment and lights, with shadows.

A G-buffer of materials is drawn, and lit pixel by pixel: by the environment's split sum
(`beam_warp.light.prefiltered`), by every light and small bright source of the environment through what the path tracers
scatter too (``kernels/light/scattering.py``), shadowed by maps that the same rasteriser draws
(`beam_warp.render.shadow_maps`, where their bias is stated). Shadows of the rest of the environment and light between
surfaces are found for every Gaussian (`beam_warp.render.arriving`).

Left out: reflections of surfaces in surfaces, light from meshes to Gaussians and back, the stretch at grazing angles of
lobes that see more than small sources, scattering inside. docs/rendering.md has measurements.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from beam_warp.device.arrays import resolve_device
from beam_warp.light.prepared import PreparedEnvironment, PreparedEnvironments
from beam_warp.raster.records import RasterOptions
from beam_warp.render.options import DeferredOptions
from beam_warp.render.prepared_shot import DeferredFrame
from beam_warp.world.shot import RenderedImage, Shot


class DeferredRenderer:
    """Renders shots by deferred shading; a `beam_warp.world.shot.Renderer`.

    What two shots share is kept from one to the next: environments made ready, arrays on the device if there are as
    many Gaussians and pixels, shadow maps if neither what casts them nor their light changed.
    """

    def __init__(
        self,
        options: DeferredOptions | None = None,
        *,
        raster: RasterOptions | None = None,
        device: Any = None,
        prepared: Iterable[PreparedEnvironment] = (),
    ) -> None:
        """Choose how shots are drawn.

        Args:
            options: See `DeferredOptions`.
            raster: How splats are drawn: as they were fitted.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.
            prepared: Environments of shots to come that are prepared already, on that device.

        Raises:
            DeviceError: There is no such device.
        """
        self.options = options or DeferredOptions()
        self._raster = raster or RasterOptions()
        self._device = resolve_device(device)
        self._environments = PreparedEnvironments(self._device, prepared)
        self._frame: DeferredFrame | None = None

    def frame(self, shot: Shot) -> DeferredFrame:
        """Return a frame of this renderer that shows a shot, drawn: the same one as before if it `fits`."""
        if self._frame is None or not self._frame.fits(shot):
            self._frame = DeferredFrame(shot, self.options, self._raster, self._environments, self._device)
        else:
            self._frame.set(shot)
        self._frame.draw()
        return self._frame

    def draw(self, shot: Shot) -> RenderedImage:
        """Render one image.

        Returns:
            Radiance, alpha, and the layers that the options name. A caught shadow covers nothing in the layers.

        Raises:
            InvalidArrayError: The Gaussians cover an image too often to be drawn.
        """
        return self.frame(shot).image()
