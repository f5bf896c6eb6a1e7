# ruff: noqa: RUF046, UP018 - variables of kernels begin as float(0.0) and int(-1)
"""The readable composite, the oracle of the fast ones: one thread a pixel, front to back, on CPU and CUDA.

`composite_cpu` and `composite_cuda` of `beam_warp.kernels.raster` do the same sums in the same order, faster.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.constants import TRANSMITTANCE_STOP
from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.bin_tiles import SIDE
from beam_warp.kernels.raster.composite import Images, RasterFrame, channel_vector, pixel_place
from beam_warp.kernels.raster.project import LOG_CUT
from beam_warp.kernels.raster.splat_rows import (
    MEDIAN,
    alpha_of,
    behind,
    depth_function,
    log_alpha_of,
    offset_from,
    whiten,
)
from beam_warp.raster.forward import composite
from beam_warp.raster.rasterizer import Rasterizer


class ReadableRasterizer(Rasterizer):
    """A rasteriser that composites with the readable kernel."""

    def _composite(self) -> None:
        if self.device.is_cuda:  # the fast composite sorts the lists, as far as pixels look
            super()._composite()
        composite(self._buffers, launch_composite_pixels)


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
                transmittance = behind(transmittance, alpha)
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
