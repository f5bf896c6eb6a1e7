"""Files that a USD stage consists of."""

from __future__ import annotations

from pathlib import Path

from pxr import Sdf, Tf, UsdUtils

from beam_warp.errors import AssetFormatError


def layer_files(path: Path) -> list[Path]:
    """Return the files of all layers of a stage, including value clips, with the stage's own file first.

    Raises:
        AssetFormatError: OpenUSD cannot open the stage, or a layer is missing.
    """
    try:
        layers, _, missing = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(str(path)))
    except Tf.ErrorException as error:
        raise AssetFormatError(f"{path} must open in OpenUSD, got {error}. Export the file again.") from error
    if missing:
        raise AssetFormatError(f"{path} must have all its layers, got none at {missing[0]}. Copy it with them.")
    files = {Path(layer.realPath) for layer in layers if layer.realPath and Path(layer.realPath).is_file()}
    return [path, *sorted(files - {path, path.absolute(), path.resolve()})]
