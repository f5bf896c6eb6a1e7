"""Back-projection of pixels to the splats that they see on the CPU: a tile's splats one after the other.

A pair of tile and splat gets the sum over the tile's pixels of blending weight times what they hold: the transpose of
`composite_cpu`, with its weights.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.composite import Images, RasterFrame, channel_vector
from beam_warp.kernels.raster.composite_cpu import MIN_TILES, columns_in, rows_in, tile_pixels
from beam_warp.kernels.raster.project import LOG_CUT
from beam_warp.kernels.raster.splat_rows import (
    alpha_of,
    behind,
    log_alpha_of,
    offset_from,
    row_reach,
    squared_extent,
    whiten,
)


@cache
def back_project_cpu_kernel(channel_count: int):
    """Return the kernel that writes ``channel_count`` sums for every pair, one tile an item."""
    Channels = channel_vector(channel_count)

    @wp.kernel(enable_backward=False, module="unique")
    def back_project_tiles_kernel(
        first: int, frame: RasterFrame, images: Images, pixels: wp.array[Channels], out_pairs: wp.array[Channels]
    ):
        listed = first + wp.tid()
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        box = tile_pixels(view, tile)
        listed_range = frame.lists.ranges[listed]
        if listed_range[0] == listed_range[1]:
            return
        # A pixel's state is what passes before the splats still to come.
        end = listed_range[0]
        for y in range(box[1], box[3]):
            for x in range(box[0], box[2]):
                pixel = view.first_pixel + y * view.width + x
                images.states[pixel] = wp.vec4(1.0, 0.0, 0.0, 0.0)
                end = wp.max(end, images.ends[pixel])
        for k in range(end, listed_range[1]):
            out_pairs[frame.lists.slots[k]] = Channels()
        for k in range(listed_range[0], end):
            splat = frame.lists.splats[k]
            center = frame.splats.centers[splat]
            shape = frame.splats.shapes[splat]
            total = Channels()
            rows = rows_in(box, center, shape)
            reach = row_reach(shape, squared_extent(center[2]))
            for y in range(rows[0], rows[1]):
                columns = columns_in(box, center, reach, y)
                start = view.first_pixel + y * view.width
                for x in range(columns[0], columns[1]):
                    pixel = start + x
                    if k >= images.ends[pixel]:
                        continue
                    offset = offset_from(center, wp.vec2(float(x) + 0.5, float(y) + 0.5))
                    log_alpha = log_alpha_of(center, whiten(shape, offset))
                    if not (log_alpha >= -LOG_CUT):
                        continue
                    alpha = alpha_of(log_alpha)
                    transmittance = images.states[pixel][0]
                    total += pixels[pixel] * (alpha * transmittance)
                    images.states[pixel] = wp.vec4(behind(transmittance, alpha), 0.0, 0.0, 0.0)
            out_pairs[frame.lists.slots[k]] = total

    return back_project_tiles_kernel


def launch_back_project_cpu(frame, images, pixels, out_pairs, device):
    """Write the sums of a band's pairs into their slots."""
    launch(
        back_project_cpu_kernel(pixels.dtype._length_),
        frame.band.end_tile - frame.band.first_tile,
        inputs=[frame, images, pixels],
        outputs=[out_pairs],
        device=device,
        min_chunk=MIN_TILES,
    )
