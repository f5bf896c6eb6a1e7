"""Compositing on CUDA: a tile a block, 8 x 8 pixels a warp, two a lane, one below the other.

The block sorts its tile's list, as far as its pixels look. Then each warp goes through what was sorted by itself: its
lanes look at 32 splats at once, those that reach its pixels are brought to shared memory, and it composites them, one
after the other. Two pixels of a lane share what a splat costs to read, and what depends on their column alone. The
block is done when all its pixels are. Where checkpoints are asked for, a warp notes what its pixels have come to before
each `STRIDE` splats but the first.

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
    bits_below_lane,
    count_bits,
    share_splats_functions,
    wait_for_warp,
)
from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.raster.bin_tiles import SIDE, TILE, TileLists
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
from beam_warp.kernels.raster.splat_rows import (
    EXTENT_MARGIN,
    MEDIAN,
    RELATIVE_MARGIN,
    alpha_of,
    behind,
    limited_depth,
    log_alpha_of,
    nearness_function,
    nearness_limits,
    offset_from,
    quick_divide,
    squared_extent,
    whiten,
)
from beam_warp.kernels.raster.tile_lists_cuda import sort_entries_function

LANES = wp.constant(32)
PART = wp.constant(8)
"""Width of the pixels of a warp; with two a lane their height, too."""

STRIDE = wp.constant(256)
"""Entries of a list between two checkpoints, a multiple of a warp's lanes."""

THREADS_HELD = 768
"""Threads that a multiprocessor should hold at least: they limit registers."""

NOWHERE = wp.constant(wp.vec4(0.0, 0.0, -1.0e30, 0.0))
"""Centre of what reaches no pixel."""

CENTER, SHAPE, SLOPE, BEND = (wp.constant(k) for k in range(4))


@wp.func
def reaches(center: wp.vec4, shape: wp.vec4, first: wp.vec2, last: wp.vec2) -> int:
    """1 if a splat reaches pixels, ``first`` and ``last`` being the centres of those at the corners of their box.

    Where their box, a little enlarged, does not hold the splat's centre, its least squared whitened distance is on one
    of the two sides that face the centre. No root and no exact quotient is needed.
    """
    x0 = first[0] - center[0]
    y0 = first[1] - center[1]
    x1 = last[0] - center[0]
    y1 = last[1] - center[1]
    farthest = wp.max(wp.max(-x0, x1), wp.max(-y0, y1))
    margin = RELATIVE_MARGIN * farthest + EXTENT_MARGIN
    x0 -= margin
    y0 -= margin
    x1 += margin
    y1 += margin
    x = wp.clamp(0.0, x0, x1)
    y = wp.clamp(0.0, y0, y1)
    across = whiten(shape, wp.vec2(x, wp.clamp(shape[1] * x, y0, y1)))
    e = shape[1] * shape[2]
    nearest = quick_divide(e * shape[2] * y, shape[0] * shape[0] + e * e)
    down = whiten(shape, wp.vec2(wp.clamp(nearest, x0, x1), y))
    least = wp.min(wp.dot(across, across), wp.dot(down, down))
    return wp.where(least <= squared_extent(center[2]), 1, 0)


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


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned long long rows = static_cast<unsigned>(upper) | static_cast<unsigned long long>(lower) << 32;
    unsigned columns = static_cast<unsigned>(upper) | static_cast<unsigned>(lower);
    columns |= columns >> 16;
    columns = (columns | columns >> 8) & 255u;
    return wp::vec4(__ffs(columns) - 1, (__ffsll(rows) - 1) >> 3, 31 - __clz(columns), (63 - __clzll(rows)) >> 3);
#else
    return wp::vec4();
