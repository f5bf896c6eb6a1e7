"""Compositing on the CPU: a tile's splats one after the other, each on the pixels that it reaches.

A pixel is visited only by splats whose alpha there is at least 1/255 or nearly so, by the interval of each row. What is
known of it lies in one row of memory: a tile is in the cache while its splats are drawn.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.constants import TRANSMITTANCE_STOP
from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.bin_tiles import SIDE
from beam_warp.kernels.raster.composite import Images, RasterFrame, channel_vector
from beam_warp.kernels.raster.project import LOG_CUT, RasterView
from beam_warp.kernels.raster.splat_rows import (
    MEDIAN,
    RowReach,
    alpha_of,
    behind,
    depth_function,
    end_pixel_at,
    first_pixel_from,
    log_alpha_of,
    offset_from,
    reach_row,
    reach_rows,
    row_reach,
    squared_extent,
    whiten,
)

MIN_TILES = 4
"""Fewest tiles of one launch."""


@wp.func
def tile_pixels(view: RasterView, tile: int) -> wp.vec4i:
    """First x, first y, end x and end y of a tile's pixels."""
    local = tile - view.first_tile
    x = (local % view.columns) * SIDE
    y = (local / view.columns) * SIDE
    return wp.vec4i(x, y, wp.min(x + SIDE, view.width), wp.min(y + SIDE, view.height))


@wp.func
def rows_in(box: wp.vec4i, center: wp.vec4, shape: wp.vec4) -> wp.vec2i:
    """First and end y of a box's pixels that a splat reaches."""
    reach = reach_rows(shape, squared_extent(center[2]))
    return wp.vec2i(
        wp.max(first_pixel_from(center[1] - reach, box[3]), box[1]), end_pixel_at(center[1] + reach, box[3])
    )


@wp.func
def columns_in(box: wp.vec4i, center: wp.vec4, row: RowReach, y: int) -> wp.vec2i:
    """First and end x of a box's pixels that a splat reaches in a row."""
    columns = reach_row(row, float(y) + 0.5 - center[1])
    return wp.vec2i(
        wp.max(first_pixel_from(center[0] + columns[0], box[2]), box[0]), end_pixel_at(center[0] + columns[1], box[2])
    )


@cache
def composite_cpu_kernel(channel_count: int, exact: bool):
    """Return the kernel that composites ``channel_count`` channels, one tile an item."""
    Channels = channel_vector(channel_count)
    depth_at = depth_function(exact)

    @wp.kernel(enable_backward=False, module="unique")
    def composite_tiles_kernel(
        first: int,
        frame: RasterFrame,
        channels: wp.array[Channels],
        out_channels: wp.array[Channels],
        out_images: Images,
    ):
        listed = first + wp.tid()
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        box = tile_pixels(view, tile)
        listed_range = frame.lists.ranges[listed]
        # A pixel's state: what passes, the sums of weights and of weighted depths, the median depth.
        for y in range(box[1], box[3]):
            for x in range(box[0], box[2]):
                pixel = view.first_pixel + y * view.width + x
                out_channels[pixel] = Channels()
                out_images.states[pixel] = wp.vec4(1.0, 0.0, 0.0, 0.0)
                out_images.ends[pixel] = listed_range[0]
                out_images.medians[pixel] = -1
        open_pixels = (box[2] - box[0]) * (box[3] - box[1])
        for k in range(listed_range[0], listed_range[1]):
            if open_pixels == 0:
                break
            splat = frame.lists.splats[k]
            center = frame.splats.centers[splat]
            shape = frame.splats.shapes[splat]
            slope = frame.splats.slopes[splat]
            bend = frame.splats.bends[splat]
            row = channels[splat]
            rows = rows_in(box, center, shape)
            reach = row_reach(shape, squared_extent(center[2]))
            for y in range(rows[0], rows[1]):
                columns = columns_in(box, center, reach, y)
                start = view.first_pixel + y * view.width
                for x in range(columns[0], columns[1]):
                    pixel = start + x
                    state = out_images.states[pixel]
                    transmittance = state[0]
                    if not (transmittance >= TRANSMITTANCE_STOP):
                        continue
                    offset = offset_from(center, wp.vec2(float(x) + 0.5, float(y) + 0.5))
                    log_alpha = log_alpha_of(center, whiten(shape, offset))
                    if not (log_alpha >= -LOG_CUT):
                        continue
                    alpha = alpha_of(log_alpha)
                    weight = alpha * transmittance
                    z = depth_at(center, shape, slope, bend, frame.near, offset)
                    out_channels[pixel] = out_channels[pixel] + row * weight
                    median = state[3]
                    if transmittance > MEDIAN:
                        median = z
                        out_images.medians[pixel] = k
                    out_images.ends[pixel] = k + 1
                    transmittance = behind(transmittance, alpha)
                    out_images.states[pixel] = wp.vec4(transmittance, state[1] + weight, state[2] + z * weight, median)
                    if transmittance < TRANSMITTANCE_STOP:
                        open_pixels -= 1
        for y in range(box[1], box[3]):
            for x in range(box[0], box[2]):
                pixel = view.first_pixel + y * view.width + x
                state = out_images.states[pixel]
                depth = float(0.0)
                gaussian = int(-1)
                if state[1] > 0.0:
                    depth = state[2] / state[1]
                    gaussian = frame.lists.splats[out_images.ends[pixel] - 1] % frame.gaussian_count
                out_images.transmittance[pixel] = state[0]
                out_images.alpha[pixel] = state[1]
                out_images.depth[pixel] = depth
                out_images.median_depth[pixel] = state[3]
                out_images.gaussians[pixel] = gaussian

    return composite_tiles_kernel


def launch_composite_cpu(frame, channels, exact, out_channels, out_images, device):
    """Composite a band, one tile an item."""
    launch(
        composite_cpu_kernel(channels.dtype._length_, exact),
        frame.band.end_tile - frame.band.first_tile,
        inputs=[frame, channels],
        outputs=[out_channels, out_images],
        device=device,
        min_chunk=MIN_TILES,
    )
