"""How pixels change with the splats that they see: one splat at one pixel.

With f_k a splat's channels, z_k its depth, T_k what passes before it and w_k = alpha_k T_k, a loss that is linear in
the sums has s_k = f_k . v_f + z_k v_z + v_a, and back to front (Kerbl et al. 2023, Section 6)

    dL/dalpha_k = T_k s_k - R_k / (1 - alpha_k),    R_k = sum over j > k of w_j s_j.

Which splats count, the order, the cap of alpha and the pick of the median are held still.

A pair's gradient is a row of numbers: `GEOMETRY` for the rows of `kernels.project.Splats`, the channels, and in exact
mode the three of the form e.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.composite import Images, channel_vector
from beam_warp.kernels.project import Splats
from beam_warp.kernels.row_loads import load_row
from beam_warp.kernels.splat_rows import SMALLEST_FACING, bend_at, facing_at

GEOMETRY = wp.constant(10)
"""x, y, ln opacity, depth; s0, s1, s2, reach; gx, gy."""


def pair_length(channel_count: int, exact: bool) -> int:
    """Return how many numbers a pair's gradient has, a multiple of 4."""
    return -(-(GEOMETRY + channel_count + 3 * exact) // 4) * 4


@cache
def pair_vector(channel_count: int, exact: bool):
    """Return the Warp type of a pair's gradient."""
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
def add_pair_function(channel_count: int, exact: bool):
    """Return the function that adds one pixel's part to a pair's gradient."""
    Channels = channel_vector(channel_count)
    Pair = pair_vector(channel_count, exact)
    bend = GEOMETRY + channel_count

    @wp.func
    def add_pair(
        total: Pair,
        splats: Splats,
        splat: int,
        center: wp.vec4,
        shape: wp.vec4,
        near: float,
        offset: wp.vec2,
        weight: float,
        log_alpha_gradient: float,
        depth_gradient: float,
        channel_gradient: Channels,
    ) -> Pair:
        x = offset[0]
        y = offset[1]
        along = y - shape[1] * x
        to_e0 = -(x * shape[0]) * log_alpha_gradient
        to_e1 = -(along * shape[2]) * log_alpha_gradient
        to_x = shape[0] * to_e0 - shape[1] * shape[2] * to_e1
        to_y = shape[2] * to_e1
        to_z = float(0.0)
        to_reach = float(0.0)
        if depth_gradient != 0.0:
            slope = load_row(splats.slopes, splat)
            facing = facing_at(slope, offset)
            inverse = facing
            if wp.static(exact):
                facing = wp.max(facing, SMALLEST_FACING)
                inverse = facing + bend_at(slope, splats.bends[splat], offset) / facing
            far = center[3] + shape[3]
            least = center[3] - shape[3]
            z = far
            if inverse > 0.0:
                z = center[3] / inverse
            if not (inverse > 0.0) or z > far:
                to_z = depth_gradient
                to_reach = depth_gradient
            elif z < wp.max(least, near):
                if least > near:
                    to_z = depth_gradient
                    to_reach = -depth_gradient
            else:
                to_z = depth_gradient / inverse
                to_facing = -depth_gradient * z / inverse
                if wp.static(exact):
                    to_bend = to_facing / facing
                    bend_y = splats.bends[splat]
                    if facing > SMALLEST_FACING:
                        to_facing *= 1.0 - bend_at(slope, bend_y, offset) / (facing * facing)
                    else:
                        to_facing = 0.0
                    total[bend] = total[bend] + to_bend * x * x
                    total[bend + 1] = total[bend + 1] + 2.0 * to_bend * x * y
                    total[bend + 2] = total[bend + 2] + to_bend * y * y
                    to_x += 2.0 * to_bend * (slope[2] * x + slope[3] * y)
                    to_y += 2.0 * to_bend * (slope[3] * x + bend_y * y)
                to_x += to_facing * slope[0]
                to_y += to_facing * slope[1]
                total[8] = total[8] + to_facing * x
                total[9] = total[9] + to_facing * y
        total[0] = total[0] - to_x
        total[1] = total[1] - to_y
        total[2] = total[2] + log_alpha_gradient
        total[3] = total[3] + to_z
        total[4] = total[4] + x * to_e0
        total[5] = total[5] - x * shape[2] * to_e1
        total[6] = total[6] + along * to_e1
        total[7] = total[7] + to_reach
        for i in range(wp.static(channel_count)):
            total[wp.static(GEOMETRY) + i] = total[wp.static(GEOMETRY) + i] + weight * channel_gradient[i]
        return total

    return add_pair
