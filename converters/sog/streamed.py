"""Reader of streamed SOG, the scenes of PlayCanvas with levels of detail; level 0, the finest, is read.

``lod-meta.json`` lists SOGs in ``filenames`` and has a binary ``tree``, whose nodes have either two ``children`` or
``lods``: for each level, as text, the number of a file, and the first row and the number of rows of one run in it.

Source: PlayCanvas user manual, "The Streamed SOG Format", version 1, and the files before it that state no version.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from beam_warp.converters.common.frames import DecodedFrame
from beam_warp.converters.common.levels import Index, Runs, joined
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.sog import reader

_MOST_LEVELS = 64


def probe(path: Path) -> None:
    """Read the index, and the headers of all files of the finest level.

    Raises:
        MissingFileError, AssetFormatError: A file is missing or malformed.
    """
    for file in _finest(Index.read(path)):
        reader.probe(file)


def decode(path: Path, options: ReadOptions) -> DecodedFrame:
    """Read the finest level of a scene.

    Args:
        path: The index, which is named ``lod-meta.json``.
        options: Passed on to the reader of SOG.

    Raises:
        MissingFileError, AssetFormatError: A file is missing or malformed; the message names it.
    """
    index = Index.read(path)
    runs = _finest(index)
    levels = index.whole(index.content["lodLevels"], "lodLevels", 1, _MOST_LEVELS)
    notes = [f"level 0, the finest of {levels}, is read"] if levels > 1 else []
    if index.content.get("environment") is not None:
        notes.append("environment, its background, is left out")
    decoded = joined(
        index,
        runs,
        lambda file: reader.decode(file, options),
        format=f"streamed SOG, {len(runs)} files at level 0",
        notes=notes,
    )
    counts, found = index.content.get("counts"), len(decoded.fields["positions"])
    if counts is not None and (not isinstance(counts, list) or counts[:1] != [found]):
        raise index.error(f"counts must say that level 0 has {found} Gaussians", counts)
    return decoded


def _finest(index: Index) -> dict[Path, Runs]:
    """Return the files of level 0 with the runs of each, in the order of their numbers."""
    content = index.content
    if content.get("version", 1) != 1 or isinstance(content.get("version"), bool):
        raise index.error("version must be 1", content["version"], "Update beam-warp to read it.")
    index.whole(content.get("lodLevels"), "lodLevels", 1, _MOST_LEVELS)
    names = index.names(content.get("filenames"), "filenames")
    found: dict[int, Runs] = {}
    nodes = [index.object(content.get("tree"), "tree")]
    while nodes:
        node = nodes.pop()
        nodes += _children(index, node)
        lod = index.object(node.get("lods") or {}, "lods").get("0")
        if lod is not None:
            file, first, count = _run(index, index.object(lod, "a level"), len(names))
            found.setdefault(file, Runs()).found.append((first, count))
    if not found:
        raise index.error("a leaf must have level 0", "none")
    return {index.beside(names[file]): found[file] for file in sorted(found)}


def _children(index: Index, node: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    children = node.get("children") or []
    if isinstance(children, list):
        return [index.object(child, "a node") for child in children]
    raise index.error("children must be a list", children)


def _run(index: Index, lod: Mapping[str, Any], files: int) -> tuple[int, int, int]:
    return (
        index.whole(lod.get("file"), "file", 0, files - 1),
        index.whole(lod.get("offset"), "offset"),
        index.whole(lod.get("count"), "count"),
    )
