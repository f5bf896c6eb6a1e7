"""How pixels change with the splats that they see, for CUDA: a tile a warp, two pixels a lane, back to front.

The lanes fetch 32 splats at once and then go through them together. The sum over a tile's pixels never leaves the warp:
no atomics, one order of additions, the same bits every run.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.composite import (
    Frame,
    Images,
    PixelPlace,
    alpha_of,
    channel_vector,
    depth_function,
    offset_from,
    pixel_place,
)
from beam_warp.kernels.composite_adjoint import (
    Adjoints,
    PixelAdjoint,
    add_pair_function,
    pair_length,
    pair_vector,
    pixel_adjoint,
)
from beam_warp.kernels.lanes import (
    ballot,
    from_lane,
    greatest_of_lanes,
    load_channels_function,
    store_lane_sums_function,
)
from beam_warp.kernels.launching import launch
from beam_warp.kernels.project import LOG_CUT
from beam_warp.kernels.row_loads import load_row
from beam_warp.kernels.splat_rows import ALPHA_CAP, log_alpha_at

LANES = wp.constant(32)


@wp.struct
class TracedPixel:
    """A pixel of a lane: what is known of it, and its state between two splats."""

    index: int
    position: wp.vec2
    end: int
    median: int
    adjoint: PixelAdjoint
    transmittance: float  # before the splats still to come
    behind: float  # the sum R of those that have been


@wp.func
def begin_pixel(images: Images, adjoints: Adjoints, place: PixelPlace) -> TracedPixel:
    """State of a pixel before the last splat."""
    pixel = TracedPixel()
    pixel.index = place.index
    pixel.position = place.position
    pixel.end = -1
    pixel.median = -1
    pixel.behind = 0.0
    if place.index >= 0:
        pixel.end = images.ends[place.index]
        pixel.median = images.medians[place.index]
        pixel.adjoint = pixel_adjoint(images, adjoints, place.index)
        pixel.transmittance = images.transmittance[place.index]
    return pixel


@cache
def composite_adjoint_cuda_kernel(channel_count: int, exact: bool):
    """Return the kernel that writes the gradient of every pair, 32 items a tile."""
    Channels = channel_vector(channel_count)
    Pair = pair_vector(channel_count, exact)
    depth_at = depth_function(exact)
    add_pair = add_pair_function(channel_count, exact)
    load_channels = load_channels_function(Channels)
    store_lane_sums = store_lane_sums_function(pair_length(channel_count, exact))

    @wp.func
    def add_pixel(
        total: Pair,
        pixel: TracedPixel,
        to_channels: Channels,
        frame: Frame,
        splat: int,
        k: int,
        center: wp.vec4,
        shape: wp.vec4,
        offset: wp.vec2,
        log_alpha: float,
        row: Channels,
    ):
        alpha = alpha_of(log_alpha)
        open_share = 1.0 - alpha
        transmittance = pixel.transmittance / open_share
        weight = alpha * transmittance
        z = depth_at(frame.splats, splat, center, shape, frame.near, offset)
        s = wp.dot(row, to_channels) + z * pixel.adjoint.depth + pixel.adjoint.alpha
        to_log_alpha = float(0.0)
        if alpha < ALPHA_CAP:
            to_log_alpha = alpha * (transmittance * s - pixel.behind / open_share)
        to_depth = weight * pixel.adjoint.depth
        if k == pixel.median:
            to_depth += pixel.adjoint.median_depth
        total = add_pair(
            total, frame.splats, splat, center, shape, frame.near, offset, weight, to_log_alpha, to_depth, to_channels
        )
        pixel.transmittance = transmittance
        pixel.behind += weight * s
        return total, pixel

    @wp.kernel(enable_backward=False, module="unique")
    def composite_warps_adjoint_kernel(
        first: int,
        frame: Frame,
        channels: wp.array[Channels],
        images: Images,
        channel_adjoints: wp.array[Channels],
        adjoints: Adjoints,
        out_pairs: wp.array[Pair],
    ):
        item = first + wp.tid()
        lane = item % LANES
        listed = item / LANES
        tile = frame.band.first_tile + listed
        view = frame.views[frame.tile_views[tile]]
        begin = frame.lists.ranges[listed][0]
        upper = begin_pixel(images, adjoints, pixel_place(view, tile, lane))
        lower = begin_pixel(images, adjoints, pixel_place(view, tile, lane + LANES))
        to_upper = Channels()
        to_lower = Channels()
        if upper.index >= 0:
            to_upper = load_channels(channel_adjoints, upper.index)
        if lower.index >= 0:
            to_lower = load_channels(channel_adjoints, lower.index)
        end = greatest_of_lanes(wp.max(upper.end, lower.end))
        while end > begin:
            mine = end - 1 - lane
            splat = int(0)
            slot = int(0)
            if mine >= begin:
                splat = frame.lists.splats[mine]
                slot = frame.lists.slots[mine]
            for i in range(wp.min(end - begin, LANES)):
                k = end - 1 - i
                drawn = from_lane(splat, i)
                center = load_row(frame.splats.centers, drawn)
                shape = load_row(frame.splats.shapes, drawn)
                upper_offset = offset_from(center, upper.position)
                lower_offset = offset_from(center, lower.position)
                upper_log_alpha = log_alpha_at(center, shape, upper_offset)
                lower_log_alpha = log_alpha_at(center, shape, lower_offset)
                in_upper = k < upper.end and upper_log_alpha >= -LOG_CUT
                in_lower = k < lower.end and lower_log_alpha >= -LOG_CUT
                if ballot(wp.where(in_upper or in_lower, 1, 0)) != 0:
                    total = Pair()
                    row = load_channels(channels, drawn)
                    if in_upper:
                        total, upper = add_pixel(
                            total, upper, to_upper, frame, drawn, k, center, shape, upper_offset, upper_log_alpha, row
                        )
                    if in_lower:
                        total, lower = add_pixel(
                            total, lower, to_lower, frame, drawn, k, center, shape, lower_offset, lower_log_alpha, row
                        )
                    store_lane_sums(out_pairs, from_lane(slot, i), total)
            end -= LANES

    return composite_warps_adjoint_kernel


def launch_composite_adjoint_cuda(frame, channels, exact, images, channel_adjoints, adjoints, out_pairs, device):
    """Write the gradients of a band's pairs into their slots; those of no pixel keep what is there."""
    launch(
        composite_adjoint_cuda_kernel(channels.dtype._length_, exact),
        (frame.band.end_tile - frame.band.first_tile) * LANES,
        inputs=[frame, channels, images, channel_adjoints, adjoints],
        outputs=[out_pairs],
        device=device,
        block_dim=64,
    )
