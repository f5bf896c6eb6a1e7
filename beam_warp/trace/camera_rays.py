"""Cameras as kernels that shoot rays see them."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from beam_warp.kernels.common.pixel_sampling import PixelRays
from beam_warp.world.camera import Camera


def pixel_rays(camera: Camera, origin: ArrayLike = (0.0, 0.0, 0.0)) -> PixelRays:
    """Describe a camera to kernels; its position is relative to ``origin`` [m], so that it keeps its digits."""
    rays = PixelRays()
    rays.origin = wp.vec3(*(camera.position - np.asarray(origin, np.float64)).tolist())
    rays.camera_to_world = wp.mat33(camera.camera_to_world[:3, :3].astype(np.float32))
    rays.focal = wp.vec2(camera.focal_x, camera.focal_y)
    rays.center = wp.vec2(camera.center_x, camera.center_y)
    rays.width = camera.width
    return rays
