"""Scene-linear colour and coverage of one image, the form in which all steps of reconstruction read a capture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.capture.mattes import MaskOffset, Uncut
from beam_warp.checks import require_array, require_count, require_finite, require_range
from beam_warp.errors import InvalidArrayError
from beam_warp.image.metrics import block_means
from beam_warp.world.camera import Camera


@dataclass(frozen=True, eq=False, kw_only=True)
class CapturedView:
    """An image, its camera and its coverage.

    Attributes:
        name: Name of the view in messages and files.
        camera: The pinhole that took the image.
        color: Scene-linear Rec.709, premultiplied by ``alpha`` where there is one, ``(H, W, 3)`` float32.
        alpha: Coverage of the subject in [0, 1], ``(H, W)`` float32; None if it is unknown.
        doubt: How much is not known of a pixel, 0 to 1: its colour and coverage are a guess where a photograph does not
            tell where the subject ends, ``(H, W)`` float32; None for nothing of any.
        mask_offset: How far the file's mask reached beyond the subject before it was moved; None if nothing tells.
        uncut: The photograph as it was before the subject was cut out of it; None if it shows the subject alone.
        is_recut: Whether ``alpha`` is an estimate in place of the file's, whose cut-out was too large or too small.

    Raises:
        InvalidArrayError: An array has another size than the camera, or a value is not finite or out of range.
    """

    name: str
    camera: Camera
    color: NDArray[np.float32]
    alpha: NDArray[np.float32] | None = None
    doubt: NDArray[np.float32] | None = None
    mask_offset: MaskOffset | None = None
    uncut: Uncut | None = None
    is_recut: bool = False

    def __post_init__(self) -> None:
        """Check sizes and values once."""
        size = (self.camera.height, self.camera.width)
        color = require_array("color", self.color, (*size, 3))
        require_finite("color", color)
        object.__setattr__(self, "color", color)
        for name in ("alpha", "doubt"):
            if (value := getattr(self, name)) is not None:
                part = require_array(name, value, size)
                require_range(name, part, 0.0, 1.0)
                object.__setattr__(self, name, part)

    @cached_property
    def subject(self) -> tuple[tuple[int, int], tuple[int, int]] | None:
        """First column and row of the subject, and the ones after its last; zeros for none, None where alpha is."""
        if self.alpha is None:
            return None
        rows, columns = (np.flatnonzero((self.alpha > 0.0).any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return (0, 0), (0, 0)
        return (int(columns[0]), int(rows[0])), (int(columns[-1]) + 1, int(rows[-1]) + 1)

    @cached_property
    def covered(self) -> float:
        """How many pixels the subject covers; all of the image where that is not known."""
        return float(self.camera.width * self.camera.height if self.alpha is None else self.alpha.sum())

    def cropped(self, left: int, top: int, width: int, height: int) -> CapturedView:
        """Return a part of the view with its camera.

        Raises:
            InvalidArrayError: The part is not within the image.
        """
        if not (0 <= left < left + width <= self.camera.width and 0 <= top < top + height <= self.camera.height):
            raise InvalidArrayError(
                f"crop must lie in {self.camera.width} x {self.camera.height} pixels, got {width} x {height} at "
                f"{left}, {top}. Cut it down."
            )
        if (width, height) == (self.camera.width, self.camera.height):
            return self
        part = (slice(top, top + height), slice(left, left + width))
        camera = self.camera.cropped(left, top, width, height)
        return self._mapped(camera, lambda image: np.ascontiguousarray(image[part]))

    def _mapped(self, camera: Camera, of: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> CapturedView:
        """Return the view of another camera, each image after the same operation."""
        return replace(
            self,
            camera=camera,
            color=of(self.color),
            alpha=None if self.alpha is None else of(self.alpha),
            doubt=None if self.doubt is None else of(self.doubt),
            uncut=None if self.uncut is None else self.uncut.mapped(of),
        )

    def brightened(self, factors: ArrayLike) -> CapturedView:
        """Return the view with its light times a factor, one for each of red, green and blue, or ``(H, W, 1)``."""
        gains = np.asarray(factors, np.float32)
        uncut = None if self.uncut is None else self.uncut.mapped(lambda image: image * gains)
        return replace(self, color=self.color * gains, uncut=uncut)

    def reduced(self, factor: int) -> CapturedView:
        """Return the view at a lower resolution, each pixel the mean of ``factor`` x ``factor`` pixels.

        Rows and columns beyond the last whole pixel are left out.

        Raises:
            InvalidArrayError: Nothing would be left.
        """
        require_count("factor", factor)
        width, height = self.camera.width // factor, self.camera.height // factor
        if not (width and height):
            raise InvalidArrayError(
                f"factor must leave a pixel of {self.camera.width} x {self.camera.height}, got {factor}. "
                "Choose a smaller one."
            )
        if factor == 1:
            return self

        return self._mapped(
            self.camera.reduced(factor), lambda image: block_means(image[: height * factor, : width * factor], factor)
        )
