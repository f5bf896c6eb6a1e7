"""The rasteriser on a device: what a frame is drawn from and into, kept from frame to frame, and the way back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from beam_warp.checks import require_count
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.raster.back_projection_cpu import launch_back_project_cpu
from beam_warp.kernels.raster.back_projection_cuda import launch_back_project_cuda
from beam_warp.kernels.raster.bin_tiles import (
    Band,
    TileLists,
    launch_count_pairs,
    launch_emit_pairs,
    launch_find_ranges,
    launch_key_splats,
)
from beam_warp.kernels.raster.channel_rows import (
    ChannelBlocks,
    launch_evaluate_colors,
    launch_evaluate_colors_adjoint,
    launch_gather_channels,
    launch_scatter_channels,
)
from beam_warp.kernels.raster.composite import CHANNEL_COUNTS, Images, RasterFrame, launch_composite_pixels
from beam_warp.kernels.raster.composite_adjoint import MOMENTS, Adjoints, pair_length
from beam_warp.kernels.raster.composite_adjoint_cpu import launch_composite_adjoint_cpu
from beam_warp.kernels.raster.composite_adjoint_cuda import launch_composite_adjoint_cuda
from beam_warp.kernels.raster.composite_cpu import launch_composite_cpu
from beam_warp.kernels.raster.composite_cuda import launch_composite_cuda
from beam_warp.kernels.raster.pair_sums import Pairs, launch_resolve_sums, launch_sum_pairs
from beam_warp.kernels.raster.project import Projection, RasterView, Splats, launch_project, launch_project_adjoint
from beam_warp.kernels.raster.view_sums import launch_sum_views
from beam_warp.raster.layout import Rows, ViewLayout, channel_rows
from beam_warp.raster.records import (
    COEFFICIENT_COUNTS,
    GaussianArrays,
    GaussianGradients,
    RasterImages,
    RasterOptions,
)
from beam_warp.world.camera import Camera

MAX_BAND_PAIRS = 2**24
"""Most (tile, splat) pairs held at a time, 24 bytes each, and on the way back up to 128 for each length of rows: beyond
it the images are drawn in bands of tile rows."""

MAX_ROW_PAIRS = 2**29
"""Most pairs in one row of tiles, the least that can be drawn: with `SPARE_CAPACITY`, and as much again for sorting, a
list's length is still a 32-bit integer."""

MAX_SPLATS = 2**26 - 1
"""Most splats, Gaussians times cameras: the up to 32 numbers that the way back sums for each are counted in 32 bits."""

SPARE_CAPACITY = 1.25
"""Room for pairs over what the first frame needs: the next ones need a little more."""


