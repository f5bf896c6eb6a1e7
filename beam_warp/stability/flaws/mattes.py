"""What a studio cuts the subject out with: masks a little too large or small, or blotted, before an even backdrop."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, shift

DIRECTIONS = 24
RADIUS_STEP = 0.5
"""Directions in which a disc is sampled, on circles this far apart [pixel]; its way is short by 0.3 % in the mean."""

PLATE_ALBEDO = 0.2
PLATE_FALLOFF = 0.2
"""Reflectance of the backdrop, a grey wall, and how much its brightness varies over an image."""


def offset_coverage(alpha: NDArray[np.float64], pixels: float) -> NDArray[np.float64]:
    """Move the outline of a mask outward or inward, by the same way in all directions, as a disc dilates or erodes it.

    Args:
        alpha: Coverage in [0, 1], ``(H, W)``.
        pixels: Way outward, or inward if negative; 0 returns the mask as it is.

    Returns:
        Coverage, ``(H, W)``: the largest within that way, or the smallest. Between pixels it is interpolated:
        sides along rows and columns move by exactly that way, others to a twentieth of a pixel.
    """
    if pixels < 0.0:
        return 1.0 - offset_coverage(1.0 - alpha, -pixels)
    angles = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    ways = np.stack([np.sin(angles), np.cos(angles)], axis=-1)
    grown = alpha.copy()
    for radius in np.arange(pixels, 0.0, -RADIUS_STEP):
        for way in radius * ways:
            np.maximum(grown, shift(alpha, way, order=1, mode="nearest"), out=grown)
    return grown


def blotted_coverage(
    alpha: NDArray[np.float64], diameter: float, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Return a mask with a round hole in the subject and a round blob beside it.

    Args:
        alpha: Coverage in [0, 1], ``(H, W)``.
        diameter: Of both [pixel].
        generator: Draws where: the hole somewhere within, the blob where the subject is as near as it is wide.
    """
    rows, columns = np.indices(alpha.shape)
    away: Any = distance_transform_edt(alpha == 0.0)  # its types say that it may be None
    near = (alpha == 0.0) & (away < 2.0 * diameter)
    blotted = alpha.copy()
    for places, value in ((alpha == 1.0, 0.0), (near, 1.0)):
        found = np.argwhere(places)
        if len(found):
            row, column = found[generator.integers(len(found))]
            blotted[np.hypot(rows - row, columns - column) <= 0.5 * diameter] = value
    return blotted


def plate(shape: tuple[int, int], radiance: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """Return what a camera sees of an empty studio: a wall whose brightness falls off smoothly, ``(H, W, 3)``.

    Args:
        shape: Rows and columns.
        radiance: The wall's mean radiance, scene-linear, ``(3,)``.
        generator: Draws the direction of the falloff.
    """
    angle = generator.uniform(0.0, 2.0 * np.pi)
    rows, columns = (np.linspace(-1.0, 1.0, count) for count in shape)
    slope = (np.sin(angle) * rows[:, None] + np.cos(angle) * columns[None, :]) / np.sqrt(2.0)
    return radiance * (1.0 + PLATE_FALLOFF * np.sin(0.5 * np.pi * slope))[..., None]
