"""The gradient of each splat: moments summed over its pairs in a fixed order, and resolved to its rows."""

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.raster.bin_tiles import SplatOrder, TileLists
from beam_warp.kernels.raster.composite_adjoint import MOMENTS
from beam_warp.kernels.raster.project import Splats

wp.set_module_options({"enable_backward": False})

LN_2 = wp.constant(0.6931471805599453)
"""Alpha is a power of two: ln alpha is this times log2 o - e0^2 - e1^2."""


@wp.kernel
def sum_pairs_kernel(
    first: int, pair_rows: wp.array2d[float], lists: TileLists, order: SplatOrder, out_sums: wp.array2d[float]
):
    """Add one column of the rows of a splat's pairs, which lie side by side; CUDA leaves out those that nobody saw."""
    item = first + wp.tid()
    length = pair_rows.shape[1]
    place = item / length
    column = item % length
    count = order.counts[place]
    if count <= 0:
        return
    total = float(0.0)
    # Ends beyond the range of integers come out negative: what was not listed has no rows.
    for row in range(wp.max(order.ends[place] - count, 0), wp.min(order.ends[place], pair_rows.shape[0])):
        if lists.summed.shape[0] == 0 or lists.summed[row] != wp.uint8(0):
            total += pair_rows[row, column]
    splat = order.splats[place]
    out_sums[splat, column] = out_sums[splat, column] + total


@wp.kernel
def resolve_sums_kernel(
    first: int, sums: wp.array2d[float], splats: Splats, channel_count: int, exact: int, out_gradients: Splats
):
    """Add to the gradients of a splat's rows, from its summed moments (see `kernels.raster.composite_adjoint`)."""
    splat = first + wp.tid()
    if not (splats.centers[splat][2] > -wp.inf):
        return
    shape = splats.shapes[splat]
    slope = splats.slopes[splat]
    s0 = shape[0]
    s1 = shape[1]
    s2 = shape[2]
    facing = sums[splat, 8]
    to_gx = sums[splat, 9] / s0
    to_gy = sums[splat, 10] / s2 + s1 * to_gx
    e0 = 2.0 * LN_2 * sums[splat, 1]
    e1 = 2.0 * LN_2 * sums[splat, 2]
    to_x = s1 * s2 * e1 - s0 * e0 + facing * slope[0]
    to_y = -s2 * e1 + facing * slope[1]
    to_bends = wp.vec3(0.0, 0.0, 0.0)
    if exact != 0:
        column = MOMENTS + channel_count
        bend = splats.bends[splat]
        b_x = sums[splat, column] / s0
        b_y = sums[splat, column + 1] / s2 + s1 * b_x
        b_xx = sums[splat, column + 2] / (s0 * s0)
        mixed = sums[splat, column + 3] / (s0 * s2)
        b_xy = mixed + s1 * b_xx
        b_yy = sums[splat, column + 4] / (s2 * s2) + s1 * (2.0 * mixed + s1 * b_xx)
        to_x += 2.0 * (slope[2] * b_x + slope[3] * b_y)
        to_y += 2.0 * (slope[3] * b_x + bend * b_y)
        to_bends = wp.vec3(b_xx, 2.0 * b_xy, b_yy)
    to_center = wp.vec4(-to_x, -to_y, LN_2 * sums[splat, 0], sums[splat, 6])
    out_gradients.centers[splat] = out_gradients.centers[splat] + to_center
    squares = 2.0 * LN_2 * wp.vec3(-sums[splat, 3] / s0, s2 / s0 * sums[splat, 4], -sums[splat, 5] / s2)
    to_shape = wp.vec4(squares[0], squares[1], squares[2], sums[splat, 7])
    out_gradients.shapes[splat] = out_gradients.shapes[splat] + to_shape
    out_gradients.slopes[splat] = out_gradients.slopes[splat] + wp.vec4(to_gx, to_gy, to_bends[0], to_bends[1])
    out_gradients.bends[splat] = out_gradients.bends[splat] + to_bends[2]


launch_sum_pairs = launcher(sum_pairs_kernel)
"""Add the rows of all pairs to the sums of their splats."""


def launch_resolve_sums(sums, splats, channel_count, exact, gradients, device):
    """Add to the gradients of all splats' rows, from their summed moments."""
    inputs = [sums, splats, channel_count, exact]
    launch(resolve_sums_kernel, sums.shape[0], inputs=inputs, outputs=[gradients], device=device)
