"""How shots are shaded by deferred rendering."""

from __future__ import annotations

from dataclasses import dataclass

from beam_warp.checks import require_choice, require_count
from beam_warp.light.regions import MOST_REGIONS

LAYERS = ("base_color", "roughness", "ambient_occlusion", "normals", "depth")
"""Every layer that an image may come with."""


@dataclass(frozen=True, kw_only=True)
class DeferredOptions:
    """How shots are shaded.

    Attributes:
        environment_shadows: Shadow maps of the environment: of its small bright sources, which are shaded as lights
            (`beam_warp.light.compact_sources`), and of regions of what is left, at least one. 0 takes ambient
            occlusion instead, and the split sum for all of it.
        bounces: How often light goes from surface to surface of the Gaussians; 0 for none.
        light_map_size: Side of every light's shadow maps, the environment's sources included [texel].
        environment_map_size: Side of the shadow maps of the environment's regions [texel].
        samples: Side of the square of samples of a pixel: the image is their mean.
        layers: Names from `LAYERS`: what images come with besides colour and alpha.

    Raises:
        InvalidOptionError: An option is out of range.
    """

    environment_shadows: int = 16
    bounces: int = 2
    light_map_size: int = 1024
    environment_map_size: int = 256
    samples: int = 1
    layers: tuple[str, ...] = LAYERS

    def __post_init__(self) -> None:
        """Check every option once."""
        require_count("environment_shadows", self.environment_shadows, 0, MOST_REGIONS)
        require_count("bounces", self.bounces, 0, 16)
        require_count("light_map_size", self.light_map_size, 16, 8192)
        require_count("environment_map_size", self.environment_map_size, 16, 4096)
        require_count("samples", self.samples, 1, 16)
        for name in self.layers:
            require_choice("layers", name, LAYERS)

    @property
    def lights_gaussians(self) -> bool:
        """Whether what arrives is found for every Gaussian, and not only for pixels."""
        return bool(self.environment_shadows or self.bounces)


UNSHADOWED = DeferredOptions(environment_shadows=0, bounces=0, layers=())
"""The split sum alone: ambient occlusion stands for the environment's shadows, and light does not bounce."""
