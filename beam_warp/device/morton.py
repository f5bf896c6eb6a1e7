"""The order of boxes or points along a Morton curve: neighbours in it are near each other in space."""

from __future__ import annotations

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.trace.tree_build import launch_order_boxes


def morton_order(lowers: wp.array, uppers: wp.array, takes_part: wp.array) -> tuple[wp.array, wp.array]:
    """Return (items, keys) of boxes in Morton order of their centres; what takes no part comes last.

    Args:
        lowers: Lower corners, ``(N,)`` vec3; points are boxes whose corners are one.
        uppers: Upper corners, like ``lowers``.
        takes_part: 1 for what counts, ``(N,)`` int.

    Returns:
        Row numbers and their int64 keys, with room for twice as many, which sorting needs.
    """
    total, device = len(lowers), lowers.device
    keys = wp.empty(2 * total, dtype=wp.int64, device=device)
    items = wp.empty(2 * total, dtype=int, device=device)
    bounds = wp.array([[LARGEST_FLOAT] * 3, [-LARGEST_FLOAT] * 3], dtype=wp.vec3, device=device)
    launch_order_boxes(lowers, uppers, takes_part, bounds, keys, items, device)
    wp.utils.radix_sort_pairs(keys, items, total)
    return items, keys
