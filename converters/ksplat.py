"""`.ksplat` files, as the viewer GaussianSplats3D writes them.

Source of the layout: mkkellogg/GaussianSplats3D, version 0.1 of its SplatBuffer. A header of 4096 bytes is followed by
one of 1024 bytes for each section, and by the sections. A section has the lengths of its partly filled buckets, the
centres of all its buckets, and its rows: position, linear standard deviations, quaternion w x y z, red, green, blue and
opacity as bytes, spherical harmonics of degree 1 and 2 channel after channel. Compression level 0 stores float32; level
1 stores half, and positions as offsets from the centre of a bucket; level 2 stores spherical harmonics as bytes, too.
Axes and units are not stated; they are those of the PLY from which such files are made.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import rows_at
from beam_warp.converters.common.activations import dc_from_color
from beam_warp.converters.common.frames import DecodedFrame
from beam_warp.converters.common.options import ReadOptions
from beam_warp.errors import AssetFormatError
from beam_warp.image.color import DISPLAY_SRGB

_HEADER_BYTES, _SECTION_BYTES = 4096, 1024
_HEADER = np.dtype(
    {
        "names": ["major", "minor", "sections", "rows", "level", "sh_low", "sh_high"],
        "formats": ["u1", "u1", "<u4", "<u4", "<u2", "<f4", "<f4"],
        "offsets": [0, 1, 4, 16, 20, 36, 40],
        "itemsize": _HEADER_BYTES,
    }
)
_SECTION = np.dtype(
    {
        "names": ["rows", "bucket_rows", "buckets", "block", "bucket_bytes", "steps", "full", "partial", "degree"],
        "formats": ["<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [4, 8, 12, 16, 20, 24, 32, 36, 40],
        "itemsize": _SECTION_BYTES,
    }
)

_LEVELS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
"""Types of positions, of scales and quaternions, and of spherical harmonics."""

_STEPS = 32767
"""Steps of a position to either side of a bucket's centre, where the section states none."""

_SH_LIMIT = 1.5
"""Largest coefficient stored as a byte, where the header states none."""

_COEFFICIENTS = (0, 3, 8)
"""Coefficients a channel above degree 0, by degree."""


@dataclass(frozen=True)
class _Section:
    """One section: its header, and where in the file it begins [byte]."""

    header: Any
    start: int
    row: np.dtype[Any]

    @property
    def centers_start(self) -> int:
        return self.start + 4 * int(self.header["partial"])

    @property
    def rows_start(self) -> int:
        return self.centers_start + int(self.header["bucket_bytes"]) * int(self.header["buckets"])

    @property
    def end(self) -> int:
        return self.rows_start + self.row.itemsize * int(self.header["rows"])


@dataclass(frozen=True)
class _Layout:
    """The headers of a file."""

    path: Path
    level: int
    sh_range: tuple[float, float]
    sections: tuple[_Section, ...]


def probe(path: Path) -> _Layout:
    """Read the headers.

    Raises:
        AssetFormatError: The file is of another version, or shorter than its headers say.
    """
    size = path.stat().st_size
    if size < _HEADER_BYTES:
        raise _malformed(path, f"must have a header of {_HEADER_BYTES} bytes", f"{size} bytes")
    header = np.fromfile(path, _HEADER, 1)[0]
    if (header["major"], header["minor"]) != (0, 1) or header["level"] >= len(_LEVELS):
        got = f"version {header['major']}.{header['minor']}, level {header['level']}"
        raise _malformed(path, "must have version 0.1 and a compression level of 0 to 2", got)
    start = _HEADER_BYTES + _SECTION_BYTES * int(header["sections"])
    if start > size:
        raise _malformed(path, f"must have the headers of {header['sections']} sections", f"{size} bytes")
    sections = []
    for found in np.fromfile(path, _SECTION, int(header["sections"]), offset=_HEADER_BYTES):
        if found["degree"] >= len(_COEFFICIENTS):
            raise _malformed(path, "must have spherical harmonics of degree 0 to 2", f"{found['degree']}")
        sections.append(_Section(found, start, _row_of(int(header["level"]), int(found["degree"]))))
        _require_buckets(path, sections[-1], int(header["level"]))
        start = sections[-1].end
        if start > size:
            raise _malformed(path, f"must have {start} bytes for {len(sections)} sections", f"{size}")
    if sum(int(section.header["rows"]) for section in sections) != header["rows"]:
        raise _malformed(path, f"must have {header['rows']} Gaussians in its sections", "another number")
    low, high = float(header["sh_low"]) or -_SH_LIMIT, float(header["sh_high"]) or _SH_LIMIT
    if not -1e6 <= low <= high <= 1e6:
        raise _malformed(path, "must state a range of spherical harmonics", f"{low:g} to {high:g}")
    return _Layout(path, int(header["level"]), (low, high), tuple(sections))


def _malformed(path: Path, contract: str, got: str) -> AssetFormatError:
    return AssetFormatError(f"{path.name} {contract}, got {got}. Export or copy the file again.")


