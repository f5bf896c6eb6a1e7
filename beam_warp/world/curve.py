"""Order of points along a space-filling curve, so that neighbours in space are near each other in memory and files."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beam_warp.blocks import for_each_block

CELLS = 1 << 21
"""Cells of an axis: three numbers below this interleave to 63 bits."""

_SPREADING = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that put two zeros before each of 21 bits."""


def morton_order(cells: NDArray[np.unsignedinteger]) -> NDArray[np.intp]:
    """Return the rows in their order along a Morton curve; rows in the same cell keep theirs.

    Args:
        cells: Number of each row's cell along x, y and z, ``(N, 3)``, below `CELLS`.
    """
    keys = np.empty(len(cells), np.uint64)

    def interleave(part: slice) -> None:
        spread = cells[part].astype(np.uint64)
        for shift, mask in _SPREADING:
            spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
        keys[part] = spread @ np.array([1, 2, 4], np.uint64)

    for_each_block(interleave, len(cells))
    return np.argsort(keys, kind="stable")
