"""The temporal term of tracking: attributes of Gaussians are held to their values in the frame before (E_temp)."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_number
from beam_warp.device.array_checks import float_rows
from beam_warp.kernels.reconstruction.gradient_sums import launch_add_difference_gradients
from beam_warp.reconstruction.parameters import GaussianParameters

SMALLEST_SPACING = 1e-11
"""Smallest distance of neighbours [m]: the inverse square of a tenth of it is a float32."""


class TemporalTerms:
    """Terms that hold each attribute of Gaussians to its value in the frame before (E_temp).

    A term is the mean of ((values - reference) / unit)^2 over all floats of an attribute as the optimiser moves it.
    Nothing is allocated in a call of `add_gradients`, and nothing waits for the device.

    Source: Jiang et al. 2024, DualGS, E_temp; there the norm of all changes of an attribute together, before its
    activation.
    """

    UNITS: Mapping[str, float] = MappingProxyType({"radiance": 0.1, "log_scales": 0.1, "logits": 0.5})
    """The change of each attribute that counts as 1."""

    def __init__(self, parameters: GaussianParameters, spacing: float) -> None:
        """Hold Gaussians to what they are now.

        Args:
            parameters: The Gaussians.
            spacing: Distance of neighbouring ones [m]; a tenth of it counts as 1.

        Raises:
            InvalidOptionError: ``spacing`` is below `SMALLEST_SPACING`.
        """
        require_number("spacing", spacing, SMALLEST_SPACING)
        self._parameters = parameters
        self._units = {**self.UNITS, "positions": 0.1 * spacing}
        self._references = {name: wp.clone(float_rows(getattr(parameters, name))) for name in self._units}

    def hold(self, changed: NDArray[np.bool_]) -> None:
        """Hold rows to what they became: another Gaussian, or none, which would be pulled back to life."""
        for name, reference in self._references.items():
            held = reference.numpy().copy()
            held[changed] = float_rows(getattr(self._parameters, name)).numpy()[changed]
            reference.assign(held)

    def add_gradients(self, weight: float) -> None:
        """Add the gradients of all terms, times a weight, to those of the Gaussians."""
        parameters = self._parameters
        for name, reference in self._references.items():
            values, gradients = float_rows(getattr(parameters, name)), float_rows(parameters.gradient(name))
            scale = weight / self._units[name] ** 2 / reference.size
            launch_add_difference_gradients(values, reference, scale, gradients, parameters.device)
