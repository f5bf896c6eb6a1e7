"""Arrays by name in NumPy's ``.npz`` and in HDF5; ``docs/formats.md`` lists the names, those of a `GaussianCloud`.

Both may also state ``axes``, ``meters_per_unit``, ``frames_per_second`` and ``radiance_color_space``: as arrays without
an axis in ``.npz``, as attributes of the file in HDF5. An HDF5 file holds one frame, or several: in arrays with one
more axis in front, or in a group for each. What is shared by all frames stands at the root once.
"""

from __future__ import annotations

import math
import re
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from beam_warp.archives import open_zip
from beam_warp.checks import require_choice, require_number
from beam_warp.converters.common.frames import DecodedFrame, FrameToWrite, sequence_of
from beam_warp.converters.common.options import ReadOptions, WriteOptions
from beam_warp.errors import AssetFormatError, BeamError, MissingFileError
from beam_warp.image.color import COLOR_SPACES, DISPLAY_SRGB
from beam_warp.world.axes import require_axes
from beam_warp.world.gaussians import ATTRIBUTES, GaussianSequence

REQUIRED = tuple(name for name, attribute in ATTRIBUTES.items() if attribute.required)
"""Arrays that every frame must have."""

STATEMENTS: dict[str, Callable[[Any], Any]] = {
    "axes": lambda value: require_axes("axes", str(value)),
    "meters_per_unit": lambda value: require_number("meters_per_unit", value, 1e-6, 1e6),
    "frames_per_second": lambda value: require_number("frames_per_second", value, 1e-3, 1e6),
    "radiance_color_space": lambda value: require_choice("radiance_color_space", str(value), COLOR_SPACES),
}
"""What a file may state about itself, and its check."""

MAX_FREE_BYTES, MAX_RATIO = 64 * 2**20, 8
"""Arrays of a frame may take so many bytes, and so many more for each byte of the file; compressed zeros take more."""


MAX_FRAMES = 100_000
"""Most frames of a file, an hour at 30 a second."""

MAX_NAMES = 2**14
"""Most arrays and groups of an HDF5 file, and so most frames where each has a group."""


Header = tuple[tuple[int, ...], np.dtype[Any]]
"""Shape and type of an array."""


def probe(path: Path) -> dict[str, tuple[zipfile.ZipInfo, Header]]:
    """Return the entry and the header ``(shape, dtype)`` of each array of an ``.npz`` file that we know.

    Raises:
        AssetFormatError: It is no such file, or an array is malformed.
    """
    found = {}
    try:
        with open_zip(path) as archive:
            for entry in archive.infolist():
                name = entry.filename.removesuffix(".npy")
                if name in ATTRIBUTES or name in STATEMENTS:
                    with archive.open(entry) as stream:
                        found[name] = entry, _header(stream, entry.file_size)
    except _BROKEN as error:
        raise _malformed(path, "must be an .npz file with arrays of numbers", str(error)) from error
    _require_arrays(path, found)
    _require_frame(path, {name: header for name, (_, header) in found.items() if name in ATTRIBUTES})
    return found


_BROKEN = (
    OSError,
    ValueError,
    RuntimeError,
    KeyError,
    TypeError,
    EOFError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
)
"""Errors of the libraries on files that are malformed, encrypted or compressed in an unknown way."""


def _malformed(path: Path, contract: str, got: str) -> AssetFormatError:
    return AssetFormatError(f"{path.name} {contract}, got {got}. See docs/formats.md for the names and shapes.")


def _header(stream: Any, size: int) -> Header:
    """Return shape and type of an array, after checking that its data are as long as they say."""
    version = npy.read_magic(stream)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Python's parser, about texts that are no header
        shape, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(stream)
    if dtype.kind not in "fiuU" or math.prod(shape) * dtype.itemsize != size - stream.tell():
        raise ValueError(f"{size} bytes for {dtype} of shape {shape}")
    return shape, dtype


def _require_arrays(path: Path, names: Mapping[str, Any]) -> None:
    if missing := [name for name in REQUIRED if name not in names]:
        raise _malformed(path, f"must have the arrays {', '.join(REQUIRED)}", f"none named {', '.join(missing)}")


