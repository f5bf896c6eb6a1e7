"""Where rendered frames go: one image, numbered images or a film; and which of them need not be rendered again.

Beside numbered images lies a log, ``.name#.suffix.frames.jsonl``: a line when a frame is begun and one when it is in
its place, each with the digest of all that decides it. Lines are only appended, so that several runs may fill one
sequence; the last line of a frame counts. A frame is kept if its line says that it is whole, the file has the size that
was written, and its digest is that of what is asked for now. A film's frames are such images in a hidden folder.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beam_warp.errors import BeamError, InvalidOptionError, OutputError

IMAGE_SUFFIXES = (".png", ".exr")
FILM_SUFFIX = ".mp4"

DIGITS = 6
"""Digits of a frame number where the name states none."""

MAX_DIGITS = 12

_FIELD = re.compile(r"%(?:0(\d{1,2}))?d")


@dataclass(frozen=True)
class FramePattern:
    """Names of numbered images.

    Attributes:
        folder: Folder of the images.
        prefix: Name before the number.
        digits: Digits of the number, more where it is larger; 0 for as many as it takes.
        suffix: Name after it, with the kind of image at its end.
    """

    folder: Path
    prefix: str
    digits: int
    suffix: str

    def path(self, number: int) -> Path:
        """Return the file of a frame."""
        return self.folder / f"{self.prefix}{number:0{self.digits}d}{self.suffix}"

    @property
    def log(self) -> Path:
        """The log of these frames."""
        return self.folder / f".{self.prefix}#{self.suffix}.frames.jsonl"

    @property
    def kind(self) -> str:
        """``.png`` or ``.exr``."""
        return Path(self.suffix if "." in self.suffix[1:] else f"x{self.suffix}").suffix.lower()

    def __str__(self) -> str:
        """Return the name as it may be given again."""
        field = f"%0{self.digits}d" if self.digits else "%d"
        return str(self.folder / f"{self.prefix.replace('%', '%%')}{field}{self.suffix.replace('%', '%%')}")


@dataclass(frozen=True)
class Still:
    """One image, at ``path``."""

    path: Path


@dataclass(frozen=True)
class Film:
    """A film, at ``path``; its frames are kept beside it until it is whole."""

    path: Path

    @property
    def work(self) -> FramePattern:
        """Where its frames are."""
        return FramePattern(self.path.with_name(f".{self.path.name}.frames"), "", DIGITS, ".png")

    @property
    def instead(self) -> FramePattern:
        """Where its frames are written if no film can be."""
        return FramePattern(self.path.with_suffix(""), "", DIGITS, ".png")

    def discard_work(self) -> None:
        """Remove the frames that the film was made of."""
        shutil.rmtree(self.work.folder, ignore_errors=True)


Target = Still | FramePattern | Film


def parse_target(out: Path) -> Target:
    """Return what a name asks for: ``x.png``, ``frames/%04d.exr`` or ``x.mp4``.

    Raises:
        InvalidOptionError: The suffix is no such one, or a pattern has not exactly one integer field.
    """
    name = out.name
    suffix = out.suffix.lower()
    if suffix not in (*IMAGE_SUFFIXES, FILM_SUFFIX):
        raise InvalidOptionError(
            f"out must end in {', '.join(IMAGE_SUFFIXES)} or {FILM_SUFFIX}, got {name}. Rename it."
        )
    if "%" not in str(out):
        return Film(out) if suffix == FILM_SUFFIX else Still(out)
    fields = list(_FIELD.finditer(name.replace("%%", "\0\0")))
    rest = _FIELD.sub("", str(out).replace("%%", ""))
    digits = int(fields[0][1] or 0) if len(fields) == 1 else 0
    if len(fields) != 1 or "%" in rest or digits > MAX_DIGITS or suffix == FILM_SUFFIX:
        raise InvalidOptionError(
            f"out must have one integer field in the name of an image, such as frames/%04d.exr, got {out}. "
            "Write a percent sign that is none as %%."
        )
    start, end = fields[0].span()
    return FramePattern(out.parent, name[:start].replace("%%", "%"), digits, name[end:].replace("%%", "%"))


def numbered(still: Still) -> FramePattern:
    """Return the pattern of several images that were given the name of one: ``x.png`` → ``x000012.png``."""
    return FramePattern(still.path.parent, still.path.stem, DIGITS, still.path.suffix)


def require_folder(target: Target) -> None:
    """Refuse an output that cannot be written, before any work is done; make its folder and those above it.

    Raises:
        OutputError: The folder cannot be made or is closed to us, or the name is a folder's.
    """
    folder = target.folder if isinstance(target, FramePattern) else target.path.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"out must be in a folder that exists or can be made, got {folder} ({error.strerror}). Choose another."
        ) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"out must be in a folder that can be written, got {folder}. Choose another.")
    if not isinstance(target, FramePattern) and target.path.is_dir():
        raise OutputError(f"out must be a file, got the folder {target.path}. Name a file in it.")


class FrameLog:
    """Which frames of a pattern are whole, and what they are of."""

    def __init__(self, pattern: FramePattern) -> None:
        """Read the log, if there is one; a line that a crash cut off counts as none.

        Raises:
            OutputError: The log cannot be read.
        """
        self.pattern = pattern
        self._known: dict[int, tuple[str, int | None]] = {}
        try:
            text = pattern.log.read_text(encoding="utf-8", errors="replace") if pattern.log.exists() else ""
        except OSError as error:
            raise _unusable(pattern.log, error) from error
        self._is_cut = bool(text) and not text.endswith("\n")
        for line in text.splitlines():
            entry = _entry(line)
            if entry is not None:
                self._known[entry[0]] = entry[1:]

    def digest(self, number: int) -> str | None:
        """Return what a frame is of, if it is whole and was written by us; else None."""
        digest, size = self._known.get(number, ("", None))
        try:
            return digest if size is not None and self.pattern.path(number).stat().st_size == size else None
        except OSError:
            return None

    def is_begun(self, number: int) -> bool:
        """Say whether the file of a frame, if there is one, is ours to write again: we were at it when we stopped."""
        return number in self._known and self._known[number][1] is None

    def missing(self, numbers: Iterable[int], digest_of: Callable[[int], str], *, overwrite: bool = False) -> list[int]:
        """Return which frames are to be rendered: those that are not there, or are not of what is asked for now.

        Args:
            numbers: Frames that are asked for.
            digest_of: Returns the digest of a frame as it is asked for; called only for frames that are there.
            overwrite: Whether what others are there may be replaced.

        Raises:
            OutputError: Some are there that are of something else, and may not be replaced.
        """
        todo, others = [], []
        for number in numbers:
            kept = self.digest(number)
            if kept is not None and kept == digest_of(number):
                continue
            todo.append(number)
            if self.pattern.path(number).exists() and not self.is_begun(number):
                others.append(number)
        if others and not overwrite:
            raise OutputError(
                f"frames that are there must be of the same render, got {self.pattern.path(others[0])} of another "
                f"input, option or version ({len(others)} in all). Pass --overwrite to render them again, or choose "
                "another name."
            )
        return todo

    def write(self, number: int, digest: str, write: Callable[[Path], None]) -> None:
        """Write a frame: ``write(path)`` must put the whole file in its place or raise.

        Raises:
            OutputError: It, or the log, cannot be written.
        """
        path = self.pattern.path(number)
        self._append(number, digest, None)
        write(path)
        try:
            size = path.stat().st_size
        except OSError as error:
            raise _unusable(path, error) from error
        self._append(number, digest, size)

    def _append(self, number: int, digest: str, size: int | None) -> None:
        line = json.dumps({"frame": number, "digest": digest, "size": size})
        try:
            with self.pattern.log.open("a", encoding="utf-8") as file:
                file.write(f"\n{line}\n" if self._is_cut else f"{line}\n")
        except OSError as error:
            raise _unusable(self.pattern.log, error) from error
        self._is_cut = False
        self._known[number] = (digest, size)


def _entry(line: str) -> tuple[int, str, int | None] | None:
    """Return the entry of a log's line; None if the line is malformed."""
    try:
        entry: Any = json.loads(line)
        number, digest, size = entry["frame"], entry["digest"], entry["size"]
    except (ValueError, KeyError, TypeError):
        return None
    if type(number) is not int or not isinstance(digest, str) or not (size is None or type(size) is int):
        return None
    return number, digest, size


def _unusable(path: Path, error: Exception) -> BeamError:
    reason = getattr(error, "strerror", None) or " ".join(str(error).split())
    return OutputError(f"output must be readable and writable, got {path} ({reason}). Free space or choose another.")
