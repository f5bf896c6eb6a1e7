"""The finest scales of Gaussians that training views can show: the 3D filter of Mip-Splatting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from beam_warp.device.array_checks import require_device_array
from beam_warp.device.arrays import resolve_device, upload_vectors
from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.reconstruction.sampling_limits import launch_write_sampling_limits
from beam_warp.raster.layout import ViewLayout
from beam_warp.world.camera import Camera

FILTER_VARIANCE = 0.2
"""Variance of the 3D filter, in squared pixels (Yu et al. 2024): with the rasteriser's low-pass of 0.3 about as much
as a pixel's own box filter blurs."""

NEAR = 0.01
"""Depth from which on a camera sees [m]."""

IMAGE_MARGIN = 0.15
"""A view counts for Gaussians whose centre is outside its image by up to this part of its sides: they still reach in.
The rasteriser grows the image by the same part."""


class SamplingLimits:
    """The standard deviations of the 3D low-pass filters of Gaussians that some cameras train.

    A Gaussian with scales s and opacity o is drawn with sqrt(s^2 + f^2), and o prod(s) / prod(sqrt(s^2 + f^2)), f its
    limit: then it is never finer than what the nearest view could show, and looks the same from nearer still.

    Nothing is allocated in a call, nothing waits for the device: calls may be captured in a CUDA graph.

    Source: Yu et al. 2024, Mip-Splatting (3D smoothing filter); the margin is that of its code. There, Gaussians that
    no view sees take the largest limit of all others; here they have none, 0: what nothing trains does not get finer.
    """

    def __init__(self, cameras: Sequence[Camera], *, device: Any = None) -> None:
        """Prepare cameras.

        Args:
            cameras: The training views' cameras, at least one.
            device: Warp device; the first GPU without, or the CPU where there is none.

        Raises:
            InvalidOptionError: There is no camera.
            DeviceError: The device is not there.
        """
        if not len(cameras):
            raise InvalidOptionError("cameras must be at least one, got none. Pass the training views' cameras.")
        self.device = resolve_device(device)
        self._views = wp.array(ViewLayout.of(cameras).views, dtype=RasterView, device=self.device)

    def write(self, positions: wp.array, limits: wp.array) -> None:
        """Write sqrt(0.2) times the least depth / focal length of the views that see each Gaussian; 0 if none does.

        Args:
            positions: Centres [m], ``(N,)`` vec3.
            limits: Written [m], ``(N,)`` float32.

        Raises:
            InvalidArrayError: An array has another type, shape or device.
        """
        centers = upload_vectors("positions", positions, self.device)
        out = require_device_array("limits", limits, (len(centers),), self.device)
        launch_write_sampling_limits(centers, self._views, NEAR, IMAGE_MARGIN, FILTER_VARIANCE**0.5, out, self.device)
