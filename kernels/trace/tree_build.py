"""A binary hierarchy over boxes: Morton order, then nearest neighbours merged round by round.

Source: Meister and Bittner 2018, "Parallel Locally-Ordered Clustering" (PLOC): every cluster looks for the neighbour,
within a window of the Morton order, with which it makes the smallest box; pairs that chose each other merge. Ties are
settled by i xor j, so that equal boxes pair up (0 with 1, 2 with 3 …) instead of forming a chain.

Leaves are numbered by their place in the Morton order, 0 … M - 1; inner nodes follow. Numbers come from scans, not from
atomic counters: the tree is the same on every run.
"""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.launching import launch, launcher

wp.set_module_options({"enable_backward": False})

CELLS = 2097150.0
"""Morton cells along the longest side: 21 bits an axis, all of them set in none, so that no code is `MORTON_LAST`."""

LAST_CELL = wp.constant(CELLS)
MORTON_LAST = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
"""Key of what takes no part: sorts behind everything."""


@wp.func
def spread_bits(x: wp.int64) -> wp.int64:
    """Insert two zeros between the lower 21 bits."""
    b = x & wp.int64(0x1FFFFF)
    b = (b | (b << wp.int64(32))) & wp.int64(0x1F00000000FFFF)
    b = (b | (b << wp.int64(16))) & wp.int64(0x1F0000FF0000FF)
    b = (b | (b << wp.int64(8))) & wp.int64(0x100F00F00F00F00F)
    b = (b | (b << wp.int64(4))) & wp.int64(0x10C30C30C30C30C3)
    b = (b | (b << wp.int64(2))) & wp.int64(0x1249249249249249)
    return b


BOXES_A_THREAD = wp.constant(32)


@wp.kernel
def bound_centers_kernel(
    first: int,
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    takes_part: wp.array[int],
    out_bounds: wp.array[wp.vec3],
):
    """Lower and upper corner of the boxes' centres; minima and maxima do not depend on the order of threads."""
    begin = (first + wp.tid()) * BOXES_A_THREAD
    lower = wp.vec3(LARGEST_FLOAT)
    upper = wp.vec3(-LARGEST_FLOAT)
    for i in range(begin, wp.min(begin + BOXES_A_THREAD, lowers.shape[0])):
        if takes_part[i] == 1:
            center = (lowers[i] + uppers[i]) * 0.5
            lower = wp.min(lower, center)
            upper = wp.max(upper, center)
    wp.atomic_min(out_bounds, 0, lower)
    wp.atomic_max(out_bounds, 1, upper)


@wp.kernel
def order_boxes_kernel(
    first: int,
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    takes_part: wp.array[int],
    bounds: wp.array[wp.vec3],
    out_keys: wp.array[wp.int64],
    out_items: wp.array[int],
):
    """Morton code of each box's centre."""
    i = first + wp.tid()
    extent = wp.max(wp.max(bounds[1] - bounds[0]), 1.0e-30)
    cell = ((lowers[i] + uppers[i]) * 0.5 - bounds[0]) * (LAST_CELL / extent)
    x = spread_bits(wp.int64(wp.clamp(cell[0], 0.0, LAST_CELL)))
    y = spread_bits(wp.int64(wp.clamp(cell[1], 0.0, LAST_CELL)))
    z = spread_bits(wp.int64(wp.clamp(cell[2], 0.0, LAST_CELL)))
    key = x | (y << wp.int64(1)) | (z << wp.int64(2))
    if takes_part[i] == 0:
        key = MORTON_LAST
    out_keys[i] = key
    out_items[i] = i


@wp.struct
class BinaryTree:
    """Nodes of a binary hierarchy; the first ``leaf_count`` are leaves in Morton order."""

    items: wp.array[int]  # Gaussian of each leaf
    leaf_count: int
    lower: wp.array[wp.vec3]
    upper: wp.array[wp.vec3]
    left: wp.array[int]
    right: wp.array[int]
    size: wp.array[int]  # leaves below


