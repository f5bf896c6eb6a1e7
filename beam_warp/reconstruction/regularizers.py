"""What Gaussians should look like whatever the images say: thin, not like needles, of one size, opaque or gone.

A term belongs to a number of Gaussians and holds the buffers for them. Called, it adds its gradient to an array that
other terms add to as well, and returns its value in an array of one element that it owns: valid until its next call.
Values and gradients are of ``weight`` times a mean over *all* Gaussians, so that a weight does not depend on their
number; masked ones add 0 to it. Scales are linear [m], opacities in [0, 1]; terms compare lengths with lengths, so that
a weight does not depend on the size of the scene either.

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
from beam_warp.kernels.reconstruction.regularizers import (
    launch_add_anisotropy,
    launch_add_entropy,
    launch_add_flatness,
    launch_add_opacity,
    launch_add_size,
    launch_write_longest,
    launch_write_parts,
)


class _Term:
    """What every term has: a number of Gaussians, a device, what they add, and its value."""

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

    def _floats(self, name: str, value: Any) -> wp.array:
        return device_array(name, value, (self.count,), self.device)

    def _mask(self, mask: Any) -> wp.array | None:
        return None if mask is None else self._floats("mask", mask)

    def _scales(self, value: Any) -> wp.array:
        return device_array("scales", _as_rows(value), (self.count, 3), self.device)

    def _scale_gradient(self, value: Any) -> wp.array | None:
        rows = _as_rows(value)
        return None if rows is None else require_device_array("gradient", rows, (self.count, 3), self.device)

    def _float_gradient(self, value: Any) -> wp.array | None:
        return None if value is None else require_device_array("gradient", value, (self.count,), self.device)

    def _scale(self, weight: float) -> float:
        return require_number("weight", weight, 0.0) / self.count

    def _finish(self, scale: float) -> wp.array:
        launch_sum_floats(self._terms, scale, self._sums, self._value, self.device)
        return self._value


class FlatnessLoss(_Term):
    """Thickness: the mean of the least scale, as a part of the distance to the neighbours.

    Thin Gaussians have a normal and a depth of their own, which the losses on normals and depth then align.

    Source: Chen et al. 2023, NeuSG (the least scale); taken relative to the spacing here.
    """

    def __call__(
        self, scales: Any, spacings: Any, *, weight: float = 1.0, mask: Any = None, gradient: Any = None
    ) -> wp.array:
        """Return weight * sum of mask * min(scales) / spacing / N, and add its gradient.

        Args:
            scales: ``(N,)`` vec3 or ``(N, 3)`` float32 [m].
            spacings: Distance to the neighbours, above 0, ``(N,)`` float32 [m]; it has no gradient.
            weight: The factor of the term, at least 0.
            mask: What each Gaussian counts, ``(N,)`` float32; 1 without. It has no gradient.
            gradient: The derivative with respect to ``scales`` is added to it, like ``scales``. Of equal least scales
                the first has it.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
            InvalidOptionError: ``weight`` is negative.
        """
        scale = self._scale(weight)
        launch_add_flatness(
            self._scales(scales),
            self._floats("spacings", spacings),
            self._mask(mask),
            scale,
            self._terms,
            self._scale_gradient(gradient),
            self.device,
        )
        return self._finish(scale)


class AnisotropyLoss(_Term):
    """Needles: the mean of how far the ratio of the longest to the middle scale is above a limit; discs cost nothing.

    Source: Xie et al. 2024, PhysGaussian (longest to shortest there, which would forbid discs).
    """

    def __call__(
        self, scales: Any, *, limit: float = 3.0, weight: float = 1.0, mask: Any = None, gradient: Any = None
    ) -> wp.array:
        """Return weight * sum of mask * max(longest / middle - limit, 0) / N, and add its gradient.

        Args:
            scales: ``(N,)`` vec3 or ``(N, 3)`` float32 [m], above 0.
            limit: Ratio up to which a Gaussian is free, at least 1.
            weight: The factor of the term, at least 0.
            mask: What each Gaussian counts, ``(N,)`` float32; 1 without. It has no gradient.
            gradient: The derivative with respect to ``scales`` is added to it, like ``scales``.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
            InvalidOptionError: ``limit`` or ``weight`` is out of range.
        """
        scale = self._scale(weight)
        launch_add_anisotropy(
            self._scales(scales),
            require_number("limit", limit, 1.0),
            self._mask(mask),
            scale,
            self._terms,
            self._scale_gradient(gradient),
            self.device,
        )
        return self._finish(scale)


class SizeLoss(_Term):
    """Outsized Gaussians: the mean of how far the longest scale leaves a range around the mean of all longest scales.

    The mean is held still: it has no gradient, so that one Gaussian's size is no other's business.

    Source: Jiang et al. 2024, DualGS (its joints; there a sum of lengths, here a mean of ratios).
    """

    def __init__(self, count: int, *, device: Any = None) -> None:
        """Make buffers; see `FlatnessLoss`."""
        super().__init__(count, device=device)
        self._total = wp.zeros(1, dtype=float, device=self.device)
        self._parts = wp.zeros(1, dtype=float, device=self.device)

    def __call__(
        self,
        scales: Any,
        *,
        low: float = 0.2,
        high: float = 5.0,
        weight: float = 1.0,
        mask: Any = None,
        gradient: Any = None,
    ) -> wp.array:
        """Return weight * sum of mask * (max(size - high, 0) + max(low - size, 0)) / N, and add its gradient.

        Args:
            scales: ``(N,)`` vec3 or ``(N, 3)`` float32 [m]; a Gaussian's size is its longest over the mean longest.
            low: Least size that is free, in [0, 1].
            high: Largest one, at least 1.
            weight: The factor of the term, at least 0.
            mask: What each Gaussian counts, here and in the mean, ``(N,)`` float32; 1 without. It has no gradient.
            gradient: The derivative with respect to ``scales`` is added to it, like ``scales``.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
            InvalidOptionError: A number is out of range.
        """
        scale = self._scale(weight)
        least, most = require_number("low", low, 0.0, 1.0), require_number("high", high, 1.0)
        rows, counted, out = self._scales(scales), self._mask(mask), self._scale_gradient(gradient)
        launch_write_longest(rows, counted, self._terms, self.device)
        launch_sum_floats(self._terms, 1.0, self._sums, self._total, self.device)
        launch_write_parts(counted, self._terms, self.device)
        launch_sum_floats(self._terms, 1.0, self._sums, self._parts, self.device)
        launch_add_size(rows, self._total, self._parts, least, most, counted, scale, self._terms, out, self.device)
        return self._finish(scale)


class OpacityLoss(_Term):
    """Opacity: its mean. What no image needs fades, until pruning or relocation takes it.

    Source: Kheradmand et al. 2024, 3DGS as Markov chain Monte Carlo (with a weight of 0.01).
    """

    def __call__(self, opacities: Any, *, weight: float = 1.0, mask: Any = None, gradient: Any = None) -> wp.array:
        """Return weight * sum of mask * opacity / N, and add its gradient.

        Args:
            opacities: ``(N,)`` float32 in [0, 1].
            weight: The factor of the term, at least 0.
            mask: What each Gaussian counts, ``(N,)`` float32; 1 without. It has no gradient.
            gradient: The derivative with respect to ``opacities`` is added to it, ``(N,)`` float32.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
            InvalidOptionError: ``weight`` is negative.
        """
        scale = self._scale(weight)
        launch_add_opacity(
            self._floats("opacities", opacities),
            self._mask(mask),
            scale,
            self._terms,
            self._float_gradient(gradient),
            self.device,
        )
        return self._finish(scale)


class OpacityEntropyLoss(_Term):
    """Indecision: the mean entropy of the opacities, at most ln 2. Half-transparent layers become surface, or go.

    For the end of a training: early on it settles what is not known yet.

    Source: Guedon and Lepetit 2024, SuGaR.
    """

    def __call__(self, opacities: Any, *, weight: float = 1.0, mask: Any = None, gradient: Any = None) -> wp.array:
        """Return weight * sum of mask * (-o ln o - (1 - o) ln(1 - o)) / N, and add its gradient.

        Args:
            opacities: ``(N,)`` float32 in [0, 1].
            weight: The factor of the term, at least 0.
            mask: What each Gaussian counts, ``(N,)`` float32; 1 without. It has no gradient.
            gradient: The derivative with respect to ``opacities`` is added to it, ``(N,)`` float32; nearer than 1e-4
                to 0 and 1, where it has poles, it is the one there.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
            InvalidOptionError: ``weight`` is negative.
        """
        scale = self._scale(weight)
        launch_add_entropy(
            self._floats("opacities", opacities),
            self._mask(mask),
            scale,
            self._terms,
            self._float_gradient(gradient),
            self.device,
        )
        return self._finish(scale)


def _as_rows(value: Any) -> Any:
    """Return an array of vec3 as rows of floats, anything else as it is."""
    return float_rows(value) if isinstance(value, wp.array) and value.dtype is wp.vec3 else value
