"""Drawing a frame, step by step: project, sort, list the splats of every tile, composite."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from beam_warp.errors import InvalidArrayError
from beam_warp.kernels.raster.bin_tiles import (
    Band,
    launch_count_pairs,
    launch_emit_pairs,
    launch_find_ranges,
    launch_key_splats,
)
from beam_warp.kernels.raster.channel_rows import launch_evaluate_colors, launch_gather_channels
from beam_warp.kernels.raster.composite import CHANNEL_COUNTS
from beam_warp.kernels.raster.composite_cpu import launch_composite_cpu
from beam_warp.kernels.raster.composite_cuda import launch_composite_cuda
from beam_warp.kernels.raster.project import launch_project
from beam_warp.kernels.raster.tile_lists_cuda import (
    launch_count_entries,
    launch_emit_entries,
    launch_plan_tiles,
    launch_project_entries,
)
from beam_warp.raster.buffers import FrameBuffers
from beam_warp.raster.records import GaussianArrays

MAX_BAND_PAIRS = 2**24
"""Most (tile, splat) pairs held at a time: 24 bytes each, 27 on CUDA, and on the way back up to 128 more for each
length of rows. Images that need more are drawn in bands of tile rows."""

MAX_ROW_PAIRS = 2**29
"""Most pairs in one row of tiles, the least that can be drawn: with `SPARE_CAPACITY`, and as much again for sorting, a
list's length is still a 32-bit integer."""

SPARE_CAPACITY = 1.25
"""Room for pairs, over the need of the first frame: the next ones need a little more."""


def project(buffers: FrameBuffers, gaussians: GaussianArrays) -> None:
    """Make splats of the Gaussians; on CUDA count the pairs of all tiles, elsewhere order the splats in depth.

    The tallies of tiles must be 0, as `list_pairs` leaves them.
    """
    tiles = (0, int(buffers.layout.first_tiles[-1]))
    inputs = (gaussians[:4], buffers.views, buffers.projection)
    if buffers.device.is_cuda:  # every tile sorts its own list
        counted = buffers.order.counts, buffers.tallies
        launch_project_entries(*inputs, _begin_band(buffers, tiles), buffers.splats, *counted, buffers.device)
        return
    launch_project(*inputs, buffers.splats, buffers.device)
    launch_key_splats(len(buffers.splats.centers), buffers.splats, buffers.keys, buffers.order.splats, buffers.device)
    if buffers.splat_count:
        wp.utils.radix_sort_pairs(buffers.keys, buffers.order.splats, buffers.splat_count)
    count_pairs(buffers, tiles)


def evaluate_colors(buffers: FrameBuffers, gaussians: GaussianArrays) -> None:
    """Find the colour of every splat. Wait for it as for `gather_channels`, which follows."""
    if buffers.channels.colors:
        seen = (gaussians.positions, gaussians.radiance, buffers.views, buffers.blocks.colors)
        with buffers.beside(buffers.gathering):
            launch_evaluate_colors(*seen, buffers.device)
            if gaussians.extra is not None:
                gaussians.extra.add(gaussians, buffers.views, buffers.blocks.colors)


def gather_channels(buffers: FrameBuffers, gaussians: GaussianArrays) -> None:
    """Write every splat's row of channels; where there are none, rows stay 0. Wait for it before compositing."""
    if buffers.channels.values:
        buffers.blocks.values = gaussians.values
    with buffers.beside(buffers.gathering):
        for i, rows in enumerate(buffers.rows if buffers.channels.count else ()):
            launch_gather_channels(buffers.blocks, i * CHANNEL_COUNTS[-1], rows.fours, buffers.device)


def plan_bands(buffers: FrameBuffers) -> list[tuple[int, int]]:
    """Cut the tiles into runs of rows whose pairs fit, usually one, and make room for the largest.

    Raises:
        InvalidArrayError: A row of tiles alone has too many pairs.
    """
    first_tiles = buffers.layout.first_tiles
    bands, most = [], 0
    waiting = [(0, len(first_tiles) - 1)]
    while waiting:
        first, end = waiting.pop()
        band = (int(first_tiles[first]), int(first_tiles[end]))
        if end - first < len(first_tiles) - 1:  # all of them are counted since they were projected
            count_pairs(buffers, band)
        if buffers.device.is_cuda:
            _plan_tiles(buffers)
        pairs = counted_pairs(buffers)
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
    if most > buffers.pair_capacity:
        buffers.reserve(int(SPARE_CAPACITY * most))
    return bands


