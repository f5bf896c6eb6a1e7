"""Builds the wide tree of a scene on its device, and refits it to Gaussians that moved."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import warp as wp

from beam_warp.device.graphs import StepGraphs
from beam_warp.device.morton import MortonOrder, morton_order
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

SPARE_LEVELS = 2
"""Levels that the next tree of moved Gaussians may have more than the first one."""

ROOT_ALONE = np.array([1] + [0] * (LARGEST_DEPTH + 2), np.int32)
"""Nodes of each level, and leaves, before any is opened."""

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
    _bound(built.layout, built.tree, built.count, [count for _, count in built.levels], packed)


def _bound(layout: WideLayout, tree: WideTree, count: int, widths: Sequence[int], packed: PackedGaussians) -> None:
    """Write a tree's leaves, and its nodes from the last level up; levels are at most so wide."""
    launch_fill_leaves(count, packed.gaussians, layout, tree, packed.device)
    for level, width in reversed(list(enumerate(widths))):
        launch_bound_nodes(width, level, packed.lowers, packed.uppers, layout, tree, packed.device)


def _split(keys: wp.array, count: int, device: Any) -> tuple[BinaryTree, int]:
    """Return the binary tree of sorted codes, without boxes, and its root."""
    binary = _binary_room(count, device)
    launch_split_runs(count - 1, keys, count, binary, device)
    return binary, count if count > 1 else 0


def _binary_room(count: int, device: Any) -> BinaryTree:
    """Allocate a binary tree without boxes."""
    binary = BinaryTree()
    for name in ("left", "right", "size"):
        setattr(binary, name, wp.empty(max(2 * count - 1, 1), dtype=int, device=device))
    return binary


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
    binary.items, binary.leaf_count = items, count
    room = max(count, 1)  # a tree has fewer nodes than leaves, and at least its root
    layout = _layout_room(room, device)
    if count:
        # The host learns how many nodes a level has, and when there are none, only now and then: asking takes longer
        # than a level. Until then a launch is as wide as the level can be.
        queue, following = wp.full(room, root, dtype=int, device=device), wp.empty(room, dtype=int, device=device)
        ask_at = math.ceil(math.log(room, WIDTH)) + 3
        for level in range(LARGEST_DEPTH + 1):
            bound = min(WIDTH**level, room)
            if device.is_cpu or level >= ask_at:
                bound = int(layout.level_sizes.numpy()[level])
                ask_at = level + 3
                if bound == 0:
                    break
            launch_open_level(bound, binary, int(method != "fast"), level, queue, following, layout, device)
            queue, following = following, queue
    levels = _levels(layout)
    node_count = sum(levels[-1])
    if node_count > LARGEST_NODE_COUNT:
        raise InvalidArrayError(
            f"cloud must make a tree of at most {LARGEST_NODE_COUNT:,} nodes, got {node_count:,} for {count:,} "
            "Gaussians. Split the cloud."
        )
    return BuiltTree(_tree_room(layout, node_count, room, device), method, count, levels, layout)


def _layout_room(room: int, device: Any) -> WideLayout:
    """Allocate who is whose child, for so many leaves; a root is all there is yet."""
    layout = WideLayout()
    layout.items = wp.empty(room, dtype=int, device=device)
    layout.children = wp.zeros(room, dtype=wp.vec4i, device=device)
    layout.level_sizes = wp.array(ROOT_ALONE, dtype=int, device=device)
    return layout


def _tree_room(layout: WideLayout, nodes: int, leaves: int, device: Any) -> WideTree:
    """Allocate what `refit` writes: boxes in the layout, and a tree."""
    tree = WideTree()
    layout.lower = wp.empty(nodes, dtype=wp.vec3, device=device)
    layout.upper = wp.empty(nodes, dtype=wp.vec3, device=device)
    tree.nodes = wp.empty(nodes * NODE_ROWS, dtype=wp.vec4i, device=device)
    tree.leaves = wp.empty(leaves * LEAF_ROWS, dtype=wp.vec4, device=device)
    return tree


def _levels(layout: WideLayout) -> tuple[tuple[int, int], ...]:
    """Return (first node, nodes) of each level; waits for the device."""
    sizes = layout.level_sizes.numpy()[: LARGEST_DEPTH + 2]
    used = sizes[sizes > 0].tolist()
    return tuple(zip([0, *np.cumsum(used).tolist()], used, strict=False))


class RepeatedBuild:
    """Fast trees of Gaussians that move: one CUDA graph each, in arrays that stay, and one question to the device.

    What the host learnt of a first tree is taken to hold for the next ones: how many Gaussians take part, and how many
    levels there are, give or take `SPARE_LEVELS`.
    """

    def __init__(self, packed: PackedGaussians, built: BuiltTree) -> None:
        """Allocate for trees like one that was built of these Gaussians, of at least two leaves."""
        self._packed, self._count, device = packed, built.count, packed.device
        depth = min(len(built.levels) + SPARE_LEVELS, LARGEST_DEPTH)
        self._widths = [min(WIDTH**level, self._count) for level in range(depth)]
        self._order = MortonOrder(len(packed), device)
        self._binary = _binary_room(self._count, device)
        self._binary.items, self._binary.leaf_count = self._order.items, self._count
        self._layout = _layout_room(self._count, device)
        self._tree = _tree_room(self._layout, self._count, self._count, device)
        self._queues = [wp.empty(self._count, dtype=int, device=device) for _ in range(2)]
        self._root_alone = wp.array(ROOT_ALONE, dtype=int, device=device)
        self._root = wp.array([self._count], dtype=int, device=device)
        self._graphs = StepGraphs(device)

    def launch(self) -> None:
        """Build the tree of the Gaussians as they are packed now, in the arrays of the one before, without waiting."""
        self._graphs.run("build", self._build)

    def built(self, count: int) -> BuiltTree | None:
        """Return the tree that was launched last, of so many Gaussians; waits for the device.

        None where the number is another one, or where the tree is deeper than was expected.
        """
        levels = _levels(self._layout)
        if count != self._count or len(levels) > len(self._widths) or sum(levels[-1]) > LARGEST_NODE_COUNT:
            return None
        return BuiltTree(self._tree, "fast", count, levels, self._layout)

    def _build(self) -> None:
        """Take every step of a build."""
        packed, device = self._packed, self._packed.device
        self._order.find(packed.lowers, packed.uppers, packed.takes_part)
        launch_split_runs(self._count - 1, self._order.keys, self._count, self._binary, device)
        wp.copy(self._layout.level_sizes, self._root_alone)
        wp.copy(self._queues[0], self._root, count=1)
        for level, width in enumerate(self._widths):
            queue, following = self._queues[level % 2], self._queues[1 - level % 2]
            launch_open_level(width, self._binary, 0, level, queue, following, self._layout, device)
        _bound(self._layout, self._tree, self._count, self._widths, packed)
