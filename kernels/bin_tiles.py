"""Which splats each tile draws, in depth order: count, emit, sort, find ranges.

Splats are sorted by depth once; their (tile, splat) pairs are emitted in that order and sorted by tile alone with a
stable sort, which costs half of one sort by (tile, depth) and gives the same order (Schütz et al. 2025, Splatshop).
A tile lists a splat only if the ellipse where its alpha is 1/255 reaches it, not already if its box does (Hanson et al.
2025, Speedy-Splat).

Pairs live in buffers of a fixed capacity, so that nothing waits for the device: what does not fit is left out, and the
true number is kept for whoever asks. Each pair owns the place at which it was emitted (its slot), where the backward
pass stores its gradient: the slots of a splat lie side by side.
"""

import warp as wp

from beam_warp.kernels.launching import launch
from beam_warp.kernels.project import Splats, View
from beam_warp.kernels.row_loads import load_row
from beam_warp.kernels.splat_rows import (
    end_pixel_at,
    first_pixel_from,
    reach_columns,
    reach_rows,
    squared_extent,
)

wp.set_module_options({"enable_backward": False})

TILE = 16
"""Side of a tile [pixel]. Fast composites look at a tile's list part by part, so that small tiles would only make more
pairs to sort: 8 pixels make 2.5 times as many for a figure of 140,000 Gaussians at 1080p."""

SIDE = wp.constant(TILE)
LAST = wp.constant(float(TILE - 1))


@wp.struct
class Band:
    """Tiles drawn together, among those of all views: all of them unless their pairs would not fit in memory."""

    first_tile: int
    end_tile: int


@wp.struct
class TileLists:
    """The splats of every tile of a band, tile by tile and nearest first."""

    ranges: wp.array[wp.vec2i]  # of each tile, in ``splats``
    splats: wp.array[int]
    slots: wp.array[int]  # where each pair was emitted


@wp.func
def row_range(center: wp.vec4, shape: wp.vec4, view: View) -> wp.vec2i:
    """First and end row of pixels that a splat reaches."""
    reach = reach_rows(shape, squared_extent(center[2]))
    return wp.vec2i(first_pixel_from(center[1] - reach, view.height), end_pixel_at(center[1] + reach, view.height))


@wp.func
def tile_row_range(center: wp.vec4, shape: wp.vec4, view: View, band: Band) -> wp.vec2i:
    """First and end row of tiles that a splat reaches in a band; none if it is not drawn."""
    if not (center[2] > -wp.inf):
        return wp.vec2i(0, 0)
    rows = row_range(center, shape, view)
    if rows[1] <= rows[0]:
        return wp.vec2i(0, 0)
    first = wp.max(band.first_tile - view.first_tile, 0) / view.columns  # bands hold whole rows
    end = wp.max(band.end_tile - view.first_tile, 0) / view.columns
    top = wp.max(rows[0] / SIDE, first)
    return wp.vec2i(top, wp.max(wp.min((rows[1] - 1) / SIDE + 1, end), top))


@wp.func
def tile_column_range(center: wp.vec4, shape: wp.vec4, view: View, row: int) -> wp.vec2i:
    """First and end column of the tiles of a row that a splat's ellipse reaches."""
    top = float(row * SIDE) + 0.5 - center[1]
    columns = reach_columns(shape, squared_extent(center[2]), top, top + LAST)
    first = first_pixel_from(center[0] + columns[0], view.width)
    end = end_pixel_at(center[0] + columns[1], view.width)
    if end <= first:
        return wp.vec2i(0, 0)
    return wp.vec2i(first / SIDE, (end - 1) / SIDE + 1)


@wp.kernel
def key_splats_kernel(
    first: int,
    splats: Splats,
    views: wp.array[View],
    gaussian_count: int,
    out_keys: wp.array[int],
    out_order: wp.array[int],
):
    """Depth of each splat as a sorting key; those on no pixel come last."""
    splat = first + wp.tid()
    center = load_row(splats.centers, splat)
    key = int(0x7F800000)  # infinity
    if center[2] > -wp.inf:
        shape = load_row(splats.shapes, splat)
        view = views[splat / gaussian_count]
        squared = squared_extent(center[2])
        rows = row_range(center, shape, view)
        reach = wp.sqrt(squared) / shape[0] * 1.00001 + 0.01
        x0 = first_pixel_from(center[0] - reach, view.width)
        x1 = end_pixel_at(center[0] + reach, view.width)
        if rows[1] > rows[0] and x1 > x0:
            key = wp.cast(center[3], int)  # the bits of a positive float sort like an integer
    out_keys[splat] = key
    out_order[splat] = splat


