"""The layout of views, tiles, pixels and channels in the arrays of images that are drawn together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.kernels.raster.bin_tiles import TILE
from beam_warp.kernels.raster.composite import CHANNEL_COUNTS, channel_vector
from beam_warp.kernels.raster.project import RasterView
from beam_warp.world.camera import Camera


@dataclass(frozen=True, eq=False)
class ViewLayout:
    """The views of some cameras: their tiles and pixels follow one another, row by row.

    Attributes:
        views: The cameras, for kernels.
        first_pixels: Where each view's pixels begin, and where the last one's end, ``(C + 1,)`` int64.
        first_tiles: Where each row of tiles begins, and where the last one ends, int64.
        tile_views: Which view each tile belongs to, int32.
    """

    views: list[RasterView]
    first_pixels: NDArray[np.int64]
    first_tiles: NDArray[np.int64]
    tile_views: NDArray[np.int32]

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> ViewLayout:
        """Lay out the views of cameras of any sizes."""
        views, rows, tile_views = [], [], []
        tile = pixel = 0
        pixels = [0]
        for i, camera in enumerate(cameras):
            view = RasterView()
            view.world_to_camera = wp.mat33(camera.world_to_camera[:3, :3].astype(np.float32))
            view.position = wp.vec3(*camera.position)
            view.focal = wp.vec2(camera.focal_x, camera.focal_y)
            view.center = wp.vec2(camera.center_x, camera.center_y)
            view.width, view.height = camera.width, camera.height
            view.columns = -(-camera.width // TILE)
            view.first_tile, view.first_pixel = tile, pixel
            views.append(view)
            row_count = -(-camera.height // TILE)
            rows += range(tile, tile + row_count * view.columns, view.columns)
            tile_views.append(np.full(row_count * view.columns, i, np.int32))
            tile += row_count * view.columns
            pixel += camera.width * camera.height
            pixels.append(pixel)
        return cls(views, np.array(pixels), np.array([*rows, tile]), np.concatenate(tile_views))


class ChannelRanges(NamedTuple):
    """The places of colours, normals and values among the channels of a splat.

    Attributes:
        colors: The captured colour; empty for none.
        normals: The normals of the surfaces of largest response; empty for none.
        values: The Gaussians' own values.
    """

    colors: range
    normals: range
    values: range

    @classmethod
    def of(cls, *, radiance: bool, normals: bool, value_count: int) -> ChannelRanges:
        """Lay out channels: colour first, then normals, then values."""
        colors_end = 3 * radiance
        normals_end = colors_end + 3 * normals
        return cls(range(colors_end), range(colors_end, normals_end), range(normals_end, normals_end + value_count))

    @property
    def count(self) -> int:
        """Number of channels."""
        return self.values.stop


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of floats of one length, read as vectors by kernels and as a matrix by everybody else.

    Attributes:
        matrix: ``(N, K)`` float; rows are compact, and may lie apart.
        vectors: The same memory, ``(N,)`` vectors of K.
    """

    matrix: wp.array
    vectors: wp.array

    @property
    def length(self) -> int:
        """K."""
        return self.matrix.shape[1]

    @cached_property
    def fours(self) -> wp.array:
        """The same memory, ``(N, K / 4)`` vectors of four, for a K that four divides."""
        start, shape, strides = self.matrix.ptr, (self.matrix.shape[0], self.length // 4), (self.matrix.strides[0], 16)
        return wp.array(ptr=start, shape=shape, strides=strides, dtype=wp.vec4, device=self.matrix.device)

    @classmethod
    def of(cls, matrix: wp.array) -> Rows:
        """Read a matrix as rows."""
        return cls(matrix, matrix.view(channel_vector(matrix.shape[1])))

    @classmethod
    def zeros(cls, count: int, length: int, device: Any) -> Rows:
        """Allocate rows."""
        return cls.of(wp.zeros((count, length), dtype=float, device=device))


def pass_lengths(channel_count: int) -> list[int]:
    """Return the lengths of the rows that channels are cut into, of those there are kernels for; at least one."""
    longest = CHANNEL_COUNTS[-1]
    starts = range(0, max(channel_count, 1), longest)
    return [next(n for n in CHANNEL_COUNTS if n >= min(channel_count - start, longest)) for start in starts]


def channel_rows(count: int, channel_count: int, device: Any) -> list[Rows]:
    """Allocate rows for channels, a pass each."""
    return [Rows.zeros(count, length, device) for length in pass_lengths(channel_count)]
