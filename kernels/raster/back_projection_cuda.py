"""Back-projection of pixels to the splats that they see on CUDA: a tile a block, two pixels a lane.

A pair of tile and splat gets the sum over the tile's pixels of blending weight times what they hold: the transpose of
`composite_cuda`, with its weights. The work is shared out as in `composite_adjoint_cuda`, but front to back. No
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
    share_row_function,
    sum_block_function,
    wait_for_block,
)
from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.bin_tiles import SIDE
from beam_warp.kernels.raster.composite import Images, RasterFrame, channel_vector, pixel_below, pixel_place
from beam_warp.kernels.raster.composite_adjoint_cuda import PART, THREADS, WARPS
from beam_warp.kernels.raster.composite_cuda import CENTER, SHAPE
from beam_warp.kernels.raster.project import LOG_CUT
from beam_warp.kernels.raster.splat_rows import alpha_of, behind, log_alpha_of, offset_from, whiten
from beam_warp.kernels.raster.strided_rows import load_row
from beam_warp.kernels.raster.warp_lists_cuda import LANES, reaches


@cache
def back_project_cuda_kernel(channel_count: int):
    """Return the kernel that writes ``channel_count`` sums for every pair, a block a tile."""
    Channels = channel_vector(channel_count)
    share_row = share_row_function(2, LANES)
    sum_block = sum_block_function(channel_count, WARPS)

    @wp.kernel(enable_backward=False, module="unique")
    def back_project_blocks_kernel(
        first: int, frame: RasterFrame, images: Images, pixels: wp.array[Channels], out_pairs: wp.array[Channels]
    ):
        item = first + wp.tid()
        thread = item % THREADS
        lane = item % LANES
        part = thread / LANES
        listed = frame.lists.order[item / THREADS]
        listed_range = frame.lists.ranges[listed]
        if listed_range[0] == listed_range[1]:  # all threads of the block alike
            return
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        corner = (part / 2) * PART * SIDE + (part % 2) * PART
        first_center = pixel_place(view, tile, corner).position
        last_center = first_center + wp.vec2(float(PART - 1), float(PART - 1))
        own = corner + (lane / PART) * SIDE + lane % PART
        upper = pixel_place(view, tile, own)
        lower = pixel_below(view, tile, own, PART / 2, upper)
        upper_end = int(-1)
        lower_end = int(-1)
        held_by_upper = Channels()
        held_by_lower = Channels()
        if upper.index >= 0:
            upper_end = images.ends[upper.index]
        if lower.index >= 0:
            lower_end = images.ends[lower.index]
        if upper_end > listed_range[0]:
            held_by_upper = pixels[upper.index]
        if lower_end > listed_range[0]:
            held_by_lower = pixels[lower.index]
        upper_transmittance = float(1.0)
        lower_transmittance = float(1.0)
        own_end = greatest_of_lanes(wp.max(upper_end, lower_end))
        end = greatest_of_block(own_end)
        begin = listed_range[0]
        while begin < end:
            mine = begin + lane
            slot = int(-1)
            splat = int(-1)
            if mine < end:
                slot = frame.lists.slots[mine]
                splat = frame.lists.splats[mine]
                if slot >= 0:
                    frame.lists.summed[slot] = wp.uint8(1)
                if part == 0:
                    share_row(1, CENTER, lane, load_row(frame.splats.centers, splat))
                if part == 1:
                    share_row(1, SHAPE, lane, load_row(frame.splats.shapes, splat))
            sum_block(BEGIN_SUMS, slot, Channels(), out_pairs)
            wait_for_block()
            wanted = int(0)
            if mine < own_end:
                wanted = reaches(
                    share_row(0, CENTER, lane, wp.vec4()),
                    share_row(0, SHAPE, lane, wp.vec4()),
                    first_center,
                    last_center,
                )
            waiting = ballot(wanted)
            while waiting != 0:
                i = lowest_lane(waiting)
                waiting = waiting & (waiting - 1)
                k = begin + i
                center = share_row(0, CENTER, i, wp.vec4())
                shape = share_row(0, SHAPE, i, wp.vec4())
                upper_log_alpha = log_alpha_of(center, whiten(shape, offset_from(center, upper.position)))
                lower_log_alpha = log_alpha_of(center, whiten(shape, offset_from(center, lower.position)))
                in_upper = k < upper_end and upper_log_alpha >= -LOG_CUT
                in_lower = k < lower_end and lower_log_alpha >= -LOG_CUT
                if ballot(wp.where(in_upper or in_lower, 1, 0)) == 0:
                    continue
                # No branches from here on: each would cost a selection for every variable that it changes.
                upper_alpha = wp.where(in_upper, alpha_of(upper_log_alpha), 0.0)
                lower_alpha = wp.where(in_lower, alpha_of(lower_log_alpha), 0.0)
                total = held_by_upper * (upper_alpha * upper_transmittance)
                total += held_by_lower * (lower_alpha * lower_transmittance)
                upper_transmittance = behind(upper_transmittance, upper_alpha)
                lower_transmittance = behind(lower_transmittance, lower_alpha)
                sum_block(ADD_TO_SUMS, i, total, out_pairs)
            wait_for_block()
            sum_block(END_SUMS, 0, Channels(), out_pairs)
            wait_for_block()
            begin += LANES

    return back_project_blocks_kernel


def launch_back_project_cuda(frame, images, pixels, out_pairs, device):
    """Write the sums of a band's pairs into their slots."""
    launch(
        back_project_cuda_kernel(pixels.dtype._length_),
        (frame.band.end_tile - frame.band.first_tile) * THREADS,
        inputs=[frame, images, pixels],
        outputs=[out_pairs],
        device=device,
        block_dim=32 * WARPS,
    )
