"""Writer of compressed PLY, as `beam_warp.converters.ply.compressed` describes it; the same Gaussians, the same bytes.

All codes are the nearest ones. Gaussians are put in Morton order, so that those of a chunk are near each other and its
bounds are narrow. A value is off by at most half a step of its code: a position by 1 / 4094 of the chunk's extent in x
and z, and by 1 / 2046 in y; a log scale likewise; a colour by 1 / 510 of the chunk's range; an opacity by 1 / 510; a
higher band by 1 / 64 (within 1 / 32 of ± 4, by 3 / 128), and what is beyond ± 4 is held there. Scales below exp(-20)
are written as that, since a chunk that holds one would have few steps left for the others.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beam_warp.blocks import for_each_block
from beam_warp.converters.common.activations import color_from_dc, log_scale
from beam_warp.converters.common.colors import display_radiance, resize_bands
from beam_warp.converters.common.frames import FrameToWrite
from beam_warp.converters.common.options import WriteOptions
from beam_warp.converters.common.rotations import SMALLER_LIMIT, to_smaller
from beam_warp.converters.ply.compressed import (
    BITS_8_8_8,
    BITS_11_10_11,
    BOUNDS,
    CHUNK_ROWS,
    COLOR_BOUNDS,
    SCALE_BOUNDS,
    WORDS,
)
from beam_warp.converters.ply.writer import comments_of, header_of
from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.curve import CELLS, morton_order
from beam_warp.world.gaussians import GaussianCloud

_LEAST_LOG_SCALE = -20.0
"""Log of the least scale written; the writers of SuperSplat and splat-transform hold the bounds of chunks to it too."""

_MAX_COEFFICIENTS = 16


def encode(frame: FrameToWrite, path: Path, options: WriteOptions) -> None:
    """Write one frame.

    Raises:
        InvalidOptionError: Materials are requested, or spherical harmonics of degree 4.
    """
    if options.profile != "standard":
        raise InvalidOptionError(
            f"profile must be standard for compressed PLY, which has no materials, got {options.profile}. Leave it out."
        )
    cloud = frame.cloud
    shown, meaning = display_radiance(cloud)
    radiance = resize_bands(shown, options.sh_degree)
    if radiance.shape[1] > _MAX_COEFFICIENTS:
        raise InvalidOptionError("sh_degree must be at most 3 for compressed PLY, got 4. Pass --sh-degree 3.")
    bounds, words, bands = _packed(cloud, radiance, morton_order(_cells(cloud.positions)))
    header = header_of(
        comments_of(frame, options, DISPLAY_SRGB, meaning),
        {
            f"chunk {len(bounds)}": [f"float {name}" for name in (*BOUNDS, *SCALE_BOUNDS, *COLOR_BOUNDS)],
            f"vertex {len(words)}": [f"uint {name}" for name in WORDS],
            **({f"sh {len(bands)}": [f"uchar f_rest_{i}" for i in range(bands.shape[1])]} if bands.size else {}),
        },
    )
    with path.open("wb") as file:
        file.write(header)
        for array in (bounds, words, bands):
            file.write(array.data)


def _packed(
    cloud: GaussianCloud, radiance: NDArray[np.float32], order: NDArray[np.intp]
) -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.uint8]]:
    """Return the bounds of chunks ``(C, 18)``, the words ``(N, 4)`` and the bytes of higher bands ``(N, B)``."""
    bounds = np.empty((-(-len(order) // CHUNK_ROWS), 18), "<f4")
    words = np.empty((len(order), 4), "<u4")
    bands = np.empty((len(order), 3 * (radiance.shape[1] - 1)), np.uint8)

    def pack(part: slice) -> None:
        rows, chunks = order[part], slice(part.start // CHUNK_ROWS, -(-part.stop // CHUNK_ROWS))
        log_scales = np.maximum(log_scale(cloud.scales[rows]), np.float32(_LEAST_LOG_SCALE))
        words[part, 0], bounds[chunks, 0:6] = _between_bounds(cloud.positions[rows], BITS_11_10_11)
        words[part, 1] = _rotation_words(cloud.orientations[rows])
        words[part, 2], bounds[chunks, 6:12] = _between_bounds(log_scales, BITS_11_10_11)
        coefficients = radiance.take(rows, axis=0)
        colors, bounds[chunks, 12:18] = _between_bounds(color_from_dc(coefficients[:, 0]), BITS_8_8_8)
        words[part, 3] = colors | np.rint(cloud.opacities[rows].astype(np.float64) * 255.0).astype(np.uint32)
        bands[part] = _band_bytes(coefficients[:, 1:].transpose(0, 2, 1).reshape(len(rows), bands.shape[1]))

    for_each_block(pack, len(order))
    return bounds, words, bands


def _between_bounds(
    values: NDArray[np.float32], fields: tuple[tuple[int, int], ...]
) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
    """Return a word for each row of three values, and the bounds of each chunk of rows ``(C, 6)``."""
    starts = np.arange(0, len(values), CHUNK_ROWS)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    words = np.zeros(len(values), np.uint32)
    for column, (shift, bits) in enumerate(fields):
        least, most = (np.repeat(end[:, column].astype(np.float64), CHUNK_ROWS)[: len(values)] for end in (low, high))
        fraction = (values[:, column] - least) / np.where(most > least, most - least, 1.0)
        words |= np.rint(fraction * ((1 << bits) - 1)).astype(np.uint32) << np.uint32(shift)
    return words, np.hstack([low, high])


def _rotation_words(orientations: NDArray[np.float32]) -> NDArray[np.uint32]:
    smaller, largest_at = to_smaller(orientations[:, [3, 0, 1, 2]])
    fraction = np.clip(smaller / (2.0 * SMALLER_LIMIT) + 0.5, 0.0, 1.0)
    codes = np.rint(fraction * 1023.0).astype(np.uint32)
    return largest_at.astype(np.uint32) << np.uint32(30) | codes @ np.array([1 << 20, 1 << 10, 1], np.uint32)


def _band_bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the bytes whose meaning is nearest: of 0 and 255 the ends of ± 4, of the others the middle of a 256th."""
    place = (values + np.float32(4.0)) * np.float32(32.0)
    inner = np.clip(np.floor(place), 1.0, 254.0)
    return np.where(place < 0.75, 0.0, np.where(place > 255.25, 255.0, inner)).astype(np.uint8)


def _cells(positions: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Return the cells of positions on the grid of `CELLS` over their box."""
    cells = np.empty(positions.shape, np.uint32)
    low = positions.min(axis=0, initial=np.inf).astype(np.float64)
    extent = positions.max(axis=0, initial=-np.inf) - low

    def fill(part: slice) -> None:
        cells[part] = (positions[part] - low) / np.where(extent > 0.0, extent, 1.0) * (CELLS - 1)

    for_each_block(fill, len(positions))
    return cells
