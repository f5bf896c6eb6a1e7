"""Every tile's list has its room and its turn, and is sorted by depth and slot, piece by piece."""

import numpy as np
import pytest
import warp as wp

from beam_warp.kernels.raster.bin_tiles import TileLists
from beam_warp.kernels.raster.tile_lists_cuda import SORTED, SPREAD, THREADS, launch_plan_tiles, sort_entries

pytestmark = pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")

ONE = 0x3F800000
"""Bits of a depth of 1."""


@wp.kernel(enable_backward=False)
def sort_all_kernel(
    entries: wp.array[wp.uint64],
    owners: wp.array[int],
    begin: int,
    end: int,
    parted: wp.array[wp.uint64],
    out_splats: wp.array[int],
    out_slots: wp.array[int],
    out_most: wp.array[int],
):
    """One block sorts a list to its end."""
    thread = wp.tid()
    listed = wp.int32(begin)
    while listed < end:
        further = sort_entries(entries, owners, begin, listed, end, parted, out_splats, out_slots)
        if thread == 0:
            wp.atomic_max(out_most, 0, further - listed)
        listed = further


@pytest.mark.parametrize("kind", ["even", "equal", "crowded", "without slots"])
@pytest.mark.parametrize("count", [1, 31, 33, 256, SORTED, SORTED + 1, 5000, 70_000])
def test_entries_are_sorted(rng, count, kind):
    """Lists beyond what shared memory holds, too; equal depths by slot; entries without a slot last."""
    begin, capacity = 5, count + 8
    depths = ONE + rng.integers(0, 2**22, count)
    if kind == "equal":
        depths[:] = ONE
    if kind == "crowded":
        depths = np.where(rng.uniform(size=count) < 0.9, ONE + 2**20 + rng.integers(0, 3, count), depths)
    slots = rng.permutation(count)
    entries = depths.astype(np.uint64) << np.uint64(32) | slots.astype(np.uint64)
    if kind == "without slots":
        lost = rng.uniform(size=count) < 0.5
        entries[lost] = np.uint64(2**63) + np.flatnonzero(lost).astype(np.uint64)
    owners = rng.integers(0, 1000, capacity)
    given = wp.array(
        np.r_[np.zeros(begin, np.uint64), entries, np.zeros(3, np.uint64)], dtype=wp.uint64, device="cuda:0"
    )
    found = [wp.full(capacity, -7, dtype=int, device="cuda:0") for _ in range(2)]
    most = wp.zeros(1, dtype=int, device="cuda:0")
    inputs = [given, wp.array(owners, dtype=int, device="cuda:0"), begin, begin + count, wp.zeros_like(given)]
    wp.launch(sort_all_kernel, THREADS, inputs=inputs, outputs=[*found, most], device="cuda:0", block_dim=THREADS)
    ordered = np.sort(entries)
    expected = np.where(ordered >= 2**63, -1, (ordered & np.uint64(0xFFFFFFFF)).astype(np.int64))
    splats, listed = (array.numpy()[begin : begin + count] for array in found)
    np.testing.assert_array_equal(listed, expected)
    np.testing.assert_array_equal(splats, np.where(expected < 0, -1, owners[expected]))
    assert all((array.numpy()[[*range(begin), *range(begin + count, capacity)]] == -7).all() for array in found)
    assert most.numpy()[0] <= SORTED


@pytest.mark.parametrize(("tile_count", "room"), [(1, 1.0), (1000, 1.0), (8160, 1.0), (8160, 0.5)])
def test_tiles_have_their_room_and_their_turn(rng, tile_count, room):
    """Each tile once, long lists before those a fifth shorter; what does not fit has none."""
    lengths = rng.integers(1, 300, tile_count) * 20 ** rng.integers(0, 2, tile_count)
    lengths[rng.uniform(size=tile_count) < 0.5] = 0
    capacity = int(room * lengths.sum())
    lists = TileLists()
    lists.ranges = wp.zeros(tile_count, dtype=wp.vec2i, device="cuda:0")
    lists.order = wp.zeros(tile_count, dtype=int, device="cuda:0")
    tallies = np.repeat(lengths, SPREAD)
    launch_plan_tiles(wp.array(tallies, dtype=int, device="cuda:0"), tile_count, capacity, lists, "cuda:0")
    ends = np.cumsum(lengths)
    fits = ends <= capacity
    expected = np.where(fits, [ends - lengths, ends], capacity).T
    np.testing.assert_array_equal(lists.ranges.numpy(), expected)
    order = lists.order.numpy()
    assert sorted(order) == list(range(tile_count))
    turns = lengths[order]
    assert (turns[1:] <= 1.26 * turns[:-1]).all()
    assert (np.maximum.accumulate(turns[::-1])[::-1] <= 1.26 * turns).all()
