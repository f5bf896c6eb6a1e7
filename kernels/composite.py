"""What each pixel shows: its tile's splats, front to back. One thread a pixel: the readable form, on CPU and CUDA.

Channels come as rows of a vector whose length is fixed at compile time; there are four lengths, so four small modules.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.bin_tiles import Band
from beam_warp.kernels.project import LOG_CUT, Pinhole, Splats

CHANNEL_COUNTS = (4, 8, 12, 16)
"""Lengths of channel vectors there are kernels for; more channels take more passes."""

ALPHA_CAP = wp.constant(0.99)
"""Largest alpha of one splat (Kerbl et al. 2023): light behind an opaque one keeps a gradient."""

TRANSMITTANCE_STOP = wp.constant(1.0e-4)
"""A pixel is done once less than this passes. The splat that gets it there still counts: leaving it out, as 3DGS does,
can drop 1 % of a pixel; what is left out here is below this number."""


@cache
def channel_vector(channel_count: int):
    """Return the Warp type of a row of channels."""
    return wp.types.vector(length=channel_count, dtype=float)


@cache
def composite_kernel(channel_count: int):
    """Return the kernel that composites ``channel_count`` channels, one of `CHANNEL_COUNTS`."""
    Channels = channel_vector(channel_count)

    @wp.kernel(enable_backward=False, module="unique")
    def composite_pixels_kernel(
        first: int,
        splats: Splats,
        pairs: wp.array[int],
        ranges: wp.array[wp.vec2i],
        channels: wp.array[Channels],
        camera: Pinhole,
        band: Band,
        out_channels: wp.array[Channels],
        out_alpha: wp.array[float],
        out_depth: wp.array[float],
    ):
        # Items go tile by tile, so that neighbours walk the same list.
        item = first + wp.tid()
        area = band.tile * band.tile
        tile = item / area
        x = (tile % band.columns) * band.tile + item % band.tile
        y = (tile / band.columns + band.first_row) * band.tile + (item % area) / band.tile
        if x >= camera.width or y >= camera.height:
            return
        pixel = wp.vec2(float(x) + 0.5, float(y) + 0.5)
        total = Channels()
        depth = float(0.0)
        weight_sum = float(0.0)
        transmittance = float(1.0)
        pairs_of_tile = ranges[tile]
        for pair in range(pairs_of_tile[0], pairs_of_tile[1]):
            splat = pairs[pair]
            offset = pixel - splats.centers[splat]
            shape = splats.shapes[splat]
            e0 = offset[0] * shape[0]
            e1 = (offset[1] - shape[1] * offset[0]) * shape[2]
            log_alpha = shape[3] - 0.5 * (e0 * e0 + e1 * e1)
            if log_alpha >= -LOG_CUT:
                alpha = wp.min(wp.exp(log_alpha), ALPHA_CAP)
                weight = alpha * transmittance
                total += channels[splat] * weight
                plane = splats.planes[splat]
                reach = splats.depth_ranges[splat]
                inverse = plane[0] + plane[1] * offset[0] + plane[2] * offset[1]
                depth += weight / wp.clamp(inverse, reach[0], reach[1])
                weight_sum += weight
                transmittance *= 1.0 - alpha
                if transmittance < TRANSMITTANCE_STOP:
                    break
        out = y * camera.width + x
        out_channels[out] = total
        out_alpha[out] = weight_sum
        out_depth[out] = depth

    return composite_pixels_kernel
