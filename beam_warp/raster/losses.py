"""Terms of a training loss on images, and their gradients: absolute difference, structural similarity, normals.

A term belongs to one size of image and holds the buffers for it. Called, it adds its gradient to an array that other
terms add to as well, and returns its value in an array of one element that it owns: valid until its next call. Values
and gradients are of ``weight`` times a mean over *all* pixels; masked ones add 0 to it. So terms of one image add up,
and halving the mask halves the term.

Nothing is allocated in a call and nothing waits for the device: calls may be captured in a CUDA graph, where weights
stay as they were captured. Sums go in a fixed order: same device, same input, same bits. Arrays may be strided views,
such as some channels of wider rows; inputs may also be NumPy arrays, which are uploaded at every call. Images are
finite.
"""

from __future__ import annotations

import math
from typing import Any

import warp as wp

from beam_warp.checks import require_count, require_number
from beam_warp.device.array_checks import device_array, require_device_array
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.common.fixed_sums import SumBuffers, launch_sum_floats
from beam_warp.kernels.raster.image_losses import launch_add_l1, launch_add_normal
from beam_warp.kernels.raster.ssim import launch_add_window_gradients, launch_compare_windows, strip_count
from beam_warp.world.camera import MAX_PIXELS, MAX_SIDE


class _Term:
    """Size, device, buffers of a sum and value, which every term has."""

    def __init__(self, height: int, width: int, channels: int = 3, *, device: Any = None) -> None:
        """Make buffers for images of one size.

        Args:
            height: Rows.
            width: Columns.
            channels: Channels, C.
            device: Warp device; the first GPU without, or the CPU where there is none.

        Raises:
            InvalidOptionError: A size is out of range.
            DeviceError: The device is not there.
        """
        self.shape = (
            require_count("height", height, 1, MAX_SIDE),
            require_count("width", width, 1, MAX_SIDE),
            require_count("channels", channels, 1, 64),
        )
        if height * width * channels > MAX_PIXELS:
            raise InvalidOptionError(
                f"height x width x channels must be at most {MAX_PIXELS}, got {height} x {width} x {channels}. "
                "Choose a smaller image."
            )
        self.device = resolve_device(device)
        self._value = wp.zeros(1, dtype=float, device=self.device)
        self._sums = SumBuffers(self.device)
        self._allocate(height, width, channels)

    def _allocate(self, height: int, width: int, channels: int) -> None:
        """Allocate the threads' output: one number a pixel."""
        self._terms = wp.empty(height * width, dtype=float, device=self.device)

    def _input(self, name: str, value: Any) -> wp.array:
        return device_array(name, value, self.shape, self.device)

    def _mask(self, mask: Any) -> wp.array | None:
        return None if mask is None else device_array("mask", mask, self.shape[:2], self.device)

    def _output(self, name: str, value: wp.array | None) -> wp.array | None:
        return None if value is None else require_device_array(name, value, self.shape, self.device)

    def _finish(self, scale: float, value: bool) -> wp.array:
        if value:
            launch_sum_floats(self._terms, scale, self._sums, self._value, self.device)
        return self._value


class _ImageTerm(_Term):
    """A mean over the channels of an image and its target, of what two pixels or windows differ by."""

    def __call__(
        self,
        image: Any,
        target: Any,
        *,
        weight: float = 1.0,
        mask: Any = None,
        gradient: wp.array | None = None,
        value: bool = True,
    ) -> wp.array:
        """Return weight * sum over pixels of mask * difference / (H W C), and add its gradient.

        Args:
            image: ``(H, W, C)`` float32.
            target: The image to match, like ``image``.
            weight: The factor of the term, at least 0.
            mask: Weight of each pixel, or of the window around it, ``(H, W)`` float32, usually in [0, 1]; 1 without. It
                has no gradient.
            gradient: The derivative with respect to ``image`` is added to it, ``(H, W, C)`` float32.
            value: Whether the sum is found, which takes three launches; else what is returned is that of before.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
            InvalidOptionError: ``weight`` is negative.
        """
        picture, truth = self._input("image", image), self._input("target", target)
        out = self._output("gradient", gradient)
        scale = _scale(weight, self.shape)
        self._compare(picture, truth, self._mask(mask), scale, out)
        return self._finish(scale, value)

    def _compare(self, image: wp.array, target: wp.array, mask: Any, scale: float, gradient: Any) -> None:
        """Write the differences to ``_terms``, and add ``scale`` times their gradient."""
        raise NotImplementedError