def count_pairs(buffers: FrameBuffers, tiles: tuple[int, int]) -> None:
    """Count the pairs of a band of tiles; elsewhere than on CUDA splat by splat in depth order, and sum them up."""
    band, order = _begin_band(buffers, tiles), buffers.order
    inputs = (buffers.splats, buffers.views, buffers.gaussian_count, band, order.counts)
    if buffers.device.is_cuda:
        buffers.tallies.zero_()
        launch_count_entries(buffers.splat_count, *inputs, buffers.tallies, buffers.device)
        return
    launch_count_pairs(order.splats, *inputs, buffers.device)
    if buffers.splat_count:
        wp.utils.array_scan(order.counts, order.ends, inclusive=True)


def _begin_band(buffers: FrameBuffers, tiles: tuple[int, int]) -> Band:
    """Make tiles those that are counted, listed and drawn next."""
    band = Band()
    band.first_tile, band.end_tile = tiles
    buffers.frame.band = band
    return band


def _plan_tiles(buffers: FrameBuffers) -> None:
    """Give every tile of the band that was counted last its place in the lists, on CUDA."""
    lists, band = buffers.frame.lists, buffers.frame.band
    tiles = (buffers.tallies, band.end_tile - band.first_tile)
    launch_plan_tiles(*tiles, buffers.pair_capacity, lists, buffers.pair_total, buffers.device)


def counted_pairs(buffers: FrameBuffers) -> int:
    """Return how many pairs the band that was counted last has; waits for the device.

    On CUDA its tiles must be planned.
    """
    if not buffers.splat_count:
        return 0
    if buffers.device.is_cuda or buffers.splat_count * int(buffers.layout.first_tiles[-1]) < 2**31:
        return int(buffers.pair_total.numpy()[0])
    return int(buffers.order.counts.numpy().sum(dtype=np.int64))  # the ends may be beyond the range of integers


def list_pairs(buffers: FrameBuffers) -> None:
    """List the splats of every tile of the band that was counted last."""
    frame, pairs = buffers.frame, buffers.pairs
    inputs = (buffers.splats, buffers.views, buffers.gaussian_count, frame.band)
    if buffers.device.is_cuda:
        _plan_tiles(buffers)
        launch_emit_entries(*inputs, buffers.tallies, frame.lists, buffers.device)
        return
    frame.lists.ranges.zero_()
    if not buffers.pair_capacity:
        return
    tile_count = frame.band.end_tile - frame.band.first_tile
    buffers.listed_tiles.fill_(tile_count)  # sorts behind every tile: room that no pair takes
    launch_emit_pairs(buffers.order, *inputs, pairs, buffers.device)
    wp.utils.radix_sort_pairs(pairs.tiles, pairs.slots, buffers.pair_capacity, end_bit=tile_count.bit_length())
    launch_find_ranges(pairs, tile_count, frame.lists, buffers.device)


def composite(buffers: FrameBuffers, draw: Callable[..., None] | None = None) -> None:
    """Draw the tiles of the band that was listed last, with the composite of the device or another launcher."""
    buffers.checkpoints.tiles.zero_()
    for rows, image, passed in zip(buffers.rows, buffers.channel_images, buffers.passed, strict=True):
        frame, drawn = (buffers.frame, rows.vectors, buffers.exact), (image.vectors, buffers.drawn)
        if draw is None and buffers.device.is_cuda:
            notes, colored = (buffers.checkpoints, passed.vectors), buffers.channels.count > 0
            launch_composite_cuda(*frame, colored, buffers.has_few_tiles, *drawn, *notes, buffers.device)
        else:
            (draw or launch_composite_cpu)(*frame, *drawn, buffers.device)
