"""Every tile's list has its room and its turn, is sorted by depth and splat, piece by piece."""

from functools import cache

import numpy as np
import pytest
import warp as wp

from beam_warp.kernels.raster.bin_tiles import SIDE, Band, SplatOrder, TileLists
from beam_warp.kernels.raster.project import LOG_CUT, Projection, RasterView, Splats
from beam_warp.kernels.raster.sort_entries_cuda import SORTED, sort_entries_function
from beam_warp.kernels.raster.splat_rows import EXTENT_MARGIN, RELATIVE_MARGIN
from beam_warp.kernels.raster.tile_lists_cuda import (
    NEXT_PLACE,
    NUMBER_BITS,
    SPREAD,
    launch_emit_entries,
    launch_plan_tiles,
    launch_project_entries,
    rank_bits,
)
from beam_warp.raster.layout import ViewLayout
from beam_warp.world.camera import Camera

pytestmark = pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")

ONE = 0x3F800000
"""Bits of a depth of 1."""


@cache
def sort_all_kernel(threads):
    """Return the kernel whose only block, of so many threads, sorts a list to its end."""
    sort_entries = sort_entries_function(threads)

    @wp.kernel(enable_backward=False, module="unique")
    def kernel(
        entries: wp.array[wp.uint64],
        begin: int,
        end: int,
        parted: wp.array[wp.uint64],
        out_splats: wp.array[int],
        out_ranks: wp.array[wp.uint16],
        out_most: wp.array[int],
    ):
        thread = wp.tid()
        listed = wp.int32(begin)
        while listed < end:
            further = sort_entries(entries, begin, listed, end, parted, out_splats, out_ranks, 7)
            if thread == 0:
                wp.atomic_max(out_most, 0, further - listed)
            listed = further

    return kernel


