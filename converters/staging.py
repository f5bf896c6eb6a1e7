"""Check of an output's place before any work; `beam_warp.image.files.replacing` then writes it whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from beam_warp.errors import OutputError


def require_writable(path: Path, *, is_made: bool = False) -> None:
    """Refuse an output whose folder does not exist or cannot be written, before any work is done.

    Args:
        path: The output.
        is_made: Its folder will be made by `folders_made`; the nearest one above it that exists is checked instead.

    Raises:
        OutputError: The folder does not exist or cannot be written, or the path is a folder itself.
    """
    folder = path.parent
    if is_made:
        folder = next((place for place in path.absolute().parents if place.exists()), folder)
    if not folder.is_dir():
        contract, remedy = ("be a folder", "Choose another") if folder.exists() else ("exist", "Create it first")
        raise OutputError(f"output folder must {contract}, got {folder} for {path.name}. {remedy}.")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"output folder must be writable, got {folder}. Choose another or change its permissions.")
    if path.is_dir():
        raise OutputError(f"output must be a file, got the folder {path}. Name a file in it.")


@contextmanager
def folders_made(folder: Path) -> Iterator[None]:
    """Make a folder and those above it; remove those that were made, should the work inside the context fail.

    Raises:
        OutputError: It cannot be made.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"output folder must be made, got {error.strerror} at {folder}. Choose another."
            ) from error
        yield
    except BaseException:
        for place in made:
            with suppress(OSError):  # it was not made, or holds what somebody else has put there
                place.rmdir()
        raise