@wp.kernel
def start_clusters_kernel(
    first: int,
    items: wp.array[int],
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    out_tree: BinaryTree,
    out_clusters: wp.array[int],
):
    i = first + wp.tid()
    out_tree.lower[i] = lowers[items[i]]
    out_tree.upper[i] = uppers[items[i]]
    out_tree.size[i] = 1
    out_clusters[i] = i


@wp.func
def half_area(lower: wp.vec3, upper: wp.vec3) -> float:
    e = upper - lower
    return e[0] * e[1] + e[1] * e[2] + e[2] * e[0]


@wp.kernel
def choose_neighbors_kernel(
    first: int, clusters: wp.array[int], count: int, reach: int, tree: BinaryTree, out_chosen: wp.array[int]
):
    """The neighbour within ``reach`` places that makes the smallest joint box; reach 0 pairs places 0-1, 2-3 …"""
    i = first + wp.tid()
    chosen = i ^ 1
    if reach > 0:
        lower = tree.lower[clusters[i]]
        upper = tree.upper[clusters[i]]
        smallest = float(LARGEST_FLOAT)
        chosen = int(-1)
        for j in range(wp.max(i - reach, 0), wp.min(i + reach + 1, count)):
            if j != i:
                other = clusters[j]
                area = half_area(wp.min(lower, tree.lower[other]), wp.max(upper, tree.upper[other]))
                if area < smallest or (area == smallest and (i ^ j) < (i ^ chosen)):
                    smallest = area
                    chosen = j
    out_chosen[i] = chosen


@wp.kernel
def mark_merges_kernel(first: int, chosen: wp.array[int], count: int, out_marks: wp.array[wp.vec2i]):
    """(stays, makes a new node) for each place; of a pair the lower place stays."""
    i = first + wp.tid()
    j = chosen[i]
    stays = int(1)
    makes = int(0)
    if j >= 0 and j < count and chosen[j] == i:
        if i < j:
            makes = 1
        else:
            stays = 0
    out_marks[i] = wp.vec2i(stays, makes)


@wp.kernel
def merge_clusters_kernel(
    first: int,
    clusters: wp.array[int],
    chosen: wp.array[int],
    marks: wp.array[wp.vec2i],
    sums: wp.array[wp.vec2i],
    next_node: int,
    out_tree: BinaryTree,
    out_clusters: wp.array[int],
):
    """``sums``: inclusive sums of ``marks``."""
    i = first + wp.tid()
    if marks[i][0] == 1:
        cluster = clusters[i]
        if marks[i][1] == 1:
            other = clusters[chosen[i]]
            node = next_node + sums[i][1] - 1
            out_tree.lower[node] = wp.min(out_tree.lower[cluster], out_tree.lower[other])
            out_tree.upper[node] = wp.max(out_tree.upper[cluster], out_tree.upper[other])
            out_tree.left[node] = cluster
            out_tree.right[node] = other
            out_tree.size[node] = out_tree.size[cluster] + out_tree.size[other]
            cluster = node
        out_clusters[sums[i][0] - 1] = cluster


def launch_order_boxes(lowers, uppers, takes_part, bounds, out_keys, out_items, device):
    """Key every box by its centre; ``bounds`` comes in as (largest, smallest) vector and comes to hold their bounds."""
    count = len(lowers)
    launch(
        bound_centers_kernel,
        -(-count // BOXES_A_THREAD),
        inputs=[lowers, uppers, takes_part],
        outputs=[bounds],
        device=device,
        in_order=True,
    )
    launch(
        order_boxes_kernel,
        count,
        inputs=[lowers, uppers, takes_part, bounds],
        outputs=[out_keys, out_items],
        device=device,
    )


launch_start_clusters = launcher(start_clusters_kernel)
"""Make every box, in Morton order, a cluster of its own."""


def launch_choose_neighbors(clusters, count, reach, tree, out_chosen, out_marks, device):
    """Let every cluster choose its neighbour, and mark the pairs."""
    launch(choose_neighbors_kernel, count, inputs=[clusters, count, reach, tree], outputs=[out_chosen], device=device)
    launch(mark_merges_kernel, count, inputs=[out_chosen, count], outputs=[out_marks], device=device)


launch_merge_clusters = launcher(merge_clusters_kernel)
"""Merge the pairs and close the gaps."""
