"""Reader of SPZ, the compressed splats of Niantic, versions 1 to 4.

Versions 1 to 3 are one gzip stream: a header of 16 bytes, the arrays, then records of extensions. Version 4 has a plain
header of 32 bytes, records of extensions, a table of sizes, and a Zstandard frame for each array. In each array,
Gaussian follows Gaussian:

- positions: three signed fixed-point numbers of 24 bits, whose fractional bits the header states (version 1: halves);
- opacities: a byte, linear;
- colours: three bytes, 0.15 f_dc + 0.5;
- scales: three bytes, 16 (ln s + 10);
- orientations: the index of the largest component in the order x, y, z, w in 2 bits, and the other three as a sign and
  9 bits of size below sqrt(1/2), from the top bit of a word; in versions 1 and 2, x, y and z over ± 1 as bytes, w ≥ 0;
- bands above the zeroth: bytes, 128 f_rest + 128, coefficient after coefficient, the channel changing fastest.

Source: README and library of github.com/nianticlabs/spz (MIT), release 3.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from beam_warp.converters.common.activations import exp_scale
from beam_warp.converters.common.errors import malformed, opened
from beam_warp.converters.common.frames import DecodedFrame
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.common.rotations import SMALLER_LIMIT, from_smaller
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.gaussians import MAX_SH_DEGREE
from beam_warp.world.metadata import UNSTATED_RASTER

AXES = "rub"
"""Axes of a file that states no others."""

_GZIP, MAGIC = b"\x1f\x8b", b"NGSP"
STREAM_HEADER = struct.Struct("<4sIIBBBx")
FRAMES_HEADER = struct.Struct("<4sIIBBBBI12x")
TABLE_ENTRY = struct.Struct("<QQ")
RECORD = struct.Struct("<II")

ANTIALIASED, EXTENDED = 1, 2
"""Flags of the header."""

COORDINATES = 0xADBE0003
"""Type of the record that states the axes of the arrays, by their number in `STATED_AXES`."""

STATED_AXES = (
    *("", "ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf"),
    *("lfd", "rfd", "lfu", "rfu", "lbd", "rbd", "lbu", "rbu"),
)

_MOST_RATIO, _ALWAYS_UNPACKED = 64, 1 << 24
"""Most bytes unpacked: for each byte of a file, of which splats need less than 10, or of any file."""

_MOST_RECORD_BYTES = 1 << 16

_ZSTANDARD_WINDOW = 1 << 27

_BYTES = np.arange(256)
_OPACITIES = (_BYTES / 255.0).astype(np.float32)
_COLORS = ((_BYTES / 255.0 - 0.5) / 0.15).astype(np.float32)
_SCALES = exp_scale(_BYTES / 16.0 - 10.0)
_BANDS = ((_BYTES - 128.0) / 128.0).astype(np.float32)

_REMEDY = "Export or download it again."


@dataclass(frozen=True)
class SpzHeader:
    """Facts that precede the arrays.

    Attributes:
        version: 1 to 4.
        count: Number of Gaussians.
        degree: Degree of the spherical harmonics.
        fractional_bits: Bits of a position after the point.
        flags: Sum of the bits `ANTIALIASED` and `EXTENDED`.
        stream_count: Number of compressed arrays; version 4 only.
        table_at: Offset of the table of sizes; version 4 only.
    """

    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int
    stream_count: int = 0
    table_at: int = 0

    @property
    def most_records(self) -> int:
        """Most bytes of extension records."""
        return _MOST_RECORD_BYTES if self.flags & EXTENDED else 0

    def widths(self) -> dict[str, int]:
        """Return the bytes of a Gaussian in each array, in the order of the file."""
        return {
            "positions": 6 if self.version == 1 else 9,
            "opacities": 1,
            "colors": 3,
            "scales": 3,
            "orientations": 3 if self.version < 3 else 4,
            "bands": 3 * (self.degree + 1) ** 2 - 3,
        }

    def sizes(self) -> dict[str, int]:
        """Return the bytes of each array, those without any left out."""
        return {name: self.count * width for name, width in self.widths().items() if self.count * width}


def probe(path: Path) -> SpzHeader:
    """Read the header and check that the file is as long as it says."""
    with opened(path) as file:
        header = _read_header(file, path)
        if header.version == 4:
            _read_table(file, header, path)
            return header
        end, held = STREAM_HEADER.size + sum(header.sizes().values()), _unpacked_size(file)
        if not end <= held <= end + header.most_records and end < 1 << 31:  # gzip counts modulo 2^32
            raise malformed(path, f"{header.count} Gaussians must have {end} bytes", str(held), _REMEDY)
    return header


def decode(path: Path, options: ReadOptions) -> DecodedFrame:
    """Read the Gaussians of a file.

    Raises:
        AssetFormatError: The header, the compression or a count is malformed.
    """
    del options  # they are settled when the frame is placed
    with opened(path) as file:
        return unpack(file, path)


def unpack(file: BinaryIO, path: Path) -> DecodedFrame:
    """Read the Gaussians of an open file, or of the part of another file that holds SPZ.

    Args:
        file: Bytes from the first to the last.
        path: What errors name.

    Raises:
        AssetFormatError: The header, the compression or a count is malformed.
    """
    header = _read_header(file, path)
    arrays, records = (_of_frames if header.version == 4 else _of_stream)(file, header, path)
    axes, notes = _stated_axes(records, path) if header.flags & EXTENDED else (None, [])
    if axes is None:
        notes.append(f"axes of SPZ are {AXES}, but some writers leave others: if it lies wrong, pass --source-axes rdf")
    return DecodedFrame(
        fields=_fields(arrays, header),
        format=f"SPZ {header.version}, {'Zstandard' if header.version == 4 else 'gzip'}",
        axes=axes or AXES,
        raster=(True, UNSTATED_RASTER[1]) if header.flags & ANTIALIASED else None,
        notes=tuple(notes),
    )


def _size(file: BinaryIO) -> int:
    return file.seek(0, io.SEEK_END)


def _unpacked_size(file: BinaryIO) -> int:
    """Return the bytes that a gzip file states at its end, or those of a file that is not compressed."""
    file.seek(0)
    zipped, size = file.read(2) == _GZIP, _size(file)
    file.seek(max(size - 4, 0))
    return int.from_bytes(file.read(4), "little") if zipped else size


def _read_header(file: BinaryIO, path: Path) -> SpzHeader:
    """Read and check the header; no array that it counts is larger than the file allows."""
    file.seek(0)
    start = file.read(4096)
    zipped = start.startswith(_GZIP)
    if zipped:
        try:
            start = zlib.decompressobj(31).decompress(start, STREAM_HEADER.size)
        except zlib.error as error:
            raise malformed(path, "SPZ must hold a gzip stream", str(error), _REMEDY) from error
    if not start.startswith(MAGIC):
        raise malformed(path, "SPZ must start with NGSP, plain or in gzip", repr(start[:4]), "Check that it is SPZ.")
    version = int.from_bytes(start[4:8], "little")
    if not 1 <= version <= (3 if zipped else 4):
        kind = "in gzip must be 1 to 3" if zipped else "must be 1 to 4"
        raise malformed(path, f"the version of SPZ {kind}", str(version), "Update beam-warp, or export an older one.")
    layout = STREAM_HEADER if version < 4 else FRAMES_HEADER
    if len(start) < layout.size:
        raise malformed(path, f"the header must have {layout.size} bytes", str(len(start)), _REMEDY)
    header = SpzHeader(*layout.unpack_from(start)[1:])
    if header.degree > MAX_SH_DEGREE or header.fractional_bits > 24:
        got = f"{header.degree} and {header.fractional_bits}"
        raise malformed(path, "degree and fractional bits must be at most 4 and 24", got, _REMEDY)
    most = max(_ALWAYS_UNPACKED, _MOST_RATIO * _size(file))
    if sum(header.sizes().values()) > most:
        got = f"{header.count} Gaussians of degree {header.degree}"
        raise malformed(path, f"the file must unpack to at most {most} bytes", got, _REMEDY)
    return header


def _of_stream(file: BinaryIO, header: SpzHeader, path: Path) -> tuple[dict[str, memoryview], bytes]:
    """Return the arrays of versions 1 to 3, and the records after them."""
    file.seek(0)
    content = file.read()
    end = STREAM_HEADER.size + sum(header.sizes().values())
    if content.startswith(_GZIP):
        stream = zlib.decompressobj(31)
        try:
            content = stream.decompress(content, end + header.most_records + 1)
        except zlib.error as error:
            raise malformed(path, "SPZ must hold a gzip stream", str(error), _REMEDY) from error
        if not stream.eof:
            got = f"{'more' if len(content) > end else 'a stream cut'} after {len(content)}"
            raise malformed(path, f"{header.count} Gaussians must fill {end} bytes of gzip", got, _REMEDY)
    if not end <= len(content) <= end + header.most_records:
        raise malformed(path, f"{header.count} Gaussians must have {end} bytes", str(len(content)), _REMEDY)
    arrays, at, view = {}, STREAM_HEADER.size, memoryview(content)
    for name, size in header.sizes().items():
        arrays[name] = view[at : at + size]
        at += size
    return arrays, bytes(view[end:])


def _read_table(file: BinaryIO, header: SpzHeader, path: Path) -> list[tuple[int, int]]:
    """Return offset and length of each compressed array of version 4, all of them within the file."""
    sizes, total = header.sizes(), _size(file)
    if header.stream_count != len(sizes):
        got = str(header.stream_count)
        raise malformed(path, f"degree {header.degree} must have {len(sizes)} streams", got, _REMEDY)
    file.seek(header.table_at)
    table = file.read(TABLE_ENTRY.size * len(sizes))
    if header.table_at < FRAMES_HEADER.size or len(table) < TABLE_ENTRY.size * len(sizes):
        got = f"{len(table)} bytes at {header.table_at}"
        raise malformed(path, f"the table of {len(sizes)} streams must follow the header", got, _REMEDY)
    places, at = [], header.table_at + len(table)
    for (packed, size), (name, wanted) in zip(TABLE_ENTRY.iter_unpack(table), sizes.items(), strict=True):
        if size != wanted or packed > total - at:
            got = f"{size} packed in {packed}, with {total - at} left in the file"
            raise malformed(path, f"stream {name} must hold {wanted} bytes", got, _REMEDY)
        places.append((at, packed))
        at += packed
    return places


def _of_frames(file: BinaryIO, header: SpzHeader, path: Path) -> tuple[dict[str, memoryview], bytes]:
    """Return the arrays of version 4, and the records before its table."""
    from zstandard import CONTENTSIZE_UNKNOWN, ZstdDecompressor, ZstdError, frame_content_size

    arrays = {}
    unpacker = ZstdDecompressor(max_window_size=_ZSTANDARD_WINDOW)
    for (at, packed), (name, size) in zip(_read_table(file, header, path), header.sizes().items(), strict=True):
        file.seek(at)
        frame = file.read(packed)
        try:
            stated = frame_content_size(frame)  # the unpacker allocates what a frame states
            content = unpacker.decompress(frame, size) if stated in (size, CONTENTSIZE_UNKNOWN) else b""
        except ZstdError as error:
            raise malformed(path, f"stream {name} must be Zstandard", str(error), _REMEDY) from error
        if len(content) != size:
            raise malformed(path, f"stream {name} must hold {size} bytes", "another number", _REMEDY)
        arrays[name] = memoryview(content)
    file.seek(FRAMES_HEADER.size)
    return arrays, file.read(min(header.table_at - FRAMES_HEADER.size, _MOST_RECORD_BYTES))


def _stated_axes(records: bytes, path: Path) -> tuple[str | None, list[str]]:
    """Return the axes that a record states, or None, and a note on records that are left out."""
    axes, unknown, at = None, [], 0
    while at + RECORD.size <= len(records):
        kind, size = RECORD.unpack_from(records, at)
        content = records[at + RECORD.size : at + RECORD.size + size]
        number = int.from_bytes(content, "little")
        if len(content) != size or (kind == COORDINATES and not (size == 4 and 0 < number < len(STATED_AXES))):
            got = f"type {kind:#x} of {size} bytes"
            raise malformed(path, "a record of extensions must be whole and known", got, _REMEDY)
        if kind == COORDINATES:
            axes = STATED_AXES[number]
        else:
            unknown.append(f"{kind:#x}")
        at += RECORD.size + size
    return axes, [f"extensions left out: {', '.join(unknown[:8])}"] if unknown else []


def _fields(arrays: Mapping[str, memoryview], header: SpzHeader) -> dict[str, Any]:
    """Unpack arrays of bytes into the fields of a cloud."""
    widths, bands = header.widths(), (header.degree + 1) ** 2

    def rows(name: str) -> NDArray[np.uint8]:
        return np.frombuffer(arrays.get(name, b""), np.uint8).reshape(header.count, widths[name])

    radiance = np.empty((header.count, bands, 3), np.float32)
    radiance[:, 0] = _COLORS[rows("colors")]
    radiance[:, 1:] = _BANDS[rows("bands").reshape(header.count, bands - 1, 3)]
    return {
        "positions": _positions(rows("positions"), header),
        "orientations": (_first_three if header.version < 3 else _smallest_three)(rows("orientations")),
        "scales": _SCALES[rows("scales")],
        "opacities": _OPACITIES[rows("opacities")[:, 0]],
        "radiance": radiance,
        "radiance_color_space": DISPLAY_SRGB,
    }


def _positions(rows: NDArray[np.uint8], header: SpzHeader) -> NDArray[np.float32]:
    if header.version == 1:
        return rows.view("<f2").astype(np.float32)
    words = np.zeros((len(rows), 3, 4), np.uint8)
    words[..., 1:] = rows.reshape(-1, 3, 3)
    fixed = words.view("<i4")[..., 0] >> 8  # with its sign
    return np.ldexp(fixed.astype(np.float32), -header.fractional_bits)


def _first_three(rows: NDArray[np.uint8]) -> NDArray[np.float64]:
    vectors = rows / 127.5 - 1.0
    squared = np.einsum("ij,ij->i", vectors, vectors)
    quaternions = np.column_stack([vectors, np.sqrt(np.maximum(1.0 - squared, 0.0))])
    return quaternions / np.sqrt(np.maximum(squared, 1.0))[:, None]


def _smallest_three(rows: NDArray[np.uint8]) -> NDArray[np.float64]:
    words = np.ascontiguousarray(rows).view("<u4")[:, 0]
    fields = words[:, None] >> np.array([20, 10, 0], np.uint32)
    smaller = np.where(fields & 512, -1.0, 1.0) * (fields & 511) * (SMALLER_LIMIT / 511.0)
    return from_smaller(smaller, (words >> np.uint32(30)).astype(np.intp))
