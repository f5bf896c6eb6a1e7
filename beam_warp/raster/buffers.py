"""The arrays that frames are drawn from and into: allocated once, kept from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import numpy as np
import warp as wp

from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.raster.bin_tiles import TILE, PairList, SplatOrder, TileLists
from beam_warp.kernels.raster.channel_rows import ChannelBlocks
from beam_warp.kernels.raster.composite import Checkpoints, Images, RasterFrame
from beam_warp.kernels.raster.composite_cuda import STRIDE
from beam_warp.kernels.raster.project import Projection, RasterView, Splats
from beam_warp.kernels.raster.tile_lists_cuda import SPREAD, rank_bits
from beam_warp.raster.layout import ChannelRanges, Rows, ViewLayout, channel_rows, pass_lengths
from beam_warp.raster.records import RasterImages, RasterOptions
from beam_warp.world.camera import Camera

BLOCKS_HELD = 16
"""Blocks of the way back that a multiprocessor holds at most. Where there are more tiles than all of them hold, no part
of the GPU waits for the longest list. Then lists stay whole, for each part of one costs a little, and a lane draws two
pixels."""


RECORD = 16
"""Floats of a splat that lie side by side: its centre, shape, slope, and up to four channels."""


class FrameBuffers:
    """Everything a frame is drawn from and into, on one device.

    Attributes:
        gaussian_count: N.
        view_count: V, the number of cameras.
        layout: Where views, tiles and pixels lie.
        channels: Where colour, normals and values are among the channels.
        device: Where all arrays are.
        exact: Whether depth is that of the largest response on every ray.
        views: The cameras, ``(V,)`` `RasterView`.
        projection: How Gaussians become splats.
        splats: The splats of every view, V * N of them.
        rows: The splats' channels, a pass each.
        blocks: Where the channels of a splat come from.
        keys: Depths to sort splats by; like ``order.splats``, of twice the length, which sorting needs. None on CUDA.
        order: The splats in depth order, on CUDA in their own order, and where each one's pairs end.
        pairs: The (tile, splat) pairs of a band; none on CUDA.
        tallies: Numbers of pairs of each tile of a band, on CUDA.
        pair_total: Number of pairs of the band that was counted last, one number.
        frame: Input of compositing, for kernels.
        drawn: Images besides channels, for kernels.
        channel_images: Images of channels, a pass each.
        images: The same images for callers.
        checkpoints: What pixels have come to on their way through long lists, on CUDA; empty unless asked for.
        passed: Sums of channels at checkpoints, a pass each.
        has_few_tiles: Whether the longest lists say how long a frame takes on CUDA.
        may_lack_ranks: Whether a splat may reach more tiles than there are bits for the ranks of its pairs, on CUDA.
        gathering: The stream on which channels are gathered while lists are made; None without CUDA.
    """

    def __init__(
        self,
        gaussian_count: int,
        cameras: Sequence[Camera],
        channels: ChannelRanges,
        options: RasterOptions,
        device: wp.Device,
        images_of: FrameBuffers | None,
        *,
        checkpoints: bool,
    ) -> None:
        """Allocate everything, without room for pairs.

        Raises:
            InvalidOptionError: ``images_of`` has other channels, too few pixels, or another device.
        """
        self.gaussian_count = gaussian_count
        self.view_count = len(cameras)
        self.layout = ViewLayout.of(cameras)
        self.channels = channels
        self.device = device
        self.exact = options.depth == "exact"
        self.gathering = wp.Stream(device) if device.is_cuda else None
        tile_count = int(self.layout.first_tiles[-1])
        self.has_few_tiles = device.is_cuda and tile_count <= BLOCKS_HELD * device.sm_count
        self._rank_bits = rank_bits(self.splat_count)
        self.may_lack_ranks = max(np.bincount(self.layout.tile_views), default=0) >= 1 << self._rank_bits
        self._has_checkpoints = checkpoints and self.has_few_tiles
        if images_of is not None:
            self._require_room(images_of)
        with wp.ScopedDevice(device):
            self._allocate_splats()
            self._allocate_images(images_of)
            self._describe_frame(options)
        self.reserve(0)

    @property
    def splat_count(self) -> int:
        """Number of splats, V * N."""
        return self.gaussian_count * self.view_count

    @property
    def pixel_count(self) -> int:
        """Number of pixels of all views."""
        return int(self.layout.first_pixels[-1])

    @property
    def pair_capacity(self) -> int:
        """Number of pairs there is room for."""
        return len(self.frame.lists.splats)

    def reserve(self, capacity: int) -> None:
        """Make room for pairs."""
        with wp.ScopedDevice(self.device):
            self.pairs = PairList()
            emitted = 0 if self.device.is_cuda else capacity
            self.pairs.tiles = wp.zeros(2 * emitted, dtype=int)  # the sort wants room for as many again
            self.pairs.slots = wp.zeros(2 * emitted, dtype=int)
            self.pairs.owners = wp.zeros(emitted, dtype=int)
            self.listed_tiles = self.pairs.tiles[:emitted] if emitted else self.pairs.tiles
            lists = TileLists()
            tile_count = int(self.layout.first_tiles[-1])
            lists.ranges = wp.zeros(tile_count, dtype=wp.vec2i)
            lists.splats = wp.zeros(capacity, dtype=int)
            lists.slots = self.pairs.slots
            if self.device.is_cuda:
                lists.order, lists.ends = (wp.zeros(tile_count, dtype=int) for _ in range(2))
                lists.slots = wp.zeros(capacity, dtype=int)
                lists.entries, lists.parted = (wp.zeros(capacity, dtype=wp.uint64) for _ in range(2))
                lists.ranks = wp.zeros(capacity, dtype=wp.uint16)
                lists.rank_bits = self._rank_bits
                lists.summed = wp.zeros(capacity, dtype=wp.uint8)
            self._reserve_checkpoints(capacity)
        self.frame.lists = lists
        self._pair_rows: dict[int, Rows] = {}

    def _reserve_checkpoints(self, capacity: int) -> None:
        """Make room for checkpoints of so many pairs, if there are to be any."""
        count = capacity // int(STRIDE) + 1 if self._has_checkpoints else 0
        self.checkpoints = Checkpoints()
        self.checkpoints.tiles = wp.zeros(count, dtype=int)
        self.checkpoints.states = wp.zeros(count * TILE * TILE, dtype=wp.vec4)
        lengths = pass_lengths(self.channels.count)
        self.passed = [Rows.zeros(count * TILE * TILE, length, self.device) for length in lengths]

    def pair_rows(self, length: int) -> Rows:
        """Return rows of that length for all pairs, allocated when first asked for and shared by all that use them."""
        if length not in self._pair_rows:
            self._pair_rows[length] = Rows.zeros(self.pair_capacity, length, self.device)
        return self._pair_rows[length]

    def beside(self, stream: wp.Stream | None) -> AbstractContextManager[object]:
        """Launch on another stream what needs nothing of the launches that follow it until `wait_for`."""
        return nullcontext() if stream is None else wp.ScopedStream(stream)

    def wait_for(self, stream: wp.Stream | None) -> None:
        """Let what is launched from here on wait for what was launched `beside`."""
        if stream is not None:
            wp.get_stream(self.device).wait_stream(stream)

    def begin_sums(self) -> None:
        """Forget which pairs' rows were written, where that is noted: on CUDA."""
        if self.device.is_cuda:
            self.frame.lists.summed.zero_()

    def zero_splats(self) -> Splats:
        """Allocate splats on the current device, with normals if they are drawn."""
        splats = Splats()
        for name, dtype in {"centers": wp.vec4, "shapes": wp.vec4, "slopes": wp.vec4, "bends": float}.items():
            setattr(splats, name, wp.zeros(self.splat_count, dtype=dtype))
        splats.normals = wp.zeros(self.splat_count if self.channels.normals else 0, dtype=wp.vec3)
        return splats

    def zero_blocks(self, value_count: int, normals: wp.array) -> ChannelBlocks:
        """Return where channels come from or their gradients go: values and colours of their own, normals if drawn."""
        blocks = ChannelBlocks()
        blocks.values = wp.zeros((self.gaussian_count if value_count else 0, value_count), dtype=float)
        blocks.colors = wp.zeros(self.splat_count if self.channels.colors else 0, dtype=wp.vec3)
        blocks.normals = normals
        return blocks

    def _require_room(self, other: FrameBuffers) -> None:
        """Refuse buffers whose images cannot hold this frame's."""
        found = other.pixel_count, other.channels.count, other.device
        needed = self.pixel_count, self.channels.count, self.device
        if found[0] < needed[0] or found[1:] != needed[1:]:
            raise InvalidOptionError(
                f"images_of must have at least {needed[0]} pixels of {needed[1]} channels on {needed[2]}, got "
                f"{found[0]} of {found[1]} on {found[2]}. Make the rasteriser of the most pixels first."
            )

    def _allocate_splats(self) -> None:
        """Allocate splats, their channels and their order."""
        count = self.splat_count
        self.splats = self.zero_splats()
        self.rows = channel_rows(count, self.channels.count, self.device)
        if count and self.device.is_cuda:
            self._interleave()
        self.blocks = self.zero_blocks(0, self.splats.normals)
        sorts = not self.device.is_cuda
        self.keys = wp.zeros(2 * count * sorts, dtype=int)
        self.order = SplatOrder()
        self.order.splats = wp.zeros(2 * count, dtype=int) if sorts else wp.array(np.arange(count), dtype=int)
        self.order.counts = wp.zeros(count, dtype=int)
        self.order.ends = wp.zeros(count, dtype=int)
        self.pair_total = self.order.ends[-1:] if sorts and count else wp.zeros(1, dtype=int)
        self.tallies = wp.zeros(0 if sorts else int(self.layout.first_tiles[-1]) * SPREAD, dtype=int)

    def _interleave(self) -> None:
        """Put what compositing on CUDA reads of a splat side by side: splats are read in the order of lists.

        Reading 16 bytes of memory takes as long as reading 64. Rows of more than four channels stay by themselves.
        """
        records = wp.zeros((self.splat_count, RECORD), dtype=float)
        centers, shapes, slopes, channels = (records[:, start : start + 4] for start in range(0, RECORD, 4))
        self.splats.centers, self.splats.shapes = centers.view(wp.vec4), shapes.view(wp.vec4)
        self.splats.slopes = slopes.view(wp.vec4)
        if [rows.length for rows in self.rows] == [4]:
            self.rows = [Rows.of(channels)]

    def _allocate_images(self, images_of: FrameBuffers | None) -> None:
        """Allocate images, or take the first pixels of another frame's."""
        if images_of is None:
            self.drawn = _zero_images(self.pixel_count, has_states=not self.device.is_cuda)
            self.channel_images = channel_rows(self.pixel_count, self.channels.count, self.device)
        else:
            self.drawn = _first_pixels_of(images_of.drawn, self.pixel_count)
            self.channel_images = [Rows.of(rows.matrix[: self.pixel_count]) for rows in images_of.channel_images]
        channels = tuple(image.matrix for image in self.channel_images)
        self.images = RasterImages(channels, self.drawn.alpha, self.drawn.depth, self.drawn.median_depth)

    def _describe_frame(self, options: RasterOptions) -> None:
        """Fill in the structs that kernels read: views, projection and frame."""
        self.views = wp.array(self.layout.views, dtype=RasterView)
        self.projection = Projection()
        self.projection.low_pass = options.low_pass
        self.projection.near = options.near
        self.projection.antialiased = int(options.antialiased)
        self.frame = RasterFrame()
        self.frame.splats = self.splats
        self.frame.views = self.views
        self.frame.tile_views = wp.array(self.layout.tile_views, dtype=int)
        self.frame.gaussian_count = self.gaussian_count
        self.frame.near = options.near


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
