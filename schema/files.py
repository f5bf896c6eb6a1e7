"""Checks of a file before OpenUSD opens it: its bytes, and a trial in a child process.

OpenUSD can end the whole process on a corrupt binary layer. So a file that this package has not just written is opened
here only after a child process has opened it and read from it.
"""

from __future__ import annotations

import glob
import json
import os
import re
import struct
import subprocess
import sys
import zipfile
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from beam_warp.archives import MANY_FILES, open_zip
from beam_warp.checks import require_path
from beam_warp.errors import AssetFormatError, MissingFileError

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")

PROBE_SECONDS = 20.0
"""Time limit for a child process that opens a small asset [s]."""

PROBE_BYTES_PER_SECOND = 2e7
"""Rate at which a child process reads at least, beyond `PROBE_SECONDS`."""

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""Environment of child processes: each thread of BLAS takes memory of its own, of which a child may not have much."""

MAX_PACKAGE_ENTRIES = 4096
ZIP_ALIGNMENT = 64

_CRATE_MAGIC = b"PXR-USDC"
_CRATE_BOOTSTRAP = struct.Struct("<8s8sq")  # magic, version, offset of the table of contents
_CRATE_SECTION = struct.Struct("<16sqq")  # name, start, size
_MAX_CRATE_SECTIONS = 64


def require_asset_file(path: str | Path) -> Path:
    """Return the absolute path of a USD file after checking its header, table of contents or zip directory.

    Raises:
        MissingFileError: There is no such file, or it cannot be read.
        AssetFormatError: It is truncated or no USD file.
    """
    source = require_path("path", path).absolute()
    if source.suffix.lower() not in SUFFIXES:
        raise AssetFormatError(
            f"{source} must end in {', '.join(SUFFIXES)}, got {source.suffix or 'no suffix'}. "
            "Convert it with beam-convert."
        )
    if source.exists() and not source.is_file():
        raise MissingFileError(f"{source} must be a readable file, got a folder, pipe or device. Check the path.")
    try:
        with source.open("rb") as stream:
            head = stream.read(16)
    except OSError as error:
        raise MissingFileError(f"{source} must be a readable file, got {error.strerror}. Check the path.") from error
    if head.startswith(_CRATE_MAGIC):
        require_whole_crate(source)
    elif head.startswith(b"PK"):
        _require_whole_package(source)
    elif not head.startswith(b"#usda ") or source.suffix.lower() in (".usdc", ".usdz"):
        raise _broken(source, f"must be a {source.suffix} file", f"the first bytes {head[:8]!r}")
    return source


def require_whole_crate(path: Path) -> None:
    """Refuse a binary layer whose table of contents or sections reach beyond the end of the file."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(_CRATE_BOOTSTRAP.size)
        if len(head) < _CRATE_BOOTSTRAP.size:
            raise _broken(path, "must hold a crate header", f"{size} bytes")
        _, _, table = _CRATE_BOOTSTRAP.unpack(head)
        if not (_CRATE_BOOTSTRAP.size <= table <= size - 8):
            raise _broken(path, "must hold its table of contents", f"{size} bytes where it starts at byte {table}")
        stream.seek(table)
        (count,) = struct.unpack("<Q", stream.read(8))
        entries = stream.read(_CRATE_SECTION.size * min(count, _MAX_CRATE_SECTIONS))
        if count > _MAX_CRATE_SECTIONS or len(entries) < _CRATE_SECTION.size * count:
            raise _broken(path, "must hold a whole table of contents", f"{len(entries)} bytes of {count} sections")
        for _, start, length in _CRATE_SECTION.iter_unpack(entries):
            if start < 0 or length < 0 or start + length > size:
                raise _broken(path, "must hold all its sections", f"{size} bytes where one ends at {start + length}")


def require_opens(path: Path) -> None:
    """Open an asset in a child process, read from every layer there, and refuse the asset if this fails.

    Raises:
        AssetFormatError: The child found a fault, crashed, or took longer than `PROBE_SECONDS` and its size explain.
    """
    answer = run_child("beam_warp.schema.probe", path, PROBE_SECONDS + size_around(path) / PROBE_BYTES_PER_SECOND)
    if answer.get("error"):
        raise _broken(path, "must open in OpenUSD", str(answer["error"]))


