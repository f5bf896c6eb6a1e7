"""What each pixel shows, for CUDA: half a tile a warp, a lane for each pixel.

The lanes look at 32 splats of the tile's list at once, a lane for each: which of them reach the warp's 8 x 4 pixels?
Those the warp then composites, one after the other, on all its pixels. A warp is done when all its pixels are.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.bin_tiles import SIDE
from beam_warp.kernels.composite import (
    Frame,
    Images,
    alpha_of,
    channel_vector,
    depth_function,
    offset_from,
    pixel_place,
)
from beam_warp.kernels.lanes import ballot, from_lane, load_channels_function, lowest_lane
from beam_warp.kernels.launching import launch
from beam_warp.kernels.project import LOG_CUT
from beam_warp.kernels.row_loads import load_row
from beam_warp.kernels.splat_rows import (
    MEDIAN,
    TRANSMITTANCE_STOP,
    log_alpha_at,
    reach_columns,
    reach_rows,
    squared_extent,
)

LANES = wp.constant(32)
HALF = wp.constant(4)
"""Rows of pixels of a warp."""


@wp.func
def reaches(center: wp.vec4, shape: wp.vec4, left: float, top: float) -> int:
    """1 if a splat reaches the pixels from (left, top), the first pixel's centre, to the end of half a tile."""
    squared = squared_extent(center[2])
    y0 = top - center[1]
    y1 = y0 + float(HALF - 1)
    rows = reach_rows(shape, squared)
    if y0 > rows or y1 < -rows:
        return 0
    columns = reach_columns(shape, squared, y0, y1)
    x0 = left - center[0]
    if x0 > columns[1] or x0 + float(SIDE - 1) < columns[0]:
        return 0
    return 1


@cache
def composite_cuda_kernel(channel_count: int, exact: bool):
    """Return the kernel that composites ``channel_count`` channels, 32 items half a tile."""
    Channels = channel_vector(channel_count)
    depth_at = depth_function(exact)
    load_channels = load_channels_function(Channels)

    @wp.kernel(enable_backward=False, module="unique")
    def composite_warps_kernel(
        first: int, frame: Frame, channels: wp.array[Channels], out_channels: wp.array[Channels], out_images: Images
    ):
        item = first + wp.tid()
        lane = item % LANES
        listed = item / (SIDE * SIDE)
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        within = item % (SIDE * SIDE)
        place = pixel_place(view, tile, within)
        pixel = place.index
        corner = pixel_place(view, tile, within - lane)
        total = Channels()
        depth = float(0.0)
        weight_sum = float(0.0)
        transmittance = float(1.0)
        if pixel < 0:
            transmittance = 0.0
        median_depth = float(0.0)
        median = int(-1)
        last = int(-1)
        listed_range = frame.lists.ranges[listed]
        end = listed_range[0]
        begin = listed_range[0]
        while begin < listed_range[1]:
            mine = begin + lane
            splat = int(0)
            wanted = int(0)
            if mine < listed_range[1]:
                splat = frame.lists.splats[mine]
                wanted = reaches(
                    load_row(frame.splats.centers, splat),
                    load_row(frame.splats.shapes, splat),
                    corner.position[0],
                    corner.position[1],
                )
            waiting = ballot(wanted)
            while waiting != 0:
                bit = lowest_lane(waiting)
                waiting = waiting & (waiting - 1)
                drawn = from_lane(splat, bit)
                center = load_row(frame.splats.centers, drawn)
                shape = load_row(frame.splats.shapes, drawn)
                offset = offset_from(center, place.position)
                log_alpha = log_alpha_at(center, shape, offset)
                if transmittance >= TRANSMITTANCE_STOP and log_alpha >= -LOG_CUT:
                    alpha = alpha_of(log_alpha)
                    weight = alpha * transmittance
                    z = depth_at(frame.splats, drawn, center, shape, frame.near, offset)
                    total += load_channels(channels, drawn) * weight
                    depth += z * weight
                    weight_sum += weight
                    if transmittance > MEDIAN:
                        median_depth = z
                        median = begin + bit
                    last = drawn
                    end = begin + bit + 1
                    transmittance *= 1.0 - alpha
            begin += LANES
            if ballot(wp.where(transmittance >= TRANSMITTANCE_STOP, 1, 0)) == 0:
                begin = listed_range[1]
        if pixel >= 0:
            out_channels[pixel] = total
            out_images.alpha[pixel] = weight_sum
            out_images.transmittance[pixel] = transmittance
            out_images.depth[pixel] = wp.where(weight_sum > 0.0, depth / weight_sum, 0.0)
            out_images.median_depth[pixel] = median_depth
            out_images.gaussians[pixel] = wp.where(last >= 0, last % frame.gaussian_count, -1)
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
        block_dim=64,
    )
