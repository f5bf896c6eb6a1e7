"""Inverses of maps of the unit square to directions, and a density, which only tests ask for."""

import warp as wp

from beam_warp.kernels.common.constants import PI
from beam_warp.kernels.light.environment_sampling import EnvironmentDistribution
from beam_warp.kernels.light.ggx_sampling import stretched
from beam_warp.kernels.light.latlong import direction_to_latlong
from beam_warp.kernels.light.product_sampling import (
    BLOCK_COLUMNS,
    BLOCK_COUNT,
    BLOCK_ROWS,
    EnvironmentBlocks,
    block_of,
    entry_before,
    texel_of,
)


@wp.func
def cosine_hemisphere_to_square(direction: wp.vec3) -> wp.vec2:
    """The point of the unit square that `square_to_cosine_hemisphere` takes to ``direction``."""
    radius = wp.sqrt(direction[0] * direction[0] + direction[1] * direction[1])
    phi = wp.atan2(direction[1], direction[0])
    if phi < -PI / 4.0:
        phi += 2.0 * PI
    a = 0.0
    b = 0.0
    if phi < PI / 4.0:
        a = radius
        b = phi * a * 4.0 / PI
    elif phi < 3.0 * PI / 4.0:
        b = radius
        a = -(phi - PI / 2.0) * b * 4.0 / PI
    elif phi < 5.0 * PI / 4.0:
        a = -radius
        b = (phi - PI) * a * 4.0 / PI
    else:
        b = -radius
        a = -(phi - 3.0 * PI / 2.0) * b * 4.0 / PI
    return wp.vec2((a + 1.0) * 0.5, (b + 1.0) * 0.5)


@wp.func
def environment_to_square(distribution: EnvironmentDistribution, direction: wp.vec3) -> wp.vec2:
    """The point of the unit square that `square_to_environment` takes to ``direction``."""
    uv = direction_to_latlong(direction)
    height = distribution.density.shape[0]
    width = distribution.density.shape[1]
    row = wp.clamp(int(uv[1] * float(height)), 0, height - 1)
    column = wp.clamp(int(uv[0] * float(width)), 0, width - 1)
    upper = wp.cos(PI * float(row) / float(height))
    lower = wp.cos(PI * float(row + 1) / float(height))
    down = wp.clamp((direction[2] - upper) / (lower - upper), 0.0, 1.0)
    across = wp.clamp(uv[0] * float(width) - float(column), 0.0, 1.0)
    top = distribution.row_edges[row]
    left = distribution.column_edges[row, column]
    return wp.vec2(
        left + (distribution.column_edges[row, column + 1] - left) * across,
        top + (distribution.row_edges[row + 1] - top) * down,
    )


@wp.func
def visible_reflection_to_square(view: wp.vec3, light: wp.vec3, alpha: float) -> wp.vec2:
    """The point of the unit square that `square_to_visible_reflection` takes to ``light``."""
    axis = stretched(view, alpha)
    half = wp.normalize(view + light)
    m = wp.normalize(wp.vec3(half[0] / alpha, half[1] / alpha, half[2]))
    c = 2.0 * wp.dot(axis, m) * m - axis
    turn = wp.atan2(c[1], c[0]) / (2.0 * PI)
    if turn < 0.0:
        turn += 1.0
    return wp.vec2(turn, 1.0 - (c[2] + axis[2]) / (1.0 + axis[2]))


@wp.func
def square_to_product_pdf(
    blocks: EnvironmentBlocks, cumulative: wp.array2d[float], point: int, direction: wp.vec3
) -> float:
    """Density of a direction [1/sr]."""
    texel = texel_of(blocks, direction)
    block = block_of(blocks, texel)
    total = cumulative[point, BLOCK_COUNT - 1]
    density = 0.0
    if total > 0.0 and blocks.block_power[block] > 0.0:
        share = (cumulative[point, block] - entry_before(cumulative, point, 0, block)) / total
        density = share * (blocks.luminance[texel[0], texel[1]] / blocks.block_power[block])
    return density


@wp.func
def product_to_square(
    blocks: EnvironmentBlocks, cumulative: wp.array2d[float], point: int, direction: wp.vec3
) -> wp.vec2:
    """The point of the unit square that `square_to_product` takes to ``direction``, if its density there is not 0."""
    texel = texel_of(blocks, direction)
    block = block_of(blocks, texel)
    row = texel[0]
    height = blocks.radiance.shape[0]
    width = blocks.radiance.shape[1]
    rows = height / BLOCK_ROWS
    columns = width / BLOCK_COLUMNS

    # Within the texel, then within the block, then among the blocks: the steps of the map from its end.
    upper = wp.cos(float(row) / float(height) * PI)
    lower = wp.cos(float(row + 1) / float(height) * PI)
    u = wp.clamp((direction[2] - upper) / (lower - upper), 0.0, 1.0)
    v = wp.clamp(direction_to_latlong(direction)[0] * float(width) - float(texel[1]), 0.0, 1.0)
    u_begin = entry_before(blocks.row_cdf, block, 0, row % rows)
    u = u_begin + u * (blocks.row_cdf[block, row % rows] - u_begin)
    v_begin = entry_before(blocks.column_cdf, row, texel[1] - texel[1] % columns, texel[1] % columns)
    v = v_begin + v * (blocks.column_cdf[row, texel[1]] - v_begin)

    block_row = block / BLOCK_COLUMNS
    row_begin = entry_before(cumulative, point, 0, block_row * BLOCK_COLUMNS)
    row_end = cumulative[point, block_row * BLOCK_COLUMNS + BLOCK_COLUMNS - 1]
    block_begin = entry_before(cumulative, point, 0, block)
    u = (row_begin + u * (row_end - row_begin)) / cumulative[point, BLOCK_COUNT - 1]
    v = (block_begin + v * (cumulative[point, block] - block_begin) - row_begin) / (row_end - row_begin)
    return wp.vec2(u, v)
