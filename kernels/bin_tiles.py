"""Which splats each tile draws, in depth order: count, emit, sort, find ranges.

Splats are sorted by depth once; their (tile, splat) pairs are emitted in that order and sorted by tile alone with a
stable sort, which costs half of one sort by (tile, depth) and gives the same order (Schütz et al. 2025, Splatshop).
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Band:
    """Some rows of tiles, drawn together; the whole image unless its pairs would not fit in memory."""

    tile: int  # side of a tile [pixel]
    columns: int  # tiles in a row
    first_row: int
    end_row: int


@wp.func
def tiles_of(box: wp.vec4i, band: Band) -> wp.vec4i:
    """First column, first row, end column and end row of the tiles of a band that a box of pixels touches."""
    if box[2] <= box[0]:
        return wp.vec4i(0, 0, 0, 0)
    row = wp.max(box[1] / band.tile, band.first_row)
    end = wp.min((box[3] - 1) / band.tile + 1, band.end_row)
    return wp.vec4i(box[0] / band.tile, row, (box[2] - 1) / band.tile + 1, wp.max(row, end))


@wp.kernel
def make_depth_keys_kernel(first: int, depths: wp.array[float], out_keys: wp.array[int], out_order: wp.array[int]):
    i = first + wp.tid()
    out_keys[i] = wp.cast(depths[i], int)  # the bits of a positive float sort like an integer
    out_order[i] = i


@wp.kernel
def count_pairs_kernel(
    first: int, order: wp.array[int], boxes: wp.array[wp.vec4i], band: Band, out_counts: wp.array[int]
):
    place = first + wp.tid()
    tiles = tiles_of(boxes[order[place]], band)
    out_counts[place] = (tiles[2] - tiles[0]) * (tiles[3] - tiles[1])


@wp.kernel
def emit_pairs_kernel(
    first: int,
    order: wp.array[int],
    boxes: wp.array[wp.vec4i],
    ends: wp.array[int],
    band: Band,
    out_tiles: wp.array[int],
    out_splats: wp.array[int],
):
    place = first + wp.tid()
    splat = order[place]
    tiles = tiles_of(boxes[splat], band)
    slot = ends[place] - (tiles[2] - tiles[0]) * (tiles[3] - tiles[1])
    for row in range(tiles[1], tiles[3]):
        for column in range(tiles[0], tiles[2]):
            out_tiles[slot] = (row - band.first_row) * band.columns + column
            out_splats[slot] = splat
            slot += 1


@wp.kernel
def find_ranges_kernel(first: int, tiles: wp.array[int], count: int, out_ranges: wp.array[wp.vec2i]):
    i = first + wp.tid()
    tile = tiles[i]
    if i == 0 or tiles[i - 1] != tile:
        out_ranges[tile][0] = i
    if i == count - 1 or tiles[i + 1] != tile:
        out_ranges[tile][1] = i + 1
