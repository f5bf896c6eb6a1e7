"""Which part of an image Gaussians are drawn in, where a subject is small in it: nothing else needs samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

REACH = float(np.sqrt(2.0 * np.log(255.0)))
"""Standard deviations beyond which an opaque splat has an alpha below 1/255, which is not drawn."""

STEPS = 8
"""Sides of parts are multiples of this part of the image's, so that those of a take seldom differ in size."""


class ImagePart(NamedTuple):
    """First column and row of a part of an image, and its width and height [pixel]."""

    left: int
    top: int
    width: int
    height: int

    def placed(self, image: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
        """Return a camera's whole image, ``(H, W)`` or ``(H, W, C)``: this part, and 0 around it."""
        whole = np.zeros((camera.height, camera.width, *image.shape[2:]), image.dtype)
        whole[self.top : self.top + self.height, self.left : self.left + self.width] = image
        return whole


def drawn_part(cloud: GaussianCloud, camera: Camera, options: RasterOptions) -> ImagePart:
    """Return a part of the image that holds every splat.

    It is the whole image where a splat may reach beyond it: how those are drawn depends on the image's size.

    Args:
        cloud: Gaussians in the world's axes.
        camera: Who looks.
        options: How splats are drawn.
    """
    sizes = np.array([camera.width, camera.height])
    whole = ImagePart(0, 0, camera.width, camera.height)
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    places = cloud.positions.astype(np.float64) @ rotation.T + shift
    shown = places[:, 2] > options.near
    if not shown.any():
        return whole
    places, largest = places[shown], cloud.scales[shown].max(axis=1).astype(np.float64)
    slopes = places[:, :2] / places[:, 2:]
    focal = np.array([camera.focal_x, camera.focal_y])
    center = np.array([camera.center_x, camera.center_y])
    deviations = (focal / places[:, 2:]) * (largest[:, None] * np.sqrt(1.0 + np.square(slopes)))
    reach = REACH * np.sqrt(np.square(deviations) + options.low_pass)
    middles = focal * slopes + center
    low, high = np.floor((middles - reach).min(axis=0)), np.ceil((middles + reach).max(axis=0))
    if not (np.all(low >= 0.0) and np.all(high <= sizes)):
        return whole
    step = -(-sizes // STEPS)
    size = np.minimum(-(-(high - low) // step) * step, sizes).astype(int)
    start = np.clip((low + high - size) // 2, 0, sizes - size).astype(int)
    return ImagePart(*map(int, (*start, *size)))
