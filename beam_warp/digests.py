"""Digests of plain records, of arrays, of the content of files, and of this package's code.

A file is read again only when its size, times or inode are others than when it was last read. One that changed less
than `RACE_SECONDS` before it was read could change once more without showing, and is never remembered.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
import importlib.util
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.errors import MissingFileError, MissingPackageError

RACE_SECONDS = 2.0
"""Coarsest time step of usual file systems (FAT)."""


PART_BYTES = 2**22
"""Bytes of a file that are digested at a time."""

SOURCE_SUFFIXES = (".py", ".usda")
"""Files of the package that a result can depend on: code, and the schema."""

MAPPED_PACKAGES = ("kernels", "schema", "converters")
"""Packages that lie beside ``beam_warp`` in a checkout, and inside it in a wheel."""


@functools.cache
def code_digest() -> str:
    """Return the digest of the code that makes results, 32 hexadecimal digits.

    Files are hashed as text, comments and docstrings included: telling them apart would mean to parse the whole
    package, which costs a second. So an edited comment makes jobs start over, and no changed algorithm goes unnoticed.

    Raises:
        MissingPackageError: Python found a checkout's folder before the installed package.
    """
    folders = {"": _folder_of("beam_warp")}
    folders |= {name: _folder_of(f"beam_warp.{name}") for name in MAPPED_PACKAGES}
    return source_digest(folders)


def source_digest(folders: Mapping[str, Path]) -> str:
    """Return the digest of the source files of folders, the same wherever the folders lie.

    Line ends do not count: checkouts on Windows have others.

    Args:
        folders: Folder by the place of its files in the package, ``""`` for the package itself. A file that two
            folders hold at the same place counts once.
    """
    files: dict[str, Path] = {}
    for place, folder in folders.items():
        for path in folder.rglob("*"):
            name = (Path(place) / path.relative_to(folder)).as_posix()
            if path.suffix in SOURCE_SUFFIXES:
                files[name] = path
    digest = hashlib.blake2b(digest_size=16)
    for name, path in sorted(files.items()):
        content = path.read_bytes().replace(b"\r\n", b"\n")
        digest.update(f"{name} {len(content)}:".encode())
        digest.update(content)
    return digest.hexdigest()


def _folder_of(package: str) -> Path:
    """Return the folder of an installed package, without importing it."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        folder = Path(importlib.import_module("beam_warp").__path__[0])
        raise MissingPackageError(
            f"beam_warp must be the installed package, got the folder of a checkout without {package} at {folder}. "
            f"Start this program, or the Ray that runs it, in another folder than {folder.parent}."
        )
    return Path(spec.submodule_search_locations[0])


def fields_of(record: Any) -> list[tuple[str, Any]]:
    """Return the names and values of a dataclass's fields."""
    return [(field.name, getattr(record, field.name)) for field in dataclasses.fields(record)]


def _whole(array: NDArray[Any]) -> list[Any]:
    return [str(array.dtype), array.tolist()]


def described(
    value: Any, describe_file: Callable[[Path], Any], describe_array: Callable[[NDArray[Any]], Any] = _whole
) -> Any:
    """Return a value as JSON-able data, exactly; a type that is not known here is an error, never left out."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return describe_file(value)
    if isinstance(value, np.ndarray):
        return describe_array(value)
    if isinstance(value, np.generic):
        return value.item()
    if dataclasses.is_dataclass(value):
        value = dict(fields_of(value))
    if isinstance(value, Mapping):
        return {str(name): described(item, describe_file, describe_array) for name, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [described(item, describe_file, describe_array) for item in value]
    raise TypeError(f"what is digested must be plain data, got {type(value).__name__}")


def content_digest(path: Path, known: Mapping[str, list[Any]]) -> tuple[tuple[int, ...] | None, str]:
    """Return what identifies the state of a file, None if it is too fresh to trust, and the digest of its content."""
    try:
        status = path.stat()
        stamp = (status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)
        remembered = known.get(str(path))
        if remembered is not None and remembered[:-1] == list(stamp):
            return stamp, remembered[-1]
        started = time.time()
        digest = _file_digest(path, status.st_size)
    except OSError as error:
        raise MissingFileError(f"input must be readable, got {path} ({error.strerror}). Check the path.") from error
    settled = started - max(status.st_mtime, status.st_ctime) > RACE_SECONDS
    return (stamp if settled else None), digest


def _file_digest(path: Path, size: int) -> str:
    """Return the digest of a file; of a long one, that of the digests of its parts, each taken by a thread."""

    def digest_at(start: int) -> Any:
        with path.open("rb") as file:
            file.seek(start)
            return hashlib.blake2b(file.read(min(PART_BYTES, size)), digest_size=16)

    if size <= PART_BYTES:
        return digest_at(0).hexdigest()
    with ThreadPoolExecutor() as pool:
        parts = pool.map(digest_at, range(0, size, PART_BYTES))
        return hashlib.blake2b(b"".join(part.digest() for part in parts), digest_size=16).hexdigest()


def array_digest(*arrays: NDArray[Any], text: str = "") -> str:
    """Return the digest of arrays, their types, shapes and bits, and of a text before them."""
    digest = hashlib.blake2b(text.encode(), digest_size=16)
    for array in arrays:
        digest.update(f"{array.dtype.str} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).data if array.size else b"")
    return digest.hexdigest()
