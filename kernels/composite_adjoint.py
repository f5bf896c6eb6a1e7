"""How pixels change with the splats that they see: one splat at one pixel.

With f_k a splat's channels, z_k its depth, T_k what passes before it and w_k = alpha_k T_k, a loss that is linear in
the sums has s_k = f_k . v_f + z_k v_z + v_a, and back to front (Kerbl et al. 2023, Section 6)

    dL/dalpha_k = T_k s_k - R_k / (1 - alpha_k),    R_k = sum over j > k of w_j s_j.

Which splats count, the order, the cap of alpha and the pick of the median are held still.

What a splat's rows get is linear in a few moments over its pixels, of the whitened offset e: with d the derivative to
ln alpha, those of 1, e0, e1, e0^2, e0 e1, e1^2 under d; the sums of the derivatives to depth and reach; the moments of
1, e0, e1 under f, the derivative to the factor l; the channels; and in exact mode the moments of e0, e1, e0^2, e0 e1,
e1^2 under b, the derivative to the form e. Whitened, nothing cancels for a needle, and a pixel costs no chain rule.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.composite import Images, channel_vector
from beam_warp.kernels.splat_rows import SMALLEST_FACING, bend_at, facing_at

MOMENTS = wp.constant(11)
"""Moments before the channels."""

BEND_MOMENTS = wp.constant(5)
"""Moments behind the channels, in exact mode."""


def pair_length(channel_count: int, exact: bool) -> int:
    """Return how many numbers a pair's moments and channels are, padded to a multiple of 4."""
    return -(-(MOMENTS + channel_count + BEND_MOMENTS * exact) // 4) * 4


@cache
def pair_vector(channel_count: int, exact: bool):
    """Return the Warp type of a pair's moments and channels."""
    return wp.types.vector(length=pair_length(channel_count, exact), dtype=float)


@wp.struct
class Adjoints:
    """Derivatives of a loss with respect to the images; an array of length 0 stands for zeros."""

    alpha: wp.array[float]
    depth: wp.array[float]
    median_depth: wp.array[float]


@wp.struct
class PixelAdjoint:
    """Derivatives with respect to the sums at one pixel."""

    alpha: float
    depth: float  # to the weighted sum, not the mean
    median_depth: float


@wp.struct
class DepthAdjoint:
    """Derivatives with respect to what a splat's depth at a pixel is made of."""

    depth: float
    reach: float
    facing: float
    bend: float


@wp.func
def pixel_adjoint(images: Images, adjoints: Adjoints, pixel: int) -> PixelAdjoint:
    """Take the derivative to the mean depth apart into those to its numerator and denominator."""
    found = PixelAdjoint()
    if adjoints.alpha.shape[0] > 0:
        found.alpha = adjoints.alpha[pixel]
    if adjoints.median_depth.shape[0] > 0:
        found.median_depth = adjoints.median_depth[pixel]
    weight_sum = images.alpha[pixel]
    if adjoints.depth.shape[0] > 0 and weight_sum > 0.0:
        found.depth = adjoints.depth[pixel] / weight_sum
        found.alpha -= found.depth * images.depth[pixel]
    return found


@cache
def depth_adjoint_function(exact: bool):
    """Return the function that takes the derivative ``v`` to a splat's depth ``z`` at a pixel apart."""

    @wp.func
    def depth_adjoint(
        center: wp.vec4, shape: wp.vec4, slope: wp.vec4, bend: float, near: float, offset: wp.vec2, z: float, v: float
    ) -> DepthAdjoint:
        found = DepthAdjoint()
        if z >= center[3] + shape[3]:
            found.depth = v
            found.reach = v
        elif z > wp.max(center[3] - shape[3], near):
            found.depth = v * z / center[3]
            found.facing = -found.depth * z
            if wp.static(exact):
                raw = facing_at(slope, offset)
                facing = wp.max(raw, SMALLEST_FACING)
                found.bend = found.facing / facing
                found.facing *= 1.0 - bend_at(slope, bend, offset) / (facing * facing)
                if raw < SMALLEST_FACING:
                    found.facing = 0.0
        elif center[3] - shape[3] > near:
            found.depth = v
            found.reach = -v
        return found

    return depth_adjoint


@cache
def add_moments_function(channel_count: int, exact: bool):
    """Return the function that adds one pixel's part to a pair's moments and channels."""
    Channels = channel_vector(channel_count)
    Pair = pair_vector(channel_count, exact)
    bend = MOMENTS + channel_count

    @wp.func
    def add_moments(
        total: Pair, e: wp.vec2, d: float, depth: DepthAdjoint, weight: float, to_channels: Channels
    ) -> Pair:
        d0 = d * e[0]
        d1 = d * e[1]
        total[0] = total[0] + d
        total[1] = total[1] + d0
        total[2] = total[2] + d1
        total[3] = total[3] + d0 * e[0]
        total[4] = total[4] + d0 * e[1]
        total[5] = total[5] + d1 * e[1]
        total[6] = total[6] + depth.depth
        total[7] = total[7] + depth.reach
        total[8] = total[8] + depth.facing
        total[9] = total[9] + depth.facing * e[0]
        total[10] = total[10] + depth.facing * e[1]
        for i in range(wp.static(channel_count)):
            total[wp.static(MOMENTS) + i] = total[wp.static(MOMENTS) + i] + weight * to_channels[i]
        if wp.static(exact):
            b0 = depth.bend * e[0]
            b1 = depth.bend * e[1]
            total[wp.static(bend)] = total[wp.static(bend)] + b0
            total[wp.static(bend + 1)] = total[wp.static(bend + 1)] + b1
            total[wp.static(bend + 2)] = total[wp.static(bend + 2)] + b0 * e[0]
            total[wp.static(bend + 3)] = total[wp.static(bend + 3)] + b0 * e[1]
            total[wp.static(bend + 4)] = total[wp.static(bend + 4)] + b1 * e[1]
        return total

    return add_moments
