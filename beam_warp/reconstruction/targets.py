"""Targets of fitting: photographs on a device, cropped and encoded, and the losses of renders against them."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy import ndimage

from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_number
from beam_warp.device.array_checks import pixel_channels
from beam_warp.device.arrays import upload
from beam_warp.device.graphs import StepGraphs
from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.common.fixed_sums import SumBuffers, launch_sum_floats
from beam_warp.kernels.reconstruction.display_encoding import (
    Behind,
    behind_samples,
    launch_add_sample_gradients,
    launch_average,
    launch_believe,
    launch_square_error,
)
from beam_warp.raster.depth_normals import DepthNormals
from beam_warp.raster.losses import L1Loss, NormalLoss, SsimLoss
from beam_warp.raster.rasterizer import PreparedCameras, Rasterizer
from beam_warp.raster.records import GaussianArrays, RasterOptions
from beam_warp.raster.resolution import disc_spacing, sample_side
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

CROP_MARGIN = 8
"""Pixels around the subject that are still looked at: a Gaussian that leaves the silhouette must be seen to do so."""

CROP_STEP = 16
"""Sides of crops are multiples of a tile of the rasteriser [pixel]."""

MATTE_SHARE = 0.4
"""Part of the weight of coverage that counts where the backdrop is known: the photograph says what a matte guesses."""


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of a step.

    Attributes:
        l1: Mean absolute difference of encoded colours.
        ssim: One minus the structural similarity of encoded colours.
        alpha: Mean absolute difference of coverage, where it is known.
        normal: Disagreement of the Gaussians' normals with those of the drawn depth.
        normal_tolerance: Angle from which on it counts no more by its square [rad], see
            `beam_warp.raster.losses.NormalLoss`; None: always by its square (BEAM Eq. 2).
        estimated: Part of ``alpha`` that counts where coverage is an estimate, of a matte or of a mask that was moved.

    Raises:
        InvalidOptionError: A weight is negative or no number, or the tolerance is not above 0.
    """

    l1: float = 0.8
    ssim: float = 0.2
    alpha: float = 1.0
    normal: float = 0.0
    normal_tolerance: float | None = None
    estimated: float = 0.5

    def __post_init__(self) -> None:
        """Check every weight once; a term that counts 0 is left out, and NaN must not pass for it."""
        for name in ("l1", "ssim", "alpha", "normal", "estimated"):
            require_number(name, getattr(self, name), 0.0)
        if self.normal_tolerance is not None and not self.normal_tolerance > 0.0:
            raise InvalidOptionError(
                f"normal_tolerance must be above 0, got {self.normal_tolerance}. Pass an angle in radians."
            )