class Rasterizer:
    """Draws some number of Gaussians for some cameras, again and again.

    All arrays stay on the device and where they are. `draw` waits for the device, to learn how much room the frame
    takes; `redraw`, and `backward` and `back_project` from their second call on, wait for nothing and allocate nothing,
    so that they can be captured in a CUDA graph. Capture again after a `draw` that changed `pair_capacity`.

    Gaussians that are not finite, or whose quaternion is 0, are not drawn; their own gradients may not be finite.

    Attributes:
        device: Where everything is.
        cameras: Pinhole cameras of any sizes.
        options: How splats are drawn.
        images: What was drawn last.
        gaussian_ids: The last Gaussian that each pixel saw, -1 for none, ``(P,)`` int.
        color_channels: Where the captured colour is among the channels; empty for none.
        normal_channels: Where the normals are, of the surfaces of largest response, in the world and towards the
            camera; empty for none.
        value_channels: Where the Gaussians' own values are.
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
        readable: bool = False,
        images_of: Rasterizer | None = None,
    ) -> None:
        """Allocate what every frame needs.

        Args:
            gaussian_count: N; times the number of cameras at most `MAX_SPLATS`.
            cameras: At least one, of any sizes.
            value_count: K, the number of the Gaussians' own values that are composited.
            radiance: Whether the captured colour is.
            normals: Whether the normal of the geometry is.
            options: How splats are drawn.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.
            readable: Composite with the readable kernel, the oracle of the fast ones.
            images_of: Another rasteriser on the device, of as many channels and of at least as many pixels, to draw
                into the first of its pixels instead of images of its own. What either shows, and what `backward` and
                `back_project` start from, lasts until the other draws.

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
        self.color_channels = range(3 * radiance)
        self.normal_channels = range(self.color_channels.stop, self.color_channels.stop + 3 * normals)
        value_count = require_count("value_count", value_count, 0)
        self.value_channels = range(self.normal_channels.stop, self.normal_channels.stop + value_count)
        self._exact = self.options.depth == "exact"
        cuda = self.device.is_cuda
        self._launch_composite = launch_composite_cuda if cuda else launch_composite_cpu
        self._launch_composite_adjoint = launch_composite_adjoint_cuda if cuda else launch_composite_adjoint_cpu
        self._launch_back_project = launch_back_project_cuda if cuda else launch_back_project_cpu
        if readable:
            self._launch_composite = launch_composite_pixels
        self._layout = ViewLayout.of(self.cameras)
        self._require_images(images_of)
        with wp.ScopedDevice(self.device):
            self._allocate(images_of)
            self._reserve(0)
        self._gaussians: GaussianArrays | None = None
        self._bands: list[tuple[int, int]] = []
        self._back: _BackwardBuffers | None = None

    def _require_images(self, other: Rasterizer | None) -> None:
        """Refuse a rasteriser whose images cannot hold this one's."""
        if other is None:
            return
        found = other.first_pixels[-1], other.value_channels.stop, other.device
        needed = self.first_pixels[-1], self.value_channels.stop, self.device
        if found[0] < needed[0] or found[1:] != needed[1:]:
            raise InvalidOptionError(
                f"images_of must have at least {needed[0]} pixels of {needed[1]} channels on {needed[2]}, got "
                f"{found[0]} of {found[1]} on {found[2]}. Make the rasteriser of the most pixels first."
            )

    def _allocate(self, images_of: Rasterizer | None) -> None:
        """Allocate everything but what depends on the number of pairs."""
        splat_count = self._count * len(self.cameras)
        pixel_count = int(self._layout.first_pixels[-1])
        channel_count = self.value_channels.stop
        self._splats = _zero_splats(splat_count)
        self._rows = channel_rows(splat_count, channel_count, self.device)
        self._blocks = ChannelBlocks()
        self._blocks.values = wp.zeros((0, 0), dtype=float)
        self._blocks.colors = wp.zeros(splat_count if self.color_channels else 0, dtype=wp.vec3)
        self._blocks.normals = self._splats.normals if self.normal_channels else wp.zeros(0, dtype=wp.vec3)
        self._keys = wp.zeros(2 * splat_count, dtype=int)  # the sort wants room for as many again
        self._order = wp.zeros(2 * splat_count, dtype=int)
        self._counts = wp.zeros(splat_count, dtype=int)
        self._ends = wp.zeros(splat_count, dtype=int)
        if images_of is None:
            self._drawn = _zero_images(pixel_count, has_states=not self.device.is_cuda)
            self._channel_images = channel_rows(pixel_count, channel_count, self.device)
        else:
            self._drawn = _first_pixels_of(images_of._drawn, pixel_count)
            self._channel_images = [Rows.of(rows.matrix[:pixel_count]) for rows in images_of._channel_images]
        self.images = RasterImages(
            tuple(image.matrix for image in self._channel_images),
            self._drawn.alpha,
            self._drawn.depth,
            self._drawn.median_depth,
        )
        self.gaussian_ids = self._drawn.gaussians
        self._views = wp.array(self._layout.views, dtype=RasterView)
        self._projection = Projection()
        self._projection.low_pass = self.options.low_pass
        self._projection.near = self.options.near
        self._projection.antialiased = int(self.options.antialiased)
        self._frame = RasterFrame()
        self._frame.splats = self._splats
        self._frame.views = self._views
        self._frame.tile_views = wp.array(self._layout.tile_views, dtype=int)
        self._frame.gaussian_count = self._count
        self._frame.near = self.options.near

    def _reserve(self, capacity: int) -> None:
        """Make room for pairs."""
        self._tiles = wp.zeros(2 * capacity, dtype=int)  # the sort wants room for as many again
        self._listed_tiles = self._tiles[:capacity] if capacity else self._tiles
        self._slots = wp.zeros(2 * capacity, dtype=int)
        self._owners = wp.zeros(capacity, dtype=int)
        lists = TileLists()
        lists.ranges = wp.zeros(int(self._layout.first_tiles[-1]), dtype=wp.vec2i)
        lists.splats = wp.zeros(capacity, dtype=int)
        lists.slots = self._slots
        self._lists = lists
        self._frame.lists = lists
        self._pair_rows: dict[int, Rows] = {}

    def prepare_cameras(self, cameras: Sequence[Camera]) -> PreparedCameras:
        """Bring other cameras to the device, so that `set_cameras` takes them without waiting.

        Raises:
            InvalidOptionError: A number or size differs from this rasteriser's.
        """
        self._require_sizes(cameras)
        layout = ViewLayout.of(cameras)
        return PreparedCameras(tuple(cameras), layout, wp.array(layout.views, dtype=RasterView, device=self.device))

    def set_cameras(self, cameras: Sequence[Camera] | PreparedCameras) -> None:
        """Move cameras or change their lenses; their number and sizes stay. `backward` wants a draw in between.

        With cameras that `prepare_cameras` brought, the call may be captured in a CUDA graph.

        Raises:
            InvalidOptionError: A number or size differs.
        """
        prepared = cameras if isinstance(cameras, PreparedCameras) else self.prepare_cameras(cameras)
        self._require_sizes(prepared.cameras)
        self.cameras = prepared.cameras
        self._layout = prepared.layout
        wp.copy(self._views, prepared.views)

    def _require_sizes(self, cameras: Sequence[Camera]) -> None:
        """Refuse cameras for which other arrays would be needed."""
        sizes = [(camera.width, camera.height) for camera in self.cameras]
        given = [(camera.width, camera.height) for camera in cameras]
        if given != sizes:
            raise InvalidOptionError(f"cameras must have the sizes {sizes}, got {given}. Make another Rasterizer.")

    @property
    def first_pixels(self) -> tuple[int, ...]:
        """Where each view's pixels begin in the images, and where the last one's end."""
        return tuple(self._layout.first_pixels.tolist())

    @property
    def pair_capacity(self) -> int:
        """Number of (tile, splat) pairs there is room for."""
        return len(self._owners)

    def pair_count(self) -> int:
        """Return how many pairs the last frame has, or the last of its bands; waits for the device.

        More than `pair_capacity` after `redraw`: the images lack splats. Call `draw`.
        """
        if not len(self._counts):
            return 0
        if len(self._counts) * int(self._layout.first_tiles[-1]) < 2**31:
            return int(self._ends[-1:].numpy()[0])
        return int(self._counts.numpy().sum(dtype=np.int64))  # the ends may be beyond the range of integers

    def draw(self, gaussians: GaussianArrays) -> RasterImages:
        """Draw Gaussians, however much room they take.

        Args:
            gaussians: Arrays on the device, of the shapes and parts this was made for; they are kept for `redraw` and
                `backward`.

        Returns:
            `images`.

        Raises:
            InvalidArrayError: An array has another shape or place, or the Gaussians cover a row of tiles too often to
                be listed.
        """
        self._check(gaussians)
        self._gaussians = None  # until all of it is drawn: a frame that is refused cannot be drawn again
        with wp.ScopedDevice(self.device):
            self._project(gaussians)
            self._bands = self._plan_bands()
            for band in self._bands:
                if len(self._bands) > 1:
                    self._count_pairs(band)
                self._list_pairs()
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
        if len(self._bands) > 1:
            return self.draw(gaussians)
        with wp.ScopedDevice(self.device):
            self._project(gaussians)
            self._count_pairs(self._bands[0])
            self._list_pairs()
            self._composite()
        return self.images

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
            self._gather_channels()
            self._composite()
        return self.images

    def adjoints(self) -> RasterImages:
        """Return the buffers of a loss's derivatives to `images`, zeros at first; fill them, then call `backward`."""
        with wp.ScopedDevice(self.device):
            return self._backward_buffers().images

    def backward(self) -> GaussianGradients:
        """Return the derivatives to the Gaussians of what was drawn last, from those in `adjoints`.

        What is discrete is held still: which splats count, their order, the cap of alpha, the pick of the median.

        Returns:
            The same arrays every time, overwritten by the next call.

        Raises:
            InvalidOptionError: Nothing was drawn.

        Source: Kerbl et al. 2023, Section 6; per-pair sums without atomics as in
        ``kernels/raster/composite_adjoint_cuda.py``.
        """
        gaussians = self._drawn_gaussians("backward")
        with wp.ScopedDevice(self.device):
            back = self._backward_buffers()
            back.match(gaussians if self.color_channels else None)
            back.zero_()
            for _ in self._listed_bands():
                self._composite_adjoint(back)
            return self._project_adjoint(gaussians, back)

    def back_project(self, pixels: wp.array, out: wp.array) -> None:
        """Carry what pixels hold back to the Gaussians that they saw in the last frame: drawing values, transposed.

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
        self._require_matrix("pixels", pixels, self.first_pixels[-1], CHANNEL_COUNTS)
        length = pixels.shape[1]
        self._require_matrix("out", out, self._count * len(self.cameras), (length,))
        with wp.ScopedDevice(self.device):
            held = Rows.of(pixels).vectors
            out.zero_()
            for _ in self._listed_bands():
                if self.pair_capacity:
                    pairs = self._rows_of_pairs(length)
                    self._launch_back_project(self._frame, self._drawn, held, pairs.vectors, self.device)
                    self._sum_pairs(pairs, out)

    def sum_views(self, rows: wp.array, out: wp.array) -> None:
        """Sum the rows of every Gaussian over the views, in their order.

        Args:
            rows: ``(V * N, K)`` float, compact, view by view, as of `back_project`.
            out: ``(N, K)`` float, compact; overwritten.

        Raises:
            InvalidArrayError: An array has another shape, type or place.
        """
        self._require_matrix("rows", rows, self._count * len(self.cameras))
        self._require_matrix("out", out, self._count, (rows.shape[1],))
        launch_sum_views(rows, out, self.device)

    def _require_matrix(self, name: str, array: Any, count: int, lengths: tuple[int, ...] = ()) -> None:
        """Refuse what is not a compact matrix of floats on the device: of so many rows, of one of some lengths."""
        if not isinstance(array, wp.array):
            got = type(array).__name__
        elif not array.is_contiguous:
            got = f"{_described(array)}, a part of another array"
        else:
            fits = array.ndim == 2 and array.shape[0] == count and (not lengths or array.shape[1] in lengths)
            if fits and array.dtype is wp.float32 and array.device == self.device:
                return
            got = _described(array)
        size = f"{count} x {' or '.join(map(str, lengths)) or 'K'}"
        raise InvalidArrayError(
            f"{name} must be a compact warp array of float32, {size}, on {self.device}, got {got}. Convert it."
        )

    def _listed_bands(self) -> Iterator[tuple[int, int]]:
        """List the pairs of one band after the other, as they were drawn; a single one is listed since."""
        for band in self._bands:
            if len(self._bands) > 1:
                self._count_pairs(band)
                self._list_pairs()
            yield band

    def _drawn_gaussians(self, caller: str) -> GaussianArrays:
        """Return what was drawn last."""
        if self._gaussians is None:
            raise InvalidOptionError(f"{caller} must follow draw, got no draw before it. Call draw first.")
        return self._gaussians

    def _check(self, gaussians: GaussianArrays) -> None:
        """Refuse arrays that kernels would misread."""
        rows, values = (self._count,), (len(self.value_channels),)
        # Of each array the type, and the lengths that each side may have.
        wanted: dict[str, tuple[Any, tuple[tuple[int, ...], ...]]] = {
            "positions": (wp.vec3, (rows,)),
            "orientations": (wp.quat, (rows,)),
            "scales": (wp.vec3, (rows,)),
            "opacities": (wp.float32, (rows,)),
        }
        if self.value_channels:
            wanted["values"] = (wp.float32, (rows, values))
        if self.color_channels:
            wanted["radiance"] = (wp.vec3, (rows, COEFFICIENT_COUNTS))
        for name, (dtype, sides) in wanted.items():
            array = getattr(gaussians, name)
            if not isinstance(array, wp.array):
                got = "none" if array is None else type(array).__name__
            elif array.dtype is dtype and array.device == self.device and _fits(array.shape, sides):
                continue
            else:
                got = _described(array)
            size = " x ".join(" or ".join(map(str, lengths)) for lengths in sides)
            raise InvalidArrayError(
                f"{name} must be a warp array of {dtype.__name__}, {size}, on {self.device}, got {got}. Convert it."
            )

    def _project(self, gaussians: GaussianArrays) -> None:
        """Make splats of the Gaussians, their rows of channels and their order in depth."""
        launch_project(gaussians[:4], self._views, self._projection, self._splats, self.device)
        if self.color_channels:
            launch_evaluate_colors(
                gaussians.positions, gaussians.radiance, self._views, self._blocks.colors, self.device
            )
        if self.value_channels:
            self._blocks.values = gaussians.values
        self._gather_channels()
        launch_key_splats(self._splats, self._keys, self._order, self.device)
        if len(self._counts):
            wp.utils.radix_sort_pairs(self._keys, self._order, len(self._counts))

    def _gather_channels(self) -> None:
        """Write every splat's row of channels."""
        for i, rows in enumerate(self._rows):
            launch_gather_channels(self._blocks, i * CHANNEL_COUNTS[-1], rows.matrix, self.device)

    def _plan_bands(self) -> list[tuple[int, int]]:
        """Cut the tiles into runs of rows whose pairs fit, usually one, and make room for the largest."""
        first_tiles = self._layout.first_tiles
        bands, most = [], 0
        waiting = [(0, len(first_tiles) - 1)]
        while waiting:
            first, end = waiting.pop()
            band = (int(first_tiles[first]), int(first_tiles[end]))
            self._count_pairs(band)
            pairs = self.pair_count()
            if pairs > MAX_BAND_PAIRS and end - first > 1:
                middle = (first + end) // 2
                waiting += [(middle, end), (first, middle)]
                continue
            if pairs > MAX_ROW_PAIRS:
                raise InvalidArrayError(
                    f"positions and scales must cover a row of tiles at most {MAX_ROW_PAIRS} times, got {pairs} "
                    f"at tile row {first}. Drop Gaussians that are larger than the scene."
                )
            bands.append(band)
            most = max(most, pairs)
        if most > self.pair_capacity:
            self._reserve(int(SPARE_CAPACITY * most))
        return bands

    def _count_pairs(self, band: tuple[int, int]) -> None:
        """Count the pairs of a band, splat by splat in depth order, and what each one's are the end of."""
        self._frame.band = _band(band)
        launch_count_pairs(
            self._order, self._splats, self._views, self._count, self._frame.band, self._counts, self.device
        )
        if len(self._counts):
            wp.utils.array_scan(self._counts, self._ends, inclusive=True)

    def _list_pairs(self) -> None:
        """List the splats of every tile of the band that was counted."""
        band = self._frame.band
        tile_count = band.end_tile - band.first_tile
        self._lists.ranges.zero_()
        if not self.pair_capacity:
            return
        self._listed_tiles.fill_(tile_count)  # sorts behind every tile: room that no pair takes
        launch_emit_pairs(
            self._order,
            self._counts,
            self._ends,
            self._splats,
            self._views,
            self._count,
            self._frame.band,
            self._tiles,
            self._slots,
            self._owners,
            self.device,
        )
        wp.utils.radix_sort_pairs(self._tiles, self._slots, self.pair_capacity, end_bit=tile_count.bit_length())
        launch_find_ranges(self._tiles, self._slots, self._owners, tile_count, self._lists, self.device)

    def _composite(self) -> None:
        """Draw the tiles of the band at hand."""
        for rows, image in zip(self._rows, self._channel_images, strict=True):
            self._launch_composite(self._frame, rows.vectors, self._exact, image.vectors, self._drawn, self.device)

    def _backward_buffers(self) -> _BackwardBuffers:
        """Return what the way back needs, made when first asked for."""
        if self._back is None:
            self._back = _BackwardBuffers.of(self)
        return self._back

    def _rows_of_pairs(self, length: int) -> Rows:
        """Return where rows of pairs go, allocated when first asked for; they are for whoever uses them next."""
        if length not in self._pair_rows:
            self._pair_rows[length] = Rows.zeros(self.pair_capacity, length, self.device)
        return self._pair_rows[length]

    def _sum_pairs(self, pairs: Rows, sums: wp.array) -> None:
        """Add the rows of the band's pairs to those of their splats."""
        summed = Pairs()
        summed.rows = pairs.matrix
        summed.order, summed.counts, summed.ends = self._order, self._counts, self._ends
        launch_sum_pairs(summed, sums, self.device)

    def _composite_adjoint(self, back: _BackwardBuffers) -> None:
        """Add what the band at hand says to the gradients of splats and of their rows."""
        if not self.pair_capacity:
            return
        upstream = Adjoints()
        upstream.alpha, upstream.depth = back.images.alpha, back.images.depth
        upstream.median_depth = back.images.median_depth
        for rows, adjoint, sums in zip(self._rows, back.channel_adjoints, back.sums, strict=True):
            pairs = self._rows_of_pairs(pair_length(rows.length, self._exact))
            arguments = (self._frame, rows.vectors, self._exact, self._drawn, adjoint.vectors, upstream)
            self._launch_composite_adjoint(*arguments, pairs.vectors, self.device)
            upstream = Adjoints()  # alpha and depth are drawn in every pass; what they say counts once
            self._sum_pairs(pairs, sums)

    def _project_adjoint(self, gaussians: GaussianArrays, back: _BackwardBuffers) -> GaussianGradients:
        """Turn sums over pairs into the gradients of Gaussians."""
        found, splats = back.gaussians, back.splats
        for i, (rows, sums) in enumerate(zip(self._rows, back.sums, strict=True)):
            launch_resolve_sums(sums, self._splats, rows.length, int(self._exact), splats, self.device)
            columns = range(MOMENTS, MOMENTS + rows.length)
            start = i * CHANNEL_COUNTS[-1]
            launch_scatter_channels(sums, columns, start, len(self.cameras), back.blocks, self.device)
        if self.color_channels:
            launch_evaluate_colors_adjoint(
                gaussians.positions,
                gaussians.radiance,
                self._views,
                self._blocks.colors,
                back.blocks.colors,
                found.positions,
                found.radiance,
                self.device,
            )
        launch_project_adjoint(
            gaussians[:4],
            self._views,
            self._projection,
            self._splats,
            [splats.centers, splats.shapes, splats.slopes, splats.bends, splats.normals],
            [found.positions, found.orientations, found.scales, found.opacities],
            self.device,
        )
        return found


