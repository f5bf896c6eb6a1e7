"""Sequences as folders of numbered files: their names and their order."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

from beam_warp.converters.formats import FORMATS, suffix_of
from beam_warp.errors import AssetFormatError, MissingFileError, OutputError

DIGITS = 6
"""Digits of the frame numbers that are written: prefix000000.ply."""

_NUMBERED = re.compile(r"(?P<prefix>.*?)(?P<number>\d+)")


def numbered_path(path: Path, frame: int) -> Path:
    """Return the name of a frame's file: ``out/walk.ply`` → ``out/walk000012.ply``."""
    stem, suffix = _split(path.name)
    return path.with_name(f"{stem}{frame:0{DIGITS}d}{suffix}")


def _split(name: str) -> tuple[str, str]:
    """Split a file name before the suffix that tells its format."""
    place = len(name) - len(suffix_of(name))
    return name[:place], name[place:]


def _frame_of(path: Path) -> re.Match[str] | None:
    """Return prefix and number of a file that holds one frame; None if it is no such file."""
    stem, suffix = _split(path.name)
    holds_a_frame = bool(suffix) and not FORMATS[suffix.lower()].holds_sequences
    return _NUMBERED.fullmatch(stem) if holds_a_frame else None


def numbered_files(folder: Path) -> list[Path]:
    """Return the frames of a folder in the order of their numbers.

    Raises:
        MissingFileError: The folder cannot be listed.
        AssetFormatError: There is no frame, several sequences share the folder, or a number is missing or occurs twice.
    """
    try:
        found = [(match, path) for path in folder.iterdir() if (match := _frame_of(path))]
    except OSError as error:
        raise MissingFileError(f"input folder must be readable, got {error.strerror} at {folder}. Check it.") from error
    if not found:
        raise AssetFormatError(
            f"folder {folder.name} must hold numbered files (walk000000.ply, walk000001.ply, …), got none. "
            "Pass a file, or another folder."
        )
    prefixes = sorted({match["prefix"] for match, _ in found})
    if len(prefixes) > 1:
        named = ", ".join(repr(prefix) for prefix in prefixes[:5])
        raise AssetFormatError(
            f"folder {folder.name} must hold one sequence, got {len(prefixes)} prefixes ({named}). "
            "Move each sequence to its own folder."
        )
    numbers = sorted((int(match["number"]), path) for match, path in found)
    for (number, path), (following, other) in pairwise(numbers):
        if following == number:
            raise AssetFormatError(
                f"folder {folder.name} must hold each frame once, got {path.name} and {other.name}. Remove one."
            )
        if following != number + 1:
            raise AssetFormatError(
                f"folder {folder.name} must hold every frame, got none between {path.name} and {other.name}. "
                "Add the missing frames or renumber the files."
            )
    return [path for _, path in numbers]


def require_no_stale_frames(path: Path, frame_count: int) -> None:
    """Refuse to write a sequence into a folder with later frames of an older one, which would become part of it.

    Raises:
        OutputError: There are such frames.
    """
    stem, suffix = _split(path.name)
    written = re.compile(rf"{re.escape(stem)}(\d{{{DIGITS},}}){re.escape(suffix)}")  # a stem may end in digits
    stale = [
        other.name
        for other in path.parent.iterdir()
        if (match := written.fullmatch(other.name)) and int(match[1]) >= frame_count
    ]
    if stale:
        raise OutputError(
            f"output folder must hold no frames after the last of {frame_count}, got {min(stale)} "
            f"({len(stale)} in all). Delete them or choose another name."
        )
