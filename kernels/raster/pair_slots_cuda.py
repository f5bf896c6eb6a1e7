"""The slots of pairs on CUDA, where the way back stores what it sums over a pair: those of a splat follow one another.

A pair's slot follows from its rank. Where a splat reaches more tiles than there are bits for ranks, the pairs beyond
are counted out.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.raster.bin_tiles import Band, SplatOrder, TileLists, tile_box, tile_columns
from beam_warp.kernels.raster.project import RasterView, Splats
from beam_warp.kernels.raster.strided_rows import load_row
from beam_warp.kernels.raster.tile_lists_cuda import last_rank

# As in `tile_lists_cuda`: the same tiles must be found to the last bit.
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fuse_fp": False})

SLOT_FINDERS = wp.constant(128)
"""Threads that find the far slots of a tile's pairs."""


@wp.func
def slot_within(slot: int, capacity: int) -> int:
    """A slot, or -1 beyond the capacity. Ends beyond the range of integers come out negative, and so do their slots."""
    return wp.where(slot >= 0 and slot < capacity, slot, -1)


@wp.kernel
def find_slots_kernel(first: int, order: SplatOrder, lists: TileLists, out_slots: wp.array[int]):
    """What is not sorted gets slots of no meaning."""
    place = first + wp.tid()
    splat = lists.splats[place]
    slot = order.ends[splat] - order.counts[splat] + int(lists.ranks[place])
    out_slots[place] = slot_within(slot, out_slots.shape[0])


@wp.kernel
def find_far_slots_kernel(
    first: int,
    order: SplatOrder,
    splats: Splats,
    views: wp.array[RasterView],
    tile_views: wp.array[int],
    gaussian_count: int,
    band: Band,
    lists: TileLists,
    out_slots: wp.array[int],
):
    """The pairs of a splat follow one another as its tiles do, row by row."""
    item = first + wp.tid()
    listed = item / SLOT_FINDERS
    tile = band.first_tile + listed
    view = views[tile_views[tile]]
    own_row = (tile - view.first_tile) / view.columns
    own_column = (tile - view.first_tile) % view.columns
    for i in range(lists.ranges[listed][0] + item % SLOT_FINDERS, lists.ends[listed], SLOT_FINDERS):
        if int(lists.ranks[i]) == last_rank(lists):
            splat = lists.splats[i]
            center = load_row(splats.centers, splat)
            shape = load_row(splats.shapes, splat)
            box = tile_box(center, shape, view, band)
            rank = own_column - tile_columns(center, shape, view, box, own_row)[0]
            for row in range(box[1], own_row):
                columns = tile_columns(center, shape, view, box, row)
                rank += columns[1] - columns[0]
            out_slots[i] = slot_within(order.ends[splat] - order.counts[splat] + rank, out_slots.shape[0])


launch_find_slots = launcher(find_slots_kernel)
"""Write the slots of all pairs whose ranks are known."""


def launch_find_far_slots(order, splats, views, tile_views, gaussian_count, band, lists, device):
    """Write the slots of those pairs whose rank says too little, among what is sorted of all lists of a band."""
    launch(
        find_far_slots_kernel,
        (band.end_tile - band.first_tile) * int(SLOT_FINDERS),
        inputs=[order, splats, views, tile_views, gaussian_count, band, lists],
        outputs=[lists.slots],
        device=device,
        block_dim=int(SLOT_FINDERS),
    )
