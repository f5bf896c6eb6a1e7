"""Check of an output's place before any work; `beam_warp.image.files.replacing` then writes it whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from beam_warp.errors import OutputError


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
