"""Compositing on CUDA: 8 x 4 pixels a warp, a lane for each.

The lanes look at 32 splats of the tile's list at once, a lane for each: which of them reach the warp's pixels? Those go
to shared memory, and the warp composites them one after the other on all its pixels. It is done when all pixels are.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.constants import TRANSMITTANCE_STOP
from beam_warp.kernels.common.lanes import (
    ballot,
    lowest_lane,
    share_channels_function,
    share_row_function,
    wait_for_lanes,
)
from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.raster.bin_tiles import SIDE, TileLists
from beam_warp.kernels.raster.composite import Images, RasterFrame, channel_vector, pixel_place
from beam_warp.kernels.raster.project import LOG_CUT
from beam_warp.kernels.raster.splat_rows import (
    EXTENT_MARGIN,
    MEDIAN,
    RELATIVE_MARGIN,
    alpha_of,
    depth_function,
    log_alpha_of,
    offset_from,
    quick_divide,
    squared_extent,
    whiten,
)

LANES = wp.constant(32)
WIDTH = wp.constant(8)
HEIGHT = wp.constant(4)
"""Pixels of a warp."""

WARPS = 4
"""Warps of a block; they share nothing."""

CENTER, SHAPE, SLOPE, BEND = (wp.constant(k) for k in range(4))


@wp.func
def reaches(center: wp.vec4, shape: wp.vec4, first: wp.vec2, width: int, height: int) -> int:
    """1 if a splat reaches a box of pixels, ``first`` being the centre of its first one.

    Where the box, a little enlarged, does not hold the splat's centre, its least squared distance in standard
    deviations is on one of the two sides that face the centre. No root and no exact quotient is needed.
    """
    x0 = first[0] - center[0]
    y0 = first[1] - center[1]
    x1 = x0 + float(width - 1)
    y1 = y0 + float(height - 1)
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


@wp.func
def listed_splat(lists: TileLists, place: int, end: int) -> int:
    """The splat at a place of the lists; any where they end."""
    splat = int(0)
    if place < end:
        splat = lists.splats[place]
    return splat


@cache
def composite_cuda_kernel(channel_count: int, exact: bool):
    """Return the kernel that composites ``channel_count`` channels, an item a pixel."""
    Channels = channel_vector(channel_count)
    depth_at = depth_function(exact)
    share_row = share_row_function(4 if exact else 3, WARPS)
    share_channels = share_channels_function(Channels, WARPS)

    @wp.kernel(enable_backward=False, module="unique")
    def composite_warps_kernel(
        first: int,
        frame: RasterFrame,
        channels: wp.array[Channels],
        out_channels: wp.array[Channels],
        out_images: Images,
    ):
        item = first + wp.tid()
        lane = item % LANES
        listed = frame.lists.order[item / (SIDE * SIDE)]
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        part = (item % (SIDE * SIDE)) / LANES
        corner = ((part / (SIDE / WIDTH)) * HEIGHT) * SIDE + (part % (SIDE / WIDTH)) * WIDTH
        box = pixel_place(view, tile, corner)
        place = pixel_place(view, tile, corner + (lane / WIDTH) * SIDE + lane % WIDTH)
        pixel = place.index
        total = Channels()
        depth = float(0.0)
        weight_sum = float(0.0)
        transmittance = float(1.0)
        if pixel < 0:
            transmittance = 0.0
        median_depth = float(0.0)
        median = int(-1)
        listed_range = frame.lists.ranges[listed]
        last = int(-1)
        begin = listed_range[0]
        # What the lanes look at next is loaded while they composite: a list is as slow as its loads otherwise.
        splat = listed_splat(frame.lists, begin + lane, listed_range[1])
        following = listed_splat(frame.lists, begin + LANES + lane, listed_range[1])
        center = wp.vec4()
        shape = wp.vec4()
        if begin < listed_range[1]:
            center = load_row(frame.splats.centers, splat)
            shape = load_row(frame.splats.shapes, splat)
        while begin < listed_range[1]:
            wanted = int(0)
            if begin + lane < listed_range[1]:
                wanted = reaches(center, shape, box.position, WIDTH, HEIGHT)
                if wanted != 0:
                    share_row(1, CENTER, lane, center)
                    share_row(1, SHAPE, lane, shape)
                    share_row(1, SLOPE, lane, load_row(frame.splats.slopes, splat))
                    if wp.static(exact):
                        share_row(1, BEND, lane, wp.vec4(frame.splats.bends[splat], 0.0, 0.0, 0.0))
                    share_channels(1, lane, channels, splat)
            waiting = ballot(wanted)
            splat = following
            center = load_row(frame.splats.centers, splat)
            shape = load_row(frame.splats.shapes, splat)
            following = listed_splat(frame.lists, begin + 2 * LANES + lane, listed_range[1])
            wait_for_lanes()
            while waiting != 0:
                bit = lowest_lane(waiting)
                waiting = waiting & (waiting - 1)
                drawn = share_row(0, CENTER, bit, wp.vec4())
                drawn_shape = share_row(0, SHAPE, bit, wp.vec4())
                offset = offset_from(drawn, place.position)
                log_alpha = log_alpha_of(drawn, whiten(drawn_shape, offset))
                seen = transmittance >= TRANSMITTANCE_STOP and log_alpha >= -LOG_CUT
                if ballot(wp.where(seen, 1, 0)) == 0:
                    continue
                # No branches from here on: each would cost a selection for every variable that it changes.
                alpha = wp.where(seen, alpha_of(log_alpha), 0.0)
                weight = alpha * transmittance
                bend = float(0.0)
                if wp.static(exact):
                    bend = share_row(0, BEND, bit, wp.vec4())[0]
                z = depth_at(drawn, drawn_shape, share_row(0, SLOPE, bit, wp.vec4()), bend, frame.near, offset)
                total += share_channels(0, bit, channels, 0) * weight
                depth += z * weight
                weight_sum += weight
                last = wp.where(seen, begin + bit, last)
                nearer = seen and transmittance > MEDIAN
                median_depth = wp.where(nearer, z, median_depth)
                median = wp.where(nearer, begin + bit, median)
                transmittance *= 1.0 - alpha
            begin += LANES
            if ballot(wp.where(transmittance >= TRANSMITTANCE_STOP, 1, 0)) == 0:
                begin = listed_range[1]
        if pixel >= 0:
            gaussian = int(-1)
            end = listed_range[0]
            if last >= 0:
                gaussian = frame.lists.splats[last] % frame.gaussian_count
                end = last + 1
            out_channels[pixel] = total
            out_images.alpha[pixel] = weight_sum
            out_images.transmittance[pixel] = transmittance
            out_images.depth[pixel] = wp.where(weight_sum > 0.0, depth / weight_sum, 0.0)
            out_images.median_depth[pixel] = median_depth
            out_images.gaussians[pixel] = gaussian
            out_images.ends[pixel] = end
            out_images.medians[pixel] = median

    return composite_warps_kernel


def launch_composite_cuda(frame, channels, exact, out_channels, out_images, device):
    """Composite a band on a CUDA device."""
    launch(
        composite_cuda_kernel(channels.dtype._length_, exact),
        (frame.band.end_tile - frame.band.first_tile) * SIDE * SIDE,
        inputs=[frame, channels],
        outputs=[out_channels, out_images],
        device=device,
        block_dim=32 * WARPS,
    )
