"""PlayCanvas compressed PLY: chunks of 256 Gaussians with bounds, and four packed words for each Gaussian.

A chunk holds the least and the greatest position, log scale and (in newer files) colour. A word holds, from the top
bit: position and log scale as 11, 10 and 11 bits between the chunk's bounds; the rotation as the 2-bit index of its
largest component in the order w, x, y, z and the other three as 10 bits over ± sqrt(1/2); colour and opacity as
8 bits each. An optional element ``sh`` holds the higher bands as one byte over ± 4, channel after channel.

Source: PlayCanvas user manual, "The PLY Format", and the files that SuperSplat writes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.blocks import for_each_block
from beam_warp.converters.common.activations import dc_from_color, exp_scale
from beam_warp.converters.common.errors import malformed
from beam_warp.converters.ply.checks import require_types, settle_log_scales
from beam_warp.converters.ply.container import Element, PlyHeader, open_columns, read_columns
from beam_warp.image.color import DISPLAY_SRGB

CHUNK_ROWS = 256

BOUNDS = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
SCALE_BOUNDS = ("min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z")
COLOR_BOUNDS = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

PLACES = np.array([[0 if i == largest else 1 + i - (i > largest) for i in (1, 2, 3, 0)] for largest in range(4)])
"""Where x, y, z, w are among the largest component and the other three in order, by its place in w, x, y, z."""

BITS_11_10_11 = ((21, 11), (11, 10), (0, 11))
BITS_8_8_8 = ((24, 8), (16, 8), (8, 8))
"""Place from the lowest bit, and width, of the three fields of a word that lie between bounds [bit]."""


def is_compressed(header: PlyHeader) -> bool:
    """True if the vertices are packed words."""
    vertex = header.element("vertex")
    return vertex is not None and "packed_position" in vertex.names


def decode(header: PlyHeader, drop_invalid: bool = False) -> dict[str, Any]:
    """Unpack a file into the fields of a cloud, in its own axes and units.

    Args:
        header: The file's header.
        drop_invalid: Leave NaN where a row is no valid Gaussian, instead of refusing the file.

    Returns:
        positions, orientations (xyzw, unit), scales, opacities, radiance and radiance_color_space.

    Raises:
        AssetFormatError: Elements, properties, types or counts differ from the layout above.
    """
    vertex, sh = header.element("vertex"), header.element("sh")
    assert vertex is not None  # is_compressed has seen it
    bounds, count = _require_layout(header, vertex), vertex.count
    settle_log_scales(header.path, bounds[:, 6:12], drop_invalid)
    bands = 0 if sh is None else len(sh.names) // 3
    shapes = {"positions": (3,), "orientations": (4,), "scales": (3,), "opacities": (), "radiance": (1 + bands, 3)}
    fields = {name: np.empty((count, *shape), np.float32) for name, shape in shapes.items()}
    _, read_words = open_columns(header, "vertex")
    _, read_bands = (None, None) if sh is None else open_columns(header, "sh")

    def unpack(part: slice) -> None:
        words = np.empty((part.stop - part.start, 4), np.uint32)
        read_words(part, [(WORDS, words)])
        position, rotation, scale, color = words.T
        chunks = bounds[part.start // CHUNK_ROWS : -(-part.stop // CHUNK_ROWS)]
        fields["positions"][part] = _between(chunks[:, 0:6], position, BITS_11_10_11)
        fields["orientations"][part] = _unpack_rotation(rotation)
        fields["scales"][part] = exp_scale(_between(chunks[:, 6:12], scale, BITS_11_10_11))
        fields["opacities"][part] = _unorm(color, 0, 8)
        fields["radiance"][part, 0] = dc_from_color(_between(chunks[:, 12:18], color, BITS_8_8_8))
        if read_bands is not None:
            bytes_ = np.empty((len(words), 3 * bands), np.uint8)
            read_bands(part, [(_band_names(bands), bytes_)])
            fields["radiance"][part, 1:] = _band_values(bytes_).reshape(-1, bands, 3)

    for_each_block(unpack, count)
    return {**fields, "radiance_color_space": DISPLAY_SRGB}


def _band_names(bands: int) -> list[str]:
    """Return the columns of the higher bands, coefficient after coefficient; the file has channel after channel."""
    return [f"f_rest_{channel * bands + k}" for k in range(bands) for channel in range(3)]


def _require_layout(header: PlyHeader, vertex: Element) -> NDArray[np.float64]:
    """Check elements, types and counts against each other; return the bounds of the chunks."""
    chunk, sh = header.element("chunk"), header.element("sh")
    if chunk is None:
        raise malformed(header.path, "packed vertices must come with an element chunk", "none", "Export it again.")
    require_types(header.path, vertex, WORDS, ("u4",))
    colors = COLOR_BOUNDS if "min_r" in chunk.names else ()
    names = BOUNDS + SCALE_BOUNDS + colors
    require_types(header.path, chunk, names, ("f4",))
    wanted = -(-vertex.count // CHUNK_ROWS)
    if chunk.count != wanted:
        raise malformed(
            header.path,
            f"{vertex.count} packed vertices must have {wanted} chunks",
            str(chunk.count),
            "Export or download it again.",
        )
    if sh is not None:
        if sh.count != vertex.count or len(sh.names) not in (9, 24, 45):
            raise malformed(
                header.path,
                f"element sh must have {vertex.count} rows of 9, 24 or 45 properties",
                f"{sh.count} rows of {len(sh.names)}",
                "Export it again.",
            )
        require_types(header.path, sh, tuple(f"f_rest_{i}" for i in range(len(sh.names))), ("u1",))
    (bounds,) = read_columns(header, "chunk", [names], np.float64)
    return bounds if colors else np.hstack([bounds, np.tile([0.0, 0.0, 0.0, 1.0, 1.0, 1.0], (len(bounds), 1))])


def _unorm(words: NDArray[np.uint32], shift: int, bits: int) -> NDArray[np.float64]:
    """Return a field of some bits as a number in [0, 1]."""
    mask = (1 << bits) - 1
    return ((words >> np.uint32(shift)) & np.uint32(mask)) / mask


def _between(
    bounds: NDArray[np.float64], words: NDArray[np.uint32], fields: tuple[tuple[int, int], ...]
) -> NDArray[np.float64]:
    """Return three fields of each word, between the bounds of its chunk."""
    values = np.empty((len(words), 3))
    for column, (shift, bits) in enumerate(fields):
        fraction = _unorm(words, shift, bits)
        low, high = (np.repeat(bounds[:, place], CHUNK_ROWS)[: len(words)] for place in (column, column + 3))
        values[:, column] = low * (1.0 - fraction) + high * fraction
    return values


def _band_values(bytes_: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the coefficient that a byte means: the middle of its interval in ± 4, but of the ends the ends."""
    values = bytes_.astype(np.float32)
    values += np.float32(0.5)
    values *= np.float32(8.0 / 256.0)
    values -= np.float32(4.0)  # exact so far: sums of a few powers of two
    values[bytes_ == 0], values[bytes_ == 255] = -4.0, 4.0
    return values


def _unpack_rotation(words: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return unit quaternions xyzw from the three smaller components in the order w, x, y, z."""
    parts = np.empty((len(words), 4))
    smaller = parts[:, 1:]
    for column, shift in enumerate((20, 10, 0)):
        smaller[:, column] = (_unorm(words, shift, 10) - 0.5) * np.sqrt(2.0)
    parts[:, 0] = np.sqrt(np.maximum(1.0 - np.einsum("ij,ij->i", smaller, smaller), 0.0))
    parts /= np.linalg.norm(parts, axis=1, keepdims=True)  # rounding to 10 bits can leave more than 1 in the three
    return np.take_along_axis(parts, PLACES[words >> np.uint32(30)], axis=1)
