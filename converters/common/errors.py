"""Files that cannot be read, and the error of one that breaks its format."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from beam_warp.errors import AssetFormatError, MissingFileError


def malformed(path: Path, contract: str, got: str, remedy: str) -> AssetFormatError:
    """Make the error of a file that breaks its format."""
    return AssetFormatError(f"{path.name}: {contract}, got {got}. {remedy}")


def unreadable(path: Path, error: OSError) -> MissingFileError:
    """Make the error of a file that the system does not let us read."""
    return MissingFileError(f"input must be readable, got {error.strerror} at {path}. Check it.")


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Open a file for reading while the context is.

    Raises:
        MissingFileError: There is no such file, or it cannot be read.
    """
    if not path.is_file():
        raise MissingFileError(f"input must be an existing file, got {path}. Check the path.")
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise unreadable(path, error) from error
