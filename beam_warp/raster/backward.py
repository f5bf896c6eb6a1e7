"""The way back to Gaussians: derivatives of a loss to the images, and the contents of pixels, carried back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from beam_warp.kernels.raster.back_projection_cpu import launch_back_project_cpu
from beam_warp.kernels.raster.back_projection_cuda import launch_back_project_cuda
from beam_warp.kernels.raster.camera_sums import LANES, launch_sum_cameras
from beam_warp.kernels.raster.channel_rows import launch_evaluate_colors_adjoint, launch_scatter_channels
from beam_warp.kernels.raster.composite import CHANNEL_COUNTS
from beam_warp.kernels.raster.composite_adjoint import MOMENTS, Adjoints, pair_length
from beam_warp.kernels.raster.composite_adjoint_cpu import launch_composite_adjoint_cpu
from beam_warp.kernels.raster.composite_adjoint_cuda import launch_composite_adjoint_cuda
from beam_warp.kernels.raster.pair_slots_cuda import launch_find_far_slots, launch_find_slots
from beam_warp.kernels.raster.pair_sums import launch_resolve_sums, launch_sum_pairs
from beam_warp.kernels.raster.project import CameraMove, Splats, launch_project_adjoint
from beam_warp.raster.buffers import FrameBuffers
from beam_warp.raster.layout import Rows, channel_rows
from beam_warp.raster.records import CAMERA_PARAMETERS, GaussianArrays, GaussianGradients, RasterImages

ALIGNMENT = 16
"""Floats in 64 bytes: arrays begin at multiples of that."""


class BackwardBuffers:
    """Arrays that differentiating a frame needs besides those that it was drawn from.

    Attributes:
        images: Derivatives to the images, for callers to fill.
        gaussians: Derivatives to the Gaussians.
    """

    def __init__(self, drawn: FrameBuffers) -> None:
        """Allocate for a frame."""
        self._drawn = drawn
        count, splat_count, pixel_count = drawn.gaussian_count, drawn.splat_count, drawn.pixel_count
        with wp.ScopedDevice(drawn.device):
            self._adjoints = channel_rows(pixel_count, drawn.channels.count, drawn.device)
            flat = [wp.zeros(pixel_count, dtype=float) for _ in range(3)]
            self.images = RasterImages(tuple(rows.matrix for rows in self._adjoints), *flat)
            lengths = [pair_length(rows.length, drawn.exact) for rows in self._adjoints]
            self._splats = drawn.zero_splats()
            self._blocks = drawn.zero_blocks(len(drawn.channels.values), self._splats.normals)
            widths = [(count, width) for width in (3, 4, 3, 1)] + [(splat_count, width) for width in (4, 4, 4, 1)]
            self._summed, parts = _zeros_in_one([*widths, *((splat_count, length) for length in lengths)])
            positions, orientations, scales, opacities, centers, shapes, slopes, bends, *self._sums = parts
            self.gaussians = GaussianGradients(
                positions.view(wp.vec3),
                orientations.view(wp.quat),
                scales.view(wp.vec3),
                opacities.flatten(),
                values=self._blocks.values if drawn.channels.values else None,
            )
            self._splats.centers, self._splats.shapes = centers.view(wp.vec4), shapes.view(wp.vec4)
            self._splats.slopes, self._splats.bends = slopes.view(wp.vec4), bends.flatten()
            # Their own: the adjoint projects anew and writes them, with other roundings than those that were drawn.
            self._tracked = _with_gradients(drawn.zero_splats(), self._splats)
        self._cameras: CameraBuffers | None = None

    def begin(self, gaussians: GaussianArrays) -> None:
        """Begin a new sum, with room for as many coefficients of captured colour as the Gaussians have."""
        if self._drawn.channels.colors and gaussians.radiance is not None:
            held = self.gaussians.radiance
            if held is None or held.shape != gaussians.radiance.shape:
                self.gaussians = self.gaussians._replace(radiance=wp.zeros_like(gaussians.radiance))
        self._summed.zero_()
        if self.gaussians.radiance is not None:
            self.gaussians.radiance.zero_()

    def add_band(self) -> None:
        """Add the part of the band listed last to the gradients of splats and of their rows."""
        drawn = self._drawn
        if not drawn.pair_capacity:
            return
        _find_slots(drawn)
        upstream = Adjoints()
        upstream.alpha, upstream.depth = self.images.alpha, self.images.depth
        upstream.median_depth = self.images.median_depth
        for i, (rows, adjoint, sums) in enumerate(zip(drawn.rows, self._adjoints, self._sums, strict=True)):
            pairs = drawn.pair_rows(sums.shape[1])
            frame = (drawn.frame, rows.vectors, drawn.exact, drawn.drawn)
            drawn.begin_sums()
            if drawn.device.is_cuda:
                image, passed = drawn.channel_images[i].vectors, (drawn.checkpoints, drawn.passed[i].vectors)
                backwards = (image, adjoint.vectors, upstream, *passed, pairs.vectors)
                launch_composite_adjoint_cuda(*frame, *backwards, drawn.device)
            else:
                launch_composite_adjoint_cpu(*frame, adjoint.vectors, upstream, pairs.vectors, drawn.device)
            upstream = Adjoints()  # alpha and depth are drawn in every pass; what they say counts once
            launch_sum_pairs(sums.size, pairs.matrix, drawn.frame.lists, drawn.order, sums, drawn.device)

    def resolve(self, gaussians: GaussianArrays, to_cameras: wp.array | None) -> GaussianGradients:
        """Turn sums over pairs into the gradients of Gaussians, and of cameras if they are asked for."""
        if to_cameras is not None and self._cameras is None:
            self._cameras = CameraBuffers(self._drawn)
        cameras = None if to_cameras is None else self._cameras
        moves = None if cameras is None else cameras.begin()
        drawn, found, splats, device = self._drawn, self.gaussians, self._splats, self._drawn.device
        for i, (rows, sums) in enumerate(zip(drawn.rows, self._sums, strict=True)):
            launch_resolve_sums(sums, drawn.splats, rows.length, int(drawn.exact), splats, device)
            columns = range(MOMENTS, MOMENTS + rows.length)
            launch_scatter_channels(sums, columns, i * CHANNEL_COUNTS[-1], drawn.view_count, self._blocks, device)
        if drawn.channels.colors:
            inputs = (gaussians.positions, gaussians.radiance, drawn.views)
            colors = (drawn.blocks.colors, self._blocks.colors)
            launch_evaluate_colors_adjoint(*inputs, *colors, found.positions, found.radiance, device, moves)
            if gaussians.extra is not None:
                gaussians.extra.differentiate(gaussians, drawn.views, self._blocks.colors)
        launch_project_adjoint(gaussians[:4], drawn.views, drawn.projection, self._tracked, found[:4], device, moves)
        if cameras is not None:
            launch_sum_cameras(cameras.rows, drawn.splats, cameras.lanes, to_cameras, device)
        return found


class CameraBuffers:
    """Arrays that derivatives to cameras need besides those to Gaussians.

    Attributes:
        rows: Derivatives to the camera of every splat, ``(V * N, 12)`` float.
        lanes: Parts of their sums.
    """

    def __init__(self, drawn: FrameBuffers) -> None:
        """Allocate for a frame."""
        count, length = drawn.splat_count, len(CAMERA_PARAMETERS)
        self.rows = wp.zeros((count, length), dtype=float, device=drawn.device)
        self.lanes = wp.zeros((drawn.view_count * LANES, length), dtype=wp.float64, device=drawn.device)
        self._moves = wp.zeros(count, dtype=CameraMove, device=drawn.device)
        if count:
            self._moves.grad = wp.array(ptr=self.rows.ptr, shape=count, dtype=CameraMove, device=drawn.device)

    def begin(self) -> wp.array:
        """Begin a new sum; return the moves of the splats' cameras, zeros, whose ``grad`` are the rows."""
        self.rows.zero_()
        return self._moves


