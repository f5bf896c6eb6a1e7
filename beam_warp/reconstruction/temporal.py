"""The temporal term of tracking: attributes of Gaussians are held to their values in the frame before (E_temp).

Terms add their gradients and return their values as `beam_warp.reconstruction.joints.rigidity` does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_count, require_number
from beam_warp.device.array_checks import float_rows
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError
from beam_warp.kernels.common.fixed_sums import SumBuffers, launch_sum_floats
from beam_warp.kernels.reconstruction.squared_difference import launch_add_squared_difference
from beam_warp.reconstruction.parameters import GaussianParameters

SMALLEST_UNIT = 1e-12
"""Smallest unit of a difference; its inverse square is a float32."""


class TemporalLoss:
    """Mean squared change of an attribute since an earlier frame (E_temp), in units of a change that matters.

    Source: Jiang et al. 2024, DualGS, E_temp; there the norm of all changes of an attribute together, before its
    activation, here the mean of their squares, and the caller says before or after.
    """

    def __init__(self, shape: tuple[int, int], *, device: Any = None) -> None:
        """Make buffers, 4 bytes for each float.

        Args:
            shape: Rows and floats of each, ``(N, K)``: vec3 have K = 3, quaternions 4.
            device: Warp device; the first GPU without, or the CPU where there is none.

        Raises:
            InvalidOptionError: A size is out of range.
            DeviceError: The device is not there.
        """
        self._shape = (require_count("shape[0]", shape[0]), require_count("shape[1]", shape[1]))
        self.device = resolve_device(device)
        self._terms = wp.empty(math.prod(self._shape), dtype=float, device=self.device)
        self._value = wp.zeros(1, dtype=float, device=self.device)
        self._sums = SumBuffers(self.device)

    def __call__(
        self,
        values: wp.array,
        reference: wp.array,
        *,
        weight: float = 1.0,
        unit: float = 1.0,
        gradient: wp.array | None = None,
    ) -> wp.array:
        """Return weight * mean over all floats of ((values - reference) / unit)^2, and add its gradient.

        Quaternions are compared as they are: q and -q are 2 apart.

        Args:
            values: N floats, vectors or quaternions, contiguous, or ``(N, K)`` floats of any strides.
            reference: The earlier values, like ``values`` or its rows as ``(N, K)`` floats, without a gradient.
            weight: The factor of the term, at least 0.
            unit: The change that counts as 1, in the units of the values; at least 1e-12.
            gradient: The derivative with respect to ``values`` is added to it, like ``reference``.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
            InvalidOptionError: ``weight`` is negative, or ``unit`` too small.
        """
        scale = require_number("weight", weight, 0.0) / require_number("unit", unit, SMALLEST_UNIT) ** 2
        scale /= self._terms.size
        launch_add_squared_difference(
            self._rows("values", values),
            self._rows("reference", reference),
            scale,
            self._terms,
            None if gradient is None else self._rows("gradient", gradient),
            self.device,
        )
        launch_sum_floats(self._terms, scale, self._sums, self._value, self.device)
        return self._value

    def _rows(self, name: str, value: Any) -> wp.array:
        if not isinstance(value, wp.array) or value.device != self.device:
            found = f"one on {value.device}" if isinstance(value, wp.array) else type(value).__name__
            raise InvalidArrayError(f"{name} must be a warp array on {self.device}, got {found}. Move it there.")
        rows = float_rows(value)
        if rows.shape != self._shape:
            raise InvalidArrayError(f"{name} must have {self._shape} floats, got {rows.shape}. Pass one row each.")
        return rows


class TemporalTerms:
    """Temporal losses that hold each attribute of Gaussians to its value in the frame before (E_temp)."""

    UNITS: Mapping[str, float] = MappingProxyType({"radiance": 0.1, "log_scales": 0.1, "logits": 0.5})
    """The change of each attribute that counts as 1."""

    def __init__(self, parameters: GaussianParameters, spacing: float) -> None:
        """Hold Gaussians to what they are now.

        Args:
            parameters: The Gaussians.
            spacing: Distance of neighbouring ones [m]; a tenth of it counts as 1.
        """
        self._parameters = parameters
        self._units = {**self.UNITS, "positions": 0.1 * spacing}
        self._terms = {}
        for name in self._units:
            rows = float_rows(getattr(parameters, name))
            self._terms[name] = (TemporalLoss(rows.shape, device=parameters.device), wp.clone(rows))

    def hold(self, changed: NDArray[np.bool_]) -> None:
        """Hold rows to what they became: another Gaussian, or none, which would be pulled back to life."""
        for name, (_, reference) in self._terms.items():
            held = reference.numpy().copy()
            held[changed] = float_rows(getattr(self._parameters, name)).numpy()[changed]
            reference.assign(held)

    def add_gradients(self, weight: float) -> None:
        """Add the gradients of all terms, times a weight, to those of the Gaussians."""
        for name, (term, reference) in self._terms.items():
            values, gradients = getattr(self._parameters, name), self._parameters.gradient(name)
            unit = self._units[name]
            term(float_rows(values), reference, weight=weight, unit=unit, gradient=float_rows(gradients))
