"""The rasteriser: draws Gaussians for some cameras again and again, and differentiates the images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from beam_warp.checks import require_count
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.raster.composite import CHANNEL_COUNTS
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.raster.view_sums import launch_sum_views
from beam_warp.raster import forward
from beam_warp.raster.array_checks import require_cameras, require_gaussians, require_matrix, require_sizes
from beam_warp.raster.backward import BackwardBuffers, back_project_band
from beam_warp.raster.buffers import FrameBuffers
from beam_warp.raster.layout import ChannelRanges, ViewLayout
from beam_warp.raster.records import CAMERA_PARAMETERS, GaussianArrays, GaussianGradients, RasterImages, RasterOptions
from beam_warp.world.camera import Camera

MAX_SPLATS = 2**26 - 1
"""Most splats, Gaussians times cameras. The way back sums up to 32 numbers for each, and counts them in 32 bits; an
entry of a list on CUDA leaves bits for the rank of a pair."""


class Rasterizer:
    """Draws some number of Gaussians for some cameras, again and again.

    All arrays stay on the device and where they are. `draw` waits for the device, to learn how much room the frame
    takes; `redraw`, and `backward` and `back_project` from their second call on, wait for nothing and allocate nothing,
    so that they can be captured in a CUDA graph. Capture again after a `draw` that changed `pair_capacity`.
    Threads must not work on one device at the same time: drawing changes Warp's current stream there for a moment.

    Gaussians that are not finite, or whose quaternion is 0, are not drawn; their own gradients may not be finite.

    Attributes:
        device: The Warp device of all arrays.
        cameras: Pinhole cameras of any sizes.
        options: How splats are drawn.
        images: The images drawn last.
        gaussian_ids: The last Gaussian that each pixel saw, -1 for none, ``(P,)`` int.
        color_channels: The channels of the captured colour; empty for none.
        normal_channels: The channels of the normals of the surfaces of largest response, in the world and towards the
            camera; empty for none.
        value_channels: The channels of the Gaussians' own values.
    """

    def __init__(
        self,
        gaussian_count: int,
        cameras: Sequence[Camera],
        *,
        value_count: int = 0,
        radiance: bool = False,
        normals: bool = False,
        options: RasterOptions | None = None,
        device: Any = None,
        images_of: Rasterizer | None = None,
        checkpoints: bool = False,
    ) -> None:
        """Allocate the arrays of every frame.

        Args:
            gaussian_count: N; times the number of cameras at most `MAX_SPLATS`.
            cameras: At least one, of any sizes.
            value_count: K, the number of the Gaussians' own values that are composited.
            radiance: Whether the captured colour is.
            normals: Whether the normal of the geometry is.
            options: How splats are drawn.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.
            images_of: Another rasteriser on the device, of as many channels and of at least as many pixels, to draw
                into the first of its pixels instead of images of its own. What either shows, and what `backward` and
                `back_project` start from, lasts until the other draws.
            checkpoints: Whether `draw` notes on CUDA what pixels have come to on their way through long lists, so that
                `backward` can share these out: faster where images are small, for 16 bytes more a pair and 4 for each
                channel. Nothing is noted of images of more tiles than a GPU holds blocks.

        Raises:
            DeviceError: There is no such device.
            InvalidOptionError: ``cameras`` is no sequence of at least one camera, a count is out of range, or
                ``images_of`` has other channels, too few pixels, or another device.
        """
        require_cameras(cameras)
        self._count = require_count("gaussian_count", gaussian_count, 0, MAX_SPLATS // len(cameras))
        self.device = resolve_device(device)
        self.cameras = tuple(cameras)
        self.options = options or RasterOptions()
        channels = ChannelRanges.of(
            radiance=radiance, normals=normals, value_count=require_count("value_count", value_count, 0)
        )
        self.color_channels, self.normal_channels, self.value_channels = channels
        room = None if images_of is None else images_of._buffers
        frame = (self._count, self.cameras, channels, self.options, self.device, room)
        self._buffers = FrameBuffers(*frame, checkpoints=checkpoints)
        self.images = self._buffers.images
        self.gaussian_ids = self._buffers.drawn.gaussians
        self._gaussians: GaussianArrays | None = None
        self._bands: list[tuple[int, int]] = []
        self._back: BackwardBuffers | None = None

    def prepare_cameras(self, cameras: Sequence[Camera]) -> PreparedCameras:
        """Bring other cameras to the device, so that `set_cameras` takes them without waiting.

        Raises:
            InvalidOptionError: A number or size differs from this rasteriser's.
        """
        require_sizes(cameras, self.cameras)
        layout = ViewLayout.of(cameras)
        return PreparedCameras(tuple(cameras), layout, wp.array(layout.views, dtype=RasterView, device=self.device))

    def set_cameras(self, cameras: Sequence[Camera] | PreparedCameras) -> None:
        """Move cameras or change their lenses; their number and sizes stay. `backward` wants a draw in between.

        With cameras that `prepare_cameras` brought, the call may be captured in a CUDA graph.

        Raises:
            InvalidOptionError: A number or size differs.
        """
        prepared = cameras if isinstance(cameras, PreparedCameras) else self.prepare_cameras(cameras)
        require_sizes(prepared.cameras, self.cameras)
        self.cameras = prepared.cameras
        self._buffers.layout = prepared.layout
        wp.copy(self._buffers.views, prepared.views)

    @property
    def first_pixels(self) -> tuple[int, ...]:
        """The first pixel of each view in the images, and the end of the last one's."""
        return tuple(self._buffers.layout.first_pixels.tolist())

    @property
    def pair_capacity(self) -> int:
        """Number of (tile, splat) pairs there is room for."""
        return self._buffers.pair_capacity

    @property
    def is_whole(self) -> bool:
        """Whether the last `draw` took one band: only then `redraw` waits for nothing."""
        return len(self._bands) <= 1

    def pair_count(self) -> int:
        """Return how many pairs the last frame has, or the last of its bands; waits for the device.

        More than `pair_capacity` after `redraw`: the images lack splats. Call `draw`.
        """
        return forward.counted_pairs(self._buffers)

    def note_pair_count(self, counts: wp.array, place: int) -> None:
        """Write what `pair_count` returns for a single band to ``counts[place]``, an int; waits for nothing."""
        if self._buffers.splat_count:
            wp.copy(counts, self._buffers.pair_total, place, 0, 1)

    def draw(self, gaussians: GaussianArrays) -> RasterImages:
        """Draw Gaussians, and make room for their pairs.

        Args:
            gaussians: Arrays on the device, of the shapes and parts this was made for; they are kept for `redraw` and
                `backward`.

        Returns:
            `images`.

        Raises:
            InvalidArrayError: An array has another shape or place, or the Gaussians cover a row of tiles too often to
                be listed.
        """
        require_gaussians(gaussians, self._count, self._buffers.channels, self.device)
        self._gaussians = None  # until all of it is drawn: a frame that is refused cannot be drawn again
        with wp.ScopedDevice(self.device):
            self._buffers.tallies.zero_()  # a frame that was refused may have left some
            forward.project(self._buffers, gaussians)
            forward.evaluate_colors(self._buffers, gaussians)
            forward.gather_channels(self._buffers, gaussians)
            self._buffers.wait_for(self._buffers.gathering)
            self._bands = forward.plan_bands(self._buffers)
            for band in self._bands:
                if len(self._bands) > 1:
                    forward.count_pairs(self._buffers, band)
                forward.list_pairs(self._buffers)
                self._composite()
        self._gaussians = gaussians
        return self.images

    def redraw(self) -> RasterImages:
        """Draw the arrays of the last `draw` again, after their contents or the cameras changed, without waiting.

        Pairs beyond `pair_capacity` are left out: ask `pair_count` from time to time. A frame that needed several bands
        is drawn by `draw`.

        Raises:
            InvalidOptionError: Nothing was drawn.
        """
        gaussians = self._drawn_gaussians("redraw")
        if not self.is_whole:
            return self.draw(gaussians)
        with wp.ScopedDevice(self.device):
            forward.project(self._buffers, gaussians)
            forward.evaluate_colors(self._buffers, gaussians)
            forward.gather_channels(
                self._buffers, gaussians
            )  # beside the lists: `relist` and then `redraw_values` take longer
            forward.list_pairs(self._buffers)
            self._buffers.wait_for(self._buffers.gathering)
            self._composite()
        return self.images

    def relist(self) -> None:
        """Find the splats of every tile again, without waiting: the part of `redraw` that looks at no values.

        `redraw_values` draws them. A frame of several bands lists each when it draws it.

        Raises:
            InvalidOptionError: Nothing was drawn.
        """
        gaussians = self._drawn_gaussians("redraw")
        if self.is_whole:
            with wp.ScopedDevice(self.device):
                forward.project(self._buffers, gaussians)
                forward.evaluate_colors(self._buffers, gaussians)
                forward.list_pairs(self._buffers)
                if self._buffers.channels.colors:
                    self._buffers.wait_for(self._buffers.gathering)

    def redraw_values(self) -> RasterImages:
        """Draw the last frame again after the contents of its values changed and nothing else, without waiting.

        Splats and their order are taken as they are, which is about half of the work; the bits are those of `redraw`.

        Raises:
            InvalidOptionError: Nothing was drawn.
        """
        gaussians = self._drawn_gaussians("redraw_values")
        if len(self._bands) > 1:
            return self.draw(gaussians)
        with wp.ScopedDevice(self.device):
            forward.gather_channels(self._buffers, gaussians)
            self._buffers.wait_for(self._buffers.gathering)
            self._composite()
        return self.images

    def adjoints(self) -> RasterImages:
        """Return the buffers of a loss's derivatives to `images`, zeros at first; fill them, then call `backward`."""
        return self._backward_buffers().images

    def backward(self, to_cameras: wp.array | None = None) -> GaussianGradients:
        """Return a loss's derivatives to the Gaussians of the last frame, from those to the images in `adjoints`.

        Discrete decisions are held still: which splats count, their order, the cap of alpha, the pick of the median.

        Args:
            to_cameras: ``(V, 12)`` float, compact; overwritten with the derivatives to the numbers of each camera that
                `CAMERA_PARAMETERS` names. None leaves them out, which costs nothing. The first call that asks for them
                allocates what they need.

        Returns:
            The same arrays every time, overwritten by the next call.

        Raises:
            InvalidArrayError: ``to_cameras`` has another shape, type or place.
            InvalidOptionError: Nothing was drawn.

        Source: Kerbl et al. 2023, Section 6; per-pair sums without atomics as in
        ``kernels/raster/composite_adjoint_cuda.py``.
        """
        gaussians = self._drawn_gaussians("backward")
        if to_cameras is not None:
            require_matrix("to_cameras", to_cameras, len(self.cameras), (len(CAMERA_PARAMETERS),), self.device)
        back = self._backward_buffers()
        with wp.ScopedDevice(self.device):
            back.begin(gaussians)
            for _ in self._listed_bands():
                back.add_band()
            return back.resolve(gaussians, to_cameras)

    def back_project(self, pixels: wp.array, out: wp.array) -> None:
        """Carry the contents of pixels back to the Gaussians of the last frame: the transpose of drawing values.

        ``out[v * N + i]`` becomes the sum over the pixels p of view v of w_ip ``pixels[p]``, where w_ip is the weight
        with which `draw` blends Gaussian i into pixel p; zeros for Gaussians that the view does not see.

        Args:
            pixels: ``(P, K)`` float, K of 4, 8, 12 or 16, compact, the pixels in the order of `images`; finite where
                alpha is not 0.
            out: ``(V * N, K)`` float, compact, view by view; overwritten. `sum_views` adds the views up.

        Raises:
            InvalidArrayError: An array has another shape, type or place.
            InvalidOptionError: Nothing was drawn.
        """
        self._drawn_gaussians("back_project")
        require_matrix("pixels", pixels, self._buffers.pixel_count, CHANNEL_COUNTS, self.device)
        require_matrix("out", out, self._buffers.splat_count, (pixels.shape[1],), self.device)
        with wp.ScopedDevice(self.device):
            out.zero_()
            for _ in self._listed_bands():
                back_project_band(self._buffers, pixels, out)

    def sum_views(self, rows: wp.array, out: wp.array) -> None:
        """Sum the rows of every Gaussian over the views, in their order.

        Args:
            rows: ``(V * N, K)`` float, compact, view by view, as of `back_project`.
            out: ``(N, K)`` float, compact; overwritten.

        Raises:
            InvalidArrayError: An array has another shape, type or place.
        """
        require_matrix("rows", rows, self._buffers.splat_count, (), self.device)
        require_matrix("out", out, self._count, (rows.shape[1],), self.device)
        launch_sum_views(out.shape[0] * out.shape[1], rows, out, self.device)

    def _composite(self) -> None:
        """Draw the band that was listed last."""
        forward.composite(self._buffers)

    def _backward_buffers(self) -> BackwardBuffers:
        """Return the buffers of the way back, made when first asked for."""
        if self._back is None:
            self._back = BackwardBuffers(self._buffers)
        return self._back

    def _listed_bands(self) -> Iterator[tuple[int, int]]:
        """List the pairs of one band after the other, as they were drawn; a single one is listed since."""
        for band in self._bands:
            if len(self._bands) > 1:
                forward.count_pairs(self._buffers, band)
                forward.list_pairs(self._buffers)
                if self.device.is_cuda:  # compositing sorts the lists
                    self._composite()
            yield band

    def _drawn_gaussians(self, caller: str) -> GaussianArrays:
        """Return the Gaussians drawn last."""
        if self._gaussians is None:
            raise InvalidOptionError(f"{caller} must follow draw, got no draw before it. Call draw first.")
        return self._gaussians


@dataclass(frozen=True, eq=False)
class PreparedCameras:
    """Cameras on a device, for `Rasterizer.set_cameras`."""

    cameras: tuple[Camera, ...]
    layout: ViewLayout
    views: wp.array