def _require_frame(path: Path, headers: Mapping[str, Header]) -> None:
    """Refuse arrays of a frame that do not go together or are very large, by their shapes and types alone."""
    rows = headers["positions"][0][:1]
    for name, (shape, _) in headers.items():
        if shape[:1] != rows:
            raise _malformed(path, f"must have as many rows in {name} as in positions", f"shape {shape}")
    size = sum(math.prod(shape) * dtype.itemsize for shape, dtype in headers.values())
    limit = MAX_FREE_BYTES + MAX_RATIO * path.stat().st_size
    if size > limit:
        raise _malformed(path, f"must hold at most {limit >> 20} MiB a frame for its size", f"{size >> 20} MiB")


def decode(path: Path, options: ReadOptions) -> DecodedFrame:
    """Read an ``.npz`` file.

    Raises:
        AssetFormatError: It is malformed.
    """
    del options  # settled by the caller
    found = probe(path)
    try:
        with open_zip(path) as archive:
            arrays = {}
            for name, (entry, _) in found.items():
                with archive.open(entry) as stream:
                    arrays[name] = npy.read_array(stream, allow_pickle=False)
            left_out = [entry.removesuffix(".npy") for entry in archive.namelist()]
    except _BROKEN as error:
        raise _malformed(path, "must be an .npz file with arrays of numbers", str(error)) from error
    left_out = [name for name in left_out if name not in found]
    statements = {name: arrays[name].item() for name in STATEMENTS if name in arrays and arrays[name].size == 1}
    fields = {name: array for name, array in arrays.items() if name in ATTRIBUTES}
    return _frame(path, fields, statements, left_out, "NumPy arrays by name")


def _frame(path: Path, fields: dict[str, Any], said: Mapping[str, Any], left_out: list[str], form: str) -> DecodedFrame:
    """Return arrays and statements as a frame."""
    try:
        said = {name: check(said[name]) for name, check in STATEMENTS.items() if name in said}
    except BeamError as error:
        raise AssetFormatError(f"{path.name}: {error}") from error
    if "radiance" in fields:
        fields["radiance_color_space"] = said.get("radiance_color_space", DISPLAY_SRGB)
    return DecodedFrame(
        fields=fields,
        format=form,
        axes=said.get("axes"),
        meters_per_unit=said.get("meters_per_unit", 1.0),
        frames_per_second=said.get("frames_per_second", 30.0),
        color_space_is_stated="radiance_color_space" in said,
        notes=(f"arrays left out: {', '.join(left_out[:12])}",) if left_out else (),
    )


def encode(frame: FrameToWrite, path: Path, options: WriteOptions) -> None:
    """Write one frame as ``.npz``: every array that it has, as it is."""
    del options  # arrays are kept as they are
    said = {
        "axes": frame.cloud.axes,
        "meters_per_unit": 1.0 / frame.units_per_meter,
        "frames_per_second": frame.frames_per_second,
    }
    if frame.cloud.radiance_color_space is not None:
        said["radiance_color_space"] = frame.cloud.radiance_color_space
    with path.open("wb") as stream:  # given a name, NumPy appends .npz
        np.savez(stream, **frame.cloud.arrays(), **said)


def read(path: Path, options: ReadOptions) -> GaussianSequence:
    """Read an HDF5 file.

    Raises:
        AssetFormatError: It is malformed, or links to other files.
    """
    layout = _layout(path)
    count = len(layout)
    names = [path.name if count == 1 else f"{path.name}, frame {frame}" for frame in range(count)]
    return sequence_of(path.name, names, lambda frame: _h5_frame(path, *layout[frame]), options)


Place = tuple[str, int | None]
"""Where a frame is: its group, and its row in the arrays that have an axis of frames."""


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open an HDF5 file; what the library finds broken in it becomes an error of ours."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            yield file
    except _BROKEN as error:
        if isinstance(error, BeamError):
            raise
        if not path.is_file():
            raise MissingFileError(f"input must be an existing file, got {path}. Check the path.") from error
        raise _malformed(path, "must be an HDF5 file with arrays of numbers", str(error)) from error


