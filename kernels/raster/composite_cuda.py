"""Compositing on CUDA: a tile a block, 8 x 8 pixels a warp, two a lane, one below the other.

The block sorts its tile's list, as far as its pixels look, and marks which warps each splat reaches. Then each warp
goes through what is marked for it by itself: 32 splats at once are brought to shared memory, and it composites them,
one after the other. Two pixels of a lane share what a splat costs to read, and what depends on their column alone. A
small splat reaches only the upper or only the lower pixels of a warp, and costs the others nothing. The block is done
when all its pixels are. Where checkpoints are asked for, a warp notes what its pixels have come to before each
`STRIDE` splats but the first.

A small image has too few tiles to keep a GPU busy, and the longest list says how long it takes. Its warps have 8 x 4
pixels, one a lane: twice as many warps, of which each has fewer splats to go through. The bits are the same.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.constants import TRANSMITTANCE_STOP
from beam_warp.kernels.common.lanes import (
    CHANNELS,
    PUT_CHANNELS,
    PUT_ROW,
    any_of_block,
    ballot,
    share_splats_functions,
    wait_for_block,
    wait_for_warp,
)
from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.bin_tiles import SIDE, TILE
from beam_warp.kernels.raster.composite import (
    Checkpoints,
    Images,
    PixelPlace,
    RasterFrame,
    channel_vector,
    pixel_below,
    pixel_place,
)
from beam_warp.kernels.raster.project import LOG_CUT
from beam_warp.kernels.raster.sort_entries_cuda import sort_entries_function
from beam_warp.kernels.raster.splat_rows import (
    MEDIAN,
    alpha_of,
    behind,
    limited_depth,
    log_alpha_of,
    nearness_function,
    nearness_limits,
    offset_from,
    whiten,
)
from beam_warp.kernels.raster.strided_rows import load_row
from beam_warp.kernels.raster.warp_lists_cuda import LANES, box_of, warp_lists_functions

PART = wp.constant(8)
"""Width of the pixels of a warp; with two a lane their height, too."""

STRIDE = wp.constant(256)
"""Entries of a list between two checkpoints, a multiple of a warp's lanes."""

THREADS_HELD = 768
"""Threads that a multiprocessor should hold at least: they limit registers."""

MOST_SHARED = 20
"""Channels, and four numbers of a bend, of which the splats of 256 threads do not fit into shared memory."""

CENTER, SHAPE, SLOPE, BEND = (wp.constant(k) for k in range(4))


@wp.struct
class PixelSums:
    """What one of the pixels of a lane has come to, but for its channels; -1 stands for no place in the lists."""

    depth: float
    weight: float
    transmittance: float
    median_depth: float
    median: int
    last: int


@wp.func
def begin_pixel(place: PixelPlace) -> PixelSums:
    """A pixel before its first splat; outside the image nothing is seen in it."""
    sums = PixelSums()
    sums.transmittance = wp.where(place.index < 0, 0.0, 1.0)
    sums.median = -1
    sums.last = -1
    return sums


@wp.func
def looks(sums: PixelSums) -> int:
    """1 if a pixel still looks further."""
    return wp.where(sums.transmittance >= TRANSMITTANCE_STOP, 1, 0)


@wp.func
def end_pixel(place: PixelPlace, sums: PixelSums, frame: RasterFrame, begin: int, out_images: Images):
    """Write a pixel's images but for its channels; ``begin`` is where its tile's list begins."""
    pixel = place.index
    if pixel >= 0:
        gaussian = int(-1)
        end = begin
        if sums.last >= 0:
            gaussian = frame.lists.splats[sums.last] % frame.gaussian_count
            end = sums.last + 1
        out_images.alpha[pixel] = sums.weight
        out_images.transmittance[pixel] = sums.transmittance
        out_images.depth[pixel] = wp.where(sums.weight > 0.0, sums.depth / sums.weight, 0.0)
        out_images.median_depth[pixel] = sums.median_depth
        out_images.gaussians[pixel] = gaussian
        out_images.ends[pixel] = end
        out_images.medians[pixel] = sums.median


@cache
def add_splat_function(channel_count: int, colored: bool):
    """Return the function that gives a pixel, and its channels, after the splat at a place in the lists."""
    Channels = channel_vector(channel_count)

    @wp.func
    def add_splat(sums: PixelSums, total: Channels, seen: bool, log_alpha: float, z: float, row: Channels, at: int):
        # No branch: it would cost a selection for every variable that it changes.
        alpha = wp.where(seen, alpha_of(log_alpha), 0.0)
        weight = alpha * sums.transmittance
        if wp.static(colored):
            total += row * weight
        sums.depth += z * weight
        sums.weight += weight
        sums.last = wp.where(seen, at, sums.last)
        nearer = seen and sums.transmittance > MEDIAN
        sums.median_depth = wp.where(nearer, z, sums.median_depth)
        sums.median = wp.where(nearer, at, sums.median)
        sums.transmittance = behind(sums.transmittance, alpha)
        return sums, total

    return add_splat