@wp.kernel
def count_pairs_kernel(
    first: int,
    order: wp.array[int],
    keys: wp.array[int],
    splats: Splats,
    views: wp.array[View],
    gaussian_count: int,
    band: Band,
    out_counts: wp.array[int],
):
    place = first + wp.tid()
    count = int(0)
    if keys[place] < 0x7F800000:
        splat = order[place]
        center = load_row(splats.centers, splat)
        shape = load_row(splats.shapes, splat)
        view = views[splat / gaussian_count]
        rows = tile_row_range(center, shape, view, band)
        for row in range(rows[0], rows[1]):
            columns = tile_column_range(center, shape, view, row)
            count += columns[1] - columns[0]
    out_counts[place] = count


@wp.kernel
def emit_pairs_kernel(
    first: int,
    order: wp.array[int],
    counts: wp.array[int],
    ends: wp.array[int],
    splats: Splats,
    views: wp.array[View],
    gaussian_count: int,
    band: Band,
    out_tiles: wp.array[int],
    out_slots: wp.array[int],
    out_owners: wp.array[int],
):
    """Ends beyond the range of integers come out negative: such pairs, like those beyond the capacity, are left out."""
    place = first + wp.tid()
    count = counts[place]
    if count <= 0:
        return
    end = wp.min(ends[place], out_owners.shape[0])
    slot = ends[place] - count
    splat = order[place]
    center = load_row(splats.centers, splat)
    shape = load_row(splats.shapes, splat)
    view = views[splat / gaussian_count]
    rows = tile_row_range(center, shape, view, band)
    for row in range(rows[0], rows[1]):
        columns = tile_column_range(center, shape, view, row)
        for column in range(columns[0], columns[1]):
            if slot >= 0 and slot < end:
                out_tiles[slot] = view.first_tile - band.first_tile + row * view.columns + column
                out_slots[slot] = slot
                out_owners[slot] = splat
                slot += 1


@wp.kernel
def find_ranges_kernel(
    first: int,
    tiles: wp.array[int],
    slots: wp.array[int],
    owners: wp.array[int],
    tile_count: int,
    out_splats: wp.array[int],
    out_ranges: wp.array[wp.vec2i],
):
    i = first + wp.tid()
    tile = tiles[i]
    if tile >= tile_count:  # room that no pair took
        return
    out_splats[i] = owners[slots[i]]
    if i == 0 or tiles[i - 1] != tile:
        out_ranges[tile][0] = i
    if i == owners.shape[0] - 1 or tiles[i + 1] != tile:
        out_ranges[tile][1] = i + 1


def launch_key_splats(splats, views, gaussian_count, keys, order, device):
    """Write every splat's depth key and number."""
    launch(
        key_splats_kernel,
        len(splats.centers),
        inputs=[splats, views, gaussian_count],
        outputs=[keys, order],
        device=device,
    )


def launch_count_pairs(order, keys, splats, views, gaussian_count, band, counts, device):
    """Count the tiles of a band that each splat reaches, in depth order."""
    launch(
        count_pairs_kernel,
        len(splats.centers),
        inputs=[order, keys, splats, views, gaussian_count, band],
        outputs=[counts],
        device=device,
    )


def launch_emit_pairs(order, counts, ends, splats, views, gaussian_count, band, tiles, slots, owners, device):
    """Write the tile, slot and splat of every pair, in depth order."""
    launch(
        emit_pairs_kernel,
        len(splats.centers),
        inputs=[order, counts, ends, splats, views, gaussian_count, band],
        outputs=[tiles, slots, owners],
        device=device,
    )


def launch_find_ranges(tiles, slots, owners, tile_count, lists, device):
    """Write each tile's range among the sorted pairs, and the pairs' splats."""
    launch(
        find_ranges_kernel,
        len(owners),
        inputs=[tiles, slots, owners, tile_count],
        outputs=[lists.splats, lists.ranges],
        device=device,
    )
