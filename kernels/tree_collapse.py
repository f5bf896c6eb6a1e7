"""From a binary hierarchy to the wide tree, and new boxes for an old tree (refit).

A wide node opens its largest child until it has four. Nodes are made level by level, so that levels are contiguous and
a refit runs from the last to the first.
"""

import warp as wp

from beam_warp.kernels.constants import LARGEST_FLOAT
from beam_warp.kernels.gaussian import Gaussians
from beam_warp.kernels.launching import launch
from beam_warp.kernels.tree_build import BinaryTree, half_area
from beam_warp.kernels.wide_tree import LEAF_ROWS, NODE_ROWS, WideTree

wp.set_module_options({"enable_backward": False})


@wp.struct
class WideLayout:
    """Who is whose child in a wide tree, and the boxes that its nodes are made from."""

    children: wp.array[wp.vec4i]  # (first node, first leaf, inner children, children), inner ones first
    items: wp.array[int]  # Gaussian of each leaf
    lower: wp.array[wp.vec3]  # of each node
    upper: wp.array[wp.vec3]


@wp.func
def widest_axis(lower: wp.vec3, upper: wp.vec3) -> int:
    e = upper - lower
    axis = int(0)
    if e[1] > e[0]:
        axis = 1
    if e[2] > e[axis]:
        axis = 2
    return axis


@wp.kernel
def open_children_kernel(
    first: int,
    tree: BinaryTree,
    leaf_count: int,
    by_area: int,
    queue: wp.array[int],
    out_children: wp.array[wp.vec4i],
    out_counts: wp.array[wp.vec2i],
):
    """Up to four descendants of a binary node, inner ones first; and how many are (inner, leaves).

    The largest is opened, by the area of its box, or by its leaves where boxes are not known yet.
    """
    i = first + wp.tid()
    found = wp.vec4i(queue[i], -1, -1, -1)
    count = int(1)
    for _ in range(3):
        largest = float(-1.0)
        which = int(-1)
        for k in range(count):
            node = found[k]
            if node >= leaf_count:
                size = float(tree.size[node])
                if by_area == 1:
                    size = half_area(tree.lower[node], tree.upper[node])
                if size > largest:
                    largest = size
                    which = k
        if which >= 0:
            node = found[which]
            found[which] = tree.left[node]
            found[count] = tree.right[node]
            count += 1
    if by_area == 1:  # in ascending order along the widest axis; codes are in order anyway
        axis = widest_axis(tree.lower[queue[i]], tree.upper[queue[i]])
        for last in range(count - 1):
            for k in range(count - 1 - last):
                a = found[k]
                b = found[k + 1]
                if tree.lower[a][axis] + tree.upper[a][axis] > tree.lower[b][axis] + tree.upper[b][axis]:
                    found[k] = b
                    found[k + 1] = a
    ordered = wp.vec4i(-1, -1, -1, -1)
    inner = int(0)
    for k in range(count):
        if found[k] >= leaf_count:
            ordered[inner] = found[k]
            inner += 1
    place = inner
    for k in range(count):
        if found[k] < leaf_count:
            ordered[place] = found[k]
            place += 1
    out_children[i] = ordered
    out_counts[i] = wp.vec2i(inner, count - inner)


@wp.kernel
def place_children_kernel(
    first: int,
    opened: wp.array[wp.vec4i],
    counts: wp.array[wp.vec2i],
    sums: wp.array[wp.vec2i],
    items: wp.array[int],
    level_begin: int,
    next_level_begin: int,
    leaf_begin: int,
    out_queue: wp.array[int],
    out_layout: WideLayout,
):
    """``sums``: inclusive sums of ``counts``; ``items``: Gaussian of each binary leaf."""
    i = first + wp.tid()
    inner = counts[i][0]
    leaves = counts[i][1]
    first_inner = sums[i][0] - inner
    first_leaf = leaf_begin + sums[i][1] - leaves
    out_layout.children[level_begin + i] = wp.vec4i(next_level_begin + first_inner, first_leaf, inner, inner + leaves)
    for k in range(inner):
        out_queue[first_inner + k] = opened[i][k]
    for k in range(leaves):
        out_layout.items[first_leaf + k] = items[opened[i][inner + k]]


@wp.kernel
def fill_leaves_kernel(first: int, gaussians: Gaussians, layout: WideLayout, out_tree: WideTree):
    leaf = first + wp.tid()
    item = layout.items[leaf]
    row = leaf * LEAF_ROWS
    m_1 = gaussians.whitening_1[item]
    out_tree.leaves[row] = gaussians.center_opacity[item]
    out_tree.leaves[row + 1] = gaussians.whitening_0[item]
    out_tree.leaves[row + 2] = wp.vec4(m_1[0], m_1[1], m_1[2], wp.cast(item, float))
    out_tree.leaves[row + 3] = gaussians.whitening_2[item]


