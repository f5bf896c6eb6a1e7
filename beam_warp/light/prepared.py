"""Environments made ready on a device, in every form that kernels take."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any

import numpy as np

from beam_warp.device.arrays import members, resolve_device, upload
from beam_warp.kernels.light.environment_sampling import EnvironmentDistribution
from beam_warp.kernels.light.product_sampling import EnvironmentBlocks
from beam_warp.kernels.light.product_tree import ProductTree
from beam_warp.kernels.light.shading import EnvironmentLight
from beam_warp.kernels.trace.incident_light import LightMoments
from beam_warp.light.compact_sources import split_sources
from beam_warp.light.prefiltered import blurred_environment
from beam_warp.light.regions import EnvironmentRegions
from beam_warp.light.sampled import environment_blocks, environment_distribution, fitted, light_moments, product_tree
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.lights import DirectionalLight

NO_LIGHT = EnvironmentMap.constant((0.0, 0.0, 0.0), height=4)
"""The environment of a shot that has none."""

KEPT_ENVIRONMENTS = 8
"""Prepared environments that `PreparedEnvironments` keeps."""


class PreparedEnvironment:
    """An environment on a device. Each form of it is made when it is first asked for, once.

    `blurred` serves shading; `distribution`, `blocks` and `product_tree` serve sampling; `moments` and
    `mean_irradiance` are the light with nothing in the way; `regions` and `split` serve shadow maps. Forms for sampling
    and moments see the texels of `beam_warp.light.sampled.fitted`.

    Attributes:
        environment: The light.
        device: Warp device that holds all forms.
    """

    def __init__(self, environment: EnvironmentMap, device: Any = None) -> None:
        """Choose the device; nothing is made yet.

        Args:
            environment: The light.
            device: A Warp device or its name; None takes the first CUDA device, or the CPU where there is none.

        Raises:
            DeviceError: There is no such device.
        """
        self.environment = environment
        self.device = resolve_device(device)
        self._unscaled: tuple[PreparedEnvironment, float] | None = None
        self._regions: dict[int, EnvironmentRegions] = {}

    @cached_property
    def blurred(self) -> EnvironmentLight:
        """Irradiance, and radiance blurred by the specular lobe of every roughness."""
        scaled = ("irradiance", "texels")
        return self._form(
            "blurred", EnvironmentLight, scaled, lambda: blurred_environment(self.environment, self.device)
        )

    @cached_property
    def distribution(self) -> EnvironmentDistribution:
        """Tables for drawing directions by radiance."""
        return self._form(
            "distribution", EnvironmentDistribution, ("radiance",), lambda: environment_distribution(*self._fitted)
        )

    @cached_property
    def blocks(self) -> EnvironmentBlocks:
        """Tables for drawing directions by radiance times cosine, with 512 weights a point."""
        scaled = ("radiance", "luminance", "block_power")
        return self._form("blocks", EnvironmentBlocks, scaled, lambda: environment_blocks(*self._fitted))

    @cached_property
    def product_tree(self) -> ProductTree:
        """Tables for drawing directions by radiance times cosine, with 48 weights a direction; holds `blocks`."""
        return product_tree(self.blocks, self.device)

    @cached_property
    def moments(self) -> LightMoments:
        """Sums over the sphere that give the irradiance of any normal with nothing in the way."""
        return self._form("moments", LightMoments, ("red", "green", "blue"), lambda: light_moments(*self._fitted))

    @cached_property
    def mean_irradiance(self) -> float:
        """Irradiance with nothing in the way [W/m^2], mean over normals and channels."""
        if self._unscaled is not None:
            source, factor = self._unscaled
            return source.mean_irradiance * factor
        return float(np.pi * self._fitted[0].mean_radiance().mean())

    def regions(self, count: int) -> EnvironmentRegions:
        """Return so many regions; see `EnvironmentRegions.of`."""
        if count not in self._regions:
            self._regions[count] = EnvironmentRegions.of(self.environment, count)
        return self._regions[count]

    @cached_property
    def split(self) -> tuple[PreparedEnvironment, tuple[DirectionalLight, ...]]:
        """What is left without the small bright sources, and these; see `beam_warp.light.compact_sources`."""
        if self._unscaled is not None:
            source, factor = self._unscaled
            rest, sources = source.split
            return (rest.scaled(factor) if sources else self), tuple(light.scaled(factor) for light in sources)
        rest, sources = split_sources(self.environment)
        return (PreparedEnvironment(rest, self.device) if sources else self), sources

    def scaled(self, factor: float) -> PreparedEnvironment:
        """Return the same light times a factor. Its forms are scaled, not made again: directions stay."""
        result = PreparedEnvironment(self.environment.scaled(factor), self.device)
        result._unscaled = (self, factor)
        return result

    @cached_property
    def _fitted(self) -> tuple[EnvironmentMap, Any]:
        """The environment on a grid that blocks divide, and the device."""
        return fitted(self.environment), self.device

    def _form(self, name: str, structure: Any, scaled: tuple[str, ...], make: Callable[[], Any]) -> Any:
        """Return a form: made, or, of a scaled light, the form before with the arrays of radiance times the factor."""
        if self._unscaled is None:
            return make()
        source, factor = self._unscaled
        result = structure()
        for part, array in members(getattr(source, name)).items():
            if part in scaled:
                array = upload(array.numpy() * np.float32(factor), array.dtype, self.device)
            setattr(result, part, array)
        return result


class PreparedEnvironments:
    """The environments that were last asked for on a device, prepared: each map object once."""

    def __init__(self, device: Any, given: Iterable[PreparedEnvironment] = ()) -> None:
        """Begin with those that are given, on the same device."""
        self._device = device
        self._kept = {prepared.environment: prepared for prepared in given}

    def of(self, environment: EnvironmentMap | None) -> PreparedEnvironment:
        """Return an environment prepared; None stands for `NO_LIGHT`."""
        key = environment or NO_LIGHT
        if key not in self._kept:
            self._kept[key] = PreparedEnvironment(key, self._device)
            if len(self._kept) > KEPT_ENVIRONMENTS:
                del self._kept[next(iter(self._kept))]
        return self._kept[key]
