"""The adjoint of compositing on CUDA: a tile a block, 8 x 8 pixels a warp, two a lane.

The block brings 32 splats at a time to shared memory, back to front. Each warp goes through those that reach its
pixels, sums over them, and leaves its sums; the block adds those of its warps and stores them in the pair's slot. No
atomics, one order of additions, the same bits every run.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.lanes import (
    ADD_TO_SUMS,
    BEGIN_SUMS,
    END_SUMS,
    ballot,
    greatest_of_block,
    greatest_of_lanes,
    lowest_lane,
    share_channels_function,
    share_row_function,
    sum_block_function,
    wait_for_block,
)
from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.raster.bin_tiles import SIDE
from beam_warp.kernels.raster.composite import Images, PixelPlace, RasterFrame, channel_vector, pixel_place
from beam_warp.kernels.raster.composite_adjoint import (
    Adjoints,
    PixelState,
    add_pixel_function,
    pair_length,
    pair_vector,
    pixel_adjoint,
)
from beam_warp.kernels.raster.composite_cuda import BEND, CENTER, LANES, SHAPE, SLOPE, reaches
from beam_warp.kernels.raster.project import LOG_CUT
from beam_warp.kernels.raster.splat_rows import SplatRow, alpha_of, sight_of

PART = wp.constant(8)
"""Side of the pixels of a warp."""

WARPS = 4
"""Warps of a block: a tile is 16 x 16 pixels."""

THREADS = wp.constant(32 * WARPS)


@wp.struct
class OwnPixel:
    """One of the pixels of a lane; outside the image nothing is seen in it."""

    index: int  # -1 for outside
    position: wp.vec2
    end: int  # end of what it looked at, in the lists
    median: int  # place of the median's splat in the lists
    state: PixelState


@wp.func
def own_pixel(place: PixelPlace, images: Images, adjoints: Adjoints) -> OwnPixel:
    """The pixel before its splats are gone through."""
    pixel = OwnPixel()
    pixel.index = place.index
    pixel.position = place.position
    pixel.end = -1
    pixel.median = -1
    if place.index >= 0:
        pixel.end = images.ends[place.index]
        pixel.median = images.medians[place.index]
        pixel.state.adjoint = pixel_adjoint(images, adjoints, place.index)
        pixel.state.transmittance = images.transmittance[place.index]
    return pixel


@cache
def share_splat_function(channel_count: int, exact: bool):
    """Return the function that brings a splat to shared memory, a part of it by each warp."""
    Channels = channel_vector(channel_count)
    share_row = share_row_function(4 if exact else 3, LANES)
    share_channels = share_channels_function(Channels, LANES)

    @wp.func
    def share_splat(part: int, lane: int, frame: RasterFrame, channels: wp.array[Channels], splat: int):
        if part == 0:
            share_row(1, CENTER, lane, load_row(frame.splats.centers, splat))
        if part == 1:
            share_row(1, SHAPE, lane, load_row(frame.splats.shapes, splat))
        if part == 2:
            share_row(1, SLOPE, lane, load_row(frame.splats.slopes, splat))
        if part == 3:
            share_channels(1, lane, channels, splat)
            if wp.static(exact):
                share_row(1, BEND, lane, wp.vec4(frame.splats.bends[splat], 0.0, 0.0, 0.0))

    return share_splat


@cache
def composite_adjoint_cuda_kernel(channel_count: int, exact: bool):
    """Return the kernel that writes the moments and channels of every pair, a block a tile."""
    Channels = channel_vector(channel_count)
    Pair = pair_vector(channel_count, exact)
    add_pixel = add_pixel_function(channel_count, exact)
    share_row = share_row_function(4 if exact else 3, LANES)
    share_channels = share_channels_function(Channels, LANES)
    share_splat = share_splat_function(channel_count, exact)
    sum_block = sum_block_function(pair_length(channel_count, exact), WARPS)

    @wp.kernel(enable_backward=False, module="unique")
    def composite_blocks_adjoint_kernel(
        first: int,
        frame: RasterFrame,
        channels: wp.array[Channels],
        images: Images,
        channel_adjoints: wp.array[Channels],
        adjoints: Adjoints,
        out_pairs: wp.array[Pair],
    ):
        item = first + wp.tid()
        thread = item % THREADS
        lane = item % LANES
        part = thread / LANES
        listed = frame.lists.order[item / THREADS]
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        listed_range = frame.lists.ranges[listed]
        corner = (part / 2) * PART * SIDE + (part % 2) * PART
        box = pixel_place(view, tile, corner)
        own = corner + (lane / PART) * SIDE + lane % PART
        upper = own_pixel(pixel_place(view, tile, own), images, adjoints)
        lower = own_pixel(pixel_place(view, tile, own + SIDE * PART / 2), images, adjoints)
        upper_state = upper.state
        lower_state = lower.state
        to_upper = Channels()
        to_lower = Channels()
        if upper.index >= 0:
            to_upper = channel_adjoints[upper.index]
        if lower.index >= 0:
            to_lower = channel_adjoints[lower.index]
        own_end = greatest_of_lanes(wp.max(upper.end, lower.end))
        end = greatest_of_block(own_end)
        while end > listed_range[0]:
            mine = end - 1 - lane
            slot = int(-1)
            splat = int(-1)
            if mine >= listed_range[0]:
                slot = frame.lists.slots[mine]
                splat = frame.lists.splats[mine]
                share_splat(part, lane, frame, channels, splat)
                frame.lists.summed[slot] = wp.uint8(1)
            sum_block(BEGIN_SUMS, slot, Pair(), out_pairs)
            wait_for_block()
            wanted = int(0)
            if splat >= 0 and mine < own_end:
                wanted = reaches(
                    share_row(0, CENTER, lane, wp.vec4()),
                    share_row(0, SHAPE, lane, wp.vec4()),
                    box.position,
                    PART,
                    PART,
                )
            waiting = ballot(wanted)
            while waiting != 0:
                i = lowest_lane(waiting)
                waiting = waiting & (waiting - 1)
                k = end - 1 - i
                drawn = SplatRow()
                drawn.center = share_row(0, CENTER, i, wp.vec4())
                drawn.shape = share_row(0, SHAPE, i, wp.vec4())
                above = sight_of(drawn.center, drawn.shape, upper.position)
                below = sight_of(drawn.center, drawn.shape, lower.position)
                in_upper = k < upper.end and above.log_alpha >= -LOG_CUT
                in_lower = k < lower.end and below.log_alpha >= -LOG_CUT
                if ballot(wp.where(in_upper or in_lower, 1, 0)) == 0:
                    continue
                drawn.slope = share_row(0, SLOPE, i, wp.vec4())
                if wp.static(exact):
                    drawn.bend = share_row(0, BEND, i, wp.vec4())[0]
                row = share_channels(0, i, channels, 0)
                total = Pair()
                upper_alpha = wp.where(in_upper, alpha_of(above.log_alpha), 0.0)
                lower_alpha = wp.where(in_lower, alpha_of(below.log_alpha), 0.0)
                total, upper_state = add_pixel(
                    total, upper_state, to_upper, drawn, row, frame.near, above, upper_alpha, k == upper.median
                )
                total, lower_state = add_pixel(
                    total, lower_state, to_lower, drawn, row, frame.near, below, lower_alpha, k == lower.median
                )
                sum_block(ADD_TO_SUMS, i, total, out_pairs)
            wait_for_block()
            sum_block(END_SUMS, 0, Pair(), out_pairs)
            wait_for_block()
            end -= LANES

    return composite_blocks_adjoint_kernel


def launch_composite_adjoint_cuda(frame, channels, exact, images, channel_adjoints, adjoints, out_pairs, device):
    """Write the moments and channels of a band's pairs into their slots."""
    launch(
        composite_adjoint_cuda_kernel(channels.dtype._length_, exact),
        (frame.band.end_tile - frame.band.first_tile) * THREADS,
        inputs=[frame, channels, images, channel_adjoints, adjoints],
        outputs=[out_pairs],
        device=device,
        block_dim=32 * WARPS,
    )
