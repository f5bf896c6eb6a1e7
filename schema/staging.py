"""Outputs that appear complete or not at all: files are written into a hidden folder and renamed at the end."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pxr import Sdf, Tf

from beam_warp.errors import OutputError
from beam_warp.outputs import require_apart, temporary_path
from beam_warp.schema.files import said_by_usd


@contextmanager
def staged_folder(target: Path) -> Iterator[Path]:
    """Make a hidden folder on the target's file system, and remove it at the end in any case.

    Raises:
        OutputError: The target's folder cannot be written, or writing inside the block failed.
    """
    if target.is_dir():
        raise OutputError(f"{target} must be a file, got a folder. Choose another name.")
    try:
        folder = temporary_path(target)
        folder.mkdir()
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
        reason = said_by_usd(error) if isinstance(error, Tf.ErrorException) else error
        raise OutputError(
            f"{target} must be writable, got {reason}. Free space or choose another place; nothing was left behind."
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


def publish_asset(folder: Path, names: list[str], destination: Path) -> list[Path]:
    """Publish an asset in place of an earlier one of its name, and remove layers that this one had and no longer has.

    Raises:
        InvalidOptionError: A file to be replaced is one that is read.
    """
    require_apart(destination / name for name in names)
    stale = [destination / name for name in _layers_of_ours(destination / names[-1]) if name not in names]
    published = publish(folder, names, destination)
    for path in stale:
        with suppress(OSError):
            path.unlink()
    return published


def _layers_of_ours(root: Path) -> list[str]:
    """Return the layers that a text root names as `beam_warp.schema.writer` does, without opening it."""
    named = re.compile(
        rf"@\./({re.escape(root.stem)}\.(?:(?:static|frames|albedo|\d{{6}})\.usdc|(?:manifest|plain)\.usda))@"
    )
    try:
        text = root.read_text(encoding="utf-8") if root.suffix == ".usda" else ""
    except (OSError, UnicodeError):
        return []
    return named.findall(text) if text.startswith("#usda") else []


def _reload_layers(paths: list[Path]) -> None:
    """Reload replaced files in OpenUSD, which shares open layers within a process."""
    replaced = {str(path.resolve()) for path in paths}
    for layer in Sdf.Layer.GetLoadedLayers():
        if layer and not layer.anonymous and layer.realPath.partition("[")[0] in replaced:
            layer.Reload(True)
