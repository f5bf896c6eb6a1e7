"""Lists of the splats that each tile draws, in depth order, on the CPU: count, emit, sort, find ranges.

Splats are sorted by depth once; their (tile, splat) pairs are emitted in that order and sorted by tile alone with a
stable sort, which costs half of one sort by (tile, depth) and gives the same order (Schütz et al. 2025, Splatshop). On
CUDA, `tile_lists_cuda` brings the same pairs into the same order.

A tile lists a splat only if the ellipse where its alpha is 1/255 reaches it, not already if its box does (Hanson et al.
2025, Speedy-Splat).

Pairs live in buffers of a fixed capacity, so that nothing waits for the device: what does not fit is left out, and the
true number is kept for whoever asks. Each pair owns a place (its slot) among those of all pairs, where the backward
pass stores its gradient: the slots of a splat lie side by side. Here it is where the pair was emitted.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.raster.project import RasterView, Splats
from beam_warp.kernels.raster.splat_rows import (
    EXTENT_MARGIN,
    RELATIVE_MARGIN,
    end_pixel_at,
    first_pixel_from,
    reach_columns,
    reach_rows,
    squared_extent,
)
from beam_warp.kernels.raster.strided_rows import load_row

wp.set_module_options({"enable_backward": False})

TILE = 16
"""Side of a tile [pixel]. Fast composites look at a tile's list part by part, so that small tiles would only make more
pairs to sort: 8 pixels make 2.2 times as many for a figure of 140,000 Gaussians at 1080p. The composite's adjoint on
CUDA is written for 16."""

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
    slots: wp.array[int]  # of each pair, -1 for none; on CUDA found on the way back
    # On CUDA only, where lists are sorted as far as they are drawn:
    order: wp.array[int]  # tiles in the order of drawing, counted from the band's first
    entries: wp.array[wp.uint64]  # depth, splat and rank of each pair, tile by tile
    parted: wp.array[wp.uint64]  # entries of long lists, parted by depth
    ends: wp.array[int]  # end of what is sorted of each tile's list
    ranks: wp.array[wp.uint16]  # of each pair among those of its splat, as far as there are bits
    rank_bits: int
    summed: wp.array[wp.uint8]  # 1 where the way back has written the row of a slot


@wp.struct
class SplatOrder:
    """All splats of all views, nearest first, and how many pairs of a band each one has."""

    splats: wp.array[int]
    counts: wp.array[int]
    ends: wp.array[int]  # end of each splat's pairs among those of the band


@wp.struct
class PairList:
    """The (tile, splat) pairs of a band on the CPU: emitted splat by splat, then sorted by tile."""

    tiles: wp.array[int]  # counted from the band's first; sorted together with ``slots``
    slots: wp.array[int]  # where each pair was emitted
    owners: wp.array[int]  # the splat of the pair that was emitted at each slot


@wp.func
def tile_box(center: wp.vec4, shape: wp.vec4, view: RasterView, band: Band) -> wp.vec4i:
    """First column, first row, end column and end row of the tiles of a band that a splat's box reaches."""
    if not (center[2] > -wp.inf):
        return wp.vec4i(0, 0, 0, 0)
    squared = squared_extent(center[2])
    down = reach_rows(shape, squared)
    across = wp.sqrt(squared) / shape[0] * (1.0 + RELATIVE_MARGIN) + EXTENT_MARGIN
    x0 = first_pixel_from(center[0] - across, view.width)
    x1 = end_pixel_at(center[0] + across, view.width)
    y0 = first_pixel_from(center[1] - down, view.height)
    y1 = end_pixel_at(center[1] + down, view.height)
    if x1 <= x0 or y1 <= y0:
        return wp.vec4i(0, 0, 0, 0)
    # Bands hold whole rows of tiles.
    top = wp.max(y0 / SIDE, wp.max(band.first_tile - view.first_tile, 0) / view.columns)
    bottom = wp.min((y1 - 1) / SIDE + 1, wp.max(band.end_tile - view.first_tile, 0) / view.columns)
    return wp.vec4i(x0 / SIDE, top, (x1 - 1) / SIDE + 1, wp.max(bottom, top))


