"""Reader of LCC2, the scenes of XGRIDS as a tree of regions; the leaves, which hold the finest level, are read.

``.lcc2`` is an index in JSON. Its ``root`` lists files, ``splatFiles``, and has children in ``child``, a list or an
object. A node names runs of Gaussians in ``data.3dgs``: ``name`` is the number of a file, ``start`` and ``count`` are
rows of it. The children of a node together show its region more finely. All files are of the kind ``splatType``; x
points right, y forward and z up, whatever is usual for that kind. The background ``data.env`` of the root is left out.

Source: XGRIDS, "LCC2 Data Organization Format White Paper", version 0.0.3. Names of fields before that version
(``files`` without a suffix), nodes without a count, and commas too many: as SplatTransform reads such files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from beam_warp.converters import formats
from beam_warp.converters.common.frames import DecodedFrame
from beam_warp.converters.common.levels import Index, Runs, joined
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.lcc import ATTRIBUTION, AXES

_KINDS = (".sog", ".spz", ".ply")


def probe(path: Path) -> None:
    """Read the index, and the header of every file that its leaves name.

    Raises:
        MissingFileError, AssetFormatError: A file is missing or malformed.
    """
    for file in _leaves(Index.read(path)):
        formats.probe(file)


def decode(path: Path, options: ReadOptions) -> DecodedFrame:
    """Read the leaves of a scene.

    Args:
        path: The index, whose name ends in ``.lcc2``.
        options: Passed on to the reader of the files.

    Raises:
        MissingFileError, AssetFormatError: A file is missing or malformed; the message names it.
    """
    index = Index.read(path)
    leaves = _leaves(index)
    notes = ["the leaves are read, the finest of its levels"]
    if _data(index, index.content["root"], "env"):
        notes.append("its background, data.env, is left out")
    return joined(
        index,
        leaves,
        lambda file: _without_axes(formats.decode(file, options)),
        format=f"LCC2 of {next(iter(leaves)).suffix} files ({ATTRIBUTION})",
        producer="XGRIDS, by its format",
        axes=AXES,
        notes=notes,
    )


def _without_axes(frame: DecodedFrame) -> DecodedFrame:
    """Leave out what is usual for files of a kind, and what their reader notes of it: the scene has its own axes."""
    notes = tuple(note for note in frame.notes if not note.startswith("axes "))
    return replace(frame, notes=notes, meters_per_unit=1.0)


def _leaves(index: Index) -> dict[Path, Runs]:
    """Return the files of the leaves with the runs of each, in the order of their numbers.

    Raises:
        AssetFormatError: There is no leaf with Gaussians, or a node is malformed.
    """
    root = index.object(index.content.get("root"), "root")
    names = _file_names(index, root)
    found: dict[int, Runs] = {}
    nodes = _children(index, root)
    while nodes:
        node = index.object(nodes.pop(), "a node")
        children = _children(index, node)
        nodes += children
        run = None if children else _data(index, node, "3dgs")
        if run:
            file = index.whole(run.get("name"), "3dgs.name", 0, len(names) - 1)
            first = index.whole(run.get("start", 0), "3dgs.start")
            count = None if run.get("count") is None else index.whole(run["count"], "3dgs.count")
            found.setdefault(file, Runs()).found.append((first, count))
    if not found:
        raise index.error("a leaf must have Gaussians in data.3dgs", "none")
    return {index.beside(names[file]): found[file] for file in sorted(found)}


def _file_names(index: Index, root: Mapping[str, Any]) -> list[str]:
    """Return the paths of all files."""
    kind = index.content.get("splatType", ".sog")
    if kind not in _KINDS:
        raise index.error(f"splatType must be one of {', '.join(_KINDS)}", kind, "Update beam-warp to read it.")
    if "splatFiles" in root:
        names = index.names(root["splatFiles"], "splatFiles")
    else:
        older = index.names(root.get("files"), "splatFiles")
        names = [name.removeprefix("/").removesuffix(".sog") + ".sog" for name in older]
    if wrong := [name for name in names if not name.lower().endswith(kind)]:
        raise index.error(f"splatFiles must end in {kind}, as splatType says", wrong[0])
    return names


def _children(index: Index, node: Mapping[str, Any]) -> list[Any]:
    children = node.get("child")
    if children is None or isinstance(children, list):
        return list(children or ())
    return list(index.object(children, "child").values())


def _data(index: Index, node: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return a part of a node's data; an empty one if there is none."""
    data = index.object(node.get("data") or {}, "data")
    return index.object(data.get(name) or {}, f"data.{name}")
