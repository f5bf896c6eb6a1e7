"""The wide tree made of a binary hierarchy, and new boxes for an old tree (refit).

A wide node opens its largest child until it has four. Nodes are made level by level, so that levels are contiguous and
a refit runs from the last to the first.
"""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.trace.gaussian import Gaussians
from beam_warp.kernels.trace.tree_build import BinaryTree, half_area
from beam_warp.kernels.trace.wide_tree import LEAF_ROWS, NODE_ROWS, WideTree

wp.set_module_options({"enable_backward": False})


@wp.struct
class WideLayout:
    """Who is whose child in a wide tree, and the boxes that its nodes are made from."""

    children: wp.array[wp.vec4i]  # (first node, first leaf, inner children, children), inner ones first
    items: wp.array[int]  # Gaussian of each leaf
    lower: wp.array[wp.vec3]  # of each node
    upper: wp.array[wp.vec3]
    level_sizes: wp.array[int]  # nodes of each level; leaves at the end


@wp.func
def nodes_above(level_sizes: wp.array[int], level: int) -> int:
    """Number of the first node of a level."""
    begin = int(0)
    for above in range(level):
        begin += level_sizes[above]
    return begin


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
def open_level_kernel(
    first: int,
    tree: BinaryTree,
    by_area: int,
    level: int,
    queue: wp.array[int],
    out_queue: wp.array[int],
    out_layout: WideLayout,
):
    """Open each queued binary node to up to four children, and queue the inner ones for the next level.

    The largest is opened, by the area of its box, or by its leaves where boxes are not known yet. Numbers come from
    counters and so from the order of threads; what a ray meets, and in which order, does not.
    """
    i = first + wp.tid()
    level_sizes = out_layout.level_sizes
    if i < level_sizes[level]:
        found = wp.vec4i(queue[i], -1, -1, -1)
        count = int(1)
        for _ in range(3):
            largest = float(-1.0)
            which = int(-1)
            for k in range(count):
                node = found[k]
                if node >= tree.leaf_count:
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
        inner = int(0)
        for k in range(count):
            if found[k] >= tree.leaf_count:
                inner += 1
        begin = nodes_above(level_sizes, level)
        next_begin = begin + level_sizes[level]
        first_inner = wp.atomic_add(level_sizes, level + 1, inner)
        first_leaf = wp.atomic_add(level_sizes, level_sizes.shape[0] - 1, count - inner)
        out_layout.children[begin + i] = wp.vec4i(next_begin + first_inner, first_leaf, inner, count)
        for k in range(count):
            if found[k] >= tree.leaf_count:
                out_queue[first_inner] = found[k]
                first_inner += 1
            else:
                out_layout.items[first_leaf] = tree.items[found[k]]
                first_leaf += 1


@wp.kernel
def fill_leaves_kernel(first: int, gaussians: Gaussians, layout: WideLayout, out_tree: WideTree):
    """Write a leaf: the whitening M as the triangular U with U^T U = M^T M, which has six entries instead of nine.

    Responses depend on |M x| alone, so that any such factor serves. Cholesky's, in double precision: scales within a
    Gaussian differ by up to 1e4, their squares by 1e8.
    """
    leaf = first + wp.tid()
    item = layout.items[leaf]
    center = gaussians.center_opacity[item]
    a = gaussians.whitening_0[item]
    b = gaussians.whitening_1[item]
    c = gaussians.whitening_2[item]
    gram = wp.mat33d()
    for i in range(3):
        for j in range(3):
            gram[i, j] = (
                wp.float64(a[i]) * wp.float64(a[j])
                + wp.float64(b[i]) * wp.float64(b[j])
                + wp.float64(c[i]) * wp.float64(c[j])
            )
    xx = wp.sqrt(gram[0, 0])
    xy = gram[0, 1] / xx
    xz = gram[0, 2] / xx
    yy = wp.sqrt(gram[1, 1] - xy * xy)
    yz = (gram[1, 2] - xy * xz) / yy
    zz = wp.sqrt(gram[2, 2] - xz * xz - yz * yz)
    row = leaf * LEAF_ROWS
    out_tree.leaves[row] = center
    out_tree.leaves[row + 1] = wp.vec4(float(xx), float(xy), float(xz), float(yy))
    out_tree.leaves[row + 2] = wp.vec4(float(yz), float(zz), a[3], wp.cast(item, float))


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
    level: int,
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    out_layout: WideLayout,
    out_tree: WideTree,
):
    """Bound a node of a level and write it, its children's boxes in steps from its corner, rounded outwards."""
    i = first + wp.tid()
    if i >= out_layout.level_sizes[level]:
        return
    node = nodes_above(out_layout.level_sizes, level) + i
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


launch_open_level = launcher(open_level_kernel, in_order=True)
"""Open a level of at most ``bound`` nodes."""


launch_fill_leaves = launcher(fill_leaves_kernel)
"""Copy the Gaussians into their leaves."""


launch_bound_nodes = launcher(bound_nodes_kernel)
"""Write a level of at most ``bound`` nodes; the level below must be done."""
