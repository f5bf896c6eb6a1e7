"""The Adam optimiser over groups of arrays that share their rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from beam_warp.checks import require_array, require_choice, require_number, require_same_length
from beam_warp.device.array_checks import float_rows
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.raster.adam import AdamOptions, ParameterGroup, launch_clear, launch_step

MOST_FLOATS = 2**31 - 1
"""Most floats that one optimiser moves: their indices are 32-bit."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """One group of parameters: an attribute of every row, its gradients and its learning rate.

    Attributes:
        values: Moved in place: N floats, vectors or quaternions, or ``(N, K)`` floats; contiguous unless the latter.
        gradients: Where steps read dL/dvalues: of the same shape and kind, or its rows as ``(N, K)`` floats.
        learning_rate: Size of a step in the units of the values; at least 0.
    """

    values: wp.array
    gradients: wp.array
    learning_rate: float


class Adam:
    """Adam with a learning rate for each group; rows that are not visible in a step stay as they are.

    With every row visible this is Kingma and Ba's method. A row that is not visible in a step keeps its values, its
    moments and its count of steps, instead of drifting on by its momentum ("selective Adam"). Steps are counted row by
    row, so that the first step of a row, whenever it comes, moves it by the learning rate against the sign of the
    gradient: the count of all steps would make the first steps of late rows three times as long.

    Counts, learning rates and moments live on the device: steps may be captured in a CUDA graph, and rates changed
    between its launches by `set_learning_rate`. Same device, same input, same bits.

    Attributes:
        parameters: The groups by name; their ``learning_rate`` is the one that they began with.
        device: Where they are.

    Source: Kingma and Ba 2015, Algorithm 1; epsilon as in 3DGS (Kerbl et al. 2023).
    """

    def __init__(
        self, parameters: Mapping[str, Parameters], *, beta1: float = 0.9, beta2: float = 0.999, epsilon: float = 1e-15
    ) -> None:
        """Begin without moments; 8 bytes for every float, and 12 for every row.

        Args:
            parameters: At least one group, by name; all have the same rows and device.
            beta1: Decay of the mean gradient, in [0, 1).
            beta2: Decay of the mean squared gradient, in [0, 1).
            epsilon: Added to the root of the latter, in the units of the gradients.

        Raises:
            InvalidArrayError: Arrays do not fit together, or are not made of float32.
            InvalidOptionError: There is no group, or an option is out of range.
        """
        if not parameters:
            raise InvalidOptionError("parameters must name at least one group, got none. Pass what is to be moved.")
        self.parameters = dict(parameters)
        self._names = tuple(parameters)
        below_one = float(np.nextafter(1.0, 0.0))
        self._options = AdamOptions()
        self._options.beta1 = require_number("beta1", beta1, 0.0, below_one)
        self._options.beta2 = require_number("beta2", beta2, 0.0, below_one)
        self._options.fresh1 = 1.0 - self._options.beta1
        self._options.fresh2 = 1.0 - self._options.beta2
        self._options.epsilon = require_number("epsilon", epsilon, 0.0)
        head = parameters[self._names[0]].values
        self.device = head.device
        self._row_count = head.shape[0]
        self._groups: list[ParameterGroup] = []
        self._float_count = 0
        rates = []
        for name, group in parameters.items():
            rows, gradients = (
                _rows(f"parameters[{name!r}].{part}", array, self._row_count, self.device)
                for part, array in (("values", group.values), ("gradients", group.gradients))
            )
            if rows.shape != gradients.shape:
                raise InvalidArrayError(
                    f"parameters[{name!r}].gradients must have the shape of its values, {rows.shape}, got "
                    f"{gradients.shape}. Pass one for each float."
                )
            rates.append(require_number(f"parameters[{name!r}].learning_rate", group.learning_rate, 0.0))
            self._float_count += rows.size
            entry = ParameterGroup()
            entry.parameters, entry.gradients, entry.end = rows, gradients, min(self._float_count, MOST_FLOATS)
            entry.means, entry.squares = (wp.zeros(rows.shape, dtype=float, device=self.device) for _ in range(2))
            self._groups.append(entry)
        if self._float_count > MOST_FLOATS:
            raise InvalidArrayError(
                f"parameters must hold at most {MOST_FLOATS} floats, got {self._float_count}. Use two optimisers."
            )
        self._table = wp.array(self._groups, dtype=ParameterGroup, device=self.device)
        self._rates = upload(np.array(rates, np.float32), float, self.device)
        self._steps = wp.zeros(self._row_count, dtype=int, device=self.device)
        self._corrections = wp.empty(self._row_count, dtype=wp.vec2, device=self.device)

    def step(self, visible: wp.array | None = None) -> None:
        """Move the values by one step along the present gradients.

        Args:
            visible: Which rows take part, ``(N,)`` warp array of bool; all of them without.

        Raises:
            InvalidArrayError: ``visible`` has another type, length or device.
        """
        if visible is not None and not (
            isinstance(visible, wp.array)
            and visible.dtype is wp.bool
            and visible.shape == (self._row_count,)
            and visible.device == self.device
        ):
            got = type(visible).__name__
            if isinstance(visible, wp.array):
                got = f"{visible.dtype.__name__} {visible.shape} on {visible.device}"
            raise InvalidArrayError(
                f"visible must be a warp array of {self._row_count} bool on {self.device}, got {got}. Convert it."
            )
        state = (self._rates, self._options, self._float_count, self._steps, self._corrections)
        launch_step(visible, self._table, *state, self.device)

    def set_learning_rate(self, name: str, learning_rate: float) -> None:
        """Change the learning rate of a group from the next step on, also of a captured one.

        Raises:
            InvalidOptionError: There is no such group, or the rate is negative.
        """
        index = self._names.index(require_choice("name", name, self._names))
        self._rates[index : index + 1].fill_(require_number("learning_rate", learning_rate, 0.0))

    def restart(self, rows: Any) -> None:
        """Forget the moments and steps of some rows, whose values were replaced; arrays stay where they are.

        Args:
            rows: ``(N,)`` bool NumPy, True for rows to begin again.

        Raises:
            InvalidArrayError: ``rows`` has another shape.
        """
        marks = upload(require_array("rows", rows, (self._row_count,), np.bool_), wp.bool, self.device)
        launch_clear(marks, self._groups, self._steps, self.device)


def _rows(name: str, array: Any, count: int, device: Any) -> wp.array:
    """Return an array's rows as floats, after checking that they fit the others."""
    if not isinstance(array, wp.array) or array.device != device:
        found = f"one on {array.device}" if isinstance(array, wp.array) else type(array).__name__
        raise InvalidArrayError(f"{name} must be a warp array on {device}, got {found}. Move it there.")
    require_same_length(name, array, "the first group's values", count)
    rows = float_rows(array)
    if rows.shape[1] == 0:
        raise InvalidArrayError(f"{name} must have at least one float in a row, got {array.shape}. Leave it out.")
    return rows