def back_project_band(drawn: FrameBuffers, pixels: wp.array, out: wp.array) -> None:
    """Add the contents of pixels, with the weights of blending, to the rows of the splats of the band listed last."""
    if not drawn.pair_capacity:
        return
    back_project = launch_back_project_cuda if drawn.device.is_cuda else launch_back_project_cpu
    _find_slots(drawn)
    pairs = drawn.pair_rows(pixels.shape[1])
    drawn.begin_sums()
    back_project(drawn.frame, drawn.drawn, Rows.of(pixels).vectors, pairs.vectors, drawn.device)
    launch_sum_pairs(out.size, pairs.matrix, drawn.frame.lists, drawn.order, out, drawn.device)


def _find_slots(drawn: FrameBuffers) -> None:
    """Give every pair of the band that was drawn last its slot, on CUDA: elsewhere pairs have them since emission."""
    if not drawn.device.is_cuda:
        return
    order, frame, lists = drawn.order, drawn.frame, drawn.frame.lists
    wp.utils.array_scan(order.counts, order.ends, inclusive=True)
    launch_find_slots(drawn.pair_capacity, order, lists, lists.slots, drawn.device)
    if drawn.may_lack_ranks:
        views = (frame.views, frame.tile_views, frame.gaussian_count)
        launch_find_far_slots(order, frame.splats, *views, frame.band, lists, drawn.device)


def _zeros_in_one(shapes: Sequence[tuple[int, int]]) -> tuple[wp.array, list[wp.array]]:
    """Allocate matrices of floats on the current device in one array, which one launch clears, each aligned to it."""
    ends = np.cumsum([-(-rows * columns // ALIGNMENT) * ALIGNMENT for rows, columns in shapes]).tolist()
    whole = wp.zeros(ends[-1], dtype=float)
    parts = []
    for (rows, columns), start in zip(shapes, [0, *ends], strict=False):
        part = whole[start : start + rows * columns].reshape((rows, columns)) if rows else wp.zeros((0, columns))
        parts.append(part)
    return whole, parts


def _with_gradients(splats: Splats, gradients: Splats) -> Splats:
    """Return splats in the same memory whose arrays carry gradients, as `launch_project_adjoint` takes them."""
    tracked = Splats()
    for name in ("centers", "shapes", "slopes", "bends", "normals"):
        array = getattr(splats, name)
        array.grad = getattr(gradients, name)
        array.retain_grad = True  # the next frame begins it anew: the adjoint need not clear it
        setattr(tracked, name, array)
    return tracked
