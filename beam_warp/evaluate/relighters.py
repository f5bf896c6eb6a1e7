"""Ways to put a relightable cloud under a light, all behind one call, so that they are scored alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from beam_warp.device.arrays import resolve_device
from beam_warp.image.metrics import block_means
from beam_warp.light.prepared import MaterialLight
from beam_warp.raster.gbuffer import rasterize_values
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.render.traced_relighting import traced_radiance
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.shot import Shot


class RelitImage(NamedTuple):
    """A view under a light.

    Attributes:
        rgb: Scene-linear Rec.709 radiance multiplied by alpha, ``(H, W, 3)`` float32.
        alpha: Coverage in [0, 1], ``(H, W)`` float32.
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]


class Relighter(Protocol):
    """Draws a relightable cloud under a light."""

    def __call__(
        self,
        cloud: GaussianCloud,
        environment: EnvironmentMap,
        cameras: Sequence[Camera],
        *,
        raster: RasterOptions,
        samples: int,
        device: str | None,
    ) -> list[RelitImage]:
        """Return what some cameras see.

        Args:
            cloud: Relightable, in the world's axes.
            environment: The light.
            cameras: Of one sample a pixel.
            raster: How splats are drawn.
            samples: Side of the square of samples of a pixel.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.
        """
        ...


class DeferredRelighter:
    """Lights a G-buffer as real-time renderers do, with shadow maps; see `beam_warp.render.deferred`."""

    def __init__(self) -> None:
        """Start with no renderer."""
        self._renderers: dict[tuple[RasterOptions, int, str], DeferredRenderer] = {}

    def __call__(
        self,
        cloud: GaussianCloud,
        environment: EnvironmentMap,
        cameras: Sequence[Camera],
        *,
        raster: RasterOptions,
        samples: int,
        device: str | None,
    ) -> list[RelitImage]:
        """Light every sample of a pixel, and take their mean."""
        renderer = self._renderer(raster, samples, str(resolve_device(device)))
        images = []
        for camera in cameras:
            image = renderer.draw(Shot(cloud=cloud, camera=camera, environment=environment))
            images.append(RelitImage(image.rgb, image.alpha))
        return images

    def _renderer(self, raster: RasterOptions, samples: int, device: str) -> DeferredRenderer:
        """Return a renderer, the same one for all frames: it keeps lights made ready."""
        key = (raster, samples, device)
        if key not in self._renderers:
            options = DeferredOptions(samples=samples, layers=())
            self._renderers[key] = DeferredRenderer(options, raster=raster, device=device)
        return self._renderers[key]


class TracedRelighter:
    """Gathers light by rays from every Gaussian (see `beam_warp.render.traced_relighting`): shadows are cast."""

    def __init__(self) -> None:
        """Start with no light made ready."""
        self._lights: dict[tuple[EnvironmentMap, str], MaterialLight] = {}

    def __call__(
        self,
        cloud: GaussianCloud,
        environment: EnvironmentMap,
        cameras: Sequence[Camera],
        *,
        raster: RasterOptions,
        samples: int,
        device: str | None,
    ) -> list[RelitImage]:
        """Light every Gaussian, and blend what it sends."""
        target = resolve_device(device)
        key = (environment, str(target))
        if key not in self._lights:
            self._lights[key] = MaterialLight.from_environment(environment, target)
        radiance = traced_radiance(cloud, self._lights[key], cameras, raster=raster)
        images = []
        for camera, sent in zip(cameras, radiance, strict=True):
            drawn = rasterize_values(cloud, camera.supersampled(samples), sent, options=raster, device=device)
            images.append(RelitImage(block_means(drawn.values, samples), block_means(drawn.alpha, samples)))
        return images


PATHS_PER_PIXEL = 256
"""Of the path tracer, when it is scored: four times as many add 0.2 dB on reconstructions of two captures."""


class PathRelighter:
    """Path traces every pixel (see `beam_warp.render.path`): what the offline renderer shows.

    Gaussians are met as they are, without the filter of the rasteriser; ``raster`` and ``samples`` have no effect.
    """

    def __init__(self) -> None:
        """Start with no renderer."""
        self._renderers: dict[str, PathRenderer] = {}

    def __call__(
        self,
        cloud: GaussianCloud,
        environment: EnvironmentMap,
        cameras: Sequence[Camera],
        *,
        raster: RasterOptions,
        samples: int,
        device: str | None,
    ) -> list[RelitImage]:
        """Trace each view by itself."""
        target = str(resolve_device(device))
        if target not in self._renderers:
            self._renderers[target] = PathRenderer(PathOptions(samples=PATHS_PER_PIXEL), device=target)
        images = []
        for camera in cameras:
            image = self._renderers[target].draw(Shot(cloud=cloud, camera=camera, environment=environment))
            images.append(RelitImage(image.rgb, image.alpha))
        return images


RELIGHTERS: Mapping[str, Callable[[], Relighter]] = {
    "deferred": DeferredRelighter,
    "traced": TracedRelighter,
    "path": PathRelighter,
}
"""By name, what makes a relighter."""
