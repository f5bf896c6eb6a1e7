"""JSON that people write by hand, read field by field: errors name the file, the field and what to do."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from beam_warp.checks import is_text
from beam_warp.errors import AssetFormatError, BeamError, MissingFileError

MAX_FILE_BYTES = 2**24
"""Largest file read."""


def read_json(path: Path, name: str) -> Any:
    """Return the content of a JSON file.

    Args:
        path: The file.
        name: Name of the file in errors.

    Raises:
        MissingFileError: It is not there or cannot be read.
        AssetFormatError: It is too large, or not JSON in UTF-8.
    """
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise AssetFormatError(f"{name} must be at most {MAX_FILE_BYTES} bytes, got more in {path}. Split it.")
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise MissingFileError(f"{name} must be a readable file, got {path} ({error.strerror}). Check it.") from error
    except (ValueError, RecursionError) as error:
        if isinstance(error, BeamError):
            raise
        reason = " ".join(str(error).split())
        raise AssetFormatError(f"{name} must be JSON in UTF-8, got {reason} in {path}. Correct the file.") from error


def shown(value: Any) -> str:
    """Show a value in a message, shortened."""
    text = json.dumps(value) if isinstance(value, (dict, list, bool)) or value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


class Fields:
    """One JSON object.

    Args:
        value: JSON value that should be the object.
        where: Place of the object, ``stage.json: assets[1]``; errors put a field's name behind it.
        known: The fields it may have.

    Raises:
        AssetFormatError: It is no object, or has another field.
    """

    def __init__(self, value: Any, where: str, known: Sequence[str]) -> None:
        """Take an object."""
        self.where = where
        if not isinstance(value, dict):
            raise AssetFormatError(f"{where} must be an object, got {shown(value)}. Write it in {{ }}.")
        for name in value:
            if name not in known:
                raise AssetFormatError(f"{where} must have no field but {', '.join(known)}, got {name!r}. Remove it.")
        self._values: dict[str, Any] = value
        self._known = known

    def given(self, **kinds: str | int) -> dict[str, Any]:
        """Return the fields that are there.

        Args:
            kinds: How each field is read: ``number``, ``flag``, ``text``, or as so many numbers.
        """
        return {
            name: self.numbers(name, kind) if isinstance(kind, int) else getattr(self, kind)(name)
            for name, kind in kinds.items()
            if name in self
        }

    def __contains__(self, name: str) -> bool:
        """Say whether a field is there; null is none."""
        return self._values.get(name) is not None

    def place(self, name: str) -> str:
        """Return where a field is."""
        return f"{self.where} {name}" if self.where.endswith(":") else f"{self.where}.{name}"

    def placed(self) -> AbstractContextManager[None]:
        """Put this object's place before errors about one of its fields."""
        return placed(self.where, self._known)

    def value(self, name: str) -> Any:
        """Return a field as it is, None where it is not there."""
        return self._values.get(name)

    def number(self, name: str) -> float:
        """Return a finite number."""
        value = self._values.get(name)
        if not _is_number(value):
            raise self.error(name, "a finite number", "Write one.")
        return float(value)  # type: ignore[arg-type]

    def numbers(self, name: str, count: int) -> tuple[float, ...]:
        """Return as many finite numbers as stated."""
        value = self._values.get(name)
        if not (isinstance(value, list) and len(value) == count and all(_is_number(item) for item in value)):
            raise self.error(name, f"{count} finite numbers", f"Write [{', '.join('xyzw'[:count])}].")
        return tuple(float(item) for item in value)

    def flag(self, name: str) -> bool:
        """Return true or false."""
        value = self._values.get(name)
        if not isinstance(value, bool):
            raise self.error(name, "true or false", "Write it without quotes.")
        return value

    def text(self, name: str) -> str:
        """Return a text that is not empty."""
        value = self._values.get(name)
        if not is_text(value):
            raise self.error(name, "a text", "Write it in quotes.")
        return value

    def items(self, name: str) -> list[Any]:
        """Return a list, empty where it is not there."""
        value = self._values.get(name)
        if value is None:
            return []
        if not isinstance(value, list):
            raise self.error(name, "a list", "Put it in [ ].")
        return value

    def path(self, name: str, folder: Path, *, folders: bool = False) -> Path:
        """Return an existing file, relative to a folder unless it is absolute; with ``folders``, a folder will do."""
        try:
            path = folder / Path(self.text(name)).expanduser()
        except RuntimeError as error:  # ~ of a user that there is not
            raise self.error(name, "an existing file", "Write its path without ~.") from error
        if not (path.is_file() or (folders and path.is_dir())):
            kind = "file or folder" if folders else "file"
            raise MissingFileError(
                f"{self.place(name)} must be an existing {kind}, got {self._values[name]!r} (looked for {path}). "
                "Correct the name; relative ones start where this file is."
            )
        return path

    def error(self, name: str, contract: str, remedy: str) -> AssetFormatError:
        """Say what a field must be."""
        found = shown(self._values[name]) if name in self._values else "nothing"
        return AssetFormatError(f"{self.place(name)} must be {contract}, got {found}. {remedy}")


@contextmanager
def placed(where: str, names: Sequence[str]) -> Iterator[None]:
    """Put a place before errors about a field, ``stage.json: assets[1].scale must …``, or about a file's content.

    Args:
        where: ``stage.json: assets[1]``.
        names: The fields there; an error that starts with none of them is put behind a colon.

    Raises:
        AssetFormatError: Instead of any other error of the package but a missing file; those that name the place
            already pass.
    """
    try:
        yield
    except MissingFileError:
        raise
    except BeamError as error:
        text = str(error)
        if text.startswith(where):
            raise
        if text.partition(" ")[0].partition("[")[0].partition(".")[0] in names and not where.endswith(":"):
            text = f"{where}.{text}"
        else:
            text = f"{where} {text}" if where.endswith(":") else f"{where}: {text}"
        raise (type(error) if isinstance(error, AssetFormatError) else AssetFormatError)(text) from error


def _is_number(value: Any) -> bool:
    """Say whether a value is a finite number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False