class L1Loss(_ImageTerm):
    """Mean absolute difference, |image - target|; its gradient is 0 where the images are equal.

    Buffers take 4 bytes a pixel.
    """

    def _compare(self, image: wp.array, target: wp.array, mask: Any, scale: float, gradient: Any) -> None:
        launch_add_l1(image, target, mask, scale, self._terms, gradient, self.device)


class SsimLoss(_ImageTerm):
    """One minus the mean structural similarity, of values in [0, 1].

    Windows are Gaussian, 11 x 11 pixels with a standard deviation of 1.5, and everything beyond the image is 0, as in
    3DGS (Kerbl et al. 2023): only 5 pixels and more from the border does it equal `beam_warp.image.metrics.ssim`'s map.
    A window that counts sees all its pixels, masked or not.

    Channels are compared one by one. Buffers take about 12 bytes a pixel and channel.

    Source: Wang et al. 2004, Eq. 13.
    """

    def _allocate(self, height: int, width: int, channels: int) -> None:
        """Allocate a number for every strip of pixels, and three slopes for every pixel and channel."""
        self._terms = wp.empty(strip_count(height, width, channels), dtype=float, device=self.device)
        self._slopes = wp.empty((3, height, width, channels), dtype=float, device=self.device)

    def _compare(self, image: wp.array, target: wp.array, mask: Any, scale: float, gradient: Any) -> None:
        slopes = None if gradient is None else self._slopes
        launch_compare_windows(image, target, mask, scale, self._terms, slopes, self.device)
        if gradient is not None:
            launch_add_window_gradients(image, target, slopes, gradient, self.device)


class NormalLoss(_Term):
    """Disagreement of rendered normals with those of the rendered depth: the mean of 1 - cos of the angle.

    Source: Zhang et al. 2024, RaDe-GS (normal consistency); there every pixel counts the same.
    """

    def __init__(self, height: int, width: int, *, device: Any = None) -> None:
        """Make buffers for images of one size, 4 bytes a pixel.

        Args:
            height: Rows.
            width: Columns.
            device: Warp device; the first GPU without, or the CPU where there is none.

        Raises:
            InvalidOptionError: A size is out of range.
            DeviceError: The device is not there.
        """
        super().__init__(height, width, device=device)

    def __call__(
        self,
        rendered: Any,
        expected: Any,
        *,
        weight: float = 1.0,
        mask: Any = None,
        tolerance: float = math.inf,
        rendered_gradient: wp.array | None = None,
        expected_gradient: wp.array | None = None,
        value: bool = True,
    ) -> wp.array:
        """Return weight * sum over pixels of mask * t (sqrt(t^2 + 2 d) - t) / (H W), and add gradients.

        d is 1 - rendered . expected / |rendered|, half the squared chord between the normals, and t the tolerance: what
        differs by less counts by the square of the angle, what differs by more by the angle, so that an edge is not
        smoothed for the sake of its few pixels. An infinite tolerance gives d itself. Pixels where ``expected`` is 0,
        or ``rendered`` shorter than 0.001, add 0 to the sum and have no gradient.

        Args:
            rendered: Normals as composited, of any length, ``(H, W, 3)`` float32.
            expected: Unit normals or 0, such as `DepthNormals` writes, in the same axes.
            weight: The factor of the term, at least 0.
            mask: Weight of each pixel, ``(H, W)`` float32, such as alpha; 1 without. It has no gradient.
            tolerance: Angle [rad], above 0.
            rendered_gradient: The derivative with respect to ``rendered``, through its normalisation, is added to it.
            expected_gradient: The derivative with respect to ``expected``, taken as it is, is added to it.
            value: Whether the sum is found, as of images.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
            InvalidOptionError: ``weight`` is negative, or ``tolerance`` not above 0.

        Source: d, BEAM Eq. 2; its growth, Charbonnier et al. 1994.
        """
        scale = _scale(weight, self.shape[:2])
        if not tolerance > 0.0:
            raise InvalidOptionError(f"tolerance must be above 0, got {tolerance}. Pass an angle in radians.")
        launch_add_normal(
            self._input("rendered", rendered),
            self._input("expected", expected),
            self._mask(mask),
            tolerance**-2.0,
            scale,
            self._terms,
            self._output("rendered_gradient", rendered_gradient),
            self._output("expected_gradient", expected_gradient),
            self.device,
        )
        return self._finish(scale, value)


def _scale(weight: float, shape: tuple[int, ...]) -> float:
    """Return the factor of a sum that makes it a weighted mean."""
    return require_number("weight", weight, 0.0) / math.prod(shape)
