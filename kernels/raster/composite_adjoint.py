"""The adjoint of compositing: one splat at one pixel.

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

from beam_warp.kernels.common.constants import ALPHA_MAX
from beam_warp.kernels.raster.composite import Images, channel_vector
from beam_warp.kernels.raster.project import Splat
from beam_warp.kernels.raster.splat_rows import (
    SMALLEST_FACING,
    Sight,
    bend_at,
    facing_at,
    limited_depth,
    nearness_function,
    nearness_limits,
    quick_divide,
)

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
    """Derivatives of a loss with respect to the images; arrays of length 0 stand for zeros."""

    alpha: wp.array[float]
    depth: wp.array[float]
    median_depth: wp.array[float]


@wp.struct
class PixelState:
    """State of a pixel on the way through its splats, back to front."""

    transmittance: float  # what passes before the splats still to come
    behind: float  # the sum R of those behind them
    adjoint: wp.vec3  # derivatives to the sums of weights and of weighted depths, and to the median depth


@wp.func
def pixel_adjoint(images: Images, adjoints: Adjoints, pixel: int) -> wp.vec3:
    """Derivatives to the sums of weights and of weighted depths, not their quotient, and to the median depth."""
    found = wp.vec3(0.0, 0.0, 0.0)
    if adjoints.alpha.shape[0] > 0:
        found[0] = adjoints.alpha[pixel]
        weight_sum = images.alpha[pixel]
        if weight_sum > 0.0:
            to_sum = adjoints.depth[pixel] / weight_sum
            found[0] = found[0] - to_sum * images.depth[pixel]
            found[1] = to_sum
        found[2] = adjoints.median_depth[pixel]
    return found


@cache
def depth_adjoint_function(exact: bool):
    """Return the function that takes the derivative ``v`` to a splat's depth ``z`` at a pixel apart.

    ``nearness`` and its limits are those that the depth came of. It gives the derivatives to the centre's depth, the
    reach, the factor l and the form e. It has no branches: in a kernel each would cost a selection for every variable
    that it changes.
    """

    @wp.func
    def depth_adjoint(
        splat: Splat, near: float, offset: wp.vec2, limits: wp.vec2, nearness: float, z: float, v: float
    ) -> wp.vec4:
        beyond = not (nearness > limits[0])
        before = (not beyond) and nearness >= limits[1]
        clamped = beyond or before
        held = before and splat.center[3] - splat.shape[3] <= near  # by the near plane, which nothing moves
        slide = quick_divide(v * z, splat.center[3])
        to_z = wp.where(clamped, wp.where(held, 0.0, v), slide)
        to_reach = wp.where(clamped, wp.where(beyond, v, wp.where(held, 0.0, -v)), 0.0)
        to_facing = wp.where(clamped, 0.0, -slide * z)
        to_bend = float(0.0)
        if wp.static(exact):
            raw = facing_at(splat.slope, offset)
            facing = wp.max(raw, SMALLEST_FACING)
            to_bend = quick_divide(to_facing, facing)
            to_facing -= quick_divide(to_bend * bend_at(splat.slope, splat.bend, offset), facing)
            to_facing = wp.where(raw < SMALLEST_FACING, 0.0, to_facing)
        return wp.vec4(to_z, to_reach, to_facing, to_bend)

    return depth_adjoint


@cache
def add_pixel_function(channel_count: int, exact: bool):
    """Return the function that adds one pixel's part to a pair's moments and channels.

    The state that it returns is the pixel's in front of this splat. A splat that the pixel does not see has an alpha
    of 0.
    """
    Channels = channel_vector(channel_count)
    Pair = pair_vector(channel_count, exact)
    nearness_at = nearness_function(exact)
    depth_adjoint = depth_adjoint_function(exact)
    bend_start = MOMENTS + channel_count

    @wp.func
    def add_pixel(
        total: Pair,
        state: PixelState,
        to_channels: Channels,
        splat: Splat,
        row: Channels,
        near: float,
        sight: Sight,
        alpha: float,
        is_median: bool,
    ):
        adjoint = state.adjoint
        e = sight.e
        open_share = 1.0 - alpha
        before = quick_divide(state.transmittance, open_share)
        weight = alpha * before
        limits = nearness_limits(splat.center, splat.shape, near)
        nearness = nearness_at(splat.slope, splat.bend, sight.offset)
        z = limited_depth(splat.center[3], limits, nearness)
        s = wp.dot(row, to_channels) + z * adjoint[1] + adjoint[0]
        d = wp.where(alpha < ALPHA_MAX, alpha * (before * s - quick_divide(state.behind, open_share)), 0.0)
        to_depth = weight * adjoint[1] + wp.where(is_median, adjoint[2], 0.0)
        depth = depth_adjoint(splat, near, sight.offset, limits, nearness, z, to_depth)
        d0 = d * e[0]
        d1 = d * e[1]
        total[0] = total[0] + d
        total[1] = total[1] + d0
        total[2] = total[2] + d1
        total[3] = total[3] + d0 * e[0]
        total[4] = total[4] + d0 * e[1]
        total[5] = total[5] + d1 * e[1]
        total[6] = total[6] + depth[0]
        total[7] = total[7] + depth[1]
        total[8] = total[8] + depth[2]
        total[9] = total[9] + depth[2] * e[0]
        total[10] = total[10] + depth[2] * e[1]
        for i in range(wp.static(channel_count)):
            total[wp.static(MOMENTS) + i] = total[wp.static(MOMENTS) + i] + weight * to_channels[i]
        if wp.static(exact):
            b0 = depth[3] * e[0]
            b1 = depth[3] * e[1]
            total[wp.static(bend_start)] = total[wp.static(bend_start)] + b0
            total[wp.static(bend_start + 1)] = total[wp.static(bend_start + 1)] + b1
            total[wp.static(bend_start + 2)] = total[wp.static(bend_start + 2)] + b0 * e[0]
            total[wp.static(bend_start + 3)] = total[wp.static(bend_start + 3)] + b0 * e[1]
            total[wp.static(bend_start + 4)] = total[wp.static(bend_start + 4)] + b1 * e[1]
        nearer = PixelState()
        nearer.transmittance = before
        nearer.behind = state.behind + weight * s
        nearer.adjoint = adjoint
        return total, nearer

    return add_pixel
