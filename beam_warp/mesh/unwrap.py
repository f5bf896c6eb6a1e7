"""Texture coordinates for a mesh: its surface cut into charts and laid out on a square."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import trimesh

from beam_warp.checks import require_count
from beam_warp.errors import InvalidArrayError, MissingPackageError

MAX_FACES = 2**21
"""Most triangles: beyond, cutting charts takes longer than an hour."""


def require_unwrapping() -> Any:
    """Return the package that unwraps.

    Raises:
        MissingPackageError: xatlas is not installed.
    """
    try:
        return import_module("xatlas")
    except ImportError as error:
        raise MissingPackageError(
            "unwrapping must have xatlas, got none installed. Install it with pip install beam-warp[unwrap]."
        ) from error


def unwrapped(mesh: trimesh.Trimesh, *, resolution: int = 1024, padding: int = 2) -> trimesh.Trimesh:
    """Return a mesh with texture coordinates; vertices on seams are there once for each side.

    Faces keep their order and their corners' positions, vertex colours and normals stay with their vertices. Charts
    overlap nowhere. Points on the atlas have v upwards, as in OBJ.

    Args:
        mesh: At least one triangle, at most `MAX_FACES`.
        resolution: Side of the texture that the layout is made for [pixel].
        padding: Distance between charts on it [pixel], so that filtering and nearest texels do not cross over.

    Raises:
        InvalidArrayError: It has no triangle, or too many.
        InvalidOptionError: An option is out of range.
        MissingPackageError: xatlas is not installed.
    """
    xatlas = require_unwrapping()
    require_count("resolution", resolution, 16, 2**14)
    require_count("padding", padding, 0, 64)
    if not 0 < len(mesh.faces) <= MAX_FACES:
        raise InvalidArrayError(
            f"mesh must hold 1 to {MAX_FACES} triangles, got {len(mesh.faces)}. Fuse it with a larger voxel."
        )
    # xatlas compares lengths with absolute thresholds: a mesh of millimetres, or far off, is scaled to a unit box.
    low, size = mesh.bounds[0], float(max(mesh.extents.max(), np.finfo(float).tiny))
    atlas = xatlas.Atlas()
    atlas.add_mesh(((mesh.vertices - low) / size).astype(np.float32), np.asarray(mesh.faces, np.uint32))
    pack = xatlas.PackOptions()
    pack.resolution = resolution
    pack.padding = padding
    atlas.generate(xatlas.ChartOptions(), pack)
    sources, corners, places = atlas[0]
    result = trimesh.Trimesh(
        mesh.vertices[sources],
        corners.astype(np.int64),
        vertex_normals=mesh.vertex_normals[sources],
        visual=trimesh.visual.TextureVisuals(uv=np.asarray(places, np.float64)),
        process=False,
    )
    result.metadata.update(mesh.metadata)
    return result