@wp.func
def tile_columns(center: wp.vec4, shape: wp.vec4, view: RasterView, box: wp.vec4i, row: int) -> wp.vec2i:
    """First and end column of the tiles of a row that a splat's ellipse reaches.

    Where the box is one tile wide or high, an ellipse, which touches all its sides, reaches all of it.
    """
    if box[2] - box[0] == 1 or box[3] - box[1] == 1:
        return wp.vec2i(box[0], box[2])
    top = float(row * SIDE) + 0.5 - center[1]
    columns = reach_columns(shape, squared_extent(center[2]), top, top + LAST)
    first = first_pixel_from(center[0] + columns[0], view.width)
    end = end_pixel_at(center[0] + columns[1], view.width)
    if end <= first:
        return wp.vec2i(0, 0)
    return wp.vec2i(first / SIDE, (end - 1) / SIDE + 1)


@wp.kernel
def key_splats_kernel(first: int, splats: Splats, out_keys: wp.array[int], out_order: wp.array[int]):
    """Depth of each splat as a sorting key; those that are not drawn come last."""
    splat = first + wp.tid()
    center = load_row(splats.centers, splat)
    key = int(0x7F800000)  # infinity
    if center[2] > -wp.inf:
        key = wp.cast(center[3], int)  # the bits of a positive float sort like an integer
    out_keys[splat] = key
    out_order[splat] = splat


@wp.kernel
def count_pairs_kernel(
    first: int,
    order: wp.array[int],
    splats: Splats,
    views: wp.array[RasterView],
    gaussian_count: int,
    band: Band,
    out_counts: wp.array[int],
):
    place = first + wp.tid()
    splat = order[place]
    center = load_row(splats.centers, splat)
    shape = load_row(splats.shapes, splat)
    view = views[splat / gaussian_count]
    box = tile_box(center, shape, view, band)
    count = int(0)
    for row in range(box[1], box[3]):
        columns = tile_columns(center, shape, view, box, row)
        count += columns[1] - columns[0]
    out_counts[place] = count


@wp.kernel
def emit_pairs_kernel(
    first: int,
    order: SplatOrder,
    splats: Splats,
    views: wp.array[RasterView],
    gaussian_count: int,
    band: Band,
    out_pairs: PairList,
):
    """Ends beyond the range of integers come out negative: such pairs, like those beyond the capacity, are left out."""
    place = first + wp.tid()
    count = order.counts[place]
    if count <= 0:
        return
    end = wp.min(order.ends[place], out_pairs.owners.shape[0])
    slot = order.ends[place] - count
    splat = order.splats[place]
    center = load_row(splats.centers, splat)
    shape = load_row(splats.shapes, splat)
    view = views[splat / gaussian_count]
    box = tile_box(center, shape, view, band)
    for row in range(box[1], box[3]):
        columns = tile_columns(center, shape, view, box, row)
        for column in range(columns[0], columns[1]):
            if slot >= 0 and slot < end:
                out_pairs.tiles[slot] = view.first_tile - band.first_tile + row * view.columns + column
                out_pairs.slots[slot] = slot
                out_pairs.owners[slot] = splat
                slot += 1


@wp.kernel
def find_ranges_kernel(
    first: int, pairs: PairList, tile_count: int, out_splats: wp.array[int], out_ranges: wp.array[wp.vec2i]
):
    i = first + wp.tid()
    tile = pairs.tiles[i]
    if tile >= tile_count:  # room that no pair took
        return
    out_splats[i] = pairs.owners[pairs.slots[i]]
    if i == 0 or pairs.tiles[i - 1] != tile:
        out_ranges[tile][0] = i
    if i == pairs.owners.shape[0] - 1 or pairs.tiles[i + 1] != tile:
        out_ranges[tile][1] = i + 1


launch_key_splats = launcher(key_splats_kernel)
"""Write every splat's depth key and number."""


def launch_count_pairs(order, splats, views, gaussian_count, band, counts, device):
    """Count the tiles of a band that each splat reaches, in depth order."""
    inputs = [order, splats, views, gaussian_count, band]
    launch(count_pairs_kernel, len(splats.centers), inputs=inputs, outputs=[counts], device=device)


def launch_emit_pairs(order, splats, views, gaussian_count, band, out_pairs, device):
    """Write the tile, slot and splat of every pair, in depth order."""
    inputs = [order, splats, views, gaussian_count, band]
    launch(emit_pairs_kernel, len(splats.centers), inputs=inputs, outputs=[out_pairs], device=device)


def launch_find_ranges(pairs, tile_count, lists, device):
    """Write each tile's range among the sorted pairs, and the pairs' splats."""
    inputs = [pairs, tile_count]
    launch(find_ranges_kernel, len(pairs.owners), inputs=inputs, outputs=[lists.splats, lists.ranges], device=device)
