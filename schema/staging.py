"""Outputs that appear complete or not at all: files are written into a hidden folder and renamed at the end."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pxr import Sdf, Tf

from beam_warp.errors import OutputError


@contextmanager
def staged_folder(target: Path) -> Iterator[Path]:
    """Make a hidden folder on the target's file system, and remove it at the end in any case.

    Raises:
        OutputError: The target's folder cannot be written, or writing inside the block failed.
    """
    if target.is_dir():
        raise OutputError(f"{target} must be a file, got a folder. Choose another name.")
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{target.stem}.", dir=target.parent))
    except OSError as error:
        raise OutputError(
            f"{target.parent} must be a folder that can be written, got {error.strerror}. "
            "Create it or choose another place."
        ) from error
    try:
        yield folder
    except (Tf.ErrorException, OSError) as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(
            f"{target} must be writable, got {error}. Free space or choose another place; nothing was left behind."
        ) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def publish(folder: Path, names: list[str], destination: Path) -> list[Path]:
    """Move staged files into place in the given order (the root layer last) and return their paths.

    After a failure, the files that this call has added, not replaced, are removed.
    """
    published, fresh = [], []
    try:
        for name in names:
            path = destination / name
            if not path.exists():
                fresh.append(path)
            (folder / name).replace(path)
            published.append(path)
    except BaseException:
        for path in fresh:
            with suppress(OSError):
                path.unlink(missing_ok=True)
        raise
    _reload_layers(published)
    return published


def _reload_layers(paths: list[Path]) -> None:
    """Reload replaced files in OpenUSD, which shares open layers within a process."""
    replaced = {str(path.resolve()) for path in paths}
    for layer in Sdf.Layer.GetLoadedLayers():
        if not layer.anonymous and layer.realPath.partition("[")[0] in replaced:
            layer.Reload(True)