@wp.func
def exponent_of(extent: float) -> int:
    """Biased exponent of the smallest power of two of which 254 steps cover ``extent``."""
    bits = wp.cast(extent / 254.0, int)
    exponent = bits >> 23
    if (bits & 0x7FFFFF) != 0:
        exponent += 1
    return wp.clamp(exponent, 1, 254)


@wp.kernel
def bound_nodes_kernel(
    first: int,
    level_begin: int,
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    out_layout: WideLayout,
    out_tree: WideTree,
):
    """Bound a node and write it, its children's boxes in steps from its corner, rounded outwards."""
    node = level_begin + first + wp.tid()
    children = out_layout.children[node]
    lower = wp.vec3(LARGEST_FLOAT)
    upper = wp.vec3(-LARGEST_FLOAT)
    for k in range(children[3]):
        if k < children[2]:
            lower = wp.min(lower, out_layout.lower[children[0] + k])
            upper = wp.max(upper, out_layout.upper[children[0] + k])
        else:
            item = out_layout.items[children[1] + k - children[2]]
            lower = wp.min(lower, lowers[item])
            upper = wp.max(upper, uppers[item])
    if children[3] == 0:
        lower = wp.vec3()
        upper = wp.vec3()
    out_layout.lower[node] = lower
    out_layout.upper[node] = upper
    exponents = wp.vec3i()
    step = wp.vec3()
    for axis in range(3):
        exponents[axis] = exponent_of(upper[axis] - lower[axis])
        step[axis] = wp.cast(exponents[axis] << 23, float)
    low_words = wp.vec3i()
    high_words = wp.vec3i()
    for k in range(children[3]):
        child_lower = wp.vec3()
        child_upper = wp.vec3()
        if k < children[2]:
            child_lower = out_layout.lower[children[0] + k]
            child_upper = out_layout.upper[children[0] + k]
        else:
            item = out_layout.items[children[1] + k - children[2]]
            child_lower = lowers[item]
            child_upper = uppers[item]
        for axis in range(3):
            # A thousandth of a step more than needed: the quotients are rounded themselves.
            low = wp.floor((child_lower[axis] - lower[axis]) / step[axis] - 0.001)
            high = wp.ceil((child_upper[axis] - lower[axis]) / step[axis] + 0.001)
            low_words[axis] = low_words[axis] | (int(wp.clamp(low, 0.0, 255.0)) << (8 * k))
            high_words[axis] = high_words[axis] | (int(wp.clamp(high, 0.0, 255.0)) << (8 * k))
    axis = widest_axis(lower, upper)
    counts = (children[2] << 24) | ((axis & 1) << 27) | (children[3] << 28) | ((axis >> 1) << 31)
    row = node * NODE_ROWS
    out_tree.nodes[row] = wp.vec4i(
        wp.cast(lower[0], int),
        wp.cast(lower[1], int),
        wp.cast(lower[2], int),
        exponents[0] | (exponents[1] << 8) | (exponents[2] << 16) | counts,
    )
    out_tree.nodes[row + 1] = wp.vec4i(children[0], children[1], low_words[0], low_words[1])
    out_tree.nodes[row + 2] = wp.vec4i(low_words[2], high_words[0], high_words[1], high_words[2])


def launch_open_children(tree, leaf_count, by_area, queue, count, out_children, out_counts, device):
    """Open every queued binary node to up to four children."""
    launch(
        open_children_kernel,
        count,
        inputs=[tree, leaf_count, int(by_area), queue],
        outputs=[out_children, out_counts],
        device=device,
    )


def launch_place_children(opened, counts, sums, count, items, begins, out_queue, out_layout, device):
    """Number the children; ``begins`` is where this level, the next one and its leaves begin."""
    launch(
        place_children_kernel,
        count,
        inputs=[opened, counts, sums, items, *begins],
        outputs=[out_queue, out_layout],
        device=device,
    )


def launch_fill_leaves(gaussians, layout, count, out_tree, device):
    """Copy the Gaussians into their leaves."""
    launch(fill_leaves_kernel, count, inputs=[gaussians, layout], outputs=[out_tree], device=device)


def launch_bound_nodes(level_begin, count, lowers, uppers, out_layout, out_tree, device):
    """Write a level's nodes; the level below must be done."""
    launch(
        bound_nodes_kernel,
        count,
        inputs=[level_begin, lowers, uppers],
        outputs=[out_layout, out_tree],
        device=device,
    )
