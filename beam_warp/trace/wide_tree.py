"""Builds the wide tree of a scene on its device, and refits it to Gaussians that moved."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import warp as wp

from beam_warp.device.morton import morton_order
from beam_warp.errors import InvalidArrayError
from beam_warp.kernels.trace.radix_tree import launch_split_runs
from beam_warp.kernels.trace.tree_build import (
    BinaryTree,
    launch_choose_neighbors,
    launch_merge_clusters,
    launch_start_clusters,
)
from beam_warp.kernels.trace.tree_collapse import WideLayout, launch_bound_nodes, launch_fill_leaves, launch_open_level
from beam_warp.kernels.trace.wide_tree import LARGEST_DEPTH, LARGEST_NODE_COUNT, LEAF_ROWS, NODE_ROWS, WideTree
from beam_warp.trace.packing import PackedGaussians

WIDTH = 4
"""Children of a node."""

REACH = 8
"""Places of the Morton order in which a cluster looks for its neighbour, to either side.

4, 8, 16 and 32 make trees of equal quality on the benchmark's torus: 19.3, 19.5, 19.1 and 19.4 nodes a ray.
"""

ROUNDS_BY_AREA = 64
"""Rounds of merging by area; after that, what is left pairs up by place, so that no input makes a deep tree."""

Method = Literal["quality", "fast", "places"]


@dataclass(frozen=True, eq=False)
class BuiltTree:
    """A wide tree and what refitting needs.

    Attributes:
        tree: What kernels traverse.
        method: How it was built; ``"places"`` where another method made it too deep.
        count: Leaves.
        levels: (first node, nodes) of each level, from the root down.
        layout: Who is whose child, and the nodes' boxes.
    """

    tree: WideTree
    method: Method
    count: int
    levels: tuple[tuple[int, int], ...]
    layout: WideLayout


def build_wide_tree(packed: PackedGaussians, count: int, method: Method) -> BuiltTree:
    """Build a tree whose depth traversal can follow.

    Args:
        packed: Gaussians and their bounds.
        count: How many of them take part.
        method: ``"quality"`` merges nearest neighbours (PLOC), ``"fast"`` splits the Morton order (Karras 2012),
            ``"places"`` halves it: worse boxes, but never deeper than half the logarithm of the count, for inputs that
            make the others too deep.

    Raises:
        InvalidArrayError: The tree has more nodes than traversal can number, from about 75 million Gaussians on.
    """
    items, keys = morton_order(packed.lowers, packed.uppers, packed.takes_part)
    methods: tuple[Method, ...] = (method, "places") if method != "places" else ("places",)
    for chosen in methods:
        if count == 0:
            binary, root = BinaryTree(), -1
        elif chosen == "fast":
            binary, root = _split(keys, count, packed.device)
        else:
            binary, root = _merge(packed, items, count, REACH if chosen == "quality" else 0)
        built = _collapse(binary, root, items, count, chosen, packed.device)
        if len(built.levels) <= LARGEST_DEPTH:
            refit(built, packed)
            return built
    raise AssertionError(f"a tree over {count} boxes came out {len(built.levels)} levels deep")


def refit(built: BuiltTree, packed: PackedGaussians) -> None:
    """Give a tree the boxes and leaves of Gaussians that moved: same tree, exact bounds."""
    launch_fill_leaves(built.count, packed.gaussians, built.layout, built.tree, packed.device)
    for begin, count in reversed(built.levels):
        launch_bound_nodes(count, begin, packed.lowers, packed.uppers, built.layout, built.tree, packed.device)


def _split(keys: wp.array, count: int, device: Any) -> tuple[BinaryTree, int]:
    """Return the binary tree of sorted codes, without boxes, and its root."""
    binary = BinaryTree()
    for name in ("left", "right", "size"):
        setattr(binary, name, wp.empty(max(2 * count - 1, 1), dtype=int, device=device))
    launch_split_runs(count - 1, keys, count, binary, device)
    return binary, count if count > 1 else 0


def _merge(packed: PackedGaussians, items: wp.array, count: int, reach: int) -> tuple[BinaryTree, int]:
    """Return the binary tree of rounds of merging, with boxes, and its root."""
    device = packed.device
    binary = BinaryTree()
    for name, dtype in (("lower", wp.vec3), ("upper", wp.vec3), ("left", int), ("right", int), ("size", int)):
        setattr(binary, name, wp.empty(2 * count - 1, dtype=dtype, device=device))
    clusters, merged, chosen = (wp.empty(count, dtype=int, device=device) for _ in range(3))
    marks, sums = (wp.empty(count, dtype=wp.vec2i, device=device) for _ in range(2))
    launch_start_clusters(count, items, packed.lowers, packed.uppers, binary, clusters, device)
    left, nodes, rounds = count, count, 0
    while left > 1:
        launch_choose_neighbors(clusters, left, reach if rounds < ROUNDS_BY_AREA else 0, binary, chosen, marks, device)
        wp.utils.array_scan(marks[:left], sums[:left], inclusive=True)
        launch_merge_clusters(left, clusters, chosen, marks, sums, nodes, binary, merged, device)
        stay, made = sums[left - 1 : left].numpy()[0]
        clusters, merged = merged, clusters
        left, nodes, rounds = int(stay), nodes + int(made), rounds + 1
    return binary, nodes - 1


def _collapse(binary: BinaryTree, root: int, items: wp.array, count: int, method: Method, device: Any) -> BuiltTree:
    """Open binary nodes to four children, level by level; boxes come with `refit`."""
    layout, tree = WideLayout(), WideTree()
    binary.items, binary.leaf_count = items, count
    room = max(count, 1)  # a tree has fewer nodes than leaves, and at least its root
    layout.items = wp.empty(room, dtype=int, device=device)
    layout.children = wp.zeros(room, dtype=wp.vec4i, device=device)
    sizes = np.zeros(LARGEST_DEPTH + 3, np.int32)
    sizes[0] = 1
    if count:
        # The host learns how many nodes a level has, and when there are none, only now and then: asking takes longer
        # than a level. Until then a launch is as wide as the level can be.
        level_sizes = wp.array(sizes, dtype=int, device=device)
        queue, following = wp.full(room, root, dtype=int, device=device), wp.empty(room, dtype=int, device=device)
        ask_at = math.ceil(math.log(room, WIDTH)) + 3
        for level in range(LARGEST_DEPTH + 1):
            bound = min(WIDTH**level, room)
            if device.is_cpu or level >= ask_at:
                sizes = level_sizes.numpy()
                bound = int(sizes[level])
                ask_at = level + 3
                if bound == 0:
                    break
            launch_open_level(
                bound, binary, int(method != "fast"), level, queue, level_sizes, following, layout, device
            )
            queue, following = following, queue
        sizes = level_sizes.numpy()
    used = sizes[: LARGEST_DEPTH + 2]
    used = used[used > 0].tolist()
    begins = np.concatenate([[0], np.cumsum(used)]).tolist()
    if begins[-1] > LARGEST_NODE_COUNT:
        raise InvalidArrayError(
            f"cloud must make a tree of at most {LARGEST_NODE_COUNT:,} nodes, got {begins[-1]:,} for {count:,} "
            "Gaussians. Split the cloud."
        )
    layout.lower = wp.empty(begins[-1], dtype=wp.vec3, device=device)
    layout.upper = wp.empty(begins[-1], dtype=wp.vec3, device=device)
    tree.nodes = wp.empty(begins[-1] * NODE_ROWS, dtype=wp.vec4i, device=device)
    tree.leaves = wp.empty(room * LEAF_ROWS, dtype=wp.vec4, device=device)
    return BuiltTree(tree, method, count, tuple(zip(begins[:-1], used, strict=True)), layout)
