"""Zipped frames: an archive of numbered files in any format that keeps one frame a file, or of one such file.

A frame is unpacked when it is asked for, under its own name in a temporary folder, and removed after it was read. With
``walk0.gltf`` comes ``walk0.bin`` from the same folder of the archive, which holds its arrays.
"""

from __future__ import annotations

import shutil
import struct
import zipfile
import zlib
from collections.abc import Sequence
from itertools import chain
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from beam_warp.archives import MANY_FILES, open_zip
from beam_warp.converters import formats
from beam_warp.converters.common.frames import DecodedFrame, sequence_of
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.numbering import holds_a_frame, in_order
from beam_warp.errors import AssetFormatError
from beam_warp.world.gaussians import GaussianSequence

MAX_ENTRIES = 2**14
"""Most files in an archive."""

MAX_FREE_BYTES, MAX_RATIO = 16 * 2**20, 32
"""A frame may unpack to so many bytes, and so many more for each byte that it takes in the archive."""

_BROKEN = (OSError, ValueError, RuntimeError, EOFError, zipfile.BadZipFile, zlib.error, struct.error)
"""Errors of the library on archives that are malformed or compressed in an unknown way."""


def read(path: Path, options: ReadOptions) -> GaussianSequence:
    """Read an archive.

    Raises:
        AssetFormatError: It is malformed, encrypted, or holds no frames.
    """
    try:
        with open_zip(path, MANY_FILES) as archive:
            entries = archive.infolist()
    except _BROKEN as error:
        raise _malformed(path, "must be a whole zip archive", str(error)) from error
    if len(entries) > MAX_ENTRIES:
        raise _malformed(path, f"must hold at most {MAX_ENTRIES} files", f"{len(entries)}")
    files = {Path(entry.filename): entry for entry in entries if _is_shown(entry)}
    frames = [[files[name] for name in (frame, *_beside(frame)) if name in files] for frame in _frames(path, files)]
    for entry in chain(*frames):
        _require_safe(path, entry)
    names = [f"{path.name}: {entry.filename}" for entry, *_ in frames]
    return sequence_of(path.name, names, lambda frame: _decoded(path, frames[frame], options), options)


def _malformed(path: Path, contract: str, got: str) -> AssetFormatError:
    return AssetFormatError(f"{path.name} {contract}, got {got}. Pack the frames again.")


def _is_shown(entry: zipfile.ZipInfo) -> bool:
    """Return False for folders, and for files that systems add without asking."""
    parts = PurePosixPath(entry.filename).parts
    is_file = parts != () and not entry.is_dir()
    return is_file and "__MACOSX" not in parts and not parts[-1].startswith(".")


def _frames(path: Path, files: dict[Path, zipfile.ZipInfo]) -> list[Path]:
    """Return the frames in order; one alone needs no number."""
    found = [name for name in files if holds_a_frame(name.name)]
    return found if len(found) == 1 else in_order(files, path.name)


def _beside(frame: Path) -> list[Path]:
    """Return the files that a frame needs beside itself."""
    return [frame.with_suffix(".bin")] if frame.suffix.lower() == ".gltf" else []


def _require_safe(path: Path, entry: zipfile.ZipInfo) -> None:
    """Refuse a frame that is encrypted, lies outside the archive, or unpacks to far more than it takes."""
    place = PurePosixPath(entry.filename)
    if place.is_absolute() or ".." in place.parts or "\\" in entry.orig_filename or ":" in entry.filename:
        raise _malformed(path, "must hold files inside itself", repr(entry.filename))
    if entry.flag_bits & 1:
        raise _malformed(path, "must not be encrypted", f"{entry.filename!r}, which is")
    if entry.file_size > MAX_FREE_BYTES + MAX_RATIO * entry.compress_size:
        got = f"{entry.compress_size} bytes that unpack to {entry.file_size}"
        raise _malformed(path, f"must unpack to at most {MAX_RATIO} × its size", f"{entry.filename!r} of {got}")


def _decoded(path: Path, entries: Sequence[zipfile.ZipInfo], options: ReadOptions) -> DecodedFrame:
    """Unpack the files of a frame and read the first of them."""
    with TemporaryDirectory(prefix="beam_warp_") as folder:
        places = [Path(folder) / PurePosixPath(entry.filename).name for entry in entries]
        for entry, place in zip(entries, places, strict=True):
            try:
                with open_zip(path, MANY_FILES) as archive, archive.open(entry) as source, place.open("wb") as target:
                    shutil.copyfileobj(source, target, 1 << 20)
            except _BROKEN as error:
                raise _malformed(path, "must hold whole files", f"{entry.filename!r} ({error})") from error
        return formats.decode(places[0], options)
