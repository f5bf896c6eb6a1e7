"""Directions in proportion to environment times clamped cosine: the density that suits both skies and suns.

The environment's texels are grouped into 16 x 32 blocks. At a surface point a block is drawn by its power times an
upper bound of the cosine over it, then a texel in it by its power, then a direction uniformly in the texel's solid
angle. Every step inverts a cumulative sum with what the step before left of the sample, so stratification survives.
Product of environment and cosine: Clarberg et al. 2005; hierarchy of cumulative sums: Pharr et al. 2023, §2.4 and A.5.
"""

import warp as wp

from beam_warp.kernels.common.constants import PI
from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.light.environment_sampling import EnvironmentSample
from beam_warp.kernels.light.latlong import direction_to_latlong

wp.set_module_options({"enable_backward": False})

BLOCK_ROWS = wp.constant(16)
BLOCK_COLUMNS = wp.constant(32)
BLOCK_COUNT = wp.constant(512)


@wp.struct
class EnvironmentBlocks:
    """An environment prepared for product sampling; built in beam_warp.light.sampled."""

    radiance: wp.array2d[wp.vec3]  # (H, W)
    luminance: wp.array2d[float]  # (H, W), what texels are drawn by
    block_power: wp.array[float]  # (512,) sum of luminance times solid angle
    block_direction: wp.array[wp.vec3]  # (512,) unit, towards the power's middle
    block_sine: wp.array[float]  # (512,) sine of the largest angle between that and the block's points
    row_cdf: wp.array2d[float]  # (512, H / 16) cumulative power of a block's texel rows, ends at 1
    column_cdf: wp.array2d[float]  # (H, W) cumulative power along each block's part of a texel row, ends at 1


@wp.func
def block_weight(blocks: EnvironmentBlocks, block: int, normal: wp.vec3) -> float:
    """Power times an upper bound of the clamped cosine: cos(a - r) <= cos a + sin r, and 0 only below the horizon."""
    bound = wp.dot(normal, blocks.block_direction[block]) + blocks.block_sine[block]
    return blocks.block_power[block] * wp.max(bound, 0.0)


@wp.func
def first_above(cumulative: wp.array2d[float], row: int, begin: int, count: int, value: float) -> int:
    """Number in [0, count) of the first entry of ``cumulative[row, begin:]`` above ``value``; binary search."""
    low = int(0)
    high = count - 1
    while low < high:
        middle = (low + high) / 2
        if cumulative[row, begin + middle] > value:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def remap(value: float, low: float, high: float) -> float:
    """What ``value`` in [low, high) leaves as a fresh uniform number in [0, 1)."""
    return wp.clamp((value - low) / wp.max(high - low, 1.0e-30), 0.0, 0.9999999)


@wp.func
def entry_before(cumulative: wp.array2d[float], row: int, begin: int, index: int) -> float:
    result = float(0.0)
    if index > 0:
        result = cumulative[row, begin + index - 1]
    return result


@wp.kernel
def accumulate_block_weights_kernel(
    first: int, blocks: EnvironmentBlocks, normals: wp.array[wp.vec3], out_cumulative: wp.array2d[float]
):
    """Cumulative block weights of one point in row-major block order, not normalised."""
    i = first + wp.tid()
    normal = normals[i]
    total = float(0.0)
    for block in range(BLOCK_COUNT):
        total += block_weight(blocks, block, normal)
        out_cumulative[i, block] = total


@wp.func
def direction_in_block(blocks: EnvironmentBlocks, block: int, u: float, v: float) -> EnvironmentSample:
    """A direction drawn in a block by its texels' power, and its density within the block."""
    sample = EnvironmentSample()
    height = blocks.radiance.shape[0]
    width = blocks.radiance.shape[1]
    rows = height / BLOCK_ROWS
    columns = width / BLOCK_COLUMNS
    row = first_above(blocks.row_cdf, block, 0, rows, u)
    u_texel = remap(u, entry_before(blocks.row_cdf, block, 0, row), blocks.row_cdf[block, row])
    y = block / BLOCK_COLUMNS * rows + row
    begin = block % BLOCK_COLUMNS * columns
    column = first_above(blocks.column_cdf, y, begin, columns, v)
    v_texel = remap(v, entry_before(blocks.column_cdf, y, begin, column), blocks.column_cdf[y, begin + column])
    x = begin + column
    luminance = blocks.luminance[y, x]
    if not (luminance > 0.0):
        return sample

    upper = wp.cos(float(y) / float(height) * PI)
    lower = wp.cos(float(y + 1) / float(height) * PI)
    z = upper + (lower - upper) * u_texel
    radius = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    phi = (0.5 - (float(x) + v_texel) / float(width)) * 2.0 * PI
    sample.direction = wp.vec3(radius * wp.cos(phi), radius * wp.sin(phi), z)
    sample.radiance = blocks.radiance[y, x]
    sample.pdf = luminance / blocks.block_power[block]
    return sample


@wp.func
def square_to_product(
    blocks: EnvironmentBlocks, cumulative: wp.array2d[float], point: int, u: float, v: float
) -> EnvironmentSample:
    """Map of the unit square to directions; ``cumulative[point]`` holds the point's cumulative block weights."""
    sample = EnvironmentSample()
    total = cumulative[point, BLOCK_COUNT - 1]
    if not (total > 0.0):
        return sample
    # Block row: the cumulative weight at the end of each row of blocks; then the block within the row.
    target = u * total
    low = int(0)
    high = BLOCK_ROWS - 1
    while low < high:
        middle = (low + high) / 2
        if cumulative[point, middle * BLOCK_COLUMNS + BLOCK_COLUMNS - 1] > target:
            high = middle
        else:
            low = middle + 1
    block_row = low
    row_begin = entry_before(cumulative, point, 0, block_row * BLOCK_COLUMNS)
    row_end = cumulative[point, block_row * BLOCK_COLUMNS + BLOCK_COLUMNS - 1]
    u_row = remap(target, row_begin, row_end)
    target = row_begin + v * (row_end - row_begin)
    block_column = first_above(cumulative, point, block_row * BLOCK_COLUMNS, BLOCK_COLUMNS, target)
    block = block_row * BLOCK_COLUMNS + block_column
    block_begin = entry_before(cumulative, point, 0, block)
    block_end = cumulative[point, block]
    v_column = remap(target, block_begin, block_end)
    if not (block_end > block_begin):
        return sample  # rounding put the target on an empty block

    sample = direction_in_block(blocks, block, u_row, v_column)
    # pdf = P(block) luminance / block_power: solid angles cancel.
    sample.pdf = (block_end - block_begin) / total * sample.pdf
    return sample


@wp.func
def texel_of(blocks: EnvironmentBlocks, direction: wp.vec3) -> wp.vec2i:
    """Row and column of the texel that holds a direction."""
    uv = direction_to_latlong(direction)
    height = blocks.radiance.shape[0]
    width = blocks.radiance.shape[1]
    return wp.vec2i(
        wp.clamp(int(uv[1] * float(height)), 0, height - 1), wp.clamp(int(uv[0] * float(width)), 0, width - 1)
    )


@wp.func
def block_of(blocks: EnvironmentBlocks, texel: wp.vec2i) -> int:
    rows = blocks.radiance.shape[0] / BLOCK_ROWS
    columns = blocks.radiance.shape[1] / BLOCK_COLUMNS
    return (texel[0] / rows) * BLOCK_COLUMNS + texel[1] / columns


launch_accumulate_block_weights = launcher(accumulate_block_weights_kernel, block_dim=128)
"""Prepare product sampling at each point."""
