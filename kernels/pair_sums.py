"""The gradient of each splat: the sum over its pairs, in a fixed order, so that its bits are the same every run."""

import warp as wp

from beam_warp.kernels.composite_adjoint import GEOMETRY
from beam_warp.kernels.launching import launch

wp.set_module_options({"enable_backward": False})


@wp.struct
class Pairs:
    """The gradients of all pairs of a band; those of a splat lie side by side, splats in depth order."""

    rows: wp.array2d[float]
    order: wp.array[int]
    counts: wp.array[int]
    ends: wp.array[int]
    channel_count: int
    exact: int


@wp.struct
class SplatGradients:
    """Derivatives with respect to the rows of `kernels.project.Splats` and to each splat's channels."""

    centers: wp.array2d[float]
    shapes: wp.array2d[float]
    slopes: wp.array2d[float]
    bends: wp.array[float]
    channels: wp.array2d[float]


@wp.kernel
def add_pairs_kernel(first: int, pairs: Pairs, out_gradients: SplatGradients):
    """Sum one column of the rows of a splat, and add it to the gradient that it belongs to."""
    item = first + wp.tid()
    length = pairs.rows.shape[1]
    place = item / length
    column = item % length
    count = pairs.counts[place]
    if count <= 0:
        return
    total = float(0.0)
    for row in range(pairs.ends[place] - count, wp.min(pairs.ends[place], pairs.rows.shape[0])):
        total += pairs.rows[row, column]
    splat = pairs.order[place]
    bend = GEOMETRY + pairs.channel_count
    if column < 4:
        out_gradients.centers[splat, column] = out_gradients.centers[splat, column] + total
    elif column < 8:
        out_gradients.shapes[splat, column - 4] = out_gradients.shapes[splat, column - 4] + total
    elif column < GEOMETRY:
        out_gradients.slopes[splat, column - 8] = out_gradients.slopes[splat, column - 8] + total
    elif column < bend:
        channel = column - GEOMETRY
        out_gradients.channels[splat, channel] = out_gradients.channels[splat, channel] + total
    elif pairs.exact != 0 and column < bend + 2:
        out_gradients.slopes[splat, column - bend + 2] = out_gradients.slopes[splat, column - bend + 2] + total
    elif pairs.exact != 0 and column == bend + 2:
        out_gradients.bends[splat] = out_gradients.bends[splat] + total


def launch_add_pairs(pairs, gradients, device):
    """Add the gradients of all pairs to those of their splats."""
    launch(
        add_pairs_kernel,
        len(pairs.counts) * pairs.rows.shape[1],
        inputs=[pairs],
        outputs=[gradients],
        device=device,
    )