def crop_views(views: Sequence[CapturedView], reductions: Sequence[int] | None = None) -> list[CapturedView]:
    """Return the parts of the views where the subject is, of one size for all that have the same resolution.

    Views whose coverage is not known stay whole. Renders and losses cost as much as there are pixels.

    Args:
        views: What the cameras saw.
        reductions: By which factor each view is reduced: sizes and margins are then those of reduced pixels. None
            leaves all as they are.
    """
    factors = reductions or [1] * len(views)
    wholes = [
        (view.camera.width // factor, view.camera.height // factor) for view, factor in zip(views, factors, strict=True)
    ]
    boxes = [_box(view, factor, whole) for view, factor, whole in zip(views, factors, wholes, strict=True)]
    sizes: dict[tuple[int, int], list[int]] = {}
    for whole, box in zip(wholes, boxes, strict=True):
        largest = sizes.setdefault(whole, [CROP_STEP, CROP_STEP])
        for axis in range(2):
            side = box[1][axis] - box[0][axis] + 2 * CROP_MARGIN
            largest[axis] = max(largest[axis], -(-side // CROP_STEP) * CROP_STEP)
    result = []
    for view, factor, whole, (low, high) in zip(views, factors, wholes, boxes, strict=True):
        size = [min(side, full) for side, full in zip(sizes[whole], whole, strict=True)]
        starts = [
            int(np.clip((low[axis] + high[axis] - size[axis]) // 2, 0, whole[axis] - size[axis])) for axis in range(2)
        ]
        result.append(view.cropped(*(factor * number for number in (*starts, *size))).reduced(factor))
    return result


def _box(view: CapturedView, factor: int, whole: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first column and row of the subject in a reduced view, and the ones after its last."""
    if view.subject is None:
        return (0, 0), whole
    (left, top), (right, bottom) = view.subject
    end = min(-(-right // factor), whole[0]), min(-(-bottom // factor), whole[1])
    start = left // factor, top // factor
    return (start, end) if start[0] < end[0] and start[1] < end[1] else ((0, 0), (0, 0))


class ViewTargets:
    """The photographs of views of one size, and how renders of Gaussians differ from them.

    Attributes:
        rasterizer: Draws one view at a time: `select` says which.
        cameras: What it draws for, with as many pixels as there are samples.
        samples: Side of the square of samples that a pixel is the mean of.
        height: Height of every view [pixel].
        width: Width of every view [pixel].
    """

    def __init__(
        self, views: Sequence[CapturedView], gaussian_count: int, options: RasterOptions, samples: int, device: Any
    ) -> None:
        """Bring views to a device.

        Args:
            views: Photographs of one size.
            gaussian_count: Rows that are drawn.
            options: How splats are drawn.
            samples: Side of the square of samples that a pixel is the mean of.
            device: Warp device.
        """
        cameras = tuple(view.camera.supersampled(samples) for view in views)
        self.cameras = cameras
        self._weigher: Rasterizer | None = None
        self._drawn: GaussianArrays | None = None
        how: dict[str, Any] = {"options": options, "device": device, "checkpoints": True}
        self.rasterizer = Rasterizer(gaussian_count, cameras[:1], radiance=True, normals=True, **how)
        self.device = self.rasterizer.device
        self._looks = StepGraphs(self.device)
        self.height, self.width = views[0].camera.height, views[0].camera.width
        self.samples = samples
        self._cameras: list[PreparedCameras] = [self.rasterizer.prepare_cameras([camera]) for camera in cameras]
        self._colors = [_encoded(view.color if view.uncut is None else view.uncut.scene, self.device) for view in views]
        self._backdrops = [
            None if view.uncut is None else upload(view.uncut.behind, float, self.device) for view in views
        ]
        self._alphas = [
            None if view.alpha is None else upload(view.alpha[..., None], float, self.device) for view in views
        ]
        self._are_estimates = [view.uncut is not None or view.is_recut for view in views]
        self._doubts = [None if view.doubt is None else upload(view.doubt, float, self.device) for view in views]
        self._subjects = [
            self.height * self.width if view.alpha is None else int((view.alpha > 0.5).sum()) for view in views
        ]
        self._depth_normals = [DepthNormals(camera, device=self.device) for camera in cameras]
        # What a view is compared with lies where the one before was, so that a recorded step fits all of one kind.
        self._target, self._geometry = wp.empty_like(self._colors[0]), DepthNormals(cameras[0], device=self.device)
        self._target_alpha, self._doubt, self._backdrop = (
            next((wp.empty_like(it) for it in arrays if it is not None), None)
            for arrays in (self._alphas, self._doubts, self._backdrops)
        )
        size, fine = (self.height, self.width), (cameras[0].height, cameras[0].width)
        images, adjoints = self.rasterizer.images, self.rasterizer.adjoints()
        colors, normals = self.rasterizer.color_channels.start, self.rasterizer.normal_channels.start
        self._color, self._to_color = (
            pixel_channels(part.channels[0], *fine, colors, 3) for part in (images, adjoints)
        )
        self._normal, self._to_normal = (
            pixel_channels(part.channels[0], *fine, normals, 3) for part in (images, adjoints)
        )
        self._alpha, self._to_alpha = (part.alpha.reshape((*fine, 1)) for part in (images, adjoints))
        self._depth, self._to_depth = (part.depth.reshape(fine) for part in (images, adjoints))
        self._coverage = images.alpha.reshape(fine)
        self._encoded, self._to_encoded = (wp.zeros((*size, 3), dtype=float, device=self.device) for _ in range(2))
        self._covered, self._to_covered = (wp.zeros((*size, 1), dtype=float, device=self.device) for _ in range(2))
        self._surface, self._to_surface = (wp.zeros((*fine, 3), dtype=float, device=self.device) for _ in range(2))
        self._l1, self._ssim = L1Loss(*size, device=self.device), SsimLoss(*size, device=self.device)
        self._l1_alpha, self._agreement = L1Loss(*size, 1, device=self.device), NormalLoss(*fine, device=self.device)
        self._adjoints = adjoints
        self._errors = wp.empty(self.height * self.width, dtype=float, device=self.device)
        self._error = wp.zeros(1, dtype=float, device=self.device)
        self._sums = SumBuffers(self.device)

    def select(self, index: int) -> None:
        """Look from a view, and bring what it is compared with to where `add_losses` finds it; waits for nothing."""
        self.rasterizer.set_cameras(self._cameras[index])
        self._geometry.look_as(self._depth_normals[index])
        for place, kept in (
            (self._target, self._colors[index]),
            (self._target_alpha, self._alphas[index]),
            (self._doubt, self._doubts[index]),
            (self._backdrop, self._backdrops[index]),
        ):
            if kept is not None:
                wp.copy(place, kept)

    def kind(self, index: int) -> Hashable:
        """Return what views have in common that are compared by the same launches, when each was selected before."""
        parts = (self._alphas, self._doubts, self._backdrops)
        return self, self._are_estimates[index], *(of[index] is None for of in parts)

    def move_camera(self, index: int, camera: Camera) -> None:
        """Draw a view from another camera from now on.

        Normals of depth keep the camera that the view began with.

        Args:
            index: Which view.
            camera: Its camera, with the view's size.
        """
        fine = camera.supersampled(self.samples)
        self._cameras[index] = self.rasterizer.prepare_cameras([fine])
        self.cameras = (*self.cameras[:index], fine, *self.cameras[index + 1 :])

    def add_losses(self, index: int, weights: LossWeights, *, values: bool = True) -> list[wp.array]:
        """Compare what was drawn last with the selected view, and write the derivatives to the rasteriser's adjoints.

        What is not known of a pixel is taken to be what was drawn.

        Returns:
            The terms that count, one element each: colour, structure, coverage, normals. Without ``values`` they are
            not brought up to date, which saves a dozen launches.
        """
        self._adjoints.zero_()
        self._to_encoded.zero_()
        behind = self._encode(index)
        target, doubt = self._target, None if self._doubts[index] is None else self._doubt
        launch_believe(doubt, target, self._encoded, self.device)
        terms = [self._l1(self._encoded, target, weight=weights.l1, gradient=self._to_encoded, value=values)]
        if weights.ssim > 0.0:
            terms.append(
                self._ssim(self._encoded, target, weight=weights.ssim, gradient=self._to_encoded, value=values)
            )
        launch_believe(doubt, None, self._to_encoded, self.device)
        launch_add_sample_gradients(
            self._color, self.samples, True, self._to_encoded, self._to_color, self.device, behind, self._to_alpha
        )
        alpha = None if self._alphas[index] is None else self._target_alpha
        if alpha is not None and weights.alpha > 0.0:
            self._to_covered.zero_()
            launch_average(self._alpha, self.samples, False, self._covered, self.device)
            launch_believe(doubt, alpha, self._covered, self.device)
            weight = weights.alpha * (1.0 if self._backdrops[index] is None else MATTE_SHARE)
            weight *= weights.estimated if self._are_estimates[index] else 1.0
            terms.append(self._l1_alpha(self._covered, alpha, weight=weight, gradient=self._to_covered, value=values))
            launch_believe(doubt, None, self._to_covered, self.device)
            launch_add_sample_gradients(self._alpha, self.samples, False, self._to_covered, self._to_alpha, self.device)
        if weights.normal > 0.0:
            self._to_surface.zero_()
            self._geometry.write(self._depth, self._coverage, self._surface)
            terms.append(
                self._agreement(
                    self._normal,
                    self._surface,
                    weight=weights.normal,
                    mask=self._coverage,
                    tolerance=weights.normal_tolerance or math.inf,
                    rendered_gradient=self._to_normal,
                    expected_gradient=self._to_surface,
                    value=values,
                )
            )
            self._geometry.add_gradients(self._depth, self._coverage, self._to_surface, self._to_depth)
        return terms

    def _encode(self, index: int) -> Behind:
        """Encode what was drawn last, before the backdrop of a view that was selected; return that."""
        backdrop = None if self._backdrops[index] is None else self._backdrop
        behind = behind_samples(backdrop, self._alpha)
        launch_average(self._color, self.samples, True, self._encoded, self.device, behind)
        return behind

    def shares(self, index: int, gaussians: GaussianArrays) -> NDArray[np.float32]:
        """Return what each Gaussian shows of itself in a view: its weights summed over the pixels, ``(N,)`` [pixel]."""
        count = gaussians.positions.shape[0]
        if self._weigher is None:
            self._weigher = Rasterizer(
                count, [self.cameras[index]], value_count=1, options=self.rasterizer.options, device=self.device
            )
        weigher = self._weigher
        weigher.set_cameras([self.cameras[index]])
        ones = wp.full((count, 1), 1.0, dtype=float, device=self.device)
        weigher.draw(gaussians._replace(values=ones, radiance=None))
        adjoints = weigher.adjoints()
        adjoints.channels[0].fill_(1.0)  # derivatives of the image's sum to what is composited are the weights
        values = weigher.backward().values
        assert values is not None
        return values.numpy()[:, 0] / np.float32(self.samples**2)

    def psnr(self, index: int) -> float:
        """Return the PSNR of what was drawn last against a view, see `decibels`; waits for the device."""
        self.write_error(index, self._error)
        return self.decibels(index, float(self._error.numpy()[0]))

    def write_error(self, index: int, out: wp.array) -> None:
        """Write the mean square error of what was drawn last against a view to ``out[0]``, encoded and clipped."""
        self._encode(index)
        launch_square_error(self._errors.size, self._encoded, self._colors[index], self._errors, self.device)
        launch_sum_floats(self._errors, 1.0 / (3 * self.height * self.width), self._sums, out, self.device)

    def decibels(self, index: int, error: float) -> float:
        """Return the PSNR of a mean square error of colours in [0, 1] [dB].

        NaN for a view that shows nothing of the subject: black is easily met, and says nothing.
        """
        if self._alphas[index] is not None and not self._subjects[index]:
            return math.nan
        return -10.0 * math.log10(max(error, 1e-12))

    def draw(self, index: int, gaussians: GaussianArrays) -> None:
        """Draw Gaussians for a view, with as much room as they take."""
        self.select(index)
        self._looks.clear()
        self.rasterizer.draw(gaussians)
        self._drawn = gaussians

    def look(self, index: int, gaussians: GaussianArrays) -> None:
        """Draw Gaussians for a view; waits for nothing, and makes no room, if the same arrays were drawn before."""
        if not self.has_drawn(gaussians):
            self.draw(index, gaussians)
            return
        self.select(index)
        self._looks.run("redraw", self.rasterizer.redraw)

    def has_drawn(self, gaussians: GaussianArrays) -> bool:
        """Tell whether these arrays were drawn last."""
        return self._drawn is gaussians

    def compared(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return what was drawn last and a view with coverage, encoded, ``(H, W, 4)`` each, and depth ``(H, W)`` [m].

        Pixels are drawn by one sample, so that each has a depth. What is not known of the view is as it was drawn.
        """
        alpha = self._alphas[index]
        assert alpha is not None
        assert self.samples == 1
        self._encode(index)
        drawn = np.dstack([self._encoded.numpy(), self._alpha.numpy()])
        photograph = np.dstack([self._colors[index].numpy(), alpha.numpy()])
        doubt = self._doubts[index]
        if doubt is not None:
            photograph += doubt.numpy()[..., None] * (drawn - photograph)
        return drawn, photograph, self._depth.numpy()

    def gap(self, index: int) -> float:
        """Return the largest connected part of a view's subject that what was drawn last does not cover, a fraction.

        It is 0 without alpha.
        """
        alpha = self._alphas[index]
        if alpha is None:
            return 0.0
        launch_average(self._alpha, self.samples, False, self._covered, self.device)
        missed = ((alpha.numpy() > 0.9) & ~(self._covered.numpy() > 0.5))[..., 0]
        labelled: Any = ndimage.label(missed)  # its types say that it may be a number
        parts, count = labelled
        largest = np.bincount(parts.ravel())[1:].max() if count else 0
        return largest / max(self._subjects[index], 1)


def _encoded(color: NDArray[np.float32], device: Any) -> wp.array:
    """Bring scene-linear colour to a device, and encode it there as renders are."""
    linear = upload(color, float, device)
    encoded = wp.empty_like(linear)
    launch_average(linear, 1, True, encoded, device)
    return encoded


class TargetSet:
    """Views of any sizes, each at hand by its number.

    Attributes:
        device: Warp device that holds the views.
    """

    def __init__(
        self,
        views: Sequence[CapturedView],
        gaussian_count: int,
        options: RasterOptions,
        samples: int,
        device: Any,
        reductions: Sequence[int] | None = None,
    ) -> None:
        """Crop views to the subject, reduce them and bring them to a device; see `ViewTargets` and `crop_views`."""
        by_size: dict[tuple[int, int], list[int]] = {}
        cropped = crop_views(views, reductions)
        for number, view in enumerate(cropped):
            by_size.setdefault((view.camera.width, view.camera.height), []).append(number)
        self.device = device
        self._places: list[tuple[ViewTargets, int]] = [None] * len(cropped)  # type: ignore[list-item]
        self._errors = wp.zeros(len(cropped), dtype=float, device=device)
        self._pairs = wp.zeros(len(cropped), dtype=int, device=device)
        self._groups = []
        for numbers in by_size.values():
            group = ViewTargets([cropped[number] for number in numbers], gaussian_count, options, samples, device)
            self._groups.append(group)
            for index, number in enumerate(numbers):
                self._places[number] = (group, index)

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self._places)

    def __getitem__(self, number: int) -> tuple[ViewTargets, int]:
        """Return where a view is: among which, and at which place."""
        return self._places[number]

    def make_room(self, gaussians: GaussianArrays) -> tuple[NDArray[np.float64], bool]:
        """Draw every view, with as much room as it takes.

        Returns:
            PSNR of each crop, encoded and clipped to [0, 1] [dB], NaN where nothing of the subject is, ``(V,)``; and
            whether room had to be made: then what was recorded with the old arrays must be recorded again.
        """
        before, are_others = self._rooms(), not all(group.has_drawn(gaussians) for group in self._groups)
        room = []
        for number, (group, index) in enumerate(self._places):
            group.look(index, gaussians)
            group.write_error(index, self._errors[number : number + 1])
            group.rasterizer.note_pair_count(self._pairs, number)
            room.append(group.rasterizer.pair_capacity)
        for number in np.flatnonzero(self._pairs.numpy() > room):
            group, index = self._places[number]
            group.draw(index, gaussians)
            group.write_error(index, self._errors[number : number + 1])
        is_new = before != self._rooms()
        if is_new or are_others:
            for group in self._groups:
                group.rasterizer.backward()  # allocates what the way back needs, which a recording must not
        errors = self._errors.numpy()
        psnr = [group.decibels(index, float(errors[k])) for k, (group, index) in enumerate(self._places)]
        return np.array(psnr), is_new

    def _rooms(self) -> list[int]:
        return [group.rasterizer.pair_capacity for group in self._groups]

    def shares(self, gaussians: GaussianArrays) -> NDArray[np.float64]:
        """Return what each Gaussian shows of itself over all views: its weights summed over pixels, ``(N,)``."""
        total = np.zeros(gaussians.positions.shape[0])
        for group, index in self._places:
            total += group.shares(index, gaussians)
        return total

    def seen_directions(self, gaussians: GaussianArrays) -> NDArray[np.float64]:
        """Return the mean direction from each Gaussian to the views, by how much they see of it, ``(N, 3)``.

        It lies on the side of a surface from which it is seen; it is 0 for what no view sees.
        """
        positions = gaussians.positions.numpy().astype(np.float64)
        total = np.zeros_like(positions)
        for group, index in self._places:
            towards = group.cameras[index].position - positions
            towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
            total += group.shares(index, gaussians)[:, None] * towards
        return total

    def gaps(self, gaussians: GaussianArrays) -> NDArray[np.float64]:
        """Draw every view, after `make_room`, and return the largest gap in each, ``(V,)``; see `ViewTargets.gap`."""
        gaps = []
        for group, index in self._places:
            group.look(index, gaussians)
            gaps.append(group.gap(index))
        return np.array(gaps)


def shuffled_views(rng: np.random.Generator, view_count: int, steps: int) -> NDArray[np.int64]:
    """Return which view each step looks at: all of them, shuffled, again and again; at least one round."""
    rounds = max(-(-steps // view_count), 1)
    return np.concatenate([rng.permutation(view_count) for _ in range(rounds)])


def chosen_samples(samples: int | Literal["auto"], cloud: GaussianCloud, views: Sequence[CapturedView]) -> int:
    """Return the side of the square of samples of a pixel; ``"auto"``: what `beam_warp.raster.resolution` asks for."""
    if samples != "auto":
        return int(samples)
    return sample_side([view.camera for view in views], np.median(cloud.positions, axis=0), disc_spacing(cloud))
