"""The order of boxes or points along a Morton curve: neighbours in it are near each other in space."""

from __future__ import annotations

from typing import Any

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
    order = MortonOrder(len(lowers), lowers.device)
    order.find(lowers, uppers, takes_part)
    return order.items, order.keys


class MortonOrder:
    """Room for `morton_order`, to find it again and again without allocating.

    Attributes:
        items: Row numbers in order, with room for twice as many.
        keys: Their int64 keys, likewise.
    """

    def __init__(self, count: int, device: Any) -> None:
        """Allocate for so many boxes."""
        self._count = count
        self.keys = wp.empty(2 * count, dtype=wp.int64, device=device)
        self.items = wp.empty(2 * count, dtype=int, device=device)
        self._nothing = wp.array([[LARGEST_FLOAT] * 3, [-LARGEST_FLOAT] * 3], dtype=wp.vec3, device=device)
        self._bounds = wp.empty(2, dtype=wp.vec3, device=device)

    def find(self, lowers: wp.array, uppers: wp.array, takes_part: wp.array) -> None:
        """Put boxes in order; arguments as of `morton_order`."""
        wp.copy(self._bounds, self._nothing)
        launch_order_boxes(lowers, uppers, takes_part, self._bounds, self.keys, self.items, lowers.device)
        wp.utils.radix_sort_pairs(self.keys, self.items, self._count)
