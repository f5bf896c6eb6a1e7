"""The light of a capture, ready on a device for all that decomposing materials asks of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from beam_warp.light.prefiltered import EnvironmentLighting
from beam_warp.light.sampled import SampledEnvironment
from beam_warp.world.environment import EnvironmentMap


@dataclass(frozen=True, eq=False)
class MaterialLight:
    """An environment prepared twice: to draw rays by, and blurred by the specular lobe of every roughness.

    Attributes:
        sampled: For drawing rays, and for irradiance with nothing in the way.
        blurred: For specular light with nothing in the way.
    """

    sampled: SampledEnvironment
    blurred: EnvironmentLighting

    @classmethod
    def from_environment(cls, environment: EnvironmentMap, device: Any) -> MaterialLight:
        """Prepare an environment for a Warp device."""
        return cls(
            SampledEnvironment.from_environment(environment, device),
            EnvironmentLighting.from_environment(environment, device=str(device)),
        )

    @property
    def device(self) -> Any:
        """The Warp device that holds it."""
        return self.sampled.device

    @property
    def mean_irradiance(self) -> float:
        """Unshadowed irradiance [W/m^2], mean over normals and channels."""
        return self.sampled.mean_irradiance

    def scaled(self, factor: float) -> MaterialLight:
        """Return the same light times a factor."""
        return MaterialLight(self.sampled.scaled(factor), self.blurred.scaled(factor))
