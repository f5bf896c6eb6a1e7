"""Meshes on disk: PLY, OBJ and GLB, in the package's world on both sides.

PLY and OBJ state no axes; they are written and read as the mesh is, in the world's (z up, see `beam_warp.world.axes`).
glTF fixes its own: y up, -z forward. A GLB is turned by a quarter about x when it is written, and back when it is read.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from beam_warp.checks import require_path
from beam_warp.errors import AssetFormatError, InvalidArrayError, InvalidOptionError, MissingFileError
from beam_warp.image.files import replacing

SUFFIXES = (".ply", ".obj", ".glb")

TO_GLTF: NDArray[np.float64] = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""World to glTF: x stays right, z, up, becomes y, and y, forward, becomes -z."""


def write_mesh(mesh: trimesh.Trimesh, path: str | os.PathLike[str]) -> None:
    """Write a mesh with its vertex normals, and its vertex colours or texture coordinates if it has them, in one step.

    Args:
        mesh: At least one triangle, in the world's axes [m].
        path: ``.ply``, ``.obj`` or ``.glb``. An OBJ names no material.

    Raises:
        InvalidArrayError: The mesh has no triangle.
        InvalidOptionError: The suffix is another one.
        OutputError: The file cannot be written; nothing is left behind.
    """
    target = require_path("path", path)
    suffix = target.suffix.lower()
    if suffix not in SUFFIXES:
        raise InvalidOptionError(f"mesh must end in one of {', '.join(SUFFIXES)}, got {target.name}. Rename it.")
    if not len(mesh.faces):
        raise InvalidArrayError("mesh must hold at least one triangle, got none. Write one with a surface.")
    content = _content(mesh, suffix)
    with replacing(target) as temporary:
        temporary.write_bytes(content)


def read_mesh(path: str | os.PathLike[str]) -> trimesh.Trimesh:
    """Read a mesh, all parts of the file as one, vertices as they are listed there.

    Args:
        path: Any format of trimesh; ``.glb`` and ``.gltf`` are turned from y up to the world's axes.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: It cannot be read, or holds no triangle.
    """
    source = require_path("path", path)
    if not source.is_file():
        raise MissingFileError(f"mesh must be an existing file, got {source}. Check the path.")
    try:
        loaded: Any = trimesh.load(source, force="mesh", process=False, maintain_order=True)
        triangles = len(loaded.faces)
    except Exception as error:  # every format fails in its own way
        reason = " ".join(str(error).split())
        raise AssetFormatError(f"mesh must be readable, got {reason} in {source}. Export it again.") from error
    if not triangles:
        raise AssetFormatError(f"mesh must hold triangles, got none in {source}. Export it again.")
    if source.suffix.lower() in (".glb", ".gltf"):
        loaded.apply_transform(TO_GLTF.T)
    return loaded


def _content(mesh: trimesh.Trimesh, suffix: str) -> bytes:
    """Return the bytes of a file."""
    if suffix == ".glb":
        turned = mesh.copy()
        turned.metadata.clear()  # would be stored as extras
        turned.apply_transform(TO_GLTF)
        return bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(turned), include_normals=True))
    if suffix == ".ply":
        return bytes(trimesh.exchange.ply.export_ply(mesh, vertex_normal=True))
    text = trimesh.exchange.obj.export_obj(
        mesh, include_normals=True, include_texture=True, write_texture=False, header="axes: world, z up; unit: metre"
    )
    # Without its image there is no material file to name.
    lines = text if isinstance(text, str) else text[0]
    kept = [line for line in lines.splitlines() if not line.startswith(("mtllib ", "usemtl "))]
    return ("\n".join(kept) + "\n").encode()
