"""Undistortion: from a photograph with lens distortion to the image that a pinhole would have taken.

Undistorting only moves pixels within the image: lens and pinhole share centre of projection and optical axis. Lens
models and tangent coordinates are defined in `beam_warp.capture.lenses`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.capture.lenses import Lens
from beam_warp.checks import require_number
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB, linear_to_srgb, srgb_to_linear, straight
from beam_warp.image.files import Image
from beam_warp.world.camera import Camera

MAX_ANGLE = float(np.radians(70.0))
"""Largest angle between the axis and the sides of an undistorted image [rad]; there a pinhole stretches pixels by
1 / cos^2, nearly 9 times."""

GRID = 129
"""Points along each side of the photograph at which the lens is inverted to find its field of view; between two of them
an edge bows by less than 1e-4 of its total bow."""

Coverage = NDArray[np.float32] | np.float32
"""Alpha of an image, or 1 if it has none."""

COLORS = ("R", "G", "B", "Y")
"""Names of colour channels."""

MAX_MAPS = 16
"""Most maps kept in memory, one for each camera and lens, at 8 bytes a pixel."""

MAX_SAMPLES = 4
"""Most samples per pixel and axis where the image is smaller than the photograph."""

BLOCK_PIXELS = 2**17
"""Pixels resampled at a time, so that their arrays fit into a processor's cache."""


