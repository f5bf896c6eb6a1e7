"""Sequences as folders of numbered files: their names and their order."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

from beam_warp.converters.formats import FORMATS, suffix_of
from beam_warp.errors import AssetFormatError, MissingFileError, OutputError

ASSET_NAME = "asset.usda"
"""Name of the asset in a folder that `beam run` wrote."""

SOG_NAMES = ("lod-meta.json", "meta.json")
"""Names of the files that describe a streamed SOG, and the images of a SOG, in a folder."""

DELIVERY_NAME = "manifest.json"
"""Name of the file that describes a take of the container b4d in a folder."""

LCC_SUFFIXES = (".lcc", ".lcc2")
"""Ends of the names of indices that a folder holds once, whatever they are called."""

DIGITS = 6
"""Digits of the frame numbers that are written: prefix000000.ply."""

_NUMBERED = re.compile(r"(?P<prefix>.*?)(?P<number>\d+)")


def numbered_path(path: Path, frame: int) -> Path:
    """Return the name of a frame's file: ``out/walk.ply`` → ``out/walk000012.ply``."""
    stem, suffix = _split(path.name)
    return path.with_name(f"{stem}{frame:0{DIGITS}d}{suffix}")


def _split(name: str) -> tuple[str, str]:
    """Split a file name before the suffix that tells its format."""
    place = len(name) - len(suffix_of(name) or Path(name).suffix)
    return name[:place], name[place:]


def _frame_of(path: Path) -> re.Match[str] | None:
    """Return prefix and number of a file that holds one frame; None if it is no such file."""
    return _NUMBERED.fullmatch(_split(path.name)[0]) if holds_a_frame(path.name) else None


def holds_a_frame(name: str) -> bool:
    """Return True for the name of a file in a format that keeps one frame a file."""
    suffix = suffix_of(name)
    return bool(suffix) and not FORMATS[suffix].holds_sequences


def files_at(path: Path) -> list[Path]:
    """Return the files of Gaussians at a path: the file itself, or of a folder its asset, its SOG or its frames.

    A folder with ``asset.usda`` is that asset, one with ``lod-meta.json`` or ``meta.json`` that SOG, one with
    ``manifest.json`` that b4d, one with a single
    index of LCC that scene, and any other a numbered sequence. This is the only place that decides it.

    Raises:
        MissingFileError: A folder cannot be listed.
        AssetFormatError: A folder holds no Gaussians, or frames that are no sequence.
    """
    if not path.is_dir():
        return [path]
    whole = next((path / name for name in (ASSET_NAME, *SOG_NAMES, DELIVERY_NAME) if (path / name).is_file()), None)
    return [whole] if whole is not None else _files_in(path)


def holds_gaussians(folder: Path) -> bool:
    """Return True if a folder holds an asset, a SOG, or files of Gaussians, whether or not their names are in order."""
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    return any(name == ASSET_NAME or holds_a_frame(name) for name in names)


def _files_in(folder: Path) -> list[Path]:
    """Return the only index of a folder, or its numbered files."""
    try:
        entries = list(folder.iterdir())
    except OSError as error:
        raise MissingFileError(f"input folder must be readable, got {error.strerror} at {folder}. Check it.") from error
    indices = [file for file in entries if suffix_of(file.name) in LCC_SUFFIXES]
    return indices if len(indices) == 1 else in_order(entries, f"folder {folder.name}")


def in_order(files: Iterable[Path], folder: str) -> list[Path]:
    """Return the frames among the files of a folder in the order of their numbers.

    Args:
        files: Names of all its files.
        folder: The folder in words, for errors.

    Raises:
        AssetFormatError: There is no frame, several sequences share the folder, or a number is missing or occurs twice.
    """
    found = [(match, path) for path in files if (match := _frame_of(path))]
    if not found:
        raise AssetFormatError(
            f"{folder} must hold {ASSET_NAME}, {SOG_NAMES[1]} or numbered files (walk000000.ply, walk000001.ply, …), "
            "got none. Pass a file, or another folder."
        )
    prefixes = sorted({match["prefix"] for match, _ in found})
    if len(prefixes) > 1:
        named = ", ".join(repr(prefix) for prefix in prefixes[:5])
        raise AssetFormatError(
            f"{folder} must hold one sequence, got {len(prefixes)} prefixes ({named}). "
            "Move each sequence to its own folder."
        )
    numbers = sorted((int(match["number"]), path) for match, path in found)
    for (number, path), (following, other) in pairwise(numbers):
        if following == number:
            raise AssetFormatError(f"{folder} must hold each frame once, got {path.name} and {other.name}. Remove one.")
        if following != number + 1:
            raise AssetFormatError(
                f"{folder} must hold every frame, got none between {path.name} and {other.name}. "
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