#endif
""")
def box_of(upper: int, lower: int) -> wp.vec4:
    """First column, first row, last column and last row of a warp's pixels whose bits are set, not all of them 0.

    Bits are those of lanes, eight a row; those of ``lower`` are of rows below those of ``upper``.
    """
    ...


@wp.func
def add_splat(sums: PixelSums, seen: bool, alpha: float, weight: float, z: float, at: int) -> PixelSums:
    """A pixel after the splat at a place in the lists; no branch, see where it is called."""
    sums.depth += z * weight
    sums.weight += weight
    sums.last = wp.where(seen, at, sums.last)
    nearer = seen and sums.transmittance > MEDIAN
    sums.median_depth = wp.where(nearer, z, sums.median_depth)
    sums.median = wp.where(nearer, at, sums.median)
    sums.transmittance = behind(sums.transmittance, alpha)
    return sums


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


@wp.func
def listed_splat(lists: TileLists, place: int, end: int) -> int:
    """The splat at a place in the lists; -1 from ``end`` on."""
    splat = int(-1)
    if place < end:
        splat = lists.splats[place]
    return splat


@wp.func
def splat_row(rows: wp.array[wp.vec4], splat: int, otherwise: wp.vec4) -> wp.vec4:
    """The row of a splat, or another one where there is none."""
    row = otherwise
    if splat >= 0:
        row = load_row(rows, splat)
    return row


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
    rows = LANES // PART
    both = pixels == 2

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
        lane = item % LANES
        part = item % threads / LANES
        listed = frame.lists.order[item / threads]
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        corner = part / 2 * wp.static(rows * pixels) * SIDE + part % 2 * PART
        origin = pixel_place(view, tile, corner).position
        within = corner + lane / PART * SIDE + lane % PART
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
        while begin < listed_range[1]:
            sorted_end = sort_entries(
                frame.lists.entries,
                frame.lists.owners,
                listed_range[0],
                begin,
                listed_range[1],
                frame.lists.parted,
                frame.lists.splats,
                frame.lists.slots,
            )
            upper_looks = ballot(looks(upper))
            lower_looks = int(0)
            if wp.static(both):
                lower_looks = ballot(looks(lower))
            box = box_of(upper_looks, lower_looks)
            first_center = wp.vec2(origin[0] + box[0], origin[1] + box[1])
            last_center = wp.vec2(origin[0] + box[2], origin[1] + box[3])
            # Groups begin at multiples of lanes, so that strides do, too, wherever what was sorted ended.
            end = wp.min(begin + LANES - (begin - listed_range[0]) % LANES, sorted_end)
            splat = listed_splat(frame.lists, begin + lane, end)
            center = splat_row(frame.splats.centers, splat, NOWHERE)
            shape = splat_row(frame.splats.shapes, splat, NOWHERE)
            ahead = listed_splat(frame.lists, end + lane, wp.min(end + LANES, sorted_end))
            while begin < sorted_end:
                if ballot(wp.max(looks(upper), looks(lower))) == 0:
                    begin = sorted_end
                    continue
                passed_by = begin - listed_range[0]
                if out_checkpoints.tiles.shape[0] > 0 and passed_by > 0 and passed_by % STRIDE == 0:
                    row = begin / STRIDE * SIDE * SIDE + within
                    out_checkpoints.tiles[begin / STRIDE] = listed + 1
                    out_checkpoints.states[row] = wp.vec4(upper.transmittance, upper.weight, upper.depth, 0.0)
                    out_passed[row] = upper_total
                    if wp.static(both):
                        row += wp.static(rows) * SIDE
                        out_checkpoints.states[row] = wp.vec4(lower.transmittance, lower.weight, lower.depth, 0.0)
                        out_passed[row] = lower_total
                wanted = reaches(center, shape, first_center, last_center)
                waiting = ballot(wanted)
                wait_for_warp()  # until all its lanes are done with the group before
                i = part * LANES
                if wanted != 0:
                    mine = i + bits_below_lane(waiting)
                    limits = nearness_limits(center, shape, frame.near)
                    slope = load_row(frame.splats.slopes, splat)
                    if wp.static(exact):
                        bend = wp.vec4(frame.splats.bends[splat], 0.0, limits[0], limits[1])
                        share(PUT_ROW, BEND, mine, bend, channels, 0)
                    else:
                        slope = wp.vec4(slope[0], slope[1], limits[0], limits[1])
                    # The limits hold what the thickness was for; its place is the splat's in the lists.
                    shape = wp.vec4(shape[0], shape[1], shape[2], wp.cast(begin + lane, float))
                    share(PUT_ROW, CENTER, mine, center, channels, 0)
                    share(PUT_ROW, SHAPE, mine, shape, channels, 0)
                    share(PUT_ROW, SLOPE, mine, slope, channels, 0)
                    if wp.static(colored):
                        share(PUT_CHANNELS, 0, mine, wp.vec4(), channels, splat)
                # What the next groups need is on its way from memory while this one is drawn.
                begin = end
                end = wp.min(begin + LANES, sorted_end)
                splat = ahead
                center = splat_row(frame.splats.centers, splat, NOWHERE)
                shape = splat_row(frame.splats.shapes, splat, NOWHERE)
                ahead = listed_splat(frame.lists, end + lane, wp.min(end + LANES, sorted_end))
                wait_for_warp()
                stop = i + count_bits(waiting)
                while i < stop:
                    k = i
                    i += 1
                    drawn = shared_row(CENTER, k, channels)
                    drawn_shape = shared_row(SHAPE, k, channels)
                    above = offset_from(drawn, upper_place.position)
                    log_above = log_alpha_of(drawn, whiten(drawn_shape, above))
                    in_upper = upper.transmittance >= TRANSMITTANCE_STOP and log_above >= -LOG_CUT
                    seen = in_upper
                    if wp.static(both):
                        below = offset_from(drawn, lower_place.position)
                        log_below = log_alpha_of(drawn, whiten(drawn_shape, below))
                        in_lower = lower.transmittance >= TRANSMITTANCE_STOP and log_below >= -LOG_CUT
                        seen = in_upper or in_lower
                    if ballot(wp.where(seen, 1, 0)) == 0:
                        continue
                    # No branches from here on: each would cost a selection for every variable that it changes.
                    at = wp.cast(drawn_shape[3], int)
                    slope = shared_row(SLOPE, k, channels)
                    bounds = slope
                    if wp.static(exact):
                        bounds = shared_row(BEND, k, channels)
                    limits = wp.vec2(bounds[2], bounds[3])
                    row_of = Channels()
                    if wp.static(colored):
                        row_of = share(CHANNELS, 0, k, wp.vec4(), channels, 0)
                    upper_z = limited_depth(drawn[3], limits, nearness_at(slope, bounds[0], above))
                    upper_alpha = wp.where(in_upper, alpha_of(log_above), 0.0)
                    upper_weight = upper_alpha * upper.transmittance
                    if wp.static(colored):
                        upper_total += row_of * upper_weight
                    upper = add_splat(upper, in_upper, upper_alpha, upper_weight, upper_z, at)
                    if wp.static(both):
                        lower_z = limited_depth(drawn[3], limits, nearness_at(slope, bounds[0], below))
                        lower_alpha = wp.where(in_lower, alpha_of(log_below), 0.0)
                        lower_weight = lower_alpha * lower.transmittance
                        if wp.static(colored):
                            lower_total += row_of * lower_weight
                        lower = add_splat(lower, in_lower, lower_alpha, lower_weight, lower_z, at)
            if any_of_block(wp.max(looks(upper), looks(lower))) == 0:
                begin = listed_range[1]
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
    frame, channels, exact, colored, pixels, out_channels, out_images, out_checkpoints, out_passed, device
):
    """Composite a band on a CUDA device, one pixel or two a lane; checkpoints' sums of channels are ``out_passed``."""
    threads = TILE * TILE // pixels
    launch(
        composite_cuda_kernel(channels.dtype._length_, exact, colored, pixels),
        (frame.band.end_tile - frame.band.first_tile) * threads,
        inputs=[frame, channels],
        outputs=[out_channels, out_images, out_checkpoints, out_passed],
        device=device,
        block_dim=threads,
    )