@dataclass(frozen=True, eq=False)
class PreparedCameras:
    """Cameras on a device, for `Rasterizer.set_cameras`."""

    cameras: tuple[Camera, ...]
    layout: ViewLayout
    views: wp.array


@dataclass(eq=False)
class _BackwardBuffers:
    """What the way back needs besides what was drawn."""

    images: RasterImages
    channel_adjoints: list[Rows]
    splats: Splats
    sums: list[wp.array]
    blocks: ChannelBlocks
    gaussians: GaussianGradients

    @classmethod
    def of(cls, rasterizer: Rasterizer) -> _BackwardBuffers:
        """Allocate for what a rasteriser draws, on the current device."""
        device, count = rasterizer.device, rasterizer._count
        splat_count, pixel_count = count * len(rasterizer.cameras), rasterizer.first_pixels[-1]
        channel_count, exact = rasterizer.value_channels.stop, rasterizer._exact
        adjoints = channel_rows(pixel_count, channel_count, device)
        has_colors, value_count = bool(rasterizer.color_channels), len(rasterizer.value_channels)
        splats = _zero_splats(splat_count)
        blocks = ChannelBlocks()
        blocks.values = wp.zeros((count, value_count), dtype=float)
        blocks.colors = wp.zeros(splat_count if has_colors else 0, dtype=wp.vec3)
        blocks.normals = splats.normals if rasterizer.normal_channels else wp.zeros(0, dtype=wp.vec3)
        return cls(
            RasterImages(
                tuple(rows.matrix for rows in adjoints), *(wp.zeros(pixel_count, dtype=float) for _ in range(3))
            ),
            adjoints,
            splats,
            [wp.zeros((splat_count, pair_length(rows.length, exact)), dtype=float) for rows in adjoints],
            blocks,
            GaussianGradients(
                wp.zeros(count, dtype=wp.vec3),
                wp.zeros(count, dtype=wp.quat),
                wp.zeros(count, dtype=wp.vec3),
                wp.zeros(count, dtype=float),
                blocks.values if value_count else None,
                None,
            ),
        )

    def match(self, colored: GaussianArrays | None) -> None:
        """Make room for as many coefficients of captured colour as Gaussians that show it have."""
        if colored is None or colored.radiance is None:
            return
        held = self.gaussians.radiance
        if held is None or held.shape != colored.radiance.shape:
            self.gaussians = replace(self.gaussians, radiance=wp.zeros_like(colored.radiance))

    def zero_(self) -> None:
        """Begin a new sum."""
        found = self.gaussians
        for array in (found.positions, found.orientations, found.scales, found.opacities, found.radiance):
            if array is not None:
                array.zero_()
        for array in (self.splats.centers, self.splats.shapes, self.splats.slopes, self.splats.bends):
            array.zero_()
        for sums in self.sums:
            sums.zero_()


