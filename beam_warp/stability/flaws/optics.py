"""What a lens and a shutter do to an image: blur, and displacement by distortion.

Images are layers ``(H, W, C)``: scene-linear colour premultiplied by coverage, and coverage. Blurs multiply the
spectrum by that of their kernel, so that kernels of any size, of parts of a pixel too, are what they say: energy is
kept, and variance grows by the kernel's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates
from scipy.special import j1

from beam_warp.capture.lenses import Lens
from beam_warp.world.camera import Camera

Transfer: TypeAlias = Callable[[NDArray[np.floating], NDArray[np.floating]], NDArray[np.floating]]
"""Spectrum of a kernel over the frequencies along x and y [1/pixel]."""

MARGIN = 16
"""Empty pixels around an image while it is blurred, so that no side sees the opposite one."""


def motion_blurred(layers: NDArray[np.float64], motion: ArrayLike) -> NDArray[np.float64]:
    """Blur an image that moves evenly while the shutter is open.

    Args:
        layers: ``(H, W, C)``; nothing is seen beyond its border.
        motion: Way during the exposure, right and down [pixel], ``(2,)``; centred on where the image is.

    Returns:
        ``(H, W, C)``, of the same sum and centre. Variance along the motion is greater by its squared length / 12.
    """
    x, y = np.asarray(motion, np.float64)
    return _filtered(layers, lambda u, v: np.sinc(u * x + v * y))


def defocused(layers: NDArray[np.float64], diameter: float) -> NDArray[np.float64]:
    """Blur an image by a disc, the circle of confusion of a thin lens.

    Args:
        layers: ``(H, W, C)``; nothing is seen beyond its border.
        diameter: Of the disc [pixel].

    Returns:
        ``(H, W, C)``, of the same sum and centre. Variance along every axis is greater by the squared diameter / 16.

    Source: Fourier transform of a disc, 2 J1(s) / s (Goodman, Introduction to Fourier Optics).
    """

    def disc(u: NDArray[np.floating], v: NDArray[np.floating]) -> NDArray[np.floating]:
        s = np.maximum(np.pi * diameter * np.hypot(u, v), 1e-9)
        return 2.0 * j1(s) / s

    return _filtered(layers, disc)


def _filtered(layers: NDArray[np.float64], transfer: Transfer) -> NDArray[np.float64]:
    """Multiply the spectrum of every channel by a function of the frequencies along x and y [1/pixel]."""
    height, width = layers.shape[0] + MARGIN, layers.shape[1] + MARGIN
    spectrum = np.fft.rfft2(layers, s=(height, width), axes=(0, 1))
    v, u = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :]
    blurred = np.fft.irfft2(spectrum * transfer(u, v)[..., None], s=(height, width), axes=(0, 1))
    return blurred[: layers.shape[0], : layers.shape[1]]


def radial_coefficient(camera: Camera, displacement: float) -> float:
    """Return the k1 at which a lens moves the middle of the image's left and right edges outward [pixel]."""
    tangent = 0.5 * camera.width / camera.focal_x
    return displacement / (camera.focal_x * tangent**3)


def distorted(layers: NDArray[np.float64], camera: Camera, k1: float) -> NDArray[np.float64]:
    """Return the image that a lens with radial distortion takes where a pinhole took ``layers``.

    Args:
        layers: ``(H, W, C)``, of ``camera``.
        camera: The pinhole, whose focal lengths and principal point the lens has too.
        k1: See `Lens`: radius r of tangents becomes r (1 + k1 r^2).

    Returns:
        ``(H, W, C)``, interpolated by cubic splines; 0 where the pinhole saw nothing.
    """
    lens = Lens((k1, 0.0, 0.0, 0.0, 0.0, 0.0))
    focal, center = (camera.focal_x, camera.focal_y), (camera.center_x, camera.center_y)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    shown = (np.stack([columns, rows], axis=-1).reshape(-1, 2) - center) / focal
    places = (lens.undistort(shown) * focal + center - 0.5).T[::-1]
    moved = [map_coordinates(channel, places, order=3) for channel in np.moveaxis(layers, -1, 0)]
    return np.stack(moved, axis=-1).reshape(layers.shape)