class Intrinsics(NamedTuple):
    """A camera without its pose; see `Camera`."""

    width: int
    height: int
    focal_x: float
    focal_y: float
    center_x: float
    center_y: float

    def to_tangents(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the tangent coordinates of pixels ``(N, 2)``."""
        return (pixels - (self.center_x, self.center_y)) / (self.focal_x, self.focal_y)

    def to_pixels(self, tangents: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixels of tangent coordinates ``(N, 2)``."""
        return tangents * (self.focal_x, self.focal_y) + (self.center_x, self.center_y)


@dataclass(frozen=True)
class Undistortion:
    """Map from the photographs of one camera to images of a pinhole at the same place.

    Attributes:
        lens: Distortion of the photographs.
        photograph: Intrinsics that go with the lens.
        pinhole: Intrinsics of the undistorted image, with the same size and shape of pixels.
    """

    lens: Lens
    photograph: Intrinsics
    pinhole: Intrinsics

    @classmethod
    def fit(cls, lens: Lens, photograph: Intrinsics, keep: float = 0.0) -> Undistortion:
        """Choose a pinhole for a photograph.

        Args:
            lens: Distortion of the photograph.
            photograph: Intrinsics that go with the lens.
            keep: 0 for the largest image that the photograph fills, 1 for the smallest image that shows all of the
                photograph and is void beyond it, or a value between; OpenCV calls it ``alpha``. Nothing beyond
                `MAX_ANGLE` from the axis is shown either way.

        Raises:
            InvalidOptionError: The lens folds over within the photograph, or ``keep`` is out of range.
        """
        return cls(lens, photograph, _pinhole(lens, photograph, require_number("keep", keep, 0.0, 1.0)))

    def camera(self, camera_to_world: ArrayLike) -> Camera:
        """Return the camera of the undistorted image, in the pose of the photograph's; see `Camera` for errors."""
        return Camera(*self.pinhole, camera_to_world)  # type: ignore[arg-type]  # Camera converts and checks it

    def mask(self) -> NDArray[np.bool_]:
        """Return which pixels of the undistorted image the photograph shows, ``(H, W)``."""
        if self.lens.is_straight:
            return np.ones((self.pinhole.height, self.pinhole.width), dtype=bool)
        return _resampling(self).mask.copy()

    def image(self, image: Image) -> Image:
        """Undistort a photograph.

        Colour and alpha are resampled as scene-linear light multiplied by alpha, so that no fringe appears, by the
        cubic of Catmull and Rom, kept within the range of the pixels it reads: nothing rings or turns negative. The
        result is encoded as the photograph was. Other channels are means weighted by alpha, between neighbours; those
        of integers are taken from the nearest pixel. Pixels that the photograph does not show are 0 in every channel.
        NaN and infinity stay with their neighbours.

        Args:
            image: The photograph, with the size of `photograph`.

        Returns:
            The image in the same channels, colour space and association with alpha; itself through a straight lens.

        Raises:
            InvalidArrayError: It has another size.
        """
        if (image.width, image.height) != self.photograph[:2]:
            raise InvalidArrayError(
                f"image must be {self.photograph.width} x {self.photograph.height}, got {image.width} x {image.height} "
                f"at {image.path}. Pass the intrinsics of its size."
            )
        if self.lens.is_straight:
            return image
        resampling = _resampling(self)
        channels: dict[str, NDArray[Any]] = {}
        weight: Coverage = np.float32(1.0)
        smooth = mean = resampling.mask.astype(np.float32)
        if image.alpha is not None:
            weight = image.alpha
            smooth, mean = (resampling.sample(weight, filter_by) for filter_by in (_catmull_rom, _linear))
        for name, plane in image.channels.items():
            if name == "A":
                channels[name] = smooth
            elif name in COLORS:
                light = resampling.sample(_premultiplied(plane, weight, image), _catmull_rom)
                channels[name] = _encoded(light, smooth, image)
            elif plane.dtype.kind == "f":
                channels[name] = straight(resampling.sample(plane * weight, _linear), mean)
            else:
                channels[name] = resampling.nearest(plane)
        return replace(image, channels=channels)


@lru_cache(maxsize=1024)
def _pinhole(lens: Lens, photograph: Intrinsics, keep: float) -> Intrinsics:
    """Return the intrinsics that `Undistortion.fit` chooses."""
    if lens.is_straight:
        return photograph
    rays = _seen_rays(lens, photograph)
    # Between the innermost points of opposite edges lies no edge: all of it is seen.
    inner = np.array([rays[:, 0, 0].max(), rays[0, :, 1].max(), rays[:, -1, 0].min(), rays[-1, :, 1].min()])
    outer = np.array([*rays.min(axis=(0, 1)), *rays.max(axis=(0, 1))])
    if not (inner[2] > inner[0] and inner[3] > inner[1]):
        raise InvalidOptionError(
            f"photograph must show a rectangle within {np.degrees(MAX_ANGLE):.0f} degrees of the axis, got tangents x "
            f"from {inner[0]:.4g} to {inner[2]:.4g}, y from {inner[1]:.4g} to {inner[3]:.4g}. Correct the calibration."
        )
    sides = np.array([photograph.width / photograph.focal_x, photograph.height / photograph.focal_y])
    scales = (((inner[2:] - inner[:2]) / sides).min(), ((outer[2:] - outer[:2]) / sides).max())
    scale = (1.0 - keep) * scales[0] + keep * scales[1]
    middle = 0.5 * ((1.0 - keep) * (inner[:2] + inner[2:]) + keep * (outer[:2] + outer[2:]))
    focal_x, focal_y = photograph.focal_x / scale, photograph.focal_y / scale
    return photograph._replace(
        focal_x=float(focal_x),
        focal_y=float(focal_y),
        center_x=float(0.5 * photograph.width - focal_x * middle[0]),
        center_y=float(0.5 * photograph.height - focal_y * middle[1]),
    )


def _seen_rays(lens: Lens, photograph: Intrinsics) -> NDArray[np.float64]:
    """Return the rays on a grid of the photograph from edge to edge, ``(GRID, GRID, 2)``, none beyond `MAX_ANGLE`."""
    x, y = np.linspace(0.0, photograph.width, GRID), np.linspace(0.0, photograph.height, GRID)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    seen = photograph.to_tangents(pixels)
    rays = lens.undistort(seen)
    lost = ~np.isfinite(rays).all(axis=1)
    radius = np.hypot(seen[:, 0], seen[:, 1])
    # What is lost to a fold further out than the image may reach is cut off with the rest there.
    folded = lost & ((radius <= lens.largest_radius) | (lens.fold_angle <= MAX_ANGLE))
    if folded.any():
        first = int(np.flatnonzero(folded)[np.argmin(radius[folded])])
        raise InvalidOptionError(
            f"{lens.fault(float(radius[first]))}, at pixel ({pixels[first, 0]:.0f}, {pixels[first, 1]:.0f}), whose "
            f"distorted radius is {radius[first]:.4g}. Correct the calibration, or crop the photograph."
        )
    edge = float(np.tan(MAX_ANGLE))
    far = ~(np.hypot(rays[:, 0], rays[:, 1]) <= edge)
    rays[far] = seen[far] * (edge / radius[far])[:, None]
    return rays.reshape(GRID, GRID, 2)


class _Resampling:
    """Position in the photograph of each pixel of the undistorted image, and the filters that sample it there."""

    def __init__(self, undistortion: Undistortion) -> None:
        shape = (undistortion.pinhole.height, undistortion.pinhole.width)
        self.samples = 1
        self.positions, inside = self._locate(undistortion)
        with np.errstate(invalid="ignore"):
            steps = [np.diff(self.positions, axis=axis) for axis in (0, 1)]
            coarsest = max(float(np.nanmax(np.hypot(s[..., 0], s[..., 1]), initial=1.0)) for s in steps)
        if coarsest > 1.5:  # made smaller: one sample a pixel would skip pixels of the photograph
            self.samples = min(MAX_SAMPLES, int(np.ceil(coarsest - 0.5)))
            self.positions, inside = self._locate(undistortion)
        n = self.samples
        self.mask: NDArray[np.bool_] = np.asarray(inside.reshape(shape[0], n, shape[1], n).all(axis=(1, 3)))
        self.positions[~np.isfinite(self.positions)] = 0.0

    def _locate(self, undistortion: Undistortion) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the photograph's pixel of every sample, ``(n H, n W, 2)``, and whether it is one."""
        pinhole, photograph, n = undistortion.pinhole, undistortion.photograph, self.samples
        x = (np.arange(n * pinhole.width) + 0.5) / n
        positions = np.empty((n * pinhole.height, n * pinhole.width, 2), np.float32)
        inside = np.empty(positions.shape[:2], dtype=bool)
        rows = max(1, BLOCK_PIXELS // len(x))
        for start in range(0, len(positions), rows):
            y = (np.arange(start, min(start + rows, len(positions))) + 0.5) / n
            pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
            found = photograph.to_pixels(undistortion.lens.distort(pinhole.to_tangents(pixels)))
            within = ((found >= 0.0) & (found <= photograph[:2])).all(axis=1)
            positions[start : start + rows] = found.reshape(len(y), len(x), 2)
            inside[start : start + rows] = within.reshape(len(y), len(x))
        return positions, inside

    def sample(
        self, plane: NDArray[np.float32], weigh: Callable[[NDArray[np.float32]], list[NDArray[Any]]]
    ) -> NDArray[np.float32]:
        """Filter a plane ``(H, W)``, extended beyond its edges by its outermost pixels; 0 outside the mask."""
        rows, columns = plane.shape
        padded = np.pad(plane.astype(np.float32, copy=False), 2, mode="edge")
        n, (height, width) = self.samples, (self.mask.shape[0], self.mask.shape[1])
        result = np.zeros((height, width), np.float32)
        step = max(1, BLOCK_PIXELS // (n * n * width))
        for start in range(0, height, step):
            at = self.positions[n * start : n * (start + step)].reshape(-1, 2) - np.float32(0.5)
            corner = np.clip(np.floor(at), -1.0, (columns - 1, rows - 1))
            part = (at - corner).astype(np.float32)
            across, down = weigh(part[:, 0].copy()), weigh(part[:, 1].copy())
            lead = 2 - (len(across) - 2) // 2  # of the first tap, in the padded plane
            index = (corner[:, 1].astype(np.int64) + lead) * (columns + 4) + corner[:, 0].astype(np.int64) + lead
            total = np.zeros(len(index), np.float32)
            low, high = np.full_like(total, np.inf), np.full_like(total, -np.inf)
            for j, row_weight in enumerate(down):
                for i, weight in enumerate(across):
                    tap = padded.take(index + (j * (columns + 4) + i), mode="clip")
                    np.minimum(low, tap, out=low)
                    np.maximum(high, tap, out=high)
                    with np.errstate(invalid="ignore"):  # infinity times no weight
                        tap *= row_weight * weight
                        total += tap
            np.clip(total, low, high, out=total)
            result[start : start + step] = (
                total.reshape(-1, n, width, n).mean(axis=(1, 3)) if n > 1 else total.reshape(-1, width)
            )
        return np.where(self.mask, result, np.float32(0.0))

    def nearest(self, plane: NDArray[Any]) -> NDArray[Any]:
        """Sample a plane ``(H, W)`` at the pixel that holds each centre."""
        middle = self.positions[self.samples // 2 :: self.samples, self.samples // 2 :: self.samples]
        column, row = (np.clip(middle[..., axis].astype(np.int64), 0, plane.shape[1 - axis] - 1) for axis in (0, 1))
        return np.where(self.mask, plane[row, column], plane.dtype.type(0))


@lru_cache(maxsize=MAX_MAPS)
def _resampling(undistortion: Undistortion) -> _Resampling:
    return _Resampling(undistortion)


def _linear(t: NDArray[np.float32]) -> list[NDArray[Any]]:
    """Return the weights of the two neighbours of a point at ``t`` between them."""
    return [np.float32(1.0) - t, t]


def _catmull_rom(t: NDArray[np.float32]) -> list[NDArray[Any]]:
    """Return the weights of the four neighbours of a point at ``t`` between the inner two; Keys 1981, a = -1/2."""
    return [
        t * (-0.5 + t * (1.0 - 0.5 * t)),
        1.0 + t * t * (-2.5 + 1.5 * t),
        t * (0.5 + t * (2.0 - 1.5 * t)),
        t * t * (-0.5 + 0.5 * t),
    ]


def _premultiplied(color: NDArray[np.float32], alpha: Coverage, image: Image) -> NDArray[np.float32]:
    """Return an image's colour as scene-linear light multiplied by alpha."""
    if image.color_space == DISPLAY_SRGB:  # the curve applies to the colour, not to its product
        color = srgb_to_linear(straight(color, alpha) if image.premultiplied else color)
        return color * alpha
    return color if image.premultiplied else color * alpha


def _encoded(light: NDArray[np.float32], alpha: NDArray[np.float32], image: Image) -> NDArray[np.float32]:
    """Undo `_premultiplied`."""
    if image.color_space == DISPLAY_SRGB:
        encoded = linear_to_srgb(straight(light, alpha))
        return encoded * alpha if image.premultiplied else encoded
    return light if image.premultiplied else straight(light, alpha)
