"""Material channels of a relightable cloud as a camera sees them, a pixel being the mean of several samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.image.files import Image
from beam_warp.image.metrics import block_means
from beam_warp.raster.channels import RADIANCE, channel_layers
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.pixel_means import PixelMeans
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import LEAST_SAMPLES
from beam_warp.reconstruction.scores import seen_radiance
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import MATERIAL_CHANNELS, GaussianCloud


@dataclass(frozen=True, eq=False)
class DrawnMaterials(PixelMeans):
    """One view of a cloud.

    Attributes:
        camera: The camera that sees it, of one sample a pixel.
        radiance: Captured colour, scene-linear and multiplied by alpha, ``(H, W, 3)`` float32; None where it was not
            drawn.
    """

    camera: Camera
    radiance: NDArray[np.float32] | None

    def layers(self) -> dict[str, NDArray[np.float32]]:
        """Return the layers of an image file, named as in a capture's truth; R, G and B are the radiance, if any."""
        layers = {"A": self.alpha, "depth": self.depth}
        for name, array in self.channels.items():
            layers.update(channel_layers(name, array))
        if self.radiance is not None:
            layers.update({part: self.radiance[..., i] for i, part in enumerate("RGB")})
        return layers


def draw_materials(
    cloud: GaussianCloud,
    camera: Camera,
    *,
    channels: Sequence[str] = MATERIAL_CHANNELS,
    radiance: bool = False,
    raster: RasterOptions | None = None,
    samples: int = LEAST_SAMPLES,
    device: str | None = None,
) -> DrawnMaterials:
    """Draw a cloud; see `beam_warp.raster.gbuffer.rasterize` for what it refuses.

    Args:
        cloud: Gaussians in the world's axes.
        camera: From where.
        channels: Which of the cloud's arrays.
        radiance: Draw the captured colour too.
        raster: How splats are drawn: as they were when the Gaussians were fitted.
        samples: Side of the square of samples of a pixel.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
    """
    names = (*channels, *((RADIANCE,) if radiance else ()))
    buffer = rasterize(cloud, camera.supersampled(samples), channels=names, options=raster, device=device)
    seen = PixelMeans.of(buffer, samples)
    return DrawnMaterials(
        seen.alpha,
        seen.depth,
        {name: seen.channels[name] for name in channels},
        camera,
        block_means(seen_radiance(buffer, cloud), samples).astype(np.float32) if radiance else None,
    )


def true_channel(truth: Image, name: str) -> NDArray[np.float32] | None:
    """Return an exact channel by the name of a cloud's array, or ``depth``; None where the file lacks it."""
    layers = {
        "base_color": ("base_color.R", "base_color.G", "base_color.B"),
        "normals": ("normal.X", "normal.Y", "normal.Z"),
    }.get(name, (name,))
    if any(layer not in truth.channels for layer in layers):
        return None
    return truth.stack(*layers) if len(layers) > 1 else truth.channels[name]
