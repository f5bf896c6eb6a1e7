"""Normals of depth images, and the gradients that they pass on to the depth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from beam_warp.checks import require_number
from beam_warp.device.array_checks import device_array, require_device_array
from beam_warp.device.arrays import resolve_device
from beam_warp.kernels.raster.depth_normals import (
    DepthNormalCamera,
    launch_add_depth_gradients,
    launch_write_depth_normals,
)
from beam_warp.world.camera import Camera

STEEPEST = 84.0
"""Tilt against the image plane from which on neighbours are taken for two surfaces, one before the other [degree].
Ledges of a few pixels' depth must not count as slopes: the Gaussians would fill them."""

LARGEST_JUMP = 0.03
"""Part of the depth that neighbours of one surface differ by at most, however wide pixels are."""


class DepthNormals:
    """Normals of depth images of one camera, by central differences over one pixel to each side.

    A normal is of unit length, in world axes (the camera's rotation is applied), and faces the camera. It is 0 on the
    border, one pixel wide, and where one of the five pixels of the stencil (the pixel and its four neighbours)

    - has an alpha that is not above ``minimum_alpha``,
    - has no depth: one that is not finite, or not above 1e-6 m, or
    - lies across an edge: its depth differs from the middle pixel's by more than ``largest_jump`` times that depth.
      Opposite neighbours so differ by at most twice as much, over two pixels. A surface that is tilted by t against
      the image plane, near the image's centre, changes by tan(t) / focal length of its depth from pixel to pixel.

    Nothing is allocated, nothing waits for the device: calls may be captured in a CUDA graph.

    Source: Zhang et al. 2024, RaDe-GS (normals of depth), for the differences; the masks are ours.
    """

    def __init__(
        self, camera: Camera, *, minimum_alpha: float = 0.5, largest_jump: float | None = None, device: Any = None
    ) -> None:
        """Prepare a camera.

        Args:
            camera: Its size is that of every image.
            minimum_alpha: Pixels count above it; in [0, 1].
            largest_jump: Largest step of depth between neighbours, as a fraction of the depth; infinite for any; None
                for that of a surface tilted by `STEEPEST`, `LARGEST_JUMP` at most.
            device: Warp device; the first GPU without, or the CPU where there is none.

        Raises:
            InvalidOptionError: An option is out of range.
            DeviceError: The device is not there.
        """
        self.camera = camera
        self.device = resolve_device(device)
        self._shape = (camera.height, camera.width)
        view = DepthNormalCamera()
        view.camera_to_world = wp.mat33(camera.camera_to_world[:3, :3].astype(np.float32))
        view.focal = wp.vec2(camera.focal_x, camera.focal_y)
        view.center = wp.vec2(camera.center_x, camera.center_y)
        view.minimum_alpha = require_number("minimum_alpha", minimum_alpha, 0.0, 1.0)
        steepest = math.tan(math.radians(STEEPEST)) / min(camera.focal_x, camera.focal_y)
        chosen = min(LARGEST_JUMP, steepest) if largest_jump is None else largest_jump
        view.largest_jump = require_number("largest_jump", chosen, 0.0)
        self._views = wp.array([view], dtype=DepthNormalCamera, device=self.device)

    def look_as(self, other: DepthNormals) -> None:
        """Look from another camera of the same size from now on, also where calls were captured in a CUDA graph.

        Args:
            other: Normals of depth images of that camera, on the same device.
        """
        wp.copy(self._views, other._views)

    def write(self, depth: Any, alpha: Any, normals: wp.array) -> None:
        """Write the normals of a depth image.

        Args:
            depth: Depth along the optical axis [m], not multiplied by alpha, ``(H, W)`` float32.
            alpha: Coverage, ``(H, W)`` float32.
            normals: Written: ``(H, W, 3)`` float32, every element. Arrays may be strided views.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
        """
        launch_write_depth_normals(
            device_array("depth", depth, self._shape, self.device),
            device_array("alpha", alpha, self._shape, self.device),
            self._views,
            require_device_array("normals", normals, (*self._shape, 3), self.device),
            self.device,
        )

    def add_gradients(self, depth: Any, alpha: Any, normal_gradients: Any, depth_gradients: wp.array) -> None:
        """Add the gradient of a loss with respect to the depth, given the one with respect to the normals.

        Which pixels have a normal is held still, and alpha, which decides nothing else, has no gradient. Every pixel
        sums its shares in one order: same device, same input, same bits.

        Args:
            depth: As for `write`.
            alpha: As for `write`.
            normal_gradients: dL/dnormal in world axes, ``(H, W, 3)`` float32; not read where there is no normal.
            depth_gradients: dL/ddepth [1/m] is added to it, ``(H, W)`` float32. Not one of the inputs.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
        """
        launch_add_depth_gradients(
            device_array("depth", depth, self._shape, self.device),
            device_array("alpha", alpha, self._shape, self.device),
            self._views,
            device_array("normal_gradients", normal_gradients, (*self._shape, 3), self.device),
            require_device_array("depth_gradients", depth_gradients, self._shape, self.device),
            self.device,
        )
