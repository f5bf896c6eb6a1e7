"""Radiance pictures (.hdr, RGBE): reader, flat or in the old or new run-length encoding, and writer.

Source: Ward 1991, "Real Pixels" (Graphics Gems II), and the Radiance file-format notes. Differences: a mantissa m
decodes to m · 2^(e − 136) without Ward's half step, as in Blender, OpenImageIO and stb, so that every renderer sees
the same light; pictures in XYZE or with transposed scan order are refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beam_warp.errors import AssetFormatError, MissingFileError

MAX_HEADER_BYTES = 65536
"""Most bytes that are searched for the end of a header, which is a few lines of text."""

MIN_RUN_WIDTH, MAX_RUN_WIDTH = 8, 32767
"""Range of widths for which the new run-length encoding is defined."""

UNCHECKED_PIXELS = 2**24
"""Pixels of the largest picture, 192 MiB, for which memory is taken before all scanlines are known to be whole."""

_RESOLUTION = re.compile(rb"([+-])Y (\d{1,9}) ([+-])X (\d{1,9})\n")


def read_radiance_hdr(path: Path, require_size: Callable[[Path, int, int], None]) -> NDArray[np.float32]:
    """Read a picture as linear RGB.

    Args:
        path: The file.
        require_size: Function that refuses a picture by its path, width and height [px].

    Returns:
        Radiance, ``(H, W, 3)`` float32, top row first, with the header's exposure divided out.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: The file is not a Radiance picture, is truncated or corrupt, or exceeds the limits.
    """
    data = _bytes_of(path)
    flip_y, flip_x, height, width, exposure, start = _parse_header(path, data)
    require_size(path, width, height)
    # A scanline takes at least one four-byte entry: refuse what cannot be complete before allocating for it.
    if len(data) - start < 4 * height:
        raise _truncated(path, 0)
    if width * height > UNCHECKED_PIXELS:
        for _ in _scanlines(path, data, start, height, width):
            pass  # a damaged picture is refused before memory is taken for all of it
    scale = np.ldexp(1.0 / exposure, np.arange(256) - 136)
    scale[0] = 0.0  # exponent 0 is black by definition
    radiance = np.empty((height, width, 3), np.float32)
    with np.errstate(over="ignore"):  # an exposure next to zero: infinity, which who asked for finite light refuses
        for row, rgbe in enumerate(_scanlines(path, data, start, height, width)):
            radiance[row] = rgbe[:, :3] * scale[rgbe[:, 3], None]
    return radiance[:: -1 if flip_y else 1, :: -1 if flip_x else 1]


def radiance_hdr(radiance: NDArray[np.float32]) -> bytes:
    """Return a picture of linear RGB ``(H, W, 3)``, finite and not negative, flat.

    A channel is off by at most half a step: 1/256 of the pixel's largest channel.
    """
    height, width = radiance.shape[:2]
    largest = np.clip(radiance.max(axis=2), 0.0, np.ldexp(255.0, 119)).astype(np.float64)
    exponent = np.maximum(np.frexp(largest)[1], -127)
    mantissas = np.minimum(np.rint(np.ldexp(radiance.astype(np.float64), 8 - exponent[..., None])), 255)
    is_black = (mantissas == 0).all(axis=2)
    octets = np.concatenate([mantissas, np.where(is_black, 0, exponent + 128)[..., None]], axis=2).astype(np.uint8)
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width) + octets.tobytes()


def radiance_hdr_size(path: Path) -> tuple[int, int]:
    """Return the width and height of a picture, from its header.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: The file is not a Radiance picture.
    """
    _, _, height, width, _, _ = _parse_header(path, _bytes_of(path, 2 * MAX_HEADER_BYTES))
    return width, height


def _bytes_of(path: Path, most: int = -1) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(most)
    except OSError as error:
        raise MissingFileError(
            f"image must be a readable file, got {path} ({error.strerror}). Check the path."
        ) from error


def _truncated(path: Path, row: int) -> AssetFormatError:
    return AssetFormatError(
        f"image must hold every scanline that its header promises, got a damaged or truncated one at row {row} "
        f"of {path}. Copy or export the file again."
    )


def _parse_header(path: Path, data: bytes) -> tuple[bool, bool, int, int, float, int]:
    """Return (flip y, flip x, height, width, exposure, offset of the first scanline)."""
    head = data[:MAX_HEADER_BYTES]
    end = head.find(b"\n\n")
    match = _RESOLUTION.match(head, end + 2) if end >= 0 else None
    if not head.startswith((b"#?RADIANCE", b"#?RGBE")) or match is None:
        raise AssetFormatError(
            f"image must be a Radiance picture with a '-Y height +X width' line, got another header in {path}. "
            "Export it as RGBE with the usual scan order."
        )
    exposure = 1.0
    for line in head[:end].split(b"\n"):
        name, _, value = line.partition(b"=")
        if name == b"FORMAT" and value.strip() != b"32-bit_rle_rgbe":
            raise AssetFormatError(
                f"image must have FORMAT=32-bit_rle_rgbe, got {value.decode('latin-1').strip()!r} in {path}. "
                "Export it as RGBE."
            )
        if name == b"EXPOSURE":
            try:
                exposure *= float(value)
            except ValueError:
                exposure = float("nan")
    if not (1e-30 < exposure < 1e30):
        raise AssetFormatError(
            f"image must have an EXPOSURE in (1e-30, 1e30), got {exposure} in {path}. Mend its header."
        )
    sign_y, height, sign_x, width = match.groups()
    return sign_y == b"+", sign_x == b"-", int(height), int(width), exposure, match.end()


def _scanlines(path: Path, data: bytes, start: int, height: int, width: int) -> Iterator[NDArray[np.uint8]]:
    """Yield the RGBE bytes of each scanline, ``(W, 4)``; its first bytes state its encoding."""
    marker = bytes((2, 2, width >> 8, width & 255)) if MIN_RUN_WIDTH <= width <= MAX_RUN_WIDTH else None
    position = start
    for row in range(height):
        if marker is not None and data.startswith(marker, position):
            line, position = _decode_new(data, position + 4, width)
        else:
            line, position = _decode_old(data, position, width)
        if line is None:
            raise _truncated(path, row)
        yield line


def _decode_new(data: bytes, position: int, width: int) -> tuple[NDArray[np.uint8] | None, int]:
    """Decode one scanline of the new encoding, in which the four components follow each other, each in runs."""
    out = bytearray()
    size = len(data)
    for end in (width, 2 * width, 3 * width, 4 * width):
        while len(out) < end:
            if position + 1 >= size:
                return None, position
            code = data[position]
            if code > 128:
                out += data[position + 1 : position + 2] * (code - 128)
                position += 2
            else:
                out += data[position + 1 : position + 1 + code]
                position += 1 + code
                if code == 0:
                    return None, position
        if len(out) != end or position > size:  # a run crosses the component's end, or a literal the file's
            return None, position
    return np.frombuffer(bytes(out), np.uint8).reshape(4, width).T, position


def _decode_old(data: bytes, position: int, width: int) -> tuple[NDArray[np.uint8] | None, int]:
    """Decode one scanline of the old encoding, or a flat one: RGBE entries, of which (1, 1, 1, n) repeats the last.

    Successive repeats are the bytes of one count, the lowest first.
    """
    available = min((len(data) - position) // 4, width)
    entries = np.frombuffer(data, np.uint8, 4 * available, position).reshape(-1, 4)
    repeats = (entries[:, :3] == 1).all(axis=1)
    index = np.arange(available)
    pixel = np.maximum.accumulate(np.where(repeats, -1, index))  # the entry whose colour each entry stands for
    place = index - pixel - 1  # how many repeats came right before this one
    if available == 0 or pixel[0] < 0 or (repeats & (place > 3)).any():
        return None, position
    counts = np.where(repeats, entries[:, 3].astype(np.int64) << (8 * np.clip(place, 0, 3)), 1)
    filled = np.cumsum(counts)
    used = int(np.searchsorted(filled, width)) + 1
    if used > available or filled[used - 1] != width:
        return None, position
    return entries[np.repeat(pixel[:used], counts[:used])], position + 4 * used
