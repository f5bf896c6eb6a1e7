"""Every pair has a slot of its own, beside the others of its splat, whether its rank is known or counted out."""

import numpy as np
import pytest
import warp as wp
from support.raster_clouds import around, cloud, drawn

from beam_warp.kernels.raster.bin_tiles import Band, SplatOrder, TileLists
from beam_warp.kernels.raster.pair_slots_cuda import launch_find_far_slots, launch_find_slots
from beam_warp.raster.buffers import FrameBuffers

BITS = 3


@pytest.fixture
def listed(rng) -> FrameBuffers:
    """Lists of some views, made on the CPU: large and small splats, images that end within tiles."""
    made = cloud(rng, 300)
    scales = made.scales * np.where(rng.uniform(size=300) < 0.1, 20.0, 1.0)[:, None]
    cameras = [around(150, 90), around(40, 170, 80.0)]
    drawer, _ = drawn(made.with_arrays(scales=scales.astype(np.float32)), cameras, "cpu", np.ones((300, 1), np.float32))
    return drawer._buffers


@pytest.mark.parametrize("room", [1.0, 0.5])
def test_slots_follow_from_ranks_and_tiles(device, listed, room):
    """Ranks of three bits: most pairs of large splats are beyond."""
    buffers, splat_count = listed, listed.splat_count
    ranges, splats = buffers.frame.lists.ranges.numpy(), buffers.frame.lists.splats.numpy()
    tiles = np.repeat(np.arange(len(ranges)), ranges[:, 1] - ranges[:, 0])
    splats = splats[: len(tiles)]
    counts = np.bincount(splats, minlength=splat_count)
    expected = np.empty(len(tiles), int)
    expected[np.lexsort((tiles, splats))] = np.arange(len(tiles))  # a splat's pairs, row by row
    ranks = expected - (np.cumsum(counts) - counts)[splats]
    assert ranks.max() > 4 * 2**BITS

    place = lambda values, dtype=int: wp.array(values, dtype=dtype, device=device)  # noqa: E731
    lists, order, band = TileLists(), SplatOrder(), Band()
    band.end_tile = len(ranges)
    lists.ranges, lists.ends = place(ranges, wp.vec2i), place(np.minimum(ranges[:, 1], int(room * len(tiles))))
    lists.splats, lists.rank_bits = place(splats), BITS
    lists.ranks = place(np.minimum(ranks, 2**BITS - 1), wp.uint16)
    order.counts, order.ends = place(counts), place(np.cumsum(counts))
    rows = buffers.zero_splats()
    for name in ("centers", "shapes", "slopes", "bends"):
        setattr(rows, name, getattr(buffers.splats, name).to(device))
    rows.normals = wp.zeros(0, dtype=wp.vec3, device=device)
    capacity = int(room * len(tiles))
    found = lists.slots = wp.full(capacity, -7, dtype=int, device=device)
    views = (buffers.views.to(device), place(buffers.layout.tile_views), buffers.gaussian_count)
    launch_find_slots(capacity, order, lists, found, device)
    launch_find_far_slots(order, rows, *views, band, lists, device)
    expected = expected[:capacity]
    np.testing.assert_array_equal(found.numpy(), np.where(expected < capacity, expected, -1))
