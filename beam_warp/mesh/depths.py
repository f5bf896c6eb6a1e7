"""Depth images of several views on a device, as fusion and the check of their consistency read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_choice, require_count, require_number
from beam_warp.device.array_checks import device_array
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import COLOR_SPACES, LINEAR_REC709
from beam_warp.kernels.mesh.depth_pixels import (
    DepthCamera,
    launch_drop_pixels,
    launch_write_depth_pixels,
    launch_write_pixel_colors,
)
from beam_warp.world.camera import Camera

MINIMUM_ALPHA = 0.5
"""A pixel shows a surface from this coverage on, as in RaDe-GS's fusion."""

MAX_PIXELS = 2**29
"""Most pixels of all views together, 12 bytes each."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthView:
    """The depth that one camera sees.

    Attributes:
        camera: The pinhole.
        depth: Along the optical axis [m], ``(H, W)``; what is not finite or not positive is no depth.
        alpha: Coverage in [0, 1], ``(H, W)``.
        normals: World axes, towards the camera, of any length, ``(H, W, 3)``; 0 where not known. None takes those of
            the depth.
        color: Premultiplied by alpha, ``(H, W, 3)``; None for none. All views have one, or none has.

    Arrays are NumPy's, or Warp's of float32 on the device where they are used.
    """

    camera: Camera
    depth: Any
    alpha: Any
    normals: Any = None
    color: Any = None


class DepthImages:
    """Depth, slope and weight of every pixel of all views: 12 bytes a pixel, and 12 more with colour.

    The weight of a pixel is alpha times the fourth power of the cosine between normal and ray; it falls towards edges
    of the depth, with the square of the share of its eight neighbours that see the same surface, and is 0 at tilts
    beyond 84 degrees. Why the fourth power: see ``kernels/mesh/depth_pixels.py``.

    Attributes:
        cameras: The views' cameras.
        device: Where the images are.
        origin: Where positions on the device are counted from [m], ``(3,)`` float64.
        views: Cameras for kernels.
        pixels: Inverse depth, slope, weight (see ``kernels/mesh/depth_pixels.py``), one view after the other, ``(P,)``
            vec3.
        colors: Straight, ``(P,)`` vec3; empty without.
        color_space: The colour space of ``colors``; None without.
    """

    def __init__(self, cameras: Sequence[Camera], *, color_space: str | None = None, device: Any = None) -> None:
        """Make room; `write` fills it, view by view.

        Args:
            cameras: At least one.
            color_space: Of the views' colour, `LINEAR_REC709` or `DISPLAY_SRGB`; None if they have none.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.

        Raises:
            InvalidOptionError: There is no camera, their pixels are more than `MAX_PIXELS`, or the space is unknown.
            DeviceError: There is no such device.
        """
        if not len(cameras):
            raise InvalidOptionError("cameras must hold at least one camera, got none. Pass the views' cameras.")
        if color_space is not None:
            require_choice("color_space", color_space, COLOR_SPACES)
        self.color_space = color_space
        self.cameras = tuple(cameras)
        self.device = resolve_device(device)
        sizes = [camera.width * camera.height for camera in self.cameras]
        self._first = np.concatenate([[0], np.cumsum(sizes)])
        total = int(self._first[-1])
        if total > MAX_PIXELS:
            raise InvalidOptionError(
                f"cameras must have at most {MAX_PIXELS} pixels together, got {total}. Use fewer or reduce them."
            )
        # Between the cameras and in whole metres: the same for all frames of a capture, and near enough for floats.
        self.origin = np.rint(np.mean([camera.position for camera in self.cameras], axis=0))
        self._views = [
            depth_camera(camera, self.origin, int(first))
            for camera, first in zip(self.cameras, self._first, strict=False)
        ]
        self.views = wp.array(self._views, dtype=DepthCamera, device=self.device)
        self.pixels = wp.zeros(total, dtype=wp.vec3, device=self.device)
        self.colors = wp.zeros(total if color_space else 0, dtype=wp.vec3, device=self.device)

    @classmethod
    def of(cls, views: Sequence[DepthView], *, device: Any = None) -> DepthImages:
        """Bring views to a device; their colour, if any, is scene-linear.

        Raises:
            InvalidArrayError: An array has another shape than its camera's image, or some views have colour.
            InvalidOptionError: There is no view, or there are too many pixels.
        """
        colored = {view.color is not None for view in views}
        if len(colored) > 1:
            raise InvalidArrayError("color must be given for all views or none, got some. Leave it out, or add it.")
        space = LINEAR_REC709 if True in colored else None
        images = cls([view.camera for view in views], color_space=space, device=device)
        for index, view in enumerate(views):
            images.write(index, view)
        return images

    def write(self, index: int, view: DepthView) -> None:
        """Fill the pixels of one view, whose camera is that given for it.

        Raises:
            InvalidArrayError: An array has another shape or device.
            InvalidOptionError: There is no such view.
        """
        require_count("index", index, 0, len(self.cameras) - 1)
        camera = self.cameras[index]
        shape = (camera.height, camera.width)
        normals = wp.zeros((0, 0), dtype=float, device=self.device)
        if view.normals is not None:
            normals = _rows("normals", view.normals, shape, self.device)
        alpha = _flat("alpha", view.alpha, shape, self.device)
        depth = _flat("depth", view.depth, shape, self.device)
        launch_write_depth_pixels(depth, alpha, normals, self._views[index], MINIMUM_ALPHA, self.pixels, self.device)
        if len(self.colors):
            rows = _rows("color", view.color, shape, self.device)
            launch_write_pixel_colors(len(alpha), rows, alpha, self.first_pixels[index], self.colors, self.device)

    @property
    def first_pixels(self) -> tuple[int, ...]:
        """The first pixel of each view, and the end of the last one's."""
        return tuple(self._first.tolist())

    def view(self, index: int) -> DepthCamera:
        """Return a view's camera for kernels."""
        return self._views[index]

    def keep(self, mask: wp.array) -> None:
        """Leave out the pixels where ``mask`` is 0, ``(P,)`` int on the device.

        Raises:
            InvalidArrayError: It has another length, type or device.
        """
        fits = isinstance(mask, wp.array) and mask.dtype is wp.int32 and mask.device == self.device
        if not fits or mask.shape != (len(self.pixels),):
            raise InvalidArrayError(
                f"mask must be a warp array of {len(self.pixels)} int32 on {self.device}, got "
                f"{type(mask).__name__} of shape {mask.shape}. Pass one number a pixel, of all views."
            )
        launch_drop_pixels(len(self.pixels), mask, self.pixels, self.device)

    def footprint(self) -> float:
        """Return the median width of a pixel at the surface that it shows [m].

        Of about 2^16 pixels of each view, evenly spread, and of all of them where none of those counts.

        Raises:
            InvalidArrayError: No pixel counts.
        """
        widths = []
        for index, camera in enumerate(self.cameras):
            view = self.pixels[self.first_pixels[index] : self.first_pixels[index + 1]]
            # An odd step does not stay in some columns of an image whose width is even.
            part = view[:: len(view) // 2**16 | 1].numpy()
            part = part if (part[:, 2] > 0.0).any() else view.numpy()
            seen = part[part[:, 2] > 0.0, 0]
            widths.append(1.0 / (seen.astype(np.float64) * min(camera.focal_x, camera.focal_y)))
        joined = np.concatenate(widths)
        if not len(joined):
            raise InvalidArrayError(
                f"depth must be seen with an alpha of at least {MINIMUM_ALPHA:g} in some view, got none in "
                f"{len(self.cameras)} views. Check that the cameras look at the subject."
            )
        return require_number("footprint", float(np.median(joined)), 1e-9, 1e9)


def depth_camera(camera: Camera, origin: NDArray[np.float64], first_pixel: int = 0) -> DepthCamera:
    """Return a camera for kernels, in single precision, with positions counted from ``origin`` [m]."""
    matrix = camera.world_to_camera
    view = DepthCamera()
    view.rotation = wp.mat33(matrix[:3, :3].astype(np.float32))
    view.translation = wp.vec3((matrix[:3, :3] @ origin + matrix[:3, 3]).astype(np.float32))
    view.focal = wp.vec2(camera.focal_x, camera.focal_y)
    view.center = wp.vec2(camera.center_x, camera.center_y)
    view.width, view.height = camera.width, camera.height
    view.first_pixel = first_pixel
    return view


def _flat(name: str, value: Any, shape: tuple[int, int], device: Any) -> wp.array:
    """Return an image as one row of floats; a flat array of the device passes as it is."""
    if isinstance(value, wp.array) and value.ndim == 1 and len(value) == shape[0] * shape[1]:
        return device_array(name, value, value.shape, device)
    image = device_array(name, value, shape, device)
    return (image if image.is_contiguous else wp.clone(image)).flatten()


def _rows(name: str, value: Any, shape: tuple[int, int], device: Any) -> wp.array:
    """Return an image of vectors as rows; rows of the device, one a pixel, of three floats or more pass as they are."""
    if isinstance(value, wp.array) and value.ndim == 2 and value.shape[0] == shape[0] * shape[1]:
        return device_array(name, value, value.shape, device)
    image = device_array(name, value, (*shape, 3), device)
    return (image if image.is_contiguous else wp.clone(image)).reshape((shape[0] * shape[1], 3))
