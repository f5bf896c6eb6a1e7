"""What the renders of Gaussians should look like: photographs on a device, cropped, encoded, and the losses to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from beam_warp.captured_views import CapturedView
from beam_warp.depth_normals import DepthNormals
from beam_warp.device_arrays import pixel_channels
from beam_warp.devices import upload
from beam_warp.image_losses import L1Loss, NormalLoss, SsimLoss
from beam_warp.images import linear_to_srgb
from beam_warp.kernels.display_encoding import launch_add_linear_gradients, launch_encode
from beam_warp.raster_records import RasterOptions
from beam_warp.rasterizer import PreparedCameras, Rasterizer

CROP_MARGIN = 8
"""Pixels around the subject that are still looked at: a Gaussian that leaves the silhouette must be seen to do so."""

CROP_STEP = 16
"""Crops are multiples of it: a tile of the rasteriser."""


@dataclass(frozen=True)
class LossWeights:
    """What the terms of a step count.

    Attributes:
        l1: Mean absolute difference of encoded colours.
        ssim: One minus the structural similarity of encoded colours.
        alpha: Mean absolute difference of coverage, where it is known.
        normal: Disagreement of the Gaussians' normals with those of the drawn depth (BEAM Eq. 2).
    """

    l1: float = 0.8
    ssim: float = 0.2
    alpha: float = 0.5
    normal: float = 0.0


def crop_views(views: Sequence[CapturedView]) -> list[CapturedView]:
    """Return the parts of the views where the subject is, of one size for all that have the same resolution.

    Views whose coverage is not known stay whole. Renders and losses cost as much as there are pixels.
    """
    boxes = [_box(view) for view in views]
    sizes: dict[tuple[int, int], list[int]] = {}
    for view, box in zip(views, boxes, strict=True):
        largest = sizes.setdefault((view.camera.width, view.camera.height), [CROP_STEP, CROP_STEP])
        for axis in range(2):
            side = box[1][axis] - box[0][axis] + 2 * CROP_MARGIN
            largest[axis] = max(largest[axis], -(-side // CROP_STEP) * CROP_STEP)
    result = []
    for view, (low, high) in zip(views, boxes, strict=True):
        whole = (view.camera.width, view.camera.height)
        size = [min(side, full) for side, full in zip(sizes[whole], whole, strict=True)]
        starts = [
            int(np.clip((low[axis] + high[axis] - size[axis]) // 2, 0, whole[axis] - size[axis])) for axis in range(2)
        ]
        result.append(view.cropped(*starts, *size))
    return result


def _box(view: CapturedView) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first column and row of the subject, and the ones after its last."""
    if view.alpha is None:
        return (0, 0), (view.camera.width, view.camera.height)
    rows, columns = (np.flatnonzero((view.alpha > 0.0).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return (0, 0), (0, 0)
    return (int(columns[0]), int(rows[0])), (int(columns[-1]) + 1, int(rows[-1]) + 1)


class ViewTargets:
    """The photographs of views of one size, and how renders of Gaussians differ from them.

    Attributes:
        rasterizer: Draws one view at a time: `select` says which.
        height: Of every view [pixel].
        width: Of every view [pixel].
    """

    def __init__(self, views: Sequence[CapturedView], gaussian_count: int, options: RasterOptions, device: Any) -> None:
        """Bring views to a device.

        Args:
            views: Of one size.
            gaussian_count: Rows that are drawn.
            options: How splats are drawn.
            device: Warp device.
        """
        self.rasterizer = Rasterizer(
            gaussian_count, [views[0].camera], radiance=True, normals=True, options=options, device=device
        )
        self.device = self.rasterizer.device
        self.height, self.width = views[0].camera.height, views[0].camera.width
        self._cameras: list[PreparedCameras] = [self.rasterizer.prepare_cameras([view.camera]) for view in views]
        self._colors = [upload(linear_to_srgb(view.color), float, self.device) for view in views]
        self._alphas = [
            None if view.alpha is None else upload(view.alpha[..., None], float, self.device) for view in views
        ]
        self._depth_normals = [DepthNormals(view.camera, device=self.device) for view in views]
        size = (self.height, self.width)
        images, adjoints = self.rasterizer.images, self.rasterizer.adjoints()
        colors, normals = self.rasterizer.color_channels.start, self.rasterizer.normal_channels.start
        self._color, self._to_color = (
            pixel_channels(part.channels[0], *size, colors, 3) for part in (images, adjoints)
        )
        self._normal, self._to_normal = (
            pixel_channels(part.channels[0], *size, normals, 3) for part in (images, adjoints)
        )
        self._alpha, self._to_alpha = (part.alpha.reshape((*size, 1)) for part in (images, adjoints))
        self._depth, self._to_depth = (part.depth.reshape(size) for part in (images, adjoints))
        self._encoded, self._to_encoded, self._surface, self._to_surface = (
            wp.zeros((*size, 3), dtype=float, device=self.device) for _ in range(4)
        )
        self._l1, self._ssim = L1Loss(*size, device=self.device), SsimLoss(*size, device=self.device)
        self._coverage, self._agreement = L1Loss(*size, 1, device=self.device), NormalLoss(*size, device=self.device)
        self._adjoints = adjoints

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self._colors)

    def select(self, index: int) -> None:
        """Look from a view; may be captured in a CUDA graph."""
        self.rasterizer.set_cameras(self._cameras[index])

    def add_losses(self, index: int, weights: LossWeights) -> list[wp.array]:
        """Compare what was drawn last with a view, and write the derivatives to the rasteriser's adjoints.

        Returns:
            The terms, one element each: colour, coverage, normals.
        """
        self._adjoints.zero_()
        self._to_encoded.zero_()
        launch_encode(self._color, self._encoded, self.device)
        target = self._colors[index]
        terms = [
            self._l1(self._encoded, target, weight=weights.l1, gradient=self._to_encoded),
        ]
        if weights.ssim > 0.0:
            terms.append(self._ssim(self._encoded, target, weight=weights.ssim, gradient=self._to_encoded))
        launch_add_linear_gradients(self._color, self._to_encoded, self._to_color, self.device)
        alpha = self._alphas[index]
        if alpha is not None and weights.alpha > 0.0:
            terms.append(self._coverage(self._alpha, alpha, weight=weights.alpha, gradient=self._to_alpha))
        if weights.normal > 0.0:
            self._to_surface.zero_()
            geometry = self._depth_normals[index]
            coverage = self._alpha.reshape((self.height, self.width))
            geometry.write(self._depth, coverage, self._surface)
            terms.append(
                self._agreement(
                    self._normal,
                    self._surface,
                    weight=weights.normal,
                    mask=coverage,
                    rendered_gradient=self._to_normal,
                    expected_gradient=self._to_surface,
                )
            )
            geometry.add_gradients(self._depth, coverage, self._to_surface, self._to_depth)
        return terms

    def square_error(self, index: int) -> float:
        """Return the mean squared difference of what was drawn last and a view, encoded and clipped to [0, 1]."""
        launch_encode(self._color, self._encoded, self.device)
        drawn = np.clip(self._encoded.numpy(), 0.0, 1.0)
        return float(np.mean((drawn - np.clip(self._colors[index].numpy(), 0.0, 1.0)) ** 2))
