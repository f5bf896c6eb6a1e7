"""Outputs that appear complete or not at all: written under a temporary name beside their place, then renamed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from beam_warp.errors import BeamError, OutputError


def require_writable(path: Path) -> None:
    """Refuse an output whose folder does not exist or cannot be written, before any work is done.

    Raises:
        OutputError: The folder does not exist or cannot be written, or the path is a folder itself.
    """
    folder = path.parent
    if not folder.is_dir():
        raise OutputError(f"output folder must exist, got {folder} for {path.name}. Create it first.")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"output folder must be writable, got {folder}. Choose another or change its permissions.")
    if path.is_dir():
        raise OutputError(f"output must be a file, got the folder {path}. Name a file in it.")


class Staging:
    """Temporary names of the outputs of one call."""

    def __init__(self) -> None:
        """Start with no outputs."""
        self.names: dict[Path, Path] = {}

    def path_for(self, final: Path) -> Path:
        """Return the temporary path of an output."""
        self.names[final] = final.with_name(f".{final.name}.{os.getpid()}.part")
        return self.names[final]


@contextmanager
def staged_outputs() -> Iterator[Staging]:
    """Put all outputs in place once the block has ended without an error.

    Raises:
        OutputError: The file system reported an error; all temporary files have been removed.
    """
    staging = Staging()
    try:
        yield staging
        for final, temporary in staging.names.items():
            temporary.replace(final)
    except OSError as error:
        if isinstance(error, BeamError):
            raise
        place = next(reversed(staging.names)).parent if staging.names else "the output"
        raise OutputError(
            f"output must be writable, got {error.strerror or error} at {place}. Free space or choose another folder."
        ) from error
    finally:
        for temporary in staging.names.values():
            temporary.unlink(missing_ok=True)