@cache
def composite_cuda_kernel(channel_count: int, exact: bool, colored: bool = True, pixels: int = 2):
    """Return the kernel that composites ``channel_count`` channels, or none, for ``pixels`` an item, one or two.

    Shadow maps show depth alone, uncoloured. Channels then stay what they were: 0.
    """
    Channels = channel_vector(channel_count)
    nearness_at = nearness_function(exact)
    threads = TILE * TILE // pixels
    share, shared_row = share_splats_functions(Channels, 4 if exact else 3, threads)
    sort_entries = sort_entries_function(threads)
    add_splat = add_splat_function(channel_count, colored)
    rows = LANES // PART
    both = pixels == 2
    put_box, mark, queue, queued, splat_of = warp_lists_functions(threads)

    @wp.kernel(
        enable_backward=False, module="unique", launch_bounds=(threads, THREADS_HELD // threads), grid_stride=False
    )
    def composite_blocks_kernel(
        first: int,
        frame: RasterFrame,
        channels: wp.array[Channels],
        out_channels: wp.array[Channels],
        out_images: Images,
        out_checkpoints: Checkpoints,
        out_passed: wp.array[Channels],
    ):
        item = first + wp.tid()
        thread = item % threads
        lane = item % LANES
        part = thread / LANES
        listed = frame.lists.order[item / threads]
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        column = part % 2 * PART
        row = part / 2 * wp.static(rows * pixels)
        within = (row + lane / PART) * SIDE + column + lane % PART
        upper_place = pixel_place(view, tile, within)
        lower_place = PixelPlace()
        lower_place.index = -1
        if wp.static(both):
            lower_place = pixel_below(view, tile, within, wp.static(rows), upper_place)
        upper = begin_pixel(upper_place)
        lower = begin_pixel(lower_place)
        upper_total = Channels()
        lower_total = Channels()
        listed_range = frame.lists.ranges[listed]
        begin = listed_range[0]
        sorted_end = int(begin)
        while begin < listed_range[1]:
            sorted_end = sort_entries(
                frame.lists.entries,
                listed_range[0],
                begin,
                listed_range[1],
                frame.lists.parted,
                frame.lists.splats,
                frame.lists.ranks,
                frame.lists.rank_bits,
            )
            upper_looks = ballot(looks(upper))
            lower_looks = int(0)
            if wp.static(both):
                lower_looks = ballot(looks(lower))
            box = box_of(upper_looks, lower_looks)
            put_box(part, lane, column, row, box)
            wait_for_block()
            mark(frame.lists, frame.splats, pixel_place(view, tile, 0).position, begin, sorted_end, thread)
            wait_for_block()
            place = begin
            stop = begin
            head = int(0)
            tail = int(0)
            while place < sorted_end or head < tail:
                if ballot(wp.max(looks(upper), looks(lower))) == 0:
                    place = sorted_end
                    tail = head
                    continue
                if place == stop and head == tail:
                    stop = sorted_end
                    if out_checkpoints.tiles.shape[0] > 0:
                        passed_by = place - listed_range[0]
                        stop = wp.min(stop, place + STRIDE - passed_by % STRIDE)
                        if passed_by > 0 and passed_by % STRIDE == 0:
                            noted = place / STRIDE * SIDE * SIDE + within
                            out_checkpoints.tiles[place / STRIDE] = listed + 1
                            out_checkpoints.states[noted] = wp.vec4(upper.transmittance, upper.weight, upper.depth, 0.0)
                            out_passed[noted] = upper_total
                            if wp.static(both):
                                noted += wp.static(rows) * SIDE
                                state = wp.vec4(lower.transmittance, lower.weight, lower.depth, 0.0)
                                out_checkpoints.states[noted] = state
                                out_passed[noted] = lower_total
                filled = queue(part, lane, begin, place, stop, head, tail)
                place = filled[0]
                tail = filled[1]
                wait_for_warp()  # also until all its lanes are done with what was drawn before
                i = part * LANES
                end = i + wp.min(tail - head, LANES)
                mine = i + lane
                if mine < end:
                    k = queued(part, head + lane)
                    splat = splat_of(frame.lists, begin, k)
                    center = load_row(frame.splats.centers, splat)
                    shape = load_row(frame.splats.shapes, splat)
                    slope = load_row(frame.splats.slopes, splat)
                    limits = nearness_limits(center, shape, frame.near)
                    if wp.static(exact):
                        bend = wp.vec4(frame.splats.bends[splat], 0.0, limits[0], limits[1])
                        share(PUT_ROW, BEND, mine, bend, channels, 0)
                    else:
                        slope = wp.vec4(slope[0], slope[1], limits[0], limits[1])
                    # The limits hold what the thickness was for; its place is the splat's in the lists.
                    shape = wp.vec4(shape[0], shape[1], shape[2], wp.cast(begin + k, float))
                    share(PUT_ROW, CENTER, mine, center, channels, 0)
                    share(PUT_ROW, SHAPE, mine, shape, channels, 0)
                    share(PUT_ROW, SLOPE, mine, slope, channels, 0)
                    if wp.static(colored):
                        share(PUT_CHANNELS, 0, mine, wp.vec4(), channels, splat)
                head += end - i
                wait_for_warp()
                while i < end:
                    k = i
                    i += 1
                    drawn = shared_row(CENTER, k, channels)
                    drawn_shape = shared_row(SHAPE, k, channels)
                    above = offset_from(drawn, upper_place.position)
                    log_above = log_alpha_of(drawn, whiten(drawn_shape, above))
                    in_upper = upper.transmittance >= TRANSMITTANCE_STOP and log_above >= -LOG_CUT
                    draws_upper = ballot(wp.where(in_upper, 1, 0))
                    draws_lower = int(0)
                    if wp.static(both):
                        below = offset_from(drawn, lower_place.position)
                        log_below = log_alpha_of(drawn, whiten(drawn_shape, below))
                        in_lower = lower.transmittance >= TRANSMITTANCE_STOP and log_below >= -LOG_CUT
                        draws_lower = ballot(wp.where(in_lower, 1, 0))
                    if (draws_upper | draws_lower) == 0:
                        continue
                    at = wp.cast(drawn_shape[3], int)
                    slope = shared_row(SLOPE, k, channels)
                    bounds = slope
                    if wp.static(exact):
                        bounds = shared_row(BEND, k, channels)
                    limits = wp.vec2(bounds[2], bounds[3])
                    row_of = Channels()
                    if wp.static(colored):
                        row_of = share(CHANNELS, 0, k, wp.vec4(), channels, 0)
                    # Loops of one round: a branch would cost a selection for every variable that it changes.
                    while draws_upper != 0:
                        draws_upper = 0
                        z = limited_depth(drawn[3], limits, nearness_at(slope, bounds[0], above))
                        upper, upper_total = add_splat(upper, upper_total, in_upper, log_above, z, row_of, at)
                    if wp.static(both):
                        while draws_lower != 0:
                            draws_lower = 0
                            z = limited_depth(drawn[3], limits, nearness_at(slope, bounds[0], below))
                            lower, lower_total = add_splat(lower, lower_total, in_lower, log_below, z, row_of, at)
            begin = sorted_end
            if any_of_block(wp.max(looks(upper), looks(lower))) == 0:
                begin = listed_range[1]
        if thread == 0:
            frame.lists.ends[listed] = sorted_end
        end_pixel(upper_place, upper, frame, listed_range[0], out_images)
        if wp.static(both):
            end_pixel(lower_place, lower, frame, listed_range[0], out_images)
        if wp.static(colored):
            if upper_place.index >= 0:
                out_channels[upper_place.index] = upper_total
            if lower_place.index >= 0:
                out_channels[lower_place.index] = lower_total

    return composite_blocks_kernel


def launch_composite_cuda(
    frame, channels, exact, colored, few_tiles, out_channels, out_images, out_checkpoints, out_passed, device
):
    """Composite a band on a CUDA device; checkpoints' sums of channels are ``out_passed``.

    Where there are ``few_tiles`` a lane has one pixel, unless so many splats of that many numbers, twice those of two
    pixels a lane, need more shared memory than the 48 KB that a block has everywhere.
    """
    channel_count = channels.dtype._length_
    pixels = 1 if few_tiles and channel_count + 4 * exact < MOST_SHARED else 2
    threads = TILE * TILE // pixels
    launch(
        composite_cuda_kernel(channel_count, exact, colored, pixels),
        (frame.band.end_tile - frame.band.first_tile) * threads,
        inputs=[frame, channels],
        outputs=[out_channels, out_images, out_checkpoints, out_passed],
        device=device,
        block_dim=threads,
    )
