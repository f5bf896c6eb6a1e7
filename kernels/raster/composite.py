"""Input and output of compositing a tile's splats at each pixel, front to back.

`composite_cpu` and `composite_cuda` do the same sums in the same order. Channels come as rows of a vector whose length
is fixed at compile time: four lengths and two modes of depth make eight small modules.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.raster.bin_tiles import SIDE, Band, TileLists
from beam_warp.kernels.raster.project import RasterView, Splats

CHANNEL_COUNTS = (4, 8, 12, 16)
"""Lengths of channel vectors there are kernels for; more channels take more passes."""


@wp.struct
class RasterFrame:
    """Input of compositing: splats, the lists of tiles, and the views they are seen from."""

    splats: Splats
    lists: TileLists
    views: wp.array[RasterView]
    tile_views: wp.array[int]  # which view each tile belongs to
    band: Band
    gaussian_count: int
    near: float


@wp.struct
class Images:
    """Images besides channels, view by view and row by row; depths in metres along the optical axis."""

    alpha: wp.array[float]  # sum of the weights
    transmittance: wp.array[float]  # what passes all
    depth: wp.array[float]  # mean; 0 where nothing is seen
    median_depth: wp.array[float]  # 0 where nothing is seen
    gaussians: wp.array[int]  # the last that was seen, -1 for none
    ends: wp.array[int]  # end of what was looked at, in the lists
    medians: wp.array[int]  # place of the median's splat in the lists, -1 for none
    states: wp.array[wp.vec4]  # what the CPU's kernels know of a pixel between two splats; none on CUDA


@wp.struct
class Checkpoints:
    """What pixels have come to after every so many entries of their tile's list, a stride; on CUDA, for the way back.

    The one before entry i of all lists has the place i / stride. Arrays of length 0 stand for none.
    """

    tiles: wp.array[int]  # whose each is, counted from 1; 0 where no list was gone through so far
    states: wp.array[wp.vec4]  # transmittance, sums of weights and of weighted depths, 0; pixel by pixel of the tile


@wp.struct
class PixelPlace:
    """Place of a pixel in its view and in the images; ``index`` is -1 outside."""

    index: int
    position: wp.vec2


@wp.func
def pixel_place(view: RasterView, tile: int, within: int) -> PixelPlace:
    """Place of a tile's pixel, counted row by row."""
    local = tile - view.first_tile
    x = (local % view.columns) * SIDE + within % SIDE
    y = (local / view.columns) * SIDE + within / SIDE
    place = PixelPlace()
    place.position = wp.vec2(float(x) + 0.5, float(y) + 0.5)
    place.index = -1
    if x < view.width and y < view.height:
        place.index = view.first_pixel + y * view.width + x
    return place


@wp.func
def pixel_below(view: RasterView, tile: int, within: int, rows: int, above: PixelPlace) -> PixelPlace:
    """Place of the pixel some rows below another one: compilers see that x is the same, and find once what it gives."""
    place = pixel_place(view, tile, within + rows * SIDE)
    place.position = wp.vec2(above.position[0], place.position[1])
    return place


@cache
def channel_vector(channel_count: int):
    """Return the Warp type of a row of channels."""
    return wp.types.vector(length=channel_count, dtype=float)
