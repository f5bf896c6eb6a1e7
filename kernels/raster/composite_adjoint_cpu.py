"""The adjoint of compositing on the CPU: a tile's splats back to front, each on the pixels that it reaches."""

from functools import cache

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.composite import Images, RasterFrame, channel_vector
from beam_warp.kernels.raster.composite_adjoint import (
    Adjoints,
    PixelState,
    add_pixel_function,
    pair_vector,
    pixel_adjoint,
)
from beam_warp.kernels.raster.composite_cpu import MIN_TILES, columns_in, rows_in, tile_pixels
from beam_warp.kernels.raster.project import LOG_CUT, Splat
from beam_warp.kernels.raster.splat_rows import alpha_of, row_reach, sight_of, squared_extent


@cache
def composite_adjoint_cpu_kernel(channel_count: int, exact: bool):
    """Return the kernel that writes the moments and channels of every pair, one tile an item."""
    Channels = channel_vector(channel_count)
    Pair = pair_vector(channel_count, exact)
    add_pixel = add_pixel_function(channel_count, exact)

    @wp.kernel(enable_backward=False, module="unique")
    def composite_tiles_adjoint_kernel(
        first: int,
        frame: RasterFrame,
        channels: wp.array[Channels],
        images: Images,
        channel_adjoints: wp.array[Channels],
        adjoints: Adjoints,
        out_pairs: wp.array[Pair],
    ):
        # A pixel's state: what passes before the splats still to come, the sum R of those behind them, and the
        # derivatives to the sums of weights and of weighted depths.
        listed = first + wp.tid()
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        box = tile_pixels(view, tile)
        listed_range = frame.lists.ranges[listed]
        end = listed_range[0]
        for y in range(box[1], box[3]):
            for x in range(box[0], box[2]):
                pixel = view.first_pixel + y * view.width + x
                adjoint = pixel_adjoint(images, adjoints, pixel)
                images.states[pixel] = wp.vec4(images.transmittance[pixel], 0.0, adjoint[0], adjoint[1])
                end = wp.max(end, images.ends[pixel])
        for k in range(end, listed_range[1]):
            out_pairs[frame.lists.slots[k]] = Pair()
        for back in range(end - listed_range[0]):
            k = end - 1 - back
            splat = frame.lists.splats[k]
            drawn = Splat()
            drawn.center = frame.splats.centers[splat]
            drawn.shape = frame.splats.shapes[splat]
            drawn.slope = frame.splats.slopes[splat]
            drawn.bend = frame.splats.bends[splat]
            row = channels[splat]
            total = Pair()
            rows = rows_in(box, drawn.center, drawn.shape)
            reach = row_reach(drawn.shape, squared_extent(drawn.center[2]))
            for y in range(rows[0], rows[1]):
                columns = columns_in(box, drawn.center, reach, y)
                for x in range(columns[0], columns[1]):
                    pixel = view.first_pixel + y * view.width + x
                    if k >= images.ends[pixel]:
                        continue
                    sight = sight_of(drawn.center, drawn.shape, wp.vec2(float(x) + 0.5, float(y) + 0.5))
                    if not (sight.log_alpha >= -LOG_CUT):
                        continue
                    known = images.states[pixel]
                    is_median = k == images.medians[pixel]
                    to_median = float(0.0)
                    if is_median and adjoints.median_depth.shape[0] > 0:
                        to_median = adjoints.median_depth[pixel]
                    state = PixelState()
                    state.transmittance = known[0]
                    state.behind = known[1]
                    state.adjoint = wp.vec3(known[2], known[3], to_median)
                    total, nearer = add_pixel(
                        total,
                        state,
                        channel_adjoints[pixel],
                        drawn,
                        row,
                        frame.near,
                        sight,
                        alpha_of(sight.log_alpha),
                        is_median,
                    )
                    images.states[pixel] = wp.vec4(nearer.transmittance, nearer.behind, known[2], known[3])
            out_pairs[frame.lists.slots[k]] = total

    return composite_tiles_adjoint_kernel


def launch_composite_adjoint_cpu(frame, channels, exact, images, channel_adjoints, adjoints, out_pairs, device):
    """Write the moments and channels of a band's pairs into their slots."""
    launch(
        composite_adjoint_cpu_kernel(channels.dtype._length_, exact),
        frame.band.end_tile - frame.band.first_tile,
        inputs=[frame, channels, images, channel_adjoints, adjoints],
        outputs=[out_pairs],
        device=device,
        min_chunk=MIN_TILES,
    )
