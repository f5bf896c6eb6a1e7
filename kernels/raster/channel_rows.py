"""Rows of channels, one a splat, gathered from the Gaussians, and the way back for gradients.

Channels are, in this order: the Gaussian's captured colour towards the view's camera, the normal of its geometry, and
its own values; each block may be missing. Rows are cut into passes of at most 16.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch, launch_adjoint
from beam_warp.kernels.common.spherical_harmonics import seen_color
from beam_warp.kernels.raster.project import CameraMove, RasterView
from beam_warp.kernels.raster.strided_rows import store_row


@wp.struct
class ChannelBlocks:
    """Sources of the channels of a splat."""

    values: wp.array2d[float]  # of each Gaussian, any number
    colors: wp.array[wp.vec3]  # of each splat, or none
    normals: wp.array[wp.vec3]  # of each splat, or none


@wp.kernel
def evaluate_colors_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    radiance: wp.array2d[wp.vec3],
    views: wp.array[RasterView],
    out_colors: wp.array[wp.vec3],
):
    """Colour of every Gaussian towards every view's camera. The module has an adjoint, which Warp makes."""
    splat = first + wp.tid()
    count = positions.shape[0]
    i = splat % count
    toward = positions[i] - views[splat / count].position
    out_colors[splat] = seen_color(radiance, i, wp.normalize(toward))


@wp.kernel
def evaluate_colors_of_cameras_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    radiance: wp.array2d[wp.vec3],
    views: wp.array[RasterView],
    moves: wp.array[CameraMove],
    out_colors: wp.array[wp.vec3],
):
    """The same with a camera for every splat, moved by zeros: a turn about a camera's place changes no colour."""
    splat = first + wp.tid()
    count = positions.shape[0]
    i = splat % count
    view = views[splat / count]
    move = moves[splat]
    shift = wp.vec3(move[3], move[4], move[5])
    toward = positions[i] - view.position + wp.transpose(view.world_to_camera) * shift
    out_colors[splat] = seen_color(radiance, i, wp.normalize(toward))


@wp.func
def color_channels(blocks: ChannelBlocks) -> int:
    return wp.where(blocks.colors.shape[0] > 0, 3, 0)


@wp.func
def normal_channels(blocks: ChannelBlocks) -> int:
    return wp.where(blocks.normals.shape[0] > 0, 3, 0)


@wp.func
def component(vector: wp.vec3, i: int) -> float:
    """A component, selected: an index would put the vector into slow memory."""
    return wp.where(i == 0, vector[0], wp.where(i == 1, vector[1], vector[2]))


@wp.func
def channel_of(blocks: ChannelBlocks, splat: int, channel: int) -> float:
    """A channel of a splat; 0 beyond the last."""
    colors_end = color_channels(blocks)
    normals_end = colors_end + normal_channels(blocks)
    value = float(0.0)
    if channel < colors_end:
        value = component(blocks.colors[splat], channel)
    elif channel < normals_end:
        value = component(blocks.normals[splat], channel - colors_end)
    elif channel < normals_end + blocks.values.shape[1]:
        value = blocks.values[splat % blocks.values.shape[0], channel - normals_end]
    return value


@wp.kernel(enable_backward=False)
def gather_channels_kernel(first: int, blocks: ChannelBlocks, start: int, out_fours: wp.array2d[wp.vec4]):
    """Channels from ``start`` on, as many as a row is long, four by four."""
    splat = first + wp.tid()
    for column in range(out_fours.shape[1]):
        channel = start + 4 * column
        row = wp.vec4(
            channel_of(blocks, splat, channel),
            channel_of(blocks, splat, channel + 1),
            channel_of(blocks, splat, channel + 2),
            channel_of(blocks, splat, channel + 3),
        )
        store_row(out_fours[splat], column, row)


@wp.kernel(enable_backward=False)
def scatter_channels_kernel(
    first: int,
    rows: wp.array2d[float],
    column: int,
    length: int,
    start: int,
    view_count: int,
    out_gradients: ChannelBlocks,
):
    """The adjoint of gathering, one Gaussian's channel an item: sums over the views in order."""
    item = first + wp.tid()
    count = rows.shape[0] / view_count
    i = item / length
    channel = start + item % length
    colors_end = color_channels(out_gradients)
    normals_end = colors_end + normal_channels(out_gradients)
    total = float(0.0)
    for view in range(view_count):
        splat = view * count + i
        value = rows[splat, column + item % length]
        if channel < colors_end:
            out_gradients.colors[splat][channel] = value
        elif channel < normals_end:
            out_gradients.normals[splat][channel - colors_end] = value
        else:
            total += value
    if channel >= normals_end and channel < normals_end + out_gradients.values.shape[1]:
        out_gradients.values[i, channel - normals_end] = total


def launch_evaluate_colors(positions, radiance, views, colors, device):
    """Evaluate the captured colour of every splat."""
    launch(evaluate_colors_kernel, len(colors), inputs=[positions, radiance, views], outputs=[colors], device=device)


def launch_evaluate_colors_adjoint(
    positions, radiance, views, colors, color_gradients, position_gradients, radiance_gradients, device, moves=None
):
    """Add to the gradients of positions and coefficients, from those of colours.

    Those of the zeros in ``moves``, a camera for every splat, are added to their ``grad``; None leaves cameras out.
    """
    kernel = evaluate_colors_kernel if moves is None else evaluate_colors_of_cameras_kernel
    count = len(positions)
    for view in range(len(views)):  # one view at a time: each Gaussian is then added to once a launch, in this order
        launch_adjoint(
            kernel,
            range(view * count, (view + 1) * count),
            inputs=[positions, radiance, views, *([] if moves is None else [moves])],
            outputs=[colors],
            input_gradients=[position_gradients, radiance_gradients, None, *([] if moves is None else [moves.grad])],
            output_gradients=[color_gradients],
            device=device,
        )


def launch_gather_channels(blocks, start, fours, device):
    """Write the channels from ``start`` on; ``fours`` are ``(splats, length / 4)`` vectors of four."""
    launch(gather_channels_kernel, fours.shape[0], inputs=[blocks, start], outputs=[fours], device=device)


def launch_scatter_channels(rows, columns, start, view_count, gradients, device):
    """Write the gradients of the blocks, from those of the rows.

    The channels from ``start`` on are in the ``columns`` of ``rows``, one row a splat.
    """
    launch(
        scatter_channels_kernel,
        rows.shape[0] // view_count * len(columns),
        inputs=[rows, columns.start, len(columns), start, view_count],
        outputs=[gradients],
        device=device,
    )
