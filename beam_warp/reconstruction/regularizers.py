"""Terms that hold the shape and the opacity of Gaussians, whatever the images say.

A term belongs to a number of Gaussians and holds the buffers for them. Called, it adds its gradient to an array that
other terms add to as well, and returns its value in an array of one element that it owns: valid until its next call.
Values and gradients are those of ``weight`` times a mean over all Gaussians, so that a weight does not depend on their
number. Scales are linear [m], opacities in [0, 1]; scales are compared with one another, so that a weight does not
depend on the size of the scene either.

Nothing is allocated in a call and nothing waits for the device: calls may be captured in a CUDA graph, where weights
stay as they were captured. Sums go in a fixed order: same device, same input, same bits.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from beam_warp.checks import require_count, require_number
from beam_warp.device.array_checks import device_array, float_rows, require_device_array
from beam_warp.device.arrays import resolve_device
from beam_warp.kernels.common.fixed_sums import SumBuffers, launch_sum_floats
from beam_warp.kernels.reconstruction.regularizers import launch_add_anisotropy, launch_add_opacity


class _Term:
    """The parts that every term has: a number of Gaussians, a device, what they add, and its value."""

    def __init__(self, count: int, *, device: Any = None) -> None:
        """Make buffers, 4 bytes a Gaussian.

        Args:
            count: Number of Gaussians, N.
            device: Warp device; the first GPU without, or the CPU where there is none.

        Raises:
            InvalidOptionError: ``count`` is out of range.
            DeviceError: The device is not there.
        """
        self.count = require_count("count", count)
        self.device = resolve_device(device)
        self._terms = wp.empty(count, dtype=float, device=self.device)
        self._value = wp.zeros(1, dtype=float, device=self.device)
        self._sums = SumBuffers(self.device)

    def _scale(self, weight: float) -> float:
        return require_number("weight", weight, 0.0) / self.count

    def _finish(self, scale: float) -> wp.array:
        launch_sum_floats(self._terms, scale, self._sums, self._value, self.device)
        return self._value


class AnisotropyLoss(_Term):
    """Needles: the mean of how far the ratio of the longest to the middle scale is above a limit; discs cost nothing.

    Source: Xie et al. 2024, PhysGaussian (longest to shortest there, which would forbid discs).
    """

    LIMIT = 3.0
    """Ratio up to which a Gaussian is free."""

    def __call__(self, scales: Any, *, weight: float = 1.0, gradient: Any = None) -> wp.array:
        """Return weight * sum of max(longest / middle - 3, 0) / N, and add its gradient.

        Args:
            scales: ``(N,)`` vec3 or ``(N, 3)`` float32 [m], above 0.
            weight: The factor of the term, at least 0.
            gradient: The derivative with respect to ``scales`` is added to it, like ``scales``.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
            InvalidOptionError: ``weight`` is negative.
        """
        scale, shape = self._scale(weight), (self.count, 3)
        launch_add_anisotropy(
            device_array("scales", _as_rows(scales), shape, self.device),
            self.LIMIT,
            scale,
            self._terms,
            None if gradient is None else require_device_array("gradient", _as_rows(gradient), shape, self.device),
            self.device,
        )
        return self._finish(scale)


class OpacityLoss(_Term):
    """Opacity: its mean. What no image needs fades, until pruning or relocation takes it.

    Source: Kheradmand et al. 2024, 3DGS as Markov chain Monte Carlo (with a weight of 0.01).
    """

    def __call__(self, opacities: Any, *, weight: float = 1.0, gradient: Any = None) -> wp.array:
        """Return weight * sum of opacity / N, and add its gradient.

        Args:
            opacities: ``(N,)`` float32 in [0, 1].
            weight: The factor of the term, at least 0.
            gradient: The derivative with respect to ``opacities`` is added to it, ``(N,)`` float32.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
            InvalidOptionError: ``weight`` is negative.
        """
        scale, shape = self._scale(weight), (self.count,)
        launch_add_opacity(
            device_array("opacities", opacities, shape, self.device),
            scale,
            self._terms,
            None if gradient is None else require_device_array("gradient", gradient, shape, self.device),
            self.device,
        )
        return self._finish(scale)


def _as_rows(value: Any) -> Any:
    """Return an array of vec3 as rows of floats, anything else as it is."""
    return float_rows(value) if isinstance(value, wp.array) and value.dtype is wp.vec3 else value