def require_cameras(cameras: Any) -> None:
    """Refuse what is not a sequence of at least one camera."""
    if not isinstance(cameras, Sequence):
        raise InvalidOptionError(
            f"cameras must be a sequence of cameras, got {type(cameras).__name__}. Put a single one in a list."
        )
    if not cameras:
        raise InvalidOptionError("cameras must hold at least one camera, got none. Pass what sees the scene.")
    for i, camera in enumerate(cameras):
        if not isinstance(camera, Camera):
            raise InvalidOptionError(
                f"cameras must hold cameras, got {type(camera).__name__} at place {i}. Make it a beam_warp.Camera."
            )


def _fits(shape: tuple[int, ...], sides: tuple[tuple[int, ...], ...]) -> bool:
    """Tell whether each side of a shape has one of the lengths that it may have."""
    return len(shape) == len(sides) and all(n in lengths for n, lengths in zip(shape, sides, strict=True))


def _described(array: wp.array) -> str:
    """Say what an array is, for an error."""
    return f"{array.dtype.__name__} {array.shape} on {array.device}"


def _zero_splats(count: int) -> Splats:
    """Allocate splats on the current device."""
    splats = Splats()
    for name, dtype in (("centers", wp.vec4), ("shapes", wp.vec4), ("slopes", wp.vec4), ("bends", float)):
        setattr(splats, name, wp.zeros(count, dtype=dtype))
    splats.normals = wp.zeros(count, dtype=wp.vec3)
    return splats


def _zero_images(pixel_count: int, *, has_states: bool) -> Images:
    """Allocate images on the current device."""
    images = Images()
    for name in ("alpha", "transmittance", "depth", "median_depth"):
        setattr(images, name, wp.zeros(pixel_count, dtype=float))
    for name in ("gaussians", "ends", "medians"):
        setattr(images, name, wp.zeros(pixel_count, dtype=int))
    images.states = wp.zeros(pixel_count if has_states else 0, dtype=wp.vec4)
    return images


def _first_pixels_of(images: Images, pixel_count: int) -> Images:
    """Return the beginning of images, in the same memory."""
    part = Images()
    for name in ("alpha", "transmittance", "depth", "median_depth", "gaussians", "ends", "medians", "states"):
        whole = getattr(images, name)
        setattr(part, name, whole[:pixel_count] if len(whole) else whole)
    return part


def _band(tiles: tuple[int, int]) -> Band:
    """Describe a run of tiles to the kernels."""
    band = Band()
    band.first_tile, band.end_tile = tiles
    return band
