"""Child process that opens an asset and reads from each of its layers: ``python -m beam_warp.schema.probe ASSET``.

It prints one JSON object, which is empty or has the key ``error``. A corrupt file may end the process instead, which
its parent treats as an error too.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdUtils, Work

from beam_warp.errors import AssetFormatError
from beam_warp.schema import register
from beam_warp.schema.files import SUFFIXES, require_whole_crate, said_by_usd, size_around
from beam_warp.schema.layout import CHANNELS
from beam_warp.schema.stage_queries import clip_sets, splat_prims

MEMORY = 2**30
"""Memory for OpenUSD itself [byte], of which it takes a tenth; a corrupt length that asks for more fails instead."""


def fault(path: Path) -> str | None:
    """Return why an asset cannot be read, or None."""
    try:
        if special := special_file(path):
            return f"{special}, which is no regular file"
        stage = Usd.Stage.Open(str(path), Usd.Stage.LoadAll)
        problems = stage.GetCompositionErrors()
        if problems:
            return str(problems[0])
        prims = splat_prims(stage)
        cut = [path for prim in prims for clips in clip_sets(prim) for path in clips.missing_layers()]
        if cut:
            return f"missing or broken layer {cut[0]}"
        layers, _, missing = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(str(path)))
        if missing:
            return f"missing or broken layer {missing[0]}"
        for layer in layers:
            real = Path(layer.realPath)
            if real.suffix == ".usdc" and real.is_file():
                require_whole_crate(real)
        for prim in prims:
            _touch(prim)
    except AssetFormatError as error:
        return str(error)
    except Tf.ErrorException as error:
        return said_by_usd(error)
    return None


def special_file(path: Path) -> str | None:
    """Return a file below an asset that is none but a pipe, a device or a folder, on which a reader might wait."""
    waiting, seen = [path], {path}
    while waiting:
        try:
            layer = Sdf.Layer.FindOrOpen(str(waiting.pop()))
        except Tf.ErrorException:  # the stage that names it says so
            continue
        if layer is None:
            continue
        named = (name for names in UsdUtils.ExtractExternalReferences(layer.identifier) for name in names)
        for found in {Path(layer.ComputeAbsolutePath(name)) for name in named if name} - seen:
            seen.add(found)
            if found.is_file():
                waiting += [found] if found.suffix.lower() in SUFFIXES else []
            elif found.exists():
                return str(found)
    return None


def _touch(prim: Usd.Prim) -> None:
    """Read every array at the default time, at its first and last sample, and at the start of each value clip."""
    starts = [start for clips in clip_sets(prim) for start, _ in clips.active]
    for channel in CHANNELS.values():
        for usd_name in channel.usd_names:
            attribute = prim.GetAttribute(usd_name)
            samples = attribute.GetTimeSamples() if attribute else []
            for time in {*samples[:1], *samples[-1:], *(starts if samples else ())}:
                attribute.Get(time)
            if attribute:
                attribute.Get()


def limit_memory(path: Path) -> None:
    """Bound the memory of this process by the size of an asset's files, where the platform can.

    OpenUSD works in one thread then: each has memory of its own, and many cores would leave none for files.
    """
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    Work.SetConcurrencyLimit(1)
    limit = MEMORY + 4 * size_around(path)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def main() -> None:
    """Probe the asset named on the command line."""
    path = Path(sys.argv[1])
    limit_memory(path)
    register()
    reason = fault(path)
    print(json.dumps({"error": reason} if reason else {}))


if __name__ == "__main__":
    main()
