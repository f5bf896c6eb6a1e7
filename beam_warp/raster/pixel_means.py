"""What pixels see of a cloud, each the mean of a square of samples, as photographs and truth are means over a pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.image.metrics import block_means
from beam_warp.raster.channels import UNIT_CHANNELS
from beam_warp.raster.gbuffer import GBuffer


@dataclass(frozen=True, eq=False)
class PixelMeans:
    """Means over the samples of each pixel.

    Attributes:
        alpha: Coverage in [0, 1], ``(H, W)`` float32.
        depth: Mean distance along the optical axis [m], ``(H, W)`` float32.
        channels: Images by name, weighted by coverage and *not* multiplied by alpha, ``(H, W)`` or ``(H, W, C)``
            float32, as in `beam_warp.raster.gbuffer.GBuffer`.

    Depth and channels are 0 where alpha is 0.
    """

    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    channels: Mapping[str, NDArray[np.float32]]

    @classmethod
    def of(cls, samples: GBuffer, side: int) -> PixelMeans:
        """Average what a camera saw that had ``side`` x ``side`` samples for each pixel."""
        alpha = samples.alpha
        channels = {
            name: mean_where_covered(values, alpha, side, unit=name in UNIT_CHANNELS)
            for name, values in samples.channels.items()
        }
        return cls(
            block_means(alpha, side).astype(np.float32), mean_where_covered(samples.depth, alpha, side), channels
        )


def mean_where_covered(
    values: NDArray[np.float32], alpha: NDArray[np.float32], side: int, *, unit: bool = False
) -> NDArray[np.float32]:
    """Return the means over the samples of each pixel, weighted by coverage.

    Args:
        values: One for each sample, ``(H side, W side)`` or ``(H side, W side, C)``.
        alpha: Coverage of each sample, ``(H side, W side)``.
        side: Side of the square of samples of a pixel.
        unit: Scale means to unit length.

    Returns:
        ``(H, W)`` or ``(H, W, C)``; 0 where nothing is covered.
    """
    if side == 1:
        return values
    weights = alpha[(...,) + (None,) * (values.ndim - 2)]
    sums = block_means(values * weights, side)
    weight = np.linalg.norm(sums, axis=-1, keepdims=True) if unit else block_means(weights, side)
    return np.divide(sums, weight, out=np.zeros_like(sums), where=weight > 0.0).astype(np.float32)
