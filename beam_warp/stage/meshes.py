"""Triangles on a stage: mesh files with a material, a ground under everything, and all of them as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from beam_warp.checks import require_array, require_finite, require_number, require_range
from beam_warp.errors import AssetFormatError, InvalidOptionError
from beam_warp.image.color import srgb_to_linear
from beam_warp.mesh.files import read_mesh
from beam_warp.schema.placement import Placement
from beam_warp.world.mesh import MaterialMesh, vertex_normals
from beam_warp.world.shot import ShotMesh

GREY = (0.5, 0.5, 0.5)
"""Base colour where none is stated."""

ROUGHNESS = 0.6
"""Roughness where none is stated."""

NO_AREA = 1e-30
"""Twice the area below which a triangle has no normal [m^2]."""

Color = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Ground:
    """A level square under the assets.

    Attributes:
        size: Side of the square [m].
        height: Height of the plane [m]; ``auto`` is the lowest point of the assets' bulk.
        center: Middle of the square, x and y [m]; ``auto`` is below the middle of the assets.
        base_color: Scene-linear Rec.709 in [0, 1].
        roughness: GGX roughness in [0, 1].
        catches_shadows: Whether only the shadows on it are seen.

    Raises:
        InvalidArrayError: The colour or centre is malformed.
        InvalidOptionError: A number is out of range.
    """

    size: float = 6.0
    height: float | Literal["auto"] = "auto"
    center: tuple[float, float] | Literal["auto"] = "auto"
    base_color: Color = GREY
    roughness: float = ROUGHNESS
    catches_shadows: bool = False

    def __post_init__(self) -> None:
        """Check every field once."""
        object.__setattr__(self, "size", require_number("size", self.size, 1e-3, 1e6))
        if self.height != "auto":
            object.__setattr__(self, "height", _number_or_auto("height", self.height))
        if self.center != "auto":
            center = require_array("center", self.center, (2,), np.float64)
            require_finite("center", center)
            object.__setattr__(self, "center", tuple(center.tolist()))
        object.__setattr__(self, "base_color", _require_color(self.base_color))
        object.__setattr__(self, "roughness", require_number("roughness", self.roughness, 0.0, 1.0))

    def mesh(self, subject: NDArray[np.float64]) -> ShotMesh:
        """Return its triangles under points ``(N, 3)`` that bound the assets [m]."""
        low, high = (subject.min(axis=0), subject.max(axis=0)) if len(subject) else (np.zeros(3), np.zeros(3))
        height = float(low[2]) if self.height == "auto" else self.height
        x, y = 0.5 * (low + high)[:2] if self.center == "auto" else self.center
        half = 0.5 * self.size
        corners = [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]
        surface = MaterialMesh(
            vertices=np.array([(*corner, height) for corner in corners], np.float32),
            faces=np.array([(0, 1, 2), (0, 2, 3)], np.int32),
            normals=np.tile(np.array((0, 0, 1), np.float32), (4, 1)),
            base_color=np.tile(np.array(self.base_color, np.float32), (4, 1)),
            roughness=np.full(4, self.roughness, np.float32),
        )
        return ShotMesh(surface=surface, catches_shadows=np.full(2, self.catches_shadows))


def read_stage_mesh(
    path: Path,
    *,
    placement: Placement,
    base_color: Color | None = None,
    roughness: float = ROUGHNESS,
    catches_shadows: bool = False,
    smooth: bool = True,
) -> tuple[ShotMesh, tuple[str, ...]]:
    """Read a mesh file, put it in its place and give it a material.

    Args:
        path: Any format of trimesh; in the world's axes (z up) and metres, but for glTF, which is turned.
        placement: Placement of the mesh in the world.
        base_color: Scene-linear Rec.709 in [0, 1]; without, the file's colours at its vertices: those of glTF are
            linear, others are taken as sRGB; a texture is looked up at the vertices. Without those, grey.
        roughness: GGX roughness in [0, 1].
        catches_shadows: Whether only the shadows on it are seen.
        smooth: Whether normals are those of the file, or smooth over edges where it has none; else triangles are flat.

    Returns:
        The triangles, and what had to be assumed.

    Raises:
        MissingFileError, AssetFormatError: The file cannot be read, or holds no triangle with an area.
        InvalidArrayError: The colour is malformed.
        InvalidOptionError: The roughness is out of range.
    """
    require_number("roughness", roughness, 0.0, 1.0)
    stated = None if base_color is None else _require_color(base_color)
    mesh = read_mesh(path)
    colors, notes = (
        _colors(mesh, path) if stated is None else (np.tile(np.array(stated, np.float32), (len(mesh.vertices), 1)), ())
    )
    local = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int64)
    normals = np.asarray(mesh.vertex_normals, np.float64) if smooth and "vertex_normals" in mesh._cache else None
    vertices = placement.scale * (local @ placement.orthogonal.T) + placement.translation
    if not np.isfinite(vertices).all():
        raise AssetFormatError(f"mesh must have finite vertices, got NaN or infinity in {path}. Export it again.")
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    faces = faces[area > NO_AREA]
    if not len(faces):
        raise AssetFormatError(f"mesh must hold a triangle with an area, got none in {path}. Export it again.")
    if smooth:
        used, flat = np.unique(faces, return_inverse=True)
    else:
        used, flat = faces.ravel(), np.arange(faces.size)
    faces = flat.reshape(faces.shape)
    if normals is not None:
        turned = normals[used] @ placement.orthogonal.T
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        normals = turned / length if (length > 1e-6).all() else None
    if normals is None:
        normals = vertex_normals(vertices[used], faces)
    surface = MaterialMesh(
        vertices=vertices[used].astype(np.float32),
        faces=faces.astype(np.int32),
        normals=normals.astype(np.float32),
        base_color=colors[used],
        roughness=np.full(len(used), roughness, np.float32),
    )
    return ShotMesh(surface=surface, catches_shadows=np.full(len(faces), catches_shadows)), notes


def joined_meshes(meshes: Sequence[ShotMesh]) -> ShotMesh | None:
    """Return all triangles as one mesh, None if there are none."""
    if len(meshes) <= 1:
        return meshes[0] if meshes else None
    surfaces = [mesh.surface for mesh in meshes]
    offsets = np.cumsum([0, *(len(surface.vertices) for surface in surfaces[:-1])])
    together: dict[str, Any] = {
        name: np.concatenate([getattr(surface, name) for surface in surfaces])
        for name in ("vertices", "normals", "base_color", "roughness")
    }
    faces = [surface.faces + np.int32(offset) for surface, offset in zip(surfaces, offsets, strict=True)]
    return ShotMesh(
        surface=MaterialMesh(faces=np.concatenate(faces), **together),
        catches_shadows=np.concatenate([mesh.catches_shadows for mesh in meshes]),
    )


def _colors(mesh: trimesh.Trimesh, path: Path) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Return the base colour of every vertex as the file has it, and what was assumed of it."""
    visual: Any = mesh.visual
    is_gltf = path.suffix.lower() in (".glb", ".gltf")
    count = len(mesh.vertices)
    if visual.kind in ("vertex", "face"):
        display = np.asarray(visual.vertex_colors)[:, :3] / 255.0
        if is_gltf:
            return display.astype(np.float32), ()
        return srgb_to_linear(display).astype(np.float32), (f"{path.name}: colours of vertices are taken as sRGB",)
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if visual.kind == "texture" and image is not None and getattr(visual, "uv", None) is not None:
        display = np.asarray(visual.to_color().vertex_colors)[:, :3] / 255.0
        if len(display) == count:
            note = f"{path.name}: its texture is taken as sRGB and looked up at the vertices only"
            return srgb_to_linear(display).astype(np.float32), (note,)
    factor = getattr(material, "baseColorFactor", None) if is_gltf else None
    if factor is not None:
        color = np.asarray(factor, np.float64)[:3] / 255.0  # trimesh keeps the linear factor in bytes
        return np.tile(color.astype(np.float32), (count, 1)), ()
    grey = np.tile(np.array(GREY, np.float32), (count, 1))
    return grey, (f"{path.name}: has no colours; its base colour is taken as {GREY[0]:g}",)


def _require_color(value: object) -> Color:
    """Return a base colour."""
    color = require_array("base_color", value, (3,), np.float64)  # type: ignore[arg-type]
    require_range("base_color", color, 0.0, 1.0, "State scene-linear reflectances.")
    return tuple(color.tolist())  # type: ignore[return-value]


def _number_or_auto(name: str, value: object) -> float:
    """Return a finite number, in words that name the other choice."""
    try:
        return require_number(name, value, -1e9, 1e9)  # type: ignore[arg-type]
    except InvalidOptionError as error:
        raise InvalidOptionError(f'{name} must be "auto" or a number [m], got {value!r}. Write one of them.') from error