def said_by_usd(error: Exception) -> str:
    """Return the messages of a `pxr.Tf.ErrorException` without OpenUSD's source lines, namespaces and repetition."""
    words = dict.fromkeys(str(getattr(item, "commentary", item)) for item in error.args)
    return re.sub(r"pxrInternal_\w+?pxrReserved_+(::|(?=\w))", "", " ".join(" ".join(words).split()))[:500]


def size_around(path: Path) -> int:
    """Return the bytes of the files beside an asset that are named as it is: its layers, if it is one of ours."""
    return sum(file.stat().st_size for file in path.parent.glob(f"{glob.escape(path.stem)}*") if file.is_file())


def run_child(module: str, path: Path, seconds: float, *arguments: str) -> dict[str, object]:
    """Run a module of ours on an asset in a child process and return the JSON object it prints last.

    Args:
        module: Name of the module.
        path: The asset, its first argument.
        seconds: Time limit [s].
        arguments: Further arguments.

    Raises:
        AssetFormatError: The child crashed or took too long: the file is not fit to be opened here.
    """
    command = [
        sys.executable,
        "-P",
        "-m",
        module,
        str(path),
        *arguments,
    ]  # a checkout in the working folder is not the package
    # The child finds this very package even where it was imported from a path that only this process knows.
    places = [place for place in sys.path if place]
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": os.pathsep.join(places)}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=seconds, check=False, env=environment
        )
    except subprocess.TimeoutExpired as error:
        raise _broken(path, "must open in OpenUSD", f"no answer within {seconds:g} s") from error
    lines = done.stdout.strip().splitlines()
    if done.returncode != 0 or not lines:
        reason = f"signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise _broken(path, "must open in OpenUSD", f"a crash of the child process ({reason}: {last[:200]})")
    return json.loads(lines[-1])


def _require_whole_package(path: Path) -> None:
    """Refuse a package that is cut short or compressed, or that names files outside itself."""
    try:
        with open_zip(path, MANY_FILES) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError, OSError, struct.error) as error:
        raise _broken(path, "must be a whole zip archive", str(error)) from error
    if not 0 < len(entries) <= MAX_PACKAGE_ENTRIES:
        raise _broken(path, f"must hold 1 to {MAX_PACKAGE_ENTRIES} files", f"{len(entries)}")
    size = path.stat().st_size
    names = set()
    with path.open("rb") as stream:
        for entry in entries:
            place = PurePosixPath(entry.filename)
            if place.is_absolute() or ".." in place.parts or "\\" in entry.filename or entry.filename in names:
                raise _broken(path, "must hold distinct names inside itself", repr(entry.filename))
            names.add(entry.filename)
            if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
                raise _broken(path, "must store its files as they are", f"{entry.filename!r} compressed or encrypted")
            start = _start_of(stream, entry)
            if start is None:
                raise _broken(path, "must hold a local header of every file", f"none of {entry.filename!r}")
            if start + entry.file_size > size:
                raise _broken(path, "must hold every file whole", f"{entry.filename!r} at {start}")


def _start_of(stream: BinaryIO, entry: zipfile.ZipInfo) -> int | None:
    """Return the byte at which the data of a zip's entry begins, or None without a local header."""
    stream.seek(entry.header_offset)
    header = stream.read(30)
    if len(header) < 30 or header[:4] != b"PK\x03\x04":
        return None
    return entry.header_offset + 30 + sum(struct.unpack("<HH", header[26:30]))


def unaligned_files(path: Path) -> list[str]:
    """Return the files of a USDZ whose data do not start at a multiple of 64 bytes, which the format demands.

    OpenUSD opens such a package; readers that map its files may not.
    """
    with open_zip(path, MANY_FILES) as archive, path.open("rb") as stream:
        return [entry.filename for entry in archive.infolist() if (_start_of(stream, entry) or 1) % ZIP_ALIGNMENT]


def _broken(path: Path, contract: str, got: str) -> AssetFormatError:
    return AssetFormatError(f"{path} {contract}, got {got}. Export or copy the file again.")