def _layout(path: Path) -> list[Place]:
    """Return the place of every frame, from the headers at the root alone."""
    import h5py

    with _opened(path) as file:
        if len(file) > MAX_NAMES:
            raise _malformed(path, f"must have at most {MAX_NAMES} arrays and groups", f"{len(file)}")
        lengths = {n: each.shape[0] for n, each in _datasets(path, file).items() if each.ndim == _dimensions(n) + 1}
        groups = [str(name) for name in file if _is_own(file, name, h5py.Group)]
    if len(set(lengths.values())) > 1 or (lengths and groups):
        got = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise _malformed(path, "must have one number of frames", f"{got} beside {len(groups)} groups")
    if groups:
        return [(group, None) for group in sorted(groups, key=_by_number)]
    if not lengths:
        return [("/", None)]
    count = next(iter(lengths.values()))
    if not 1 <= count <= MAX_FRAMES:
        raise _malformed(path, f"must have 1 to {MAX_FRAMES} frames", f"{count}")
    return [("/", row) for row in range(count)]


def _is_own(group: Any, name: str, kind: type) -> bool:
    """Return whether a name stands for an object of a kind in the file itself; links elsewhere are not followed."""
    import h5py

    return isinstance(group.get(name, getlink=True), h5py.HardLink) and group.get(name, getclass=True) is kind


def _by_number(name: str) -> tuple[int, str]:
    """Return the key that puts groups in the order of the numbers in their names."""
    digits = re.findall(r"\d+", name)
    return (int(digits[-1]) if digits else 0, name)


def _dimensions(name: str) -> int:
    """Return the axes of an array of one frame."""
    return 1 + len(ATTRIBUTES[name].trailing)


def _datasets(path: Path, group: Any) -> dict[str, Any]:
    """Return the arrays of a group that we know, after checking that they lie in this file and hold numbers."""
    import h5py

    found = {}
    for name in (name for name in group if name in ATTRIBUTES):
        if not _is_own(group, name, h5py.Dataset) or group[name].external or group[name].is_virtual:
            raise _malformed(path, "must hold its arrays itself", f"{name} as a group or link")
        array = found[name] = group[name]
        if array.chunks is None and array.id.get_storage_size() < (array.nbytes or 0):
            raise _malformed(path, "must hold its arrays whole", f"{name} without its data")
        if array.dtype.kind not in "fiu" or array.ndim not in (_dimensions(name), _dimensions(name) + 1):
            got = f"{array.dtype} of shape {array.shape}"
            raise _malformed(path, f"must have numbers with {_dimensions(name)} axes in {name}", got)
        if array.chunks and math.prod(array.chunks) * array.dtype.itemsize > MAX_FREE_BYTES:
            got = f"{array.chunks} of {name}"
            raise _malformed(path, f"must have chunks of at most {MAX_FREE_BYTES >> 20} MiB", got)
    return found


def _h5_frame(path: Path, group: str, row: int | None) -> DecodedFrame:
    """Read one frame: the arrays of its group or row, and those at the root that all frames share."""
    import h5py

    with _opened(path) as file:
        found = _datasets(path, file) | (_datasets(path, file[group]) if row is None else {})
        rows = {name: row if array.ndim > _dimensions(name) else None for name, array in found.items()}
        _require_arrays(path, found)
        shapes = {name: array.shape[rows[name] is not None :] for name, array in found.items()}
        _require_frame(path, {name: (shapes[name], array.dtype) for name, array in found.items()})
        fields = {name: array[() if rows[name] is None else rows[name]] for name, array in found.items()}
        said = {name: file.attrs[name] for name in STATEMENTS if name in file.attrs}
        left_out = [str(name) for name in file if name not in ATTRIBUTES and _is_own(file, name, h5py.Dataset)]
    said = {name: value.decode() if isinstance(value, bytes) else value for name, value in said.items()}
    return _frame(path, fields, said, left_out, "HDF5 arrays by name")
