"""The adjoint of compositing on CUDA: a tile a block, 8 x 8 pixels a warp, two a lane.

The block brings 32 splats at a time to shared memory, back to front. Each warp goes through those that reach its
pixels, sums over them, and leaves its sums; the block adds those of its warps and stores them in the pair's slot. No
atomics, one order of additions, the same bits every run.

A small image has fewer tiles than a GPU has room for blocks, and the longest list would say how long it takes. So with
checkpoints each stride of a list is a block's, which begins with what pixels had come to behind it, as in Mallick et
al. 2024, Taming 3DGS.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.lanes import (
    ADD_TO_SUMS,
    BEGIN_SUMS,
    CHANNELS,
    END_SUMS,
    PUT_CHANNELS,
    PUT_ROW,
    ballot,
    greatest_of_block,
    greatest_of_lanes,
    lowest_lane,
    share_splats_functions,
    sum_block_function,
    wait_for_block,
)
from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.bin_tiles import SIDE
from beam_warp.kernels.raster.composite import (
    Checkpoints,
    Images,
    PixelPlace,
    RasterFrame,
    channel_vector,
    pixel_below,
    pixel_place,
)
from beam_warp.kernels.raster.composite_adjoint import (
    Adjoints,
    PixelState,
    add_pixel_function,
    pair_length,
    pair_vector,
    pixel_adjoint,
)
from beam_warp.kernels.raster.composite_cuda import BEND, CENTER, PART, SHAPE, SLOPE, STRIDE
from beam_warp.kernels.raster.project import LOG_CUT, Splat
from beam_warp.kernels.raster.splat_rows import alpha_of, sight_of
from beam_warp.kernels.raster.strided_rows import load_row
from beam_warp.kernels.raster.warp_lists_cuda import LANES, reaches

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
def cut_function(channel_count: int):
    """Return the function that ends a pixel's list where its block's stride ends, if the pixel looked further."""
    Channels = channel_vector(channel_count)

    @wp.func
    def cut(
        pixel: OwnPixel,
        stop: int,
        noted: int,
        images: Images,
        drawn: wp.array[Channels],
        to_channels: Channels,
        checkpoints: Checkpoints,
        passed: wp.array[Channels],
    ) -> OwnPixel:
        if pixel.end > stop:
            i = pixel.index
            held = checkpoints.states[noted]
            adjoint = pixel.state.adjoint
            behind = wp.dot(drawn[i] - passed[noted], to_channels)
            behind += (images.alpha[i] - held[1]) * adjoint[0]
            behind += (images.depth[i] * images.alpha[i] - held[2]) * adjoint[1]
            pixel.state.behind = behind
            pixel.state.transmittance = held[0]
            pixel.end = stop
        return pixel

    return cut


@cache
def share_splat_function(channel_count: int, exact: bool):
    """Return the function that brings a splat to shared memory, a part of it by each warp."""
    Channels = channel_vector(channel_count)
    share, _ = share_splats_functions(Channels, 4 if exact else 3, LANES)

    @wp.func
    def share_splat(part: int, lane: int, frame: RasterFrame, channels: wp.array[Channels], splat: int):
        if part == 0:
            share(PUT_ROW, CENTER, lane, load_row(frame.splats.centers, splat), channels, 0)
        if part == 1:
            share(PUT_ROW, SHAPE, lane, load_row(frame.splats.shapes, splat), channels, 0)
        if part == 2:
            share(PUT_ROW, SLOPE, lane, load_row(frame.splats.slopes, splat), channels, 0)
        if part == 3:
            share(PUT_CHANNELS, 0, lane, wp.vec4(), channels, splat)
            if wp.static(exact):
                share(PUT_ROW, BEND, lane, wp.vec4(frame.splats.bends[splat], 0.0, 0.0, 0.0), channels, 0)

    return share_splat


@cache
def composite_adjoint_cuda_kernel(channel_count: int, exact: bool):
    """Return the kernel that writes the moments and channels of every pair, a block a tile or a stride of its list."""
    Channels = channel_vector(channel_count)
    Pair = pair_vector(channel_count, exact)
    add_pixel = add_pixel_function(channel_count, exact)
    share, shared_row = share_splats_functions(Channels, 4 if exact else 3, LANES)
    share_splat = share_splat_function(channel_count, exact)
    cut = cut_function(channel_count)
    sum_block = sum_block_function(pair_length(channel_count, exact), WARPS)

    @wp.kernel(enable_backward=False, module="unique")
    def composite_blocks_adjoint_kernel(
        first: int,
        frame: RasterFrame,
        channels: wp.array[Channels],
        images: Images,
        drawn_channels: wp.array[Channels],
        channel_adjoints: wp.array[Channels],
        adjoints: Adjoints,
        checkpoints: Checkpoints,
        passed: wp.array[Channels],
        out_pairs: wp.array[Pair],
    ):
        item = first + wp.tid()
        thread = item % THREADS
        lane = item % LANES
        part = thread / LANES
        block = item / THREADS
        tile_count = frame.band.end_tile - frame.band.first_tile
        listed = int(0)
        begin = int(0)
        if block < tile_count:
            listed = frame.lists.order[block]
            begin = frame.lists.ranges[listed][0]
        else:
            checkpoint = block - tile_count
            listed = checkpoints.tiles[checkpoint] - 1
            if listed < 0:  # all threads of the block alike
                return
            begin = checkpoint * STRIDE + frame.lists.ranges[listed][0] % STRIDE
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        corner = (part / 2) * PART * SIDE + (part % 2) * PART
        first_center = pixel_place(view, tile, corner).position
        last_center = first_center + wp.vec2(float(PART - 1), float(PART - 1))
        own = corner + (lane / PART) * SIDE + lane % PART
        place = pixel_place(view, tile, own)
        upper = own_pixel(place, images, adjoints)
        lower = own_pixel(pixel_below(view, tile, own, PART / 2, place), images, adjoints)
        to_upper = Channels()
        to_lower = Channels()
        if upper.index >= 0:
            to_upper = channel_adjoints[upper.index]
        if lower.index >= 0:
            to_lower = channel_adjoints[lower.index]
        if checkpoints.tiles.shape[0] > 0:
            stop = begin + STRIDE
            noted = stop / STRIDE * SIDE * SIDE + own
            upper = cut(upper, stop, noted, images, drawn_channels, to_upper, checkpoints, passed)
            noted += SIDE * PART / 2
            lower = cut(lower, stop, noted, images, drawn_channels, to_lower, checkpoints, passed)
        upper_state = upper.state
        lower_state = lower.state
        own_end = greatest_of_lanes(wp.max(upper.end, lower.end))
        end = greatest_of_block(own_end)
        while end > begin:
            mine = end - 1 - lane
            slot = int(-1)
            splat = int(-1)
            if mine >= begin:
                slot = frame.lists.slots[mine]
                splat = frame.lists.splats[mine]
                share_splat(part, lane, frame, channels, splat)
                if slot >= 0:
                    frame.lists.summed[slot] = wp.uint8(1)
            sum_block(BEGIN_SUMS, slot, Pair(), out_pairs)
            wait_for_block()
            wanted = int(0)
            if splat >= 0 and mine < own_end:
                wanted = reaches(
                    shared_row(CENTER, lane, channels), shared_row(SHAPE, lane, channels), first_center, last_center
                )
            waiting = ballot(wanted)
            while waiting != 0:
                i = lowest_lane(waiting)
                waiting = waiting & (waiting - 1)
                k = end - 1 - i
                drawn = Splat()
                drawn.center = shared_row(CENTER, i, channels)
                drawn.shape = shared_row(SHAPE, i, channels)
                above = sight_of(drawn.center, drawn.shape, upper.position)
                below = sight_of(drawn.center, drawn.shape, lower.position)
                in_upper = k < upper.end and above.log_alpha >= -LOG_CUT
                in_lower = k < lower.end and below.log_alpha >= -LOG_CUT
                if ballot(wp.where(in_upper or in_lower, 1, 0)) == 0:
                    continue
                drawn.slope = shared_row(SLOPE, i, channels)
                if wp.static(exact):
                    drawn.bend = shared_row(BEND, i, channels)[0]
                row = share(CHANNELS, 0, i, wp.vec4(), channels, 0)
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


def launch_composite_adjoint_cuda(
    frame, channels, exact, images, drawn_channels, channel_adjoints, adjoints, checkpoints, passed, out_pairs, device
):
    """Write the moments and channels of a band's pairs into their slots."""
    drawn = [images, drawn_channels]
    launch(
        composite_adjoint_cuda_kernel(channels.dtype._length_, exact),
        (frame.band.end_tile - frame.band.first_tile + len(checkpoints.tiles)) * THREADS,
        inputs=[frame, channels, *drawn, channel_adjoints, adjoints, checkpoints, passed],
        outputs=[out_pairs],
        device=device,
        block_dim=32 * WARPS,
    )
