"""Compositing on CUDA: a tile a block, 8 x 4 pixels a warp, a pixel a lane.

The block sorts its tile's list, as far as its pixels look, and brings `THREADS` splats at a time to shared memory. The
lanes of a warp look at 32 of these at once: which reach the warp's pixels? The warp composites those, one after the
other. The block is done when all its pixels are. Where checkpoints are asked for, it notes what its pixels have come to
before each `STRIDE` splats but the first.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.constants import TRANSMITTANCE_STOP
from beam_warp.kernels.common.lanes import (
    any_of_block,
    ballot,
    lowest_lane,
    share_channels_function,
    share_row_function,
    wait_for_block,
)
from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.raster.bin_tiles import SIDE
from beam_warp.kernels.raster.composite import Checkpoints, Images, RasterFrame, channel_vector, pixel_place
from beam_warp.kernels.raster.project import LOG_CUT
from beam_warp.kernels.raster.splat_rows import (
    EXTENT_MARGIN,
    MEDIAN,
    RELATIVE_MARGIN,
    alpha_of,
    depth_limits,
    limited_depth_function,
    log_alpha_of,
    offset_from,
    quick_divide,
    squared_extent,
    whiten,
)
from beam_warp.kernels.raster.tile_lists_cuda import THREADS, sort_entries

LANES = wp.constant(32)
WIDTH = wp.constant(8)
HEIGHT = wp.constant(4)
"""Pixels of a warp."""

STRIDE = THREADS
"""Entries of a list between two checkpoints: those that are brought to shared memory at a time."""

BLOCKS = 4
"""Blocks that a multiprocessor should hold at least: they limit registers."""

NOWHERE = wp.constant(wp.vec4(0.0, 0.0, -1.0e30, 0.0))
"""Centre of what reaches no pixel."""

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


@cache
def composite_cuda_kernel(channel_count: int, exact: bool, colored: bool = True):
    """Return the kernel that composites ``channel_count`` channels, an item a pixel; unless ``colored``, none of them.

    Shadow maps show depth alone. Channels then stay what they were: 0.
    """
    Channels = channel_vector(channel_count)
    depth_at = limited_depth_function(exact)
    share_row = share_row_function(4 if exact else 3, THREADS)
    share_channels = share_channels_function(Channels, THREADS)

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=(THREADS, BLOCKS), grid_stride=False)
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
        thread = item % THREADS
        lane = thread % LANES
        listed = frame.lists.order[item / THREADS]
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        part = thread / LANES
        corner = part / (SIDE / WIDTH) * HEIGHT * SIDE + part % (SIDE / WIDTH) * WIDTH
        box = pixel_place(view, tile, corner).position
        within = corner + lane / WIDTH * SIDE + lane % WIDTH
        place = pixel_place(view, tile, within)
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
        sorted_end = listed_range[0]
        while begin < listed_range[1]:
            if begin == sorted_end:
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
            count = wp.min(sorted_end - begin, THREADS)
            if out_checkpoints.tiles.shape[0] > 0:
                strayed = (begin - listed_range[0]) % STRIDE
                if strayed != 0:  # by the end of what was sorted: the next stride begins as it should
                    count = wp.min(count, STRIDE - strayed)
                elif begin > listed_range[0]:
                    row = begin / STRIDE * SIDE * SIDE + within
                    out_checkpoints.tiles[begin / STRIDE] = listed + 1
                    out_checkpoints.states[row] = wp.vec4(transmittance, weight_sum, depth, 0.0)
                    out_passed[row] = total
            splat = int(-1)
            center = NOWHERE
            if thread < count:
                splat = frame.lists.splats[begin + thread]
            if splat >= 0:
                center = load_row(frame.splats.centers, splat)
                shape = load_row(frame.splats.shapes, splat)
                limits = depth_limits(center, shape, frame.near)
                slope = load_row(frame.splats.slopes, splat)
                if wp.static(exact):
                    share_row(1, BEND, thread, wp.vec4(frame.splats.bends[splat], 0.0, limits[0], limits[1]))
                else:
                    slope = wp.vec4(slope[0], slope[1], limits[0], limits[1])
                share_row(1, SHAPE, thread, shape)
                share_row(1, SLOPE, thread, slope)
                if wp.static(colored):
                    share_channels(1, thread, channels, splat)
            share_row(1, CENTER, thread, center)
            wait_for_block()
            group = int(0)
            while group < count:
                waiting = int(0)
                if ballot(wp.where(transmittance >= TRANSMITTANCE_STOP, 1, 0)) != 0:
                    found = share_row(0, CENTER, group + lane, wp.vec4())
                    waiting = ballot(reaches(found, share_row(0, SHAPE, group + lane, wp.vec4()), box, WIDTH, HEIGHT))
                while waiting != 0:
                    i = group + lowest_lane(waiting)
                    waiting = waiting & (waiting - 1)
                    drawn = share_row(0, CENTER, i, wp.vec4())
                    drawn_shape = share_row(0, SHAPE, i, wp.vec4())
                    offset = offset_from(drawn, place.position)
                    log_alpha = log_alpha_of(drawn, whiten(drawn_shape, offset))
                    seen = transmittance >= TRANSMITTANCE_STOP and log_alpha >= -LOG_CUT
                    if ballot(wp.where(seen, 1, 0)) == 0:
                        continue
                    # No branches from here on: each would cost a selection for every variable that it changes.
                    alpha = wp.where(seen, alpha_of(log_alpha), 0.0)
                    weight = alpha * transmittance
                    slope = share_row(0, SLOPE, i, wp.vec4())
                    bounds = slope
                    if wp.static(exact):
                        bounds = share_row(0, BEND, i, wp.vec4())
                    z = depth_at(drawn[3], wp.vec2(bounds[2], bounds[3]), slope, bounds[0], offset)
                    if wp.static(colored):
                        total += share_channels(0, i, channels, 0) * weight
                    depth += z * weight
                    weight_sum += weight
                    last = wp.where(seen, begin + i, last)
                    nearer = seen and transmittance > MEDIAN
                    median_depth = wp.where(nearer, z, median_depth)
                    median = wp.where(nearer, begin + i, median)
                    transmittance *= 1.0 - alpha
                group += LANES
            begin += count
            if any_of_block(wp.where(transmittance >= TRANSMITTANCE_STOP, 1, 0)) == 0:
                begin = listed_range[1]
        if pixel >= 0:
            gaussian = int(-1)
            end = listed_range[0]
            if last >= 0:
                gaussian = frame.lists.splats[last] % frame.gaussian_count
                end = last + 1
            if wp.static(colored):
                out_channels[pixel] = total
            out_images.alpha[pixel] = weight_sum
            out_images.transmittance[pixel] = transmittance
            out_images.depth[pixel] = wp.where(weight_sum > 0.0, depth / weight_sum, 0.0)
            out_images.median_depth[pixel] = median_depth
            out_images.gaussians[pixel] = gaussian
            out_images.ends[pixel] = end
            out_images.medians[pixel] = median

    return composite_blocks_kernel


def launch_composite_cuda(
    frame, channels, exact, colored, out_channels, out_images, out_checkpoints, out_passed, device
):
    """Composite a band on a CUDA device; checkpoints get their sums of channels in ``out_passed``."""
    launch(
        composite_cuda_kernel(channels.dtype._length_, exact, colored),
        (frame.band.end_tile - frame.band.first_tile) * SIDE * SIDE,
        inputs=[frame, channels],
        outputs=[out_channels, out_images, out_checkpoints, out_passed],
        device=device,
        block_dim=THREADS,
    )
