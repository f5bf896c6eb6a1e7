"""Paths on a command line, before any work: names that files can have, and originals that no output may replace."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from beam_warp.checks import require_path, shortened
from beam_warp.converters.numbering import files_at
from beam_warp.errors import BeamError, MissingFileError
from beam_warp.outputs import ROOM, keep_original, kept_originals, originals_kept, require_apart

OUTPUTS = ("out", "output", "renders", "sarif", "html")
"""Fields of commands' records that name what is written."""

_WRITTEN = re.compile(
    r"(asset|gaussians)(\.\w+)?\.usd[ac]|report\.json|(overview|capture|evaluation)\.(png|html|json)|(mesh\d+|canonical)\.\w+"
)
"""Names of the files that commands write into a folder."""

MOST_JSON_BYTES = 2**23
"""Largest JSON that is searched for the names of files."""


@contextmanager
def paths_checked(record: Any) -> Iterator[None]:
    """Check every path of a command's options, and keep the files that it names safe until the command has ended.

    Raises:
        InvalidOptionError: No file can have a name, or an output is a file that is read.
        MissingFileError: A folder cannot be searched.
    """
    paths = list(_paths_in(record))
    for name, path in paths:
        require_path(name, path, room=ROOM if name in OUTPUTS else 0)
        _require_reachable(name, path)
    with originals_kept():
        for name, path in paths:
            if name not in OUTPUTS:
                keep_original(*_files_named_by(path))
        for name, path in paths:
            if name in OUTPUTS:
                within = [file for file in kept_originals() if _WRITTEN.fullmatch(file.name)]
                require_apart([path, *(path / file.name for file in within)], name)
        yield


def _paths_in(record: Any, name: str = "") -> Iterator[tuple[str, Path]]:
    """Yield every path of a record and of the records in it, with the name of its field."""
    if isinstance(record, Path):
        yield name, record
    elif isinstance(record, tuple):
        for item in record:
            yield from _paths_in(item, name)
    elif isinstance(record, dict) or dataclasses.is_dataclass(record):
        for field, item in (record if isinstance(record, dict) else vars(record)).items():
            yield from _paths_in(item, field)


def _require_reachable(name: str, path: Path) -> None:
    """Refuse a path in a folder that cannot be searched, whether or not there is a file."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):  # who needs it says so
        pass
    except OSError as error:
        raise MissingFileError(
            f"{name} must be within reach, got {shortened(str(path))} ({error.strerror}). Check its folders' rights."
        ) from error


def _files_named_by(path: Path) -> Iterator[Path]:
    """Yield the files that a path names: itself, those of a folder, and those that their JSON names.

    The layers of USD files are named when they are read, after a trial in a child process.
    """
    found = [path, path / "transforms.json"]
    with suppress(BeamError, OSError):
        found += files_at(path) if path.is_dir() else []
    for file in filter(Path.is_file, dict.fromkeys(found)):
        yield file
        if file.suffix.lower() in (".json", ".gltf") and file.stat().st_size <= MOST_JSON_BYTES:
            with suppress(OSError, ValueError, RecursionError):
                yield from _named_in(json.loads(file.read_bytes()), file.parent)


def _named_in(content: Any, folder: Path) -> Iterator[Path]:
    """Yield the files beside or below a folder that texts in JSON name."""
    if isinstance(content, dict | list):
        for item in content.values() if isinstance(content, dict) else content:
            yield from _named_in(item, folder)
    elif isinstance(content, str):
        with suppress(OSError, ValueError):  # no text that is a name
            path = folder / unquote(content)
            if path.is_file():
                yield path
