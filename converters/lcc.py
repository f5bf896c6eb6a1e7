"""Reader of LCC, the scenes of XGRIDS with levels of detail; the finest level is read.

``.lcc`` is an index in JSON; beside it lie ``index.bin``, ``data.bin``, ``shcoef.bin`` and ``environment.bin``. Every
region of ``index.bin`` has its number in 32 bits, then for each level, the finest first, how many Gaussians it has (32
bits), where they begin in ``data.bin`` (64 bits) and how many bytes they take (32 bits). A Gaussian has 32 bytes:
position as three floats; R, G, B and opacity as bytes over 255; scales as three 16-bit fractions between the bounds of
the attribute ``scale``, linear; the rotation in 32 bits; a normal, which no reader uses. The rotation has three numbers
of 10 bits over ± sqrt(1/2), the lowest bits first, and in the highest 2 the place of the largest component, which is
left out of x, y, z, w. The bands are those of degree 3, in 64 bytes at twice the offset in ``shcoef.bin``: a word a
coefficient, with R, G and B in 11, 10 and 11 bits as fractions between the bounds of the attribute ``shcoef``, and a
16th word that is not used. x points right, y forward and z up.

Source: XGRIDS, "LCC Data Organization Format White Paper". That bytes are colour as seen, that opacity and scales are
linear, and files without ``fileType``: as SplatTransform reads such files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from beam_warp.converters.common.activations import dc_from_color
from beam_warp.converters.common.frames import DecodedFrame
from beam_warp.converters.common.levels import Index
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.common.rotations import SMALLER_LIMIT, from_smaller
from beam_warp.errors import MissingFileError
from beam_warp.image.color import DISPLAY_SRGB

AXES = "rfu"
"""Axes of all scenes of XGRIDS."""

ATTRIBUTION = "Data Organization Format originated from XGRIDS"
"""Words that the white papers ask programs to show."""

_GAUSSIAN = np.dtype(
    [("position", "<f4", 3), ("color", "u1", 4), ("scale", "<u2", 3), ("rotation", "<u4"), ("normal", "<u2", 3)]
)
_BAND_WORDS = 16
_BANDS = 15
_MOST_LEVELS = 64


@dataclass(frozen=True)
class LccHeader:
    """What the index says, checked against the sizes of the files.

    Attributes:
        index: The index.
        runs: Number and offset [byte] of the Gaussians of every region, at the finest level, ``(R,)``.
        scales: Least and greatest scale, ``(2, 3)``.
        bands: Least and greatest coefficient above the zeroth, ``(2, 3)``; None without any.
        files: Path of every file beside the index, by its name in lower case.
    """

    index: Index
    runs: NDArray[Any]
    scales: NDArray[np.float64]
    bands: NDArray[np.float64] | None
    files: Mapping[str, Path]


def probe(path: Path) -> LccHeader:
    """Read the index and the places of the Gaussians, and check that they lie in the files.

    Raises:
        MissingFileError, AssetFormatError: A file is missing or malformed.
    """
    index = Index.read(path)
    files = {file.name.lower(): file for file in sorted(path.parent.iterdir(), reverse=True) if file.is_file()}
    encoding, kind = index.content.get("encoding", "COMPRESS"), index.content.get("fileType")
    if encoding != "COMPRESS":
        raise index.error("encoding must be COMPRESS", encoding, "Update beam-warp to read it.")
    if kind not in (None, "Portable", "Quality"):
        raise index.error("fileType must be Portable or Quality", kind, "Update beam-warp to read it.")
    attributes = index.content.get("attributes")
    if not isinstance(attributes, list):
        raise index.error("attributes must be a list", attributes)
    named = {str(each.get("name")): each for each in attributes if isinstance(each, dict)}
    has_bands = kind == "Quality" or (kind is None and "shcoef" in named)
    header = LccHeader(
        index=index,
        runs=_runs(index, files),
        scales=_bounds(index, named, "scale"),
        bands=_bounds(index, named, "shcoef") if has_bands else None,
        files=files,
    )
    _require_inside(header, "data.bin", 1)
    if has_bands:
        _require_inside(header, "shcoef.bin", 2)
    return header


def _bounds(index: Index, attributes: Mapping[str, Any], name: str) -> NDArray[np.float64]:
    """Return the bounds of an attribute, ``(2, 3)``."""
    attribute = index.object(attributes.get(name), f"attribute {name}")
    return np.stack([index.numbers(attribute.get(key), f"{name}.{key}", 3) for key in ("min", "max")])


def _file(index: Index, files: Mapping[str, Path], name: str) -> Path:
    if name not in files:
        raise MissingFileError(f"{index.path.name}: its file {name} must lie beside it, got none. Put it there.")
    return files[name]


def _runs(index: Index, files: Mapping[str, Path]) -> NDArray[Any]:
    """Return count, offset and size of the finest level of every region."""
    levels = index.whole(index.content.get("totalLevel"), "totalLevel", 1, _MOST_LEVELS)
    level = np.dtype([("count", "<u4"), ("offset", "<u8"), ("size", "<u4")])
    region = np.dtype([("number", "<u4"), ("levels", level, levels)])
    place = _file(index, files, "index.bin")
    size = place.stat().st_size
    if size % region.itemsize:
        raise index.error(f"index.bin must have {region.itemsize} bytes for every region", size)
    return np.fromfile(place, region)["levels"][:, 0]


def _require_inside(header: LccHeader, name: str, factor: int) -> None:
    """Refuse runs that end beyond a file, or that take more of it than there is."""
    index, runs = header.index, header.runs
    size = _file(index, header.files, name).stat().st_size // factor
    needed = _GAUSSIAN.itemsize * runs["count"].astype(np.int64)
    outside = (runs["offset"] > size) | (needed > size - np.minimum(runs["offset"], size).astype(np.int64))
    if outside.any():
        place = int(np.argmax(outside))
        got = f"{runs['count'][place]} after {factor * int(runs['offset'][place])} of region {place}"
        raise index.error(f"Gaussians must lie within the {factor * size} bytes of {name}", got)
    if needed.sum() > size:
        raise index.error(f"{name} must hold Gaussians of the finest level once", f"{needed.sum()} of {size} bytes")
    if (needed > runs["size"]).any():
        raise index.error(f"a Gaussian must have {_GAUSSIAN.itemsize} bytes", "fewer in index.bin")


def decode(path: Path, options: ReadOptions) -> DecodedFrame:
    """Read the finest level of a scene.

    Args:
        path: The index, whose name ends in ``.lcc``.
        options: Nothing in them matters here.

    Raises:
        MissingFileError, AssetFormatError: A file is missing or malformed; the message names it.
    """
    del options
    header = probe(path)
    rows = _rows(header, "data.bin", 1, _GAUSSIAN)
    smaller = np.stack([rows["rotation"] >> np.uint32(10 * place) & np.uint32(1023) for place in range(3)], axis=1)
    radiance = np.empty((len(rows), 1 if header.bands is None else 1 + _BANDS, 3), np.float32)
    radiance[:, 0] = dc_from_color(rows["color"][:, :3] / 255.0)
    if header.bands is not None:
        words = _rows(header, "shcoef.bin", 2, np.dtype(("<u4", _BAND_WORDS)))
        for channel, (shift, bits) in enumerate(((0, 11), (11, 10), (21, 11))):
            codes = words[:, :_BANDS] >> np.uint32(shift) & np.uint32(2**bits - 1)
            radiance[:, 1:, channel] = _between(header.bands[:, channel], codes, 2**bits - 1)
    content = header.index.content
    notes = ["the finest of its levels is read"] if content["totalLevel"] != 1 else []
    if "environment.bin" in header.files:
        notes.append("environment.bin, its background, is left out")
    if any(content.get(name) not in (None, 0, [0, 0, 0]) for name in ("epsg", "offset", "shift")):
        notes.append("its place on Earth (epsg, offset, shift) is left out")
    return DecodedFrame(
        fields={
            "positions": rows["position"].copy(),
            "orientations": from_smaller(
                (smaller / 1023.0 * 2.0 - 1.0) * SMALLER_LIMIT, (rows["rotation"] >> np.uint32(30)).astype(np.intp)
            ),
            "scales": _between(header.scales, rows["scale"], 65535).astype(np.float32),
            "opacities": (rows["color"][:, 3] / 255.0).astype(np.float32),
            "radiance": radiance,
            "radiance_color_space": DISPLAY_SRGB,
        },
        format=f"LCC ({ATTRIBUTION})",
        producer="XGRIDS, by its format",
        axes=AXES,
        notes=tuple(notes),
    )


def _between(bounds: NDArray[np.float64], codes: NDArray[np.integer], greatest: int) -> NDArray[np.float64]:
    """Return numbers between bounds, whose codes go from 0 to ``greatest``."""
    fraction = codes / float(greatest)
    return bounds[0] * (1.0 - fraction) + bounds[1] * fraction


def _rows(header: LccHeader, name: str, factor: int, kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the entries of all regions in a file, in the order of index.bin."""
    rows = np.empty(int(header.runs["count"].sum(dtype=np.int64)), kind)
    at = 0
    with header.files[name].open("rb") as file:
        for run in header.runs[header.runs["count"] > 0]:
            _fill(file, factor * int(run["offset"]), rows[at : at + int(run["count"])])
            at += int(run["count"])
    return rows


def _fill(file: BinaryIO, offset: int, rows: NDArray[Any]) -> None:
    """Read entries that the file is known to hold."""
    file.seek(offset)
    rows.reshape(-1).view(np.uint8)[:] = np.frombuffer(file.read(rows.nbytes), np.uint8)
