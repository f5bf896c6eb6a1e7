"""Environment times clamped cosine without memory at the point: two levels of blocks instead of a cumulative sum.

`product_sampling` keeps 512 cumulative weights for every point; a path has no room for them. Here 4 x 8 groups of 16
blocks are weighed first, then the 16 of the one that was drawn: 48 weights a direction, made when they are wanted.
"""

import warp as wp

from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.light.environment_sampling import EnvironmentSample
from beam_warp.kernels.light.product_sampling import (
    EnvironmentBlocks,
    block_of,
    block_weight,
    direction_in_block,
    remap,
    texel_of,
)

wp.set_module_options({"enable_backward": False})

GROUP_COUNT = wp.constant(32)
GROUP_COLUMNS = wp.constant(8)
SIDE = wp.constant(4)
"""Blocks along a side of a group."""


@wp.struct
class ProductTree:
    """An environment in blocks and groups of blocks; built in beam_warp.light.sampled."""

    blocks: EnvironmentBlocks
    groups: wp.array[wp.vec4]  # (32,) unit vector towards the group's power, and the power
    group_sine: wp.array[float]  # (32,) sine of the largest angle between that and the group's points


@wp.func
def group_weight(tree: ProductTree, group: int, normal: wp.vec3) -> float:
    row = load_row(tree.groups, group)
    bound = wp.dot(normal, wp.vec3(row[0], row[1], row[2])) + tree.group_sine[group]
    return row[3] * wp.max(bound, 0.0)


@wp.func
def block_in_group(group: int, k: int) -> int:
    """Number of block ``k`` of a group, row by row."""
    return (group / GROUP_COLUMNS * SIDE + k / SIDE) * (GROUP_COLUMNS * SIDE) + group % GROUP_COLUMNS * SIDE + k % SIDE


@wp.func
def total_weight(tree: ProductTree, normal: wp.vec3) -> float:
    """Sum of the weights of all groups: densities at a point are divided by it."""
    total = float(0.0)
    for group in range(GROUP_COUNT):
        total += group_weight(tree, group, normal)
    return total


@wp.func
def weight_in_group(tree: ProductTree, group: int, normal: wp.vec3) -> float:
    total = float(0.0)
    for k in range(SIDE * SIDE):
        total += block_weight(tree.blocks, block_in_group(group, k), normal)
    return total


@wp.func
def square_to_product_tree(tree: ProductTree, normal: wp.vec3, total: float, u: float, v: float) -> EnvironmentSample:
    """Map of the unit square to directions; ``total`` is `total_weight`. A density of 0 where nothing can be drawn."""
    sample = EnvironmentSample()
    if not (total > 0.0):
        return sample
    target = u * total
    group = int(-1)
    u_left = float(0.0)
    share = float(0.0)
    begin = float(0.0)
    for k in range(GROUP_COUNT):
        weight = group_weight(tree, k, normal)
        if group < 0 and begin + weight > target:
            group = k
            u_left = remap(target, begin, begin + weight)
            share = weight / total
        begin += weight
    if group < 0:
        return sample  # rounding put the target behind the last group
    inner = weight_in_group(tree, group, normal)
    target = v * inner
    block = int(-1)
    v_left = float(0.0)
    before = float(0.0)
    for k in range(SIDE * SIDE):
        weight = block_weight(tree.blocks, block_in_group(group, k), normal)
        if block < 0 and before + weight > target:
            block = block_in_group(group, k)
            v_left = remap(target, before, before + weight)
            share *= weight / inner
        before += weight
    if block < 0:
        return sample  # all of the group is below the horizon after all
    sample = direction_in_block(tree.blocks, block, u_left, v_left)
    sample.pdf = sample.pdf * share
    return sample


@wp.func
def square_to_product_tree_pdf(tree: ProductTree, normal: wp.vec3, total: float, direction: wp.vec3) -> float:
    """Density of a direction [1/sr]."""
    texel = texel_of(tree.blocks, direction)
    block = block_of(tree.blocks, texel)
    group = block / (GROUP_COLUMNS * SIDE) / SIDE * GROUP_COLUMNS + block % (GROUP_COLUMNS * SIDE) / SIDE
    density = float(0.0)
    inner = weight_in_group(tree, group, normal)
    if total > 0.0 and inner > 0.0 and tree.blocks.block_power[block] > 0.0:
        share = group_weight(tree, group, normal) / total * (block_weight(tree.blocks, block, normal) / inner)
        density = share * (tree.blocks.luminance[texel[0], texel[1]] / tree.blocks.block_power[block])
    return density
