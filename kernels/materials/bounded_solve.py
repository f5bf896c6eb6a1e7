"""Steps of the bounded quadratic problem min 1/2 x'Ax - b'x, low <= x <= high, column by column, A as an operator.

Modified proportioning with reduced gradient projections (Dostal and Schoeberl 2005) in the scaled variables sqrt(D) x:
conjugate gradients on the free face; where such a step would leave the box, the part of it that does not, and then a
projected gradient step of fixed length; where the bound variables say more than the free ones, a step that frees them.
A round applies A to one direction for every column, whichever of these a column is at:

    walk    x <- x - a d, a by conjugate gradients or as far as the box reaches      (d = p)
    free    the same along the gradient at the bounds                                (d = beta / D)
    shift   x was already moved to x + d by projection; the gradient follows         (A d is what it lacks)

D is such that the eigenvalues of D^-1/2 A D^-1/2 are at most 1, so that a fixed step of 1 descends (any below 2 does).
Bound variables are freed when their gradient is longer than the free ones' reduced gradient (a proportion of 1).
All sums are of lanes of a fixed stride, in float64, so that bits do not depend on threads.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})

LANES = 1024
"""Partial sums of each column: rows a lane are those of a stride, so that neighbouring threads read neighbours."""

WALK = wp.constant(0)
FREE = wp.constant(1)
SHIFT = wp.constant(2)


@wp.struct
class Problem:
    """State of all columns, ``(N, K)`` each."""

    x: wp.array2d[float]
    gradient: wp.array2d[float]  # A x - b
    walk: wp.array2d[float]  # p, the conjugate direction
    direction: wp.array2d[float]  # d, what A is applied to next
    applied: wp.array2d[float]  # A d
    scaling: wp.array2d[float]  # D; 0 where nothing determines x, which then stays
    low: float
    high: float


@wp.struct
class ColumnState:
    """State of the solution of each column, ``(K,)`` each."""

    mode: wp.array[int]
    step: wp.array[float]
    clipped: wp.array[int]
    conjugation: wp.array[float]  # next p = phi / D - this times p
    curvature: wp.array[wp.float64]  # d' A d
    residual: wp.array[float]  # length of the projected gradient in the scaled variables


@wp.func
def is_free(problem: Problem, x: float) -> bool:
    return x > problem.low and x < problem.high


@wp.func
def free_gradient(problem: Problem, x: float, g: float) -> float:
    return wp.where(is_free(problem, x), g, 0.0)


@wp.func
def bound_gradient(problem: Problem, x: float, g: float) -> float:
    """Gradient of a variable at its bound if descent leads into the box, else 0."""
    value = float(0.0)
    if x <= problem.low:
        value = wp.min(g, 0.0)
    elif x >= problem.high:
        value = wp.max(g, 0.0)
    return value


@wp.func
def room(problem: Problem, x: float, d: float) -> float:
    """Largest step along -d that keeps x within the box, in units of d."""
    reach = float(wp.inf)
    if d > 0.0:
        reach = (x - problem.low) / d
    elif d < 0.0:
        reach = (x - problem.high) / d
    return reach


@wp.func
def over_scaling(problem: Problem, row: int, column: int, value: float) -> float:
    scale = problem.scaling[row, column]
    return wp.where(scale > 0.0, value / scale, 0.0)


@wp.kernel
def sum_direction_kernel(first: int, problem: Problem, out_sums: wp.array2d[wp.vec2d], out_rooms: wp.array2d[float]):
    """(g'd, d'Ad) and the room along -d of the rows of a lane."""
    item = first + wp.tid()
    columns = problem.x.shape[1]
    lane = item / columns
    c = item % columns
    along = wp.float64(0.0)
    curvature = wp.float64(0.0)
    reach = float(wp.inf)
    for row in range(lane, problem.x.shape[0], wp.static(LANES)):
        d = problem.direction[row, c]
        along += wp.float64(problem.gradient[row, c]) * wp.float64(d)
        curvature += wp.float64(d) * wp.float64(problem.applied[row, c])
        reach = wp.min(reach, room(problem, problem.x[row, c], d))
    out_sums[lane, c] = wp.vec2d(along, curvature)
    out_rooms[lane, c] = reach


@wp.kernel
def choose_step_kernel(first: int, sums: wp.array2d[wp.vec2d], rooms: wp.array2d[float], out_state: ColumnState):
    c = first + wp.tid()
    total = wp.vec2d()
    reach = float(wp.inf)
    for lane in range(sums.shape[0]):
        total += sums[lane, c]
        reach = wp.min(reach, rooms[lane, c])
    step = float(0.0)
    clipped = int(0)
    if total[1] > wp.float64(0.0):
        step = float(total[0] / total[1])
        if step > reach:
            step = reach
            clipped = 1
    out_state.step[c] = step
    out_state.clipped[c] = clipped
    out_state.curvature[c] = total[1]


@wp.kernel
def take_step_kernel(first: int, problem: Problem, state: ColumnState, out_sums: wp.array2d[wp.vec4d]):
    """Move x and its gradient; sum what the next direction depends on: |beta|^2, |phi|^2, phi~'phi, phi'A d, scaled."""
    item = first + wp.tid()
    columns = problem.x.shape[1]
    lane = item / columns
    c = item % columns
    mode = state.mode[c]
    step = state.step[c]
    bound = wp.float64(0.0)
    free = wp.float64(0.0)
    reduced = wp.float64(0.0)
    coupled = wp.float64(0.0)
    for row in range(lane, problem.x.shape[0], wp.static(LANES)):
        x = problem.x[row, c]
        g = problem.gradient[row, c]
        applied = problem.applied[row, c]
        if mode == SHIFT:
            g += applied
        else:
            x = wp.clamp(x - step * problem.direction[row, c], problem.low, problem.high)
            g -= step * applied
            problem.x[row, c] = x
        problem.gradient[row, c] = g
        phi = free_gradient(problem, x, g)
        beta = bound_gradient(problem, x, g)
        scaled = over_scaling(problem, row, c, phi)
        bound += wp.float64(beta) * wp.float64(over_scaling(problem, row, c, beta))
        free += wp.float64(phi) * wp.float64(scaled)
        shortened = x - wp.clamp(x - scaled, problem.low, problem.high)
        reduced += wp.float64(shortened) * wp.float64(phi)
        coupled += wp.float64(scaled) * wp.float64(applied)
    out_sums[lane, c] = wp.vec4d(bound, free, reduced, coupled)


@wp.kernel
def choose_mode_kernel(
    first: int, sums: wp.array2d[wp.vec4d], round: int, out_state: ColumnState, out_residuals: wp.array2d[float]
):
    c = first + wp.tid()
    total = wp.vec4d()
    for lane in range(sums.shape[0]):
        total += sums[lane, c]
    residual = float(wp.sqrt(total[0] + total[1]))
    out_state.residual[c] = residual
    out_residuals[round, c] = residual
    before = out_state.mode[c]
    mode = int(WALK)
    conjugation = float(0.0)
    if before == WALK and out_state.clipped[c] == 1:
        mode = int(SHIFT)
    elif not (total[0] <= total[2]):
        mode = int(FREE)
    elif before == WALK and out_state.curvature[c] > wp.float64(0.0):
        conjugation = float(total[3] / out_state.curvature[c])
    out_state.mode[c] = mode
    out_state.conjugation[c] = conjugation


@wp.kernel
def write_direction_kernel(first: int, problem: Problem, state: ColumnState):
    item = first + wp.tid()
    columns = problem.x.shape[1]
    row = item / columns
    c = item % columns
    x = problem.x[row, c]
    g = problem.gradient[row, c]
    scaled = over_scaling(problem, row, c, free_gradient(problem, x, g))
    if state.mode[c] == SHIFT:
        moved = wp.clamp(x - scaled, problem.low, problem.high)
        problem.x[row, c] = moved
        problem.direction[row, c] = moved - x
        problem.walk[row, c] = 0.0
    elif state.mode[c] == FREE:
        problem.direction[row, c] = over_scaling(problem, row, c, bound_gradient(problem, x, g))
        problem.walk[row, c] = 0.0
    else:
        # Of a variable that has just met its bound the old direction is dropped: the face is another one.
        old = wp.where(is_free(problem, x), problem.walk[row, c], 0.0)
        walk = scaled - state.conjugation[c] * old
        problem.walk[row, c] = walk
        problem.direction[row, c] = walk


class SolveSums:
    """Buffers of the lanes' sums."""

    def __init__(self, columns: int, device: Any) -> None:
        self.direction = wp.empty((LANES, columns), dtype=wp.vec2d, device=device)
        self.rooms = wp.empty((LANES, columns), dtype=float, device=device)
        self.step = wp.empty((LANES, columns), dtype=wp.vec4d, device=device)


def launch_take_step(problem, state, sums, device):
    """Choose every column's step along the direction that A was applied to, and take it."""
    columns = problem.x.shape[1]
    launch(sum_direction_kernel, LANES * columns, inputs=[problem], outputs=[sums.direction, sums.rooms], device=device)
    launch(choose_step_kernel, columns, inputs=[sums.direction, sums.rooms], outputs=[state], device=device)
    launch(take_step_kernel, LANES * columns, inputs=[problem, state], outputs=[sums.step], device=device)


def launch_choose_direction(problem, state, sums, round, out_residuals, device):
    """Choose what every column does next, and the direction that A must be applied to for it."""
    launch(
        choose_mode_kernel, problem.x.shape[1], inputs=[sums.step, round], outputs=[state, out_residuals], device=device
    )
    launch(write_direction_kernel, problem.x.size, inputs=[problem, state], outputs=[], device=device)
