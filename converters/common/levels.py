"""Formats with levels of detail: an index in JSON, and files that hold the Gaussians of many regions, run after run."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.converters.common.errors import malformed, unreadable
from beam_warp.converters.common.frames import DecodedFrame
from beam_warp.errors import AssetFormatError, MissingFileError

MAX_INDEX_BYTES = 2**26
"""Largest index read [byte]."""

_MOST_VALUES = 2**20
"""Values in an index, which take up to a hundred bytes of memory each: some 50,000 regions."""

FREE_COUNT = 2**20
"""Gaussians that the files of a scene may have together, however small they are."""

COUNT_PER_BYTE = 4
"""Gaussians that they may have beyond for every byte; those of real scenes have 5 bytes or more each."""

_COMMA_TOO_MANY = re.compile(r'("(?:[^"\\]|\\.)*"?)|,(?=\s*[}\]])', re.DOTALL)

_REMEDY = "Export or download it again."


@dataclass(frozen=True)
class Index:
    """The index of a scene, and its folder.

    Attributes:
        path: The index, for errors.
        content: Its object.
    """

    path: Path
    content: Mapping[str, Any]

    @classmethod
    def read(cls, path: Path) -> Index:
        """Read an index; commas before a closing bracket, which some exporters write, are allowed.

        Raises:
            MissingFileError: It cannot be read.
            AssetFormatError: It is too large, or holds no JSON object.
        """
        try:
            if path.stat().st_size > MAX_INDEX_BYTES:
                raise malformed(path, f"an index must have at most {MAX_INDEX_BYTES} bytes", "more", _REMEDY)
            text = path.read_bytes().decode("utf-8-sig")
            if sum(map(text.count, ",[{")) > _MOST_VALUES:
                raise malformed(path, f"an index must have at most {_MOST_VALUES} values", "more", _REMEDY)
            content = _parsed(text)
        except OSError as error:
            raise unreadable(path, error) from error
        except (ValueError, RecursionError) as error:
            raise malformed(path, "an index must be JSON", " ".join(str(error).split())[:120], _REMEDY) from error
        if not isinstance(content, dict):
            raise malformed(path, "an index must hold an object", type(content).__name__, _REMEDY)
        return cls(path, content)

    def error(self, contract: str, got: object, remedy: str = _REMEDY) -> AssetFormatError:
        """Make the error of an index that breaks its format; what was got is shown as Python writes it."""
        return malformed(self.path, contract, repr(got)[:80], remedy)

    def object(self, value: object, name: str) -> Mapping[str, Any]:
        """Return a value that must be an object."""
        if isinstance(value, dict):
            return value
        raise self.error(f"{name} must be an object", value)

    def whole(self, value: object, name: str, least: int = 0, greatest: int = 2**31 - 1) -> int:
        """Return a value that must be a whole number between bounds."""
        if isinstance(value, int) and not isinstance(value, bool) and least <= value <= greatest:
            return value
        raise self.error(f"{name} must be a whole number in [{least}, {greatest}]", value)

    def numbers(self, value: object, name: str, count: int) -> NDArray[np.float64]:
        """Return a value that must be a list of finite numbers."""
        is_list = isinstance(value, list) and len(value) == count
        if is_list and all(type(v) in (int, float) and abs(v) <= 1e38 for v in value):  # type: ignore[union-attr]
            return np.array(value, np.float64)
        raise self.error(f"{name} must be {count} finite numbers", value)

    def names(self, value: object, name: str) -> list[str]:
        """Return a value that must be a list of texts."""
        if isinstance(value, list) and all(isinstance(each, str) for each in value):
            return value
        raise self.error(f"{name} must be a list of file names", value)

    def beside(self, name: str) -> Path:
        """Return the file that a relative path names, in the folder of the index or below.

        Raises:
            AssetFormatError: The path leads elsewhere.
            MissingFileError: There is no such file.
        """
        relative = PurePosixPath(name)
        if not name.isprintable() or set(name) & set("\\:") or relative.is_absolute() or ".." in relative.parts:
            raise self.error("a file must be named by a path below the folder of the index", name)
        place = self.path.parent / relative
        if not os.path.isfile(place):  # noqa: PTH113, a Path raises of names that are too long
            raise MissingFileError(f"{self.path.name}: its file {name[:80]!r} must exist, got none. Put it beside.")
        if not place.resolve().is_relative_to(self.path.parent.resolve()):
            raise self.error("a file must stay in the folder of the index", name, "Copy the file there.")
        return place


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return json.loads(_COMMA_TOO_MANY.sub(lambda found: found[1] or "", text))


@dataclass
class Runs:
    """Runs of Gaussians to read in one file: the first one and the number of each; a number None is all the rest."""

    found: list[tuple[int, int | None]] = field(default_factory=list)

    def rows(self, count: int) -> list[slice]:
        """Return the runs as slices of a file of ``count`` Gaussians, joined where one follows another.

        Raises:
            ValueError: Two overlap, or one ends beyond the file.
        """
        joined: list[slice] = []
        end = 0
        for first, number in sorted(self.found, key=lambda run: (run[0], run[1] or 0)):
            stop = count if number is None else first + number
            if first < end or not first <= stop <= count:
                raise ValueError(f"{stop - first} after {first}, with {end} taken of {count}")
            if joined and first == end:
                joined[-1] = slice(joined[-1].start, stop)
            else:
                joined.append(slice(first, stop))
            end = stop
        return joined


def joined(
    index: Index, runs: Mapping[Path, Runs], decode: Callable[[Path], DecodedFrame], **stated: Any
) -> DecodedFrame:
    """Read runs of Gaussians from files of one kind, and put them behind one another.

    Files of lower degree get zeros for the bands that they lack. Everything but the Gaussians and the notes is taken
    from the first file.

    Args:
        index: For errors.
        runs: The runs of every file.
        decode: Reads a whole file.
        stated: What the index states instead: attributes of a `DecodedFrame`.

    Raises:
        AssetFormatError: Runs overlap or end beyond their file, or a file is malformed, or files hold far more
            Gaussians than their bytes can.
    """
    frames, parts = list[DecodedFrame](), list[dict[str, Any]]()
    most = FREE_COUNT + COUNT_PER_BYTE * sum(map(_bytes, runs))
    for file, wanted in runs.items():
        frame = decode(file)
        count = len(frame.fields["positions"])
        most -= count
        if most < 0:
            raise index.error(f"files must hold at most {COUNT_PER_BYTE} Gaussians a byte", f"{count} in {file.name}")
        try:
            rows = wanted.rows(count)
        except ValueError as error:
            raise index.error(f"runs in {file.name} must lie beside each other", str(error)) from error
        frames.append(replace(frame, fields={}))
        parts.append({name: _taken(value, rows) for name, value in frame.fields.items()})
    notes = dict.fromkeys([*stated.pop("notes", ()), *(note for frame in frames for note in frame.notes)])
    return replace(frames[0], fields=_concatenated(index, parts), notes=tuple(notes), **stated)


def _bytes(file: Path) -> int:
    """Return the bytes of a file; of one that describes others, those of all files in its folder."""
    files = file.parent.iterdir() if file.suffix == ".json" else [file]
    return sum(each.stat().st_size for each in files if each.is_file())


def _taken(value: Any, rows: list[slice]) -> Any:
    """Return rows of an array; what is no array is as it is."""
    if not isinstance(value, np.ndarray) or rows == [slice(0, len(value))]:
        return value
    return np.concatenate([value[part] for part in rows]) if rows else value[:0]


def _concatenated(index: Index, parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the fields of all parts; each array of a part is given up as soon as it is copied."""
    fields: dict[str, Any] = {}
    if any(part.keys() != parts[0].keys() for part in parts):
        raise index.error("all files must have colour, or none", "some with and some without")
    for name in list(parts[0]):
        values = [part.pop(name) for part in parts]
        if not isinstance(values[0], np.ndarray):
            fields[name] = values[0]
            continue
        shape = (sum(map(len, values)), *np.max([value.shape[1:] for value in values], axis=0).astype(int))
        fields[name] = np.zeros(shape, values[0].dtype)
        at = 0
        for value in values:
            fields[name][(slice(at, at + len(value)), *map(slice, value.shape[1:]))] = value
            at += len(value)
    return fields
