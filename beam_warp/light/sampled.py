"""Tables of an environment: for drawing directions by it, or by it times cosine, and for its irradiance."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.device.arrays import upload
from beam_warp.image.color import LUMINANCE
from beam_warp.kernels.light.environment_sampling import EnvironmentDistribution
from beam_warp.kernels.light.product_sampling import EnvironmentBlocks
from beam_warp.kernels.light.product_tree import ProductTree
from beam_warp.kernels.trace.incident_light import LightMoments
from beam_warp.world.environment import EnvironmentMap

BLOCK_ROWS, BLOCK_COLUMNS = 16, 32
GROUP_ROWS, GROUP_COLUMNS = 4, 8
LARGEST_HEIGHT = 512
"""Taller maps are reduced to this height, energy kept: a texel is then 0.35 degrees, two thirds of the sun."""

MOMENT_ROWS = 32
"""Rows of the grid behind `light_moments`. Measured against full sums under even light and skies with suns of up to 2e4
times the mean: 2e-4 RMS of the irradiance, without bias; bilinear lookup of a 64-row irradiance map errs by 8e-3."""

FINE_ROWS = 512
"""Least rows that moments are summed over, so that cells of any map have nearly the same size."""


def suited_height(height: int) -> int:
    """Return the largest number of texel rows, at most ``LARGEST_HEIGHT``, that blocks divide evenly; 32 at least."""
    return max(2 * BLOCK_ROWS, min(height, LARGEST_HEIGHT) // BLOCK_ROWS * BLOCK_ROWS)


def fitted(environment: EnvironmentMap) -> EnvironmentMap:
    """Return the environment on a grid that blocks divide, energy kept; itself if they do already."""
    height = suited_height(environment.height)
    return environment if height == environment.height else environment.resized(height, 2 * height)


def environment_blocks(environment: EnvironmentMap, device: Any) -> EnvironmentBlocks:
    """Group an environment's texels into blocks, and accumulate the powers that directions are drawn by.

    Args:
        environment: The light, on a grid that blocks divide; see `fitted`.
        device: Warp device.
    """
    height, width = environment.height, environment.width
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


def product_tree(blocks: EnvironmentBlocks, device: Any) -> ProductTree:
    """Group the blocks of an environment, for points that cannot keep a weight for each of them."""
    tree = ProductTree()
    tree.blocks = blocks
    side = BLOCK_ROWS // GROUP_ROWS
    power = tree.blocks.block_power.numpy().astype(np.float64)
    middles = tree.blocks.block_direction.numpy().astype(np.float64)
    angles = np.arcsin(np.clip(tree.blocks.block_sine.numpy().astype(np.float64), 0.0, 1.0))

    def grouped(rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """(512, ...) -> (32, 16, ...)."""
        split = rows.reshape(GROUP_ROWS, side, GROUP_COLUMNS, side, *rows.shape[1:])
        return np.moveaxis(split, 2, 1).reshape(GROUP_ROWS * GROUP_COLUMNS, side * side, *rows.shape[1:])

    powers, members, radii = grouped(power), grouped(middles), grouped(angles)
    total = powers.sum(axis=1)
    weight = np.where(total[:, None] > 0.0, powers, 1.0)
    middle = (weight[..., None] * members).sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    # A block reaches at most its own angle beyond its middle.
    reach = (np.arccos(np.clip(np.einsum("gmk,gk->gm", members, middle), -1.0, 1.0)) + radii).max(axis=1)
    tree.groups = upload(np.column_stack([middle, total]).astype(np.float32), wp.vec4, device)
    tree.group_sine = upload(np.sin(np.minimum(reach, np.pi / 2.0)).astype(np.float32), float, device)
    return tree


def environment_distribution(environment: EnvironmentMap, device: Any) -> EnvironmentDistribution:
    """Accumulate what drawing directions by luminance times solid angle needs; a black map is drawn uniformly."""
    angles = environment.solid_angles()
    luminance = environment.radiance.astype(np.float64) @ LUMINANCE
    power = luminance * angles
    if not power.sum() > 0.0:
        luminance, power = np.ones_like(luminance), angles
    rows = power.sum(axis=1)
    # A row without light is never drawn; its columns are given uniform edges so that they rise all the same.
    columns = np.where(rows[:, None] > 0.0, power, angles)
    distribution = EnvironmentDistribution()
    distribution.radiance = upload(environment.radiance, wp.vec3, device)
    distribution.row_edges = upload(_edges(rows[None])[0], float, device)
    distribution.column_edges = upload(_edges(columns), float, device)
    distribution.density = upload((luminance / power.sum()).astype(np.float32), float, device)
    return distribution


def _edges(weights: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return cumulative shares of each row from exactly 0 to exactly 1."""
    edges = np.zeros((weights.shape[0], weights.shape[1] + 1))
    np.cumsum(weights, axis=1, out=edges[:, 1:])
    return (edges / edges[:, -1:]).astype(np.float32)


def light_moments(environment: EnvironmentMap, device: Any) -> LightMoments:
    """Sum radiance times the first moment of its texel, in closed form, over the cells of a grid.

    E(n) = sum over cells of max(0, n . moment) is then the unshadowed irradiance of a normal, exact for every cell on
    one side of the normal's horizon; a sun keeps its place whatever its cell. For cells that the horizon cuts, the
    light's height n . w is taken as uniform over the moment's, give or take a half width of equal variance: directions
    of mean length R have a variance of about 1 - R along each axis.
    """
    repeat = -(-FINE_ROWS // environment.height)
    radiance = environment.radiance.astype(np.float64).repeat(repeat, axis=0).repeat(repeat, axis=1)
    height, width = radiance.shape[:2]
    theta = np.linspace(0.0, np.pi, height + 1)
    phi = np.pi - (np.arange(width) + 0.5) * (2.0 * np.pi / width)
    # integrals of (cos phi sin theta, cos theta, 1) sin theta over a texel whose middle is at phi = 0, for each row
    sideways = np.diff(theta / 2.0 - np.sin(2.0 * theta) / 4.0) * (2.0 * np.sin(np.pi / width))
    upward = np.diff(np.sin(theta) ** 2 / 2.0) * (2.0 * np.pi / width)
    angle = -np.diff(np.cos(theta)) * (2.0 * np.pi / width)
    terms = (
        sideways[:, None] * np.cos(phi),
        sideways[:, None] * np.sin(phi),
        np.broadcast_to(upward[:, None], (height, width)),
        np.broadcast_to(angle[:, None], (height, width)),
    )
    rows = np.arange(MOMENT_ROWS) * height // MOMENT_ROWS
    columns = np.arange(2 * MOMENT_ROWS) * width // (2 * MOMENT_ROWS)
    moments = LightMoments()
    for channel, name in enumerate(("red", "green", "blue")):
        sums = np.stack(
            [
                np.add.reduceat(np.add.reduceat(term * radiance[..., channel], rows, axis=0), columns, axis=1).ravel()
                for term in terms
            ],
            axis=-1,
        )
        length = np.linalg.norm(sums[:, :3], axis=1)
        spread = np.maximum(1.0 - length / np.maximum(sums[:, 3], 1e-300), 0.0)
        sums[:, 3] = length * np.sqrt(3.0 * spread)
        setattr(moments, name, upload(sums.astype(np.float32), wp.vec4, device))
    return moments
