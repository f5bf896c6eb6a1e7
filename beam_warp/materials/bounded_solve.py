"""Bounded quadratic problems: the minimum of 1/2 x'Ax - b'x in a box, column by column, with A as an operator.

Conjugate gradients on the variables that no bound holds; see ``kernels/materials/bounded_solve.py``.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.kernels.materials.bounded_solve import (
    ColumnState,
    Problem,
    SolveSums,
    launch_choose_direction,
    launch_take_step,
)

CHECK_EVERY = 5
"""Passes between looks at the residual, each of which waits for the device."""


class QuadraticProblem(Protocol):
    """A and b; arrays are ``(N, K)`` float on one device."""

    def scaling(self) -> wp.array:
        """Return a diagonal D with eigenvalues of D^-1/2 A D^-1/2 of at most 1; 0 where nothing determines x."""

    def add_gradient(self, values: wp.array, out: wp.array) -> None:
        """Add A x - b to ``out``."""

    def apply(self, values: wp.array, out: wp.array) -> None:
        """Write A x to ``out``."""


def solve_bounded(
    quadratic: QuadraticProblem, values: wp.array, *, bounds: tuple[float, float], passes: int, tolerance: float
) -> NDArray[np.float32]:
    """Move values to the minimum by modified proportioning, in place.

    Args:
        quadratic: The problem.
        values: Where solving begins, within the bounds.
        bounds: Least and largest value; infinite for none.
        passes: Most times that A is applied.
        tolerance: Solving ends where the projected gradient of every column is below this part of what it was.

    Returns:
        After each pass, and before the first, the length of the projected gradient, ``(passes + 1, K)``.

    Source: Dostal and Schoeberl 2005.
    """
    device, (count, width) = values.device, values.shape
    problem = Problem()
    problem.x = values
    for name in ("gradient", "walk", "direction", "applied"):
        setattr(problem, name, wp.zeros((count, width), dtype=float, device=device))
    problem.scaling = quadratic.scaling()
    problem.low, problem.high = bounds
    state = ColumnState()
    for name, dtype in (("mode", int), ("step", float), ("clipped", int), ("conjugation", float)):
        setattr(state, name, wp.zeros(width, dtype=dtype, device=device))
    state.curvature = wp.zeros(width, dtype=wp.float64, device=device)
    state.residual = wp.zeros(width, dtype=float, device=device)
    sums = SolveSums(width, device)
    residuals = wp.zeros((passes + 1, width), dtype=float, device=device)

    quadratic.add_gradient(values, problem.gradient)
    # A step along no direction: it only sums what the first direction depends on.
    launch_take_step(problem, state, sums, device)
    launch_choose_direction(problem, state, sums, 0, residuals, device)
    taken = 0
    for taken in range(1, passes + 1):
        quadratic.apply(problem.direction, problem.applied)
        launch_take_step(problem, state, sums, device)
        launch_choose_direction(problem, state, sums, taken, residuals, device)
        if taken % CHECK_EVERY == 0 or taken == passes:
            found = residuals.numpy()[: taken + 1]
            if not (found[-1] > tolerance * found[0]).any():
                break
    return np.asarray(residuals.numpy()[: taken + 1])
