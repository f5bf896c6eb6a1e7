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

from beam_warp.converters.activations import dc_from_color, exp_scale
from beam_warp.converters.ply_checks import require_log_scales, require_types
from beam_warp.converters.ply_container import Element, PlyHeader, malformed, read_table
from beam_warp.image.color import DISPLAY_SRGB

CHUNK_ROWS = 256

_BOUNDS = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
_SCALE_BOUNDS = ("min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z")
_COLOR_BOUNDS = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def is_compressed(header: PlyHeader) -> bool:
    """True if the vertices are packed words."""
    vertex = header.element("vertex")
    return vertex is not None and "packed_position" in vertex.names


def decode(header: PlyHeader) -> dict[str, Any]:
    """Unpack a file into the fields of a cloud, in its own axes and units.

    Returns:
        positions, orientations (xyzw, unit), scales, opacities, radiance and radiance_color_space.

    Raises:
        AssetFormatError: Elements, properties, types or counts differ from the layout above.
    """
    vertex = header.element("vertex")
    assert vertex is not None  # is_compressed has seen it
    bounds = _require_layout(header, vertex)
    words = read_table(header, "vertex").columns(_WORDS, np.uint32)
    position_words, rotation_words, scale_words, color_words = words.T

    chunk_of_row = np.arange(vertex.count) // CHUNK_ROWS
    log_scales = _between(bounds[:, 6:12], _unpack_11_10_11(scale_words), chunk_of_row)
    require_log_scales(header.path, log_scales)
    color = _unpack_8888(color_words)
    shown = _between(bounds[:, 12:18], color[:, :3], chunk_of_row) if bounds.shape[1] == 18 else color[:, :3]
    radiance = dc_from_color(shown)[:, None]
    if header.element("sh") is not None:
        radiance = np.concatenate([radiance, _higher_bands(header)], axis=1)
    return {
        "positions": _between(bounds[:, 0:6], _unpack_11_10_11(position_words), chunk_of_row),
        "orientations": _unpack_rotation(rotation_words),
        "scales": exp_scale(log_scales),
        "opacities": color[:, 3],
        "radiance": radiance,
        "radiance_color_space": DISPLAY_SRGB,
    }


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
    return read_table(header, "chunk").columns(names, np.float64)


def _unorm(words: NDArray[np.uint32], shift: int, bits: int) -> NDArray[np.float64]:
    """Return a field of some bits as a number in [0, 1]."""
    mask = (1 << bits) - 1
    return ((words >> np.uint32(shift)) & np.uint32(mask)) / mask


def _unpack_11_10_11(words: NDArray[np.uint32]) -> NDArray[np.float64]:
    return np.column_stack([_unorm(words, 21, 11), _unorm(words, 11, 10), _unorm(words, 0, 11)])


def _unpack_8888(words: NDArray[np.uint32]) -> NDArray[np.float64]:
    return np.column_stack([_unorm(words, shift, 8) for shift in (24, 16, 8, 0)])


def _between(
    bounds: NDArray[np.float64], fraction: NDArray[np.float64], chunk_of_row: NDArray[np.intp]
) -> NDArray[np.float64]:
    low, high = bounds[chunk_of_row, :3], bounds[chunk_of_row, 3:]
    return low * (1.0 - fraction) + high * fraction


def _unpack_rotation(words: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return unit quaternions xyzw from the three smaller components in the order w, x, y, z."""
    smaller = (np.column_stack([_unorm(words, shift, 10) for shift in (20, 10, 0)]) - 0.5) * np.sqrt(2.0)
    squared = np.einsum("ij,ij->i", smaller, smaller)
    largest_at = (words >> np.uint32(30)).astype(np.intp)
    # The largest component is taken out of the order: the others keep theirs around it.
    place = np.arange(3) + (np.arange(3) >= largest_at[:, None])
    wxyz = np.empty((len(words), 4))
    np.put_along_axis(wxyz, place, smaller, axis=1)
    np.put_along_axis(wxyz, largest_at[:, None], np.sqrt(np.maximum(1.0 - squared, 0.0))[:, None], axis=1)
    wxyz /= np.linalg.norm(wxyz, axis=1, keepdims=True)  # rounding to 10 bits can leave more than 1 in the three
    return wxyz[:, [1, 2, 3, 0]]


def _higher_bands(header: PlyHeader) -> NDArray[np.float32]:
    """Return the coefficients above the zeroth, ``(N, K - 1, 3)``."""
    table = read_table(header, "sh")
    bytes_ = table.columns([f"f_rest_{i}" for i in range(len(table.names))], np.uint8)
    # A byte means the middle of its interval, except that the ends mean the ends.
    levels = (np.arange(256) + 0.5) / 256.0
    levels[[0, 255]] = 0.0, 1.0
    values = ((levels - 0.5) * 8.0).astype(np.float32)[bytes_]
    return values.reshape(len(values), 3, -1).transpose(0, 2, 1)
