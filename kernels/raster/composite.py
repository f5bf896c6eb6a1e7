"""Compositing a tile's splats at each pixel, front to back. One thread a pixel: the readable form, on CPU and CUDA.

`composite_cpu` and `composite_cuda` do the same sums in the same order, faster. Channels come as rows of a vector whose
length is fixed at compile time: four lengths and two modes of depth make eight small modules.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.bin_tiles import SIDE, Band, TileLists
from beam_warp.kernels.raster.project import LOG_CUT, RasterView, Splats
from beam_warp.kernels.raster.splat_rows import (
    MEDIAN,
    TRANSMITTANCE_STOP,
    alpha_of,
    depth_function,
    log_alpha_of,
    offset_from,
    whiten,
)

CHANNEL_COUNTS = (4, 8, 12, 16)
"""Lengths of channel vectors there are kernels for; more channels take more passes."""


@wp.struct
class RasterFrame:
    """Input of compositing: splats, the lists of tiles, and the views they are seen from."""

    splats: Splats
    lists: TileLists
    views: wp.array[RasterView]
    tile_views: wp.array[int]  # which view each tile belongs to
    band: Band
    gaussian_count: int
    near: float


@wp.struct
class Images:
    """Images besides channels, view by view and row by row; depths in metres along the optical axis."""

    alpha: wp.array[float]  # sum of the weights
    transmittance: wp.array[float]  # what passes all
    depth: wp.array[float]  # mean; 0 where nothing is seen
    median_depth: wp.array[float]  # 0 where nothing is seen
    gaussians: wp.array[int]  # the last that was seen, -1 for none
    ends: wp.array[int]  # end of what was looked at, in the lists
    medians: wp.array[int]  # place of the median's splat in the lists, -1 for none
    states: wp.array[wp.vec4]  # what the CPU's kernels know of a pixel between two splats; none on CUDA


@wp.struct
class PixelPlace:
    """Place of a pixel in its view and in the images; ``index`` is -1 outside."""

    index: int
    position: wp.vec2


@wp.func
def pixel_place(view: RasterView, tile: int, within: int) -> PixelPlace:
    """Place of a tile's pixel, counted row by row."""
    local = tile - view.first_tile
    x = (local % view.columns) * SIDE + within % SIDE
    y = (local / view.columns) * SIDE + within / SIDE
    place = PixelPlace()
    place.position = wp.vec2(float(x) + 0.5, float(y) + 0.5)
    place.index = -1
    if x < view.width and y < view.height:
        place.index = view.first_pixel + y * view.width + x
    return place


@cache
def channel_vector(channel_count: int):
    """Return the Warp type of a row of channels."""
    return wp.types.vector(length=channel_count, dtype=float)


@cache
def composite_kernel(channel_count: int, exact: bool):
    """Return the kernel that composites ``channel_count`` channels, one of `CHANNEL_COUNTS`."""
    Channels = channel_vector(channel_count)
    depth_at = depth_function(exact)

    @wp.kernel(enable_backward=False, module="unique")
    def composite_pixels_kernel(
        first: int,
        frame: RasterFrame,
        channels: wp.array[Channels],
        out_channels: wp.array[Channels],
        out_images: Images,
    ):
        # Items go tile by tile, so that neighbours walk the same list.
        item = first + wp.tid()
        listed = item / (SIDE * SIDE)
        tile = frame.band.first_tile + listed
        place = pixel_place(frame.views[frame.tile_views[tile]], tile, item % (SIDE * SIDE))
        pixel = place.index
        if pixel < 0:
            return
        total = Channels()
        depth = float(0.0)
        weight_sum = float(0.0)
        transmittance = float(1.0)
        median_depth = float(0.0)
        median = int(-1)
        last = int(-1)
        listed_range = frame.lists.ranges[listed]
        end = listed_range[0]
        for k in range(listed_range[0], listed_range[1]):
            splat = frame.lists.splats[k]
            center = frame.splats.centers[splat]
            shape = frame.splats.shapes[splat]
            offset = offset_from(center, place.position)
            log_alpha = log_alpha_of(center, whiten(shape, offset))
            if log_alpha >= -LOG_CUT:
                alpha = alpha_of(log_alpha)
                weight = alpha * transmittance
                slope = frame.splats.slopes[splat]
                z = depth_at(center, shape, slope, frame.splats.bends[splat], frame.near, offset)
                total += channels[splat] * weight
                depth += z * weight
                weight_sum += weight
                if transmittance > MEDIAN:
                    median_depth = z
                    median = k
                last = splat % frame.gaussian_count
                end = k + 1
                transmittance *= 1.0 - alpha
                if transmittance < TRANSMITTANCE_STOP:
                    break
        out_channels[pixel] = total
        out_images.alpha[pixel] = weight_sum
        out_images.transmittance[pixel] = transmittance
        out_images.depth[pixel] = wp.where(weight_sum > 0.0, depth / weight_sum, 0.0)
        out_images.median_depth[pixel] = median_depth
        out_images.gaussians[pixel] = last
        out_images.ends[pixel] = end
        out_images.medians[pixel] = median

    return composite_pixels_kernel


def launch_composite_pixels(frame, channels, exact, out_channels, out_images, device):
    """Composite a band, one thread a pixel."""
    launch(
        composite_kernel(channels.dtype._length_, exact),
        (frame.band.end_tile - frame.band.first_tile) * SIDE * SIDE,
        inputs=[frame, channels],
        outputs=[out_channels, out_images],
        device=device,
    )