@pytest.mark.parametrize("threads", [128, 256])
@pytest.mark.parametrize("kind", ["even", "equal", "crowded"])
@pytest.mark.parametrize("count", [1, 31, 33, 256, SORTED, SORTED + 1, 5000, 70_000])
def test_entries_are_sorted(rng, count, kind, threads):
    """Lists beyond what shared memory holds, too; equal depths by splat."""
    begin, capacity = 5, count + 8
    depths = ONE + rng.integers(0, 2**22, count)
    if kind == "equal":
        depths[:] = ONE
    if kind == "crowded":
        depths = np.where(rng.uniform(size=count) < 0.9, ONE + 2**20 + rng.integers(0, 3, count), depths)
    numbers = 128 * rng.permutation(count) + rng.integers(0, 128, count)
    entries = (depths << NUMBER_BITS | numbers).astype(np.uint64)
    given = wp.array(
        np.r_[np.zeros(begin, np.uint64), entries, np.zeros(3, np.uint64)], dtype=wp.uint64, device="cuda:0"
    )
    found = [wp.full(capacity, 77, dtype=dtype, device="cuda:0") for dtype in (int, wp.uint16)]
    most = wp.zeros(1, dtype=int, device="cuda:0")
    inputs = [given, begin, begin + count, wp.zeros_like(given)]
    kernel, outputs = sort_all_kernel(threads), [*found, most]
    wp.launch(kernel, threads, inputs=inputs, outputs=outputs, device="cuda:0", block_dim=threads)
    splats, ranks = (array.numpy() for array in found)
    ordered = np.sort(entries).astype(np.int64) % 2**NUMBER_BITS
    np.testing.assert_array_equal(splats[begin : begin + count], ordered // 128)
    np.testing.assert_array_equal(ranks[begin : begin + count], ordered % 128)
    outside = [*range(begin), *range(begin + count, capacity)]
    assert (splats[outside] == 77).all()
    assert (ranks[outside] == 77).all()
    assert most.numpy()[0] <= SORTED


@pytest.mark.parametrize(("tile_count", "room"), [(1, 1.0), (1000, 1.0), (8160, 1.0), (8160, 0.5), (50_000, 1.0)])
def test_tiles_have_their_room_and_their_turn(rng, tile_count, room):
    """Each tile once, long lists before those a fifth shorter; what does not fit has none."""
    lengths = rng.integers(1, 300, tile_count) * 20 ** rng.integers(0, 2, tile_count)
    lengths[rng.uniform(size=tile_count) < 0.5] = 0
    capacity = int(room * lengths.sum())
    lists = TileLists()
    lists.ranges = wp.zeros(tile_count, dtype=wp.vec2i, device="cuda:0")
    lists.order = wp.zeros(tile_count, dtype=int, device="cuda:0")
    tallies, total = (wp.array(numbers, dtype=int, device="cuda:0") for numbers in (np.repeat(lengths, SPREAD), [-1]))
    launch_plan_tiles(tallies, tile_count, capacity, lists, total, "cuda:0")
    ends = np.cumsum(lengths)
    assert total.numpy()[0] == ends[-1]
    fits = ends <= capacity
    expected = np.where(fits, [ends - lengths, ends], capacity).T
    np.testing.assert_array_equal(lists.ranges.numpy(), expected)
    order = lists.order.numpy()
    assert sorted(order) == list(range(tile_count))
    turns = lengths[order]
    assert (turns[1:] <= 1.26 * turns[:-1]).all()
    assert (np.maximum.accumulate(turns[::-1])[::-1] <= 1.26 * turns).all()


def test_every_pair_that_is_counted_is_emitted(rng):
    """Ellipses that begin where a tile does, to the left or above: the last bit says which tiles they reach.

    One kernel counts, another emits. A pair that only one of them finds leaves an entry of an earlier frame in a list,
    so that images differ from run to run.
    """
    count, side, device = 300_000, 1024, "cuda:0"
    camera = Camera.orbit((0, 0, 0), 2.0, 0, 0, width=side, height=side, vertical_fov=40)
    layout = ViewLayout.of([camera])
    views = wp.array(layout.views, dtype=RasterView, device=device)
    band, projection = Band(), Projection()
    tile_count = band.end_tile = len(layout.tile_views)
    projection.low_pass, projection.near, projection.antialiased = 0.1, 0.01, 1
    splats, order, lists = Splats(), SplatOrder(), TileLists()
    zeros = lambda size, dtype=int: wp.zeros(size, dtype=dtype, device=device)  # noqa: E731
    for name, dtype in {"centers": wp.vec4, "shapes": wp.vec4, "slopes": wp.vec4, "bends": float}.items():
        setattr(splats, name, zeros(count, dtype))
    splats.normals = zeros(0, wp.vec3)
    order.counts, order.ends, tallies = zeros(count), zeros(count), zeros(tile_count * SPREAD)
    positions = rng.uniform(-0.4, 0.4, (count, 3))
    scales = np.exp(rng.uniform(np.log(0.001), np.log(0.02), (count, 3)))
    rest = ((rng.normal(size=(count, 4)), wp.quat), (scales, wp.vec3), (rng.uniform(0.1, 1.0, count), float))
    shapes_of = [wp.array(values, dtype=dtype, device=device) for values, dtype in rest]
    row_of, is_above = rng.integers(-1, 2, count), rng.uniform(size=count) < 0.5
    for _ in range(5):  # each time closer, until positions cannot say it better
        tallies.zero_()
        gaussians = (wp.array(positions, dtype=wp.vec3, device=device), *shapes_of)
        launch_project_entries(gaussians, views, projection, band, splats, order.counts, tallies, device)
        centers, shapes = (rows.numpy().astype(np.float64) for rows in (splats.centers, splats.shapes))
        squared = LOG_CUT + centers[:, 2]
        top = (np.floor(centers[:, 1] / SIDE) + row_of) * SIDE + 0.5 - centers[:, 1]
        left = centers[:, 0] + _left_end(shapes, squared, top, top + SIDE - 1.0)
        begin = np.where(is_above, centers[:, 1] - _reach_of_rows(shapes, squared), left)
        shift = (np.round((begin + 0.5) / SIDE) * SIDE - 0.5 - begin) * centers[:, 3] / camera.focal_x
        axes = np.where(is_above[:, None], camera.world_to_camera[1, :3], camera.world_to_camera[0, :3])
        positions += np.where(np.isfinite(shift), shift, 0.0)[:, None] * axes
    wp.utils.array_scan(order.counts, order.ends, inclusive=True)
    pairs = int(order.ends.numpy()[-1])
    lists.ranges, lists.order = zeros(tile_count, wp.vec2i), zeros(tile_count)
    lists.entries, lists.rank_bits, total = zeros(pairs, wp.uint64), rank_bits(count), zeros(1)
    counted = tallies.numpy()[:: int(SPREAD)]
    launch_plan_tiles(tallies, tile_count, pairs, lists, total, device)
    launch_emit_entries(splats, views, count, band, tallies, lists, device)
    left, places = tallies.numpy().reshape(tile_count, -1)[:, [0, NEXT_PLACE]].T
    assert pairs > 2 * count
    assert np.median(np.abs(shift)) < 1e-5
    assert not left.any()
    np.testing.assert_array_equal(places, np.cumsum(counted))  # each list ends where the next one begins
    listed, ranks = np.divmod(lists.entries.numpy().astype(np.int64) % 2**NUMBER_BITS, 2**lists.rank_bits)
    owners = np.repeat(np.arange(count), order.counts.numpy())
    np.testing.assert_array_equal(np.sort(listed), owners)
    # Ranks are those of a splat's tiles, row by row.
    tiles = np.repeat(np.arange(tile_count), counted)
    ordered = np.lexsort((tiles, listed))
    np.testing.assert_array_equal(ranks[ordered], np.concatenate([np.arange(n) for n in order.counts.numpy()]))


def _left_end(shapes, squared, top, bottom):
    """Least x of ellipses between two y, with the margins that belong to it; both from the centres."""
    s0, s1, s2, _ = shapes.T
    e = s1 * s2
    k = s0 * s0 + e * e
    y = np.clip(-np.sqrt(squared) * s1 / s0, top, bottom)
    half = np.sqrt(np.maximum(k * squared - (s0 * s2 * y) ** 2, 0.0))
    left, right = (e * s2 * y - half) / k, (e * s2 * y + half) / k
    return left - RELATIVE_MARGIN * np.maximum(np.abs(left), np.abs(right)) - EXTENT_MARGIN


def _reach_of_rows(shapes, squared):
    """Largest distance along y of ellipses from their centres, with the margins that belong to it."""
    s0, s1, s2, _ = shapes.T
    reach = np.sqrt(squared * (s0 * s0 + (s1 * s2) ** 2)) / (s0 * s2)
    return reach * (1.0 + RELATIVE_MARGIN) + EXTENT_MARGIN
