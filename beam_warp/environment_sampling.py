"""An environment prepared on a device for drawing directions by environment times cosine."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from beam_warp.devices import upload
from beam_warp.environments import EnvironmentMap
from beam_warp.kernels.product_sampling import EnvironmentBlocks

BLOCK_ROWS, BLOCK_COLUMNS = 16, 32
LARGEST_HEIGHT = 512
"""Taller maps are reduced to this height, energy kept: a texel is then 0.35 degrees, two thirds of the sun."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec.709 luminance weights."""


def suited_height(height: int) -> int:
    """Return the largest number of texel rows, at most ``LARGEST_HEIGHT``, that blocks divide evenly; 32 at least."""
    return max(2 * BLOCK_ROWS, min(height, LARGEST_HEIGHT) // BLOCK_ROWS * BLOCK_ROWS)


def environment_blocks(environment: EnvironmentMap, device: Any) -> EnvironmentBlocks:
    """Group an environment's texels into blocks and accumulate what drawing needs.

    Args:
        environment: Resampled, energy kept, if blocks do not divide its size.
        device: Warp device.
    """
    height = suited_height(environment.radiance.shape[0])
    if height != environment.radiance.shape[0]:
        environment = environment.resized(height, 2 * height)
    width = 2 * height
    rows, columns = height // BLOCK_ROWS, width // BLOCK_COLUMNS
    radiance = environment.radiance.astype(np.float64)
    luminance = radiance @ LUMINANCE
    power = luminance * environment.solid_angles().reshape(height, -1)

    def by_block(texels: np.ndarray) -> np.ndarray:
        """(H, W, …) → (512, rows, columns, …)."""
        split = texels.reshape(BLOCK_ROWS, rows, BLOCK_COLUMNS, columns, *texels.shape[2:])
        return np.moveaxis(split, 2, 1).reshape(BLOCK_ROWS * BLOCK_COLUMNS, rows, columns, *texels.shape[2:])

    directions = by_block(environment.directions().astype(np.float64))
    blocked = by_block(power)
    block_power = blocked.sum((1, 2))
    # Towards the power's middle; a black block points at its geometric middle.
    weight = np.where(block_power[:, None, None] > 0.0, blocked, 1.0)
    middle = (weight[..., None] * directions).sum((1, 2))
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    # Texel centres are not the block's edge: half a texel's diagonal is added to the angle.
    angle = np.arccos(np.clip(np.einsum("brck,bk->brc", directions, middle), -1.0, 1.0)).max((1, 2))
    angle = np.minimum(angle + np.pi / height * np.sqrt(0.5), np.pi / 2.0)

    row_power = blocked.sum(2)
    row_cdf = np.cumsum(row_power, axis=1) / np.maximum(row_power.sum(1, keepdims=True), 1e-300)
    column_cdf = np.cumsum(blocked, axis=2) / np.maximum(row_power[..., None], 1e-300)
    column_cdf = np.moveaxis(column_cdf.reshape(BLOCK_ROWS, BLOCK_COLUMNS, rows, columns), 1, 2).reshape(height, width)

    blocks = EnvironmentBlocks()
    blocks.radiance = upload(radiance.astype(np.float32), wp.vec3, device)
    blocks.luminance = upload(luminance.astype(np.float32), float, device)
    blocks.block_power = upload(block_power.astype(np.float32), float, device)
    blocks.block_direction = upload(middle.astype(np.float32), wp.vec3, device)
    blocks.block_sine = upload(np.sin(angle).astype(np.float32), float, device)
    blocks.row_cdf = upload(row_cdf.astype(np.float32), float, device)
    blocks.column_cdf = upload(column_cdf.astype(np.float32), float, device)
    return blocks
