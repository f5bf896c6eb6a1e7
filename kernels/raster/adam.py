"""Adam over rows: every row has its own count of steps, every group of columns its own learning rate.

Two kernels: one a row, which counts its step and works out the bias corrections in float64 (1 - 0.999^t has no digits
to lose in float32); one a float of any group, which moves it.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})


@wp.struct
class ParameterGroup:
    """Some columns of every row, with their moments; each ``(N, K)``."""

    parameters: wp.array2d[float]
    gradients: wp.array2d[float]
    means: wp.array2d[float]  # of the gradient, decaying
    squares: wp.array2d[float]  # of its square
    end: int  # how many floats this group and those before it have


@wp.struct
class AdamOptions:
    beta1: wp.float64
    beta2: wp.float64
    fresh1: float  # 1 - beta1, rounded once
    fresh2: float
    epsilon: float


@wp.kernel
def count_steps_kernel(
    first: int,
    visible: wp.array[bool],
    options: AdamOptions,
    out_steps: wp.array[int],
    out_corrections: wp.array[wp.vec2],
):
    row = first + wp.tid()
    if visible:
        if not visible[row]:
            out_corrections[row] = wp.vec2(0.0, 0.0)  # no correction is 0: the row is left alone
            return
    step = out_steps[row] + 1
    out_steps[row] = step
    one = wp.float64(1.0)
    count = wp.float64(step)
    out_corrections[row] = wp.vec2(
        wp.float32(one / (one - wp.pow(options.beta1, count))), wp.float32(one / (one - wp.pow(options.beta2, count)))
    )


@wp.kernel
def move_parameters_kernel(
    first: int,
    groups: wp.array[ParameterGroup],
    rates: wp.array[float],
    corrections: wp.array[wp.vec2],
    options: AdamOptions,
):
    item = first + wp.tid()
    start = int(0)
    index = int(0)
    while item >= groups[index].end:
        start = groups[index].end
        index += 1
    width = groups[index].parameters.shape[1]
    row = (item - start) / width
    column = (item - start) % width
    correction = corrections[row]
    if correction[0] == 0.0:
        return
    # Members one by one: a group as a whole would be copied, ten times what is read here.
    gradient = groups[index].gradients[row, column]
    mean = groups[index].means[row, column]
    square = groups[index].squares[row, column]
    mean += options.fresh1 * (gradient - mean)
    square += options.fresh2 * (gradient * gradient - square)
    groups[index].means[row, column] = mean
    groups[index].squares[row, column] = square
    step = mean * correction[0] / (wp.sqrt(square * correction[1]) + options.epsilon)
    groups[index].parameters[row, column] = groups[index].parameters[row, column] - rates[index] * step


@wp.kernel
def clear_rows_kernel(first: int, marks: wp.array[bool], out_rows: wp.array2d[float]):
    item = first + wp.tid()
    width = out_rows.shape[1]
    if marks[item / width]:
        out_rows[item / width, item % width] = 0.0


@wp.kernel
def clear_steps_kernel(first: int, marks: wp.array[bool], out_steps: wp.array[int]):
    item = first + wp.tid()
    if marks[item]:
        out_steps[item] = 0


def launch_step(visible, groups, rates, options, float_count, out_steps, out_corrections, device):
    """Count the step of every visible row, and move its parameters and moments."""
    inputs = [visible, options]
    launch(count_steps_kernel, out_steps.size, inputs=inputs, outputs=[out_steps, out_corrections], device=device)
    inputs = [groups, rates, out_corrections, options]  # its output goes through the groups
    launch(move_parameters_kernel, float_count, inputs=inputs, outputs=[], device=device)


def launch_clear(marks, groups, out_steps, device):
    """Set the moments and the counts of marked rows to 0."""
    for group in groups:
        for rows in (group.means, group.squares):
            launch(clear_rows_kernel, rows.size, inputs=[marks], outputs=[rows], device=device)
    launch(clear_steps_kernel, out_steps.size, inputs=[marks], outputs=[out_steps], device=device)
