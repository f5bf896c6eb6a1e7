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
from beam_warp.converters.activations import dc_from_color, exp_scale
from beam_warp.converters.ply_checks import require_types, settle_log_scales
from beam_warp.converters.ply_container import Element, PlyHeader, malformed, read_columns
from beam_warp.image.color import DISPLAY_SRGB

CHUNK_ROWS = 256

_BOUNDS = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
_SCALE_BOUNDS = ("min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z")
_COLOR_BOUNDS = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

PLACES = np.array([[0 if i == largest else 1 + i - (i > largest) for i in (1, 2, 3, 0)] for largest in range(4)])
"""For each place of the largest component in w, x, y, z: where x, y, z, w are in (largest, the other three in order)."""

_BAND_VALUES = ((np.arange(256) + 0.5) / 256.0 - 0.5) * 8.0
_BAND_VALUES[[0, 255]] = -4.0, 4.0
_BAND_VALUES = _BAND_VALUES.astype(np.float32)
"""Coefficient that each byte means: the middle of its interval, except that the ends mean the ends."""


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
    (words,) = read_columns(header, "vertex", [_WORDS], np.uint32)
    bytes_ = np.empty((count, 0), np.uint8) if sh is None else read_columns(header, "sh", [_band_names(sh)], np.uint8)[0]
    fields = {name: np.empty((count, width), np.float32) for name, width in (("positions", 3), ("orientations", 4))}
    fields |= {"scales": np.empty((count, 3), np.float32), "opacities": np.empty(count, np.float32)}
    fields["radiance"] = np.empty((count, 1 + bytes_.shape[1] // 3, 3), np.float32)
    log_scales = np.empty((count, 3))

    def unpack(part: slice) -> None:
        position, rotation, scale, color = words[part].T
        bounds_of_row = bounds[np.arange(part.start, part.stop) // CHUNK_ROWS]
        fields["positions"][part] = _between(bounds_of_row[:, 0:6], _unpack_11_10_11(position))
        fields["orientations"][part] = _unpack_rotation(rotation)
        log_scales[part] = _between(bounds_of_row[:, 6:12], _unpack_11_10_11(scale))
        shown = _unpack_8888(color)
        fields["opacities"][part] = shown[:, 3]
        within = _between(bounds_of_row[:, 12:18], shown[:, :3]) if bounds.shape[1] == 18 else shown[:, :3]
        fields["radiance"][part, 0] = dc_from_color(within)
        fields["radiance"][part, 1:] = _BAND_VALUES[bytes_[part]].reshape(len(shown), bytes_.shape[1] // 3, 3)

    def activate(part: slice) -> None:
        fields["scales"][part] = exp_scale(log_scales[part])

    for_each_block(unpack, count)
    settle_log_scales(header.path, log_scales, drop_invalid)
    for_each_block(activate, count)
    return {**fields, "radiance_color_space": DISPLAY_SRGB}


def _band_names(sh: Element) -> list[str]:
    """Return the names of the higher bands' columns, coefficient after coefficient."""
    bands = len(sh.names) // 3  # of a channel: the file has channel after channel
    return [f"f_rest_{channel * bands + k}" for k in range(bands) for channel in range(3)]


def _require_layout(header: PlyHeader, vertex: Element) -> NDArray[np.float64]:
    """Check elements, types and counts against each other; return the bounds of the chunks."""
    chunk, sh = header.element("chunk"), header.element("sh")
    if chunk is None:
        raise malformed(header.path, "packed vertices must come with an element chunk", "none", "Export it again.")
    require_types(header.path, vertex, _WORDS, ("u4",))
    names = _BOUNDS + _SCALE_BOUNDS + (_COLOR_BOUNDS if "min_r" in chunk.names else ())
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
    return read_columns(header, "chunk", [names], np.float64)[0]


def _unorm(words: NDArray[np.uint32], shift: int, bits: int) -> NDArray[np.float64]:
    """Return a field of some bits as a number in [0, 1]."""
    mask = (1 << bits) - 1
    return ((words >> np.uint32(shift)) & np.uint32(mask)) / mask


def _unpack_11_10_11(words: NDArray[np.uint32]) -> NDArray[np.float64]:
    return np.column_stack([_unorm(words, 21, 11), _unorm(words, 11, 10), _unorm(words, 0, 11)])


def _unpack_8888(words: NDArray[np.uint32]) -> NDArray[np.float64]:
    return np.column_stack([_unorm(words, shift, 8) for shift in (24, 16, 8, 0)])


def _between(bounds: NDArray[np.float64], fraction: NDArray[np.float64]) -> NDArray[np.float64]:
    return bounds[:, :3] * (1.0 - fraction) + bounds[:, 3:] * fraction


def _unpack_rotation(words: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return unit quaternions xyzw from the three smaller components in the order w, x, y, z."""
    parts = np.empty((len(words), 4))
    smaller = parts[:, 1:]
    for column, shift in enumerate((20, 10, 0)):
        smaller[:, column] = (_unorm(words, shift, 10) - 0.5) * np.sqrt(2.0)
    parts[:, 0] = np.sqrt(np.maximum(1.0 - np.einsum("ij,ij->i", smaller, smaller), 0.0))
    parts /= np.linalg.norm(parts, axis=1, keepdims=True)  # rounding to 10 bits can leave more than 1 in the three
    return np.take_along_axis(parts, PLACES[words >> np.uint32(30)], axis=1)