def _row_of(level: int, degree: int) -> np.dtype[Any]:
    position, geometry, harmonics = _LEVELS[level]
    count = 3 * _COEFFICIENTS[degree]
    fields = [("position", position, 3), ("scale", geometry, 3), ("rotation", geometry, 4), ("color", "u1", 4)]
    return np.dtype([*fields, ("harmonics", harmonics, count)])


def _require_buckets(path: Path, section: _Section, level: int) -> None:
    """Refuse a section whose buckets cannot hold its rows."""
    header = section.header
    if level == 0:
        return
    block = float(header["block"])
    fits = header["bucket_bytes"] >= 12 and int(header["full"]) + int(header["partial"]) == header["buckets"]
    if not (fits and 0.0 < block < np.inf and int(header["full"]) * int(header["bucket_rows"]) <= header["rows"]):
        got = f"{header['full']} full and {header['partial']} other ones of {header['buckets']}, {block:g} wide"
        raise _malformed(path, "must have buckets for all rows", got)


def decode(path: Path, options: ReadOptions) -> DecodedFrame:
    """Read a file.

    Raises:
        AssetFormatError: It is malformed, or a quaternion is zero.
    """
    layout = probe(path)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is infinite or NaN, which a cloud refuses
        return _frame(layout, options)


def _frame(layout: _Layout, options: ReadOptions) -> DecodedFrame:
    """Return what the sections hold."""
    path = layout.path
    degree = max((int(section.header["degree"]) for section in layout.sections), default=0)
    parts = [dict(_decoded(layout, section, degree)) for section in layout.sections]
    empty = {"positions": (0, 3), "orientations": (0, 4), "scales": (0, 3), "opacities": (0,), "radiance": (0, 1, 3)}
    fields = {name: np.concatenate([part[name] for part in parts] or [np.empty(empty[name])]) for name in empty}
    length = np.linalg.norm(fields["orientations"].astype(np.float64), axis=1, keepdims=True)
    bad = ~((length[:, 0] > 0.0) & (length[:, 0] < np.inf))
    if bad.any() and not options.drop_invalid:
        raise AssetFormatError(
            f"{path.name}: rotations must be quaternions, got zero, NaN or infinity at {rows_at(bad)}. "
            "Drop those rows with --drop-invalid."
        )
    fields["orientations"] = fields["orientations"] / np.where(bad[:, None], 1.0, length)
    return DecodedFrame(
        fields={**fields, "radiance_color_space": DISPLAY_SRGB},
        format=f"ksplat 0.1, compression level {layout.level}",
        producer="GaussianSplats3D or a tool with its layout",
    )


def _decoded(layout: _Layout, section: _Section, degree: int) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays of a section, with spherical harmonics of the file's greatest degree."""
    header = section.header
    rows = np.fromfile(layout.path, section.row, int(header["rows"]), offset=section.rows_start)
    positions = rows["position"].astype(np.float32)
    if layout.level:
        steps = int(header["steps"]) or _STEPS
        offsets = (positions.astype(np.float64) - steps) * (float(header["block"]) / 2.0 / steps)
        positions = (_centers(layout.path, section) + offsets).astype(np.float32)
    yield "positions", positions
    yield "scales", rows["scale"].astype(np.float32)
    yield "orientations", rows["rotation"].astype(np.float32)[:, [1, 2, 3, 0]]
    color = rows["color"].astype(np.float32) / 255.0
    yield "opacities", color[:, 3]
    harmonics = rows["harmonics"].astype(np.float32)
    if layout.level == 2:
        low, high = layout.sh_range
        harmonics = low + harmonics / 255.0 * (high - low)
    radiance = np.zeros((len(rows), 1 + _COEFFICIENTS[degree], 3), np.float32)
    radiance[:, 0] = dc_from_color(color[:, :3])
    for first, end in ((0, 3), (3, 8))[: int(header["degree"])]:  # each degree channel after channel
        band = harmonics[:, 3 * first : 3 * end].reshape(len(rows), 3, end - first)
        radiance[:, 1 + first : 1 + end] = band.transpose(0, 2, 1)
    yield "radiance", radiance


def _centers(path: Path, section: _Section) -> NDArray[np.float64]:
    """Return the centre of each row's bucket: full buckets come first, then those of stated lengths."""
    header = section.header
    rows, full = int(header["rows"]), int(header["full"])
    lengths = np.fromfile(path, "<u4", int(header["partial"]), offset=section.start).astype(np.int64)
    if int(lengths.sum()) != rows - full * int(header["bucket_rows"]):
        raise _malformed(path, "must have lengths of partly filled buckets that sum up to its rows", f"{lengths.sum()}")
    width = int(header["bucket_bytes"])
    stored = np.fromfile(path, np.uint8, width * int(header["buckets"]), offset=section.centers_start)
    centers = stored.reshape(-1, width)[:, :12].copy().view("<f4").astype(np.float64)
    return np.repeat(centers, np.concatenate([np.full(full, header["bucket_rows"], np.int64), lengths]), axis=0)
