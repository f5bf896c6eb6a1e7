"""Mending of an asset in place: what can be mended safely, and what is left to a person.

`mend` runs ``python -m beam_warp.schema.validation.mending ASSET FOLDER`` as a child process, which a corrupt file may
end. The child writes the layers that it has changed to the folder. They replace those of the asset once the child has
ended.
"""

from __future__ import annotations

import json
import shutil
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

from pxr import Sdf, Tf, Usd

from beam_warp.checks import require_path
from beam_warp.errors import AssetFormatError, OutputError
from beam_warp.schema import register
from beam_warp.schema.files import require_asset_file, run_child, said_by_usd
from beam_warp.schema.staging import publish, staged_folder
from beam_warp.schema.validation.mends import MENDS
from beam_warp.schema.validation.report import BrokenRule, Report
from beam_warp.schema.validation.validator import check_rules, time_limit, validate_stage

MOST_ROUNDS = 8
"""Rounds of checks and mends at most: each one mends at least one rule that the one before has uncovered."""

UNPACKED = "unpacked"
"""Folder of the layers of a package, in the folder of what is written."""


def mend(path: str | Path) -> Report:
    """Mend an asset in place as far as that is safe, and check the result; see `beam_warp.schema.validation.mends`.

    Only layers in the folder of the asset, or inside the package, are changed. An asset that has been mended is not
    changed by another call.

    Args:
        path: A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.

    Returns:
        The report of the asset as it is now, with what was mended.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: The file cannot be opened at all.
        OutputError: A layer cannot be written. The asset is as before.
    """
    source = require_asset_file(require_path("path", path).resolve())
    with staged_folder(source) as folder:
        answer = run_child("beam_warp.schema.validation.mending", source, 4.0 * time_limit(source), str(folder))
        if "error" in answer:
            reason = answer["error"]
            raise AssetFormatError(f"{source} must open in OpenUSD, got {reason}. Export or copy the file again.")
        names = answer["layers"]
        assert isinstance(names, list)
        for name in names:
            shutil.copymode(source.parent / name, folder / name)
        publish(folder, names, source.parent)
    report = answer["report"]
    assert isinstance(report, dict)
    return Report.from_dict(report)


def mend_stage(stage: Usd.Stage) -> Report:
    """Mend the layers of a stage in memory, and check the result; what has been changed is not saved."""
    register()
    broken: dict[tuple[str, str, str], BrokenRule] = {}
    for _ in range(MOST_ROUNDS):
        found = {_key(finding): finding for finding in check_rules(stage).findings if finding.rule in MENDS}
        if not found.keys() - broken.keys():
            break
        broken |= found
        for finding in found.values():
            MENDS[finding.rule](stage.GetPrimAtPath(finding.prim), finding.attribute)
    report = validate_stage(stage)
    left = {_key(finding) for finding in report.findings}
    return replace(report, mended=tuple(finding for key, finding in sorted(broken.items()) if key not in left))


def _key(finding: BrokenRule) -> tuple[str, str, str]:
    return finding.rule, finding.prim, finding.attribute


def _mend_into(source: Path, folder: Path) -> tuple[Report, list[str]]:
    """Mend an asset; return the report and the files written to a folder, named as in that of the asset."""
    if source.suffix.lower() != ".usdz":
        stage = Usd.Stage.Open(str(source), Usd.Stage.LoadAll)
        report = mend_stage(stage)
        return report, _export(stage, folder) if report.mended else []
    unpacked = folder / UNPACKED
    with zipfile.ZipFile(source) as package:  # require_asset_file has refused names outside the package
        names = package.namelist()
        package.extractall(unpacked)
    stage = Usd.Stage.Open(str(unpacked / names[0]), Usd.Stage.LoadAll)
    report = replace(mend_stage(stage), path=str(source))
    if not report.mended:
        return report, []
    for layer in _changed(stage):
        _require_written(layer.Save(), layer.GetDisplayName())
    writer = Sdf.ZipFileWriter.CreateNew(str(folder / source.name))
    for name in names:
        writer.AddFile(str(unpacked / name), name)
    _require_written(writer.Save(), source.name)
    return report, [source.name]


def _export(stage: Usd.Stage, folder: Path) -> list[str]:
    """Write the layers that have changed to a folder, the root layer last, and return their names."""
    home, names = Path(stage.GetRootLayer().realPath).parent, []
    for layer in _changed(stage):
        name = Path(layer.realPath).relative_to(home)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        form = str(Sdf.UsdFileFormat.GetUnderlyingFormatForLayer(layer))
        _require_written(layer.Export(str(folder / name), args={"format": form}), str(name))
        names.append(name.as_posix())
    return names


def _changed(stage: Usd.Stage) -> list[Sdf.Layer]:
    """Return the layers that have changed, the root layer last."""
    root = stage.GetRootLayer()
    return sorted((layer for layer in stage.GetUsedLayers() if layer.dirty), key=lambda layer: layer == root)


def _require_written(written: bool, name: str) -> None:
    if not written:
        raise OutputError(f"{name} must be writable, got a failed save. Free space or choose another place.")


def main() -> None:
    """Mend the asset named on the command line; print the report and the layers written, or why there are none."""
    register()
    try:
        report, layers = _mend_into(Path(sys.argv[1]), Path(sys.argv[2]))
    except (Tf.ErrorException, OutputError) as error:
        reason = said_by_usd(error) if isinstance(error, Tf.ErrorException) else str(error)
        print(json.dumps({"error": reason}))
        return
    print(json.dumps({"report": report.as_dict(), "layers": layers}, allow_nan=False))


if __name__ == "__main__":
    main()
