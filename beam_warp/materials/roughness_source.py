"""Stated roughness: a constant, or a texture on a mesh whose nearest valid texel each Gaussian takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from beam_warp.checks import require_number
from beam_warp.errors import AssetFormatError, MissingFileError
from beam_warp.image.files import read_image
from beam_warp.world.gaussians import GaussianCloud

if TYPE_CHECKING:
    import trimesh

MAX_TEXELS = 1 << 26
"""Largest texture, in texels, that is projected: 8192 x 8192."""


@dataclass(frozen=True)
class RoughnessTexture:
    """A roughness texture and the mesh whose texture coordinates it follows, in the axes and units of the input.

    Raises:
        MissingFileError: One of the files is not there.
    """

    texture: Path
    mesh: Path

    def __post_init__(self) -> None:
        """Look for both files before any work."""
        for path in (self.texture, self.mesh):
            if not path.is_file():
                raise MissingFileError(f"roughness texture and mesh must be files, got {path}. Check the path.")


def stated_roughness(cloud: GaussianCloud, source: float | RoughnessTexture) -> NDArray[np.float32]:
    """Return the perceptual roughness that a constant or a texture states for every Gaussian, ``(N,)`` float32.

    Args:
        cloud: Gaussians, in the axes and units of a texture's mesh.
        source: A constant in [0, 1], or a texture.

    Raises:
        BeamError: As `textured_roughness`, or the constant is out of range.
    """
    if isinstance(source, RoughnessTexture):
        return textured_roughness(cloud, source.texture, source.mesh)
    return np.full(len(cloud), require_number("roughness", source, 0.0, 1.0), np.float32)


def texel_positions(mesh: trimesh.Trimesh, height: int, width: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return where on a mesh the texels of its texture lie.

    Args:
        mesh: With texture coordinates, v upwards.
        height: Texture height [pixel].
        width: Texture width [pixel].

    Returns:
        World positions of the valid texels ``(M, 3)`` and their flat, row-major indices ``(M,)``. A texel is valid if
        its centre lies in a triangle of the chart, edges included.
    """
    uv = np.asarray(mesh.visual.uv, dtype=np.float64)[mesh.faces]  # type: ignore[union-attr]
    corners = np.stack([uv[..., 0] * width, (1.0 - uv[..., 1]) * height], axis=-1) - 0.5
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    positions, indices = [], []
    for pixels, world in zip(corners, triangles, strict=True):
        low = np.maximum(np.ceil(pixels.min(axis=0)), 0).astype(int)
        high = np.minimum(np.floor(pixels.max(axis=0)), (width - 1, height - 1)).astype(int)
        edges = np.stack([pixels[1] - pixels[0], pixels[2] - pixels[0]], axis=1)
        if (high < low).any() or not abs(np.linalg.det(edges)) > 1e-12:
            continue
        x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        x, y = x.ravel(), y.ravel()
        b, c = np.linalg.solve(edges, np.stack([x, y]) - pixels[0][:, None])
        inside = (b >= -1e-9) & (c >= -1e-9) & (b + c <= 1.0 + 1e-9)
        weights = np.stack([1.0 - b - c, b, c], axis=1)[inside]
        positions.append(weights @ world)
        indices.append(y[inside] * width + x[inside])
    if not positions:
        return np.zeros((0, 3)), np.zeros(0, np.int64)
    return np.concatenate(positions), np.concatenate(indices)


def textured_roughness(cloud: GaussianCloud, texture: Path, mesh: Path) -> NDArray[np.float32]:
    """Give each Gaussian the roughness of the nearest valid texel of a texture on a mesh.

    Args:
        cloud: Gaussians, in the same axes and units as the mesh.
        texture: Image whose first channel is perceptual roughness in [0, 1], stored linearly.
        mesh: Mesh with texture coordinates in any format of trimesh; glTF's axes are turned to the world's.

    Returns:
        ``(N,)`` float32.

    Raises:
        MissingFileError: A file is not there.
        AssetFormatError: The mesh has no texture coordinates, no texel is valid, or a value is outside [0, 1].

    Source: BEAM §3.2, "each valid pixel of the texture is mapped back to the world …".
    """
    from beam_warp.mesh.files import read_mesh  # with trimesh

    if not mesh.is_file():
        raise MissingFileError(f"roughness mesh must be an existing file, got {mesh}. Check the path.")
    image = read_image(texture)
    values = np.asarray(image.rgb()[..., 0], dtype=np.float64)
    if not ((values >= 0.0) & (values <= 1.0)).all():
        raise AssetFormatError(
            f"roughness texture must hold values in [0, 1], got {values.min():g} to {values.max():g} in {texture}. "
            "Save perceptual roughness linearly."
        )
    if values.size > MAX_TEXELS:
        raise AssetFormatError(
            f"roughness texture must have at most {MAX_TEXELS} texels, got {values.size} in {texture}. Reduce it."
        )
    loaded = read_mesh(mesh)
    if getattr(loaded.visual, "uv", None) is None:
        raise AssetFormatError(
            f"roughness mesh must have texture coordinates, got none in {mesh}. Unwrap it before baking."
        )
    positions, indices = texel_positions(loaded, values.shape[0], values.shape[1])
    if len(positions) == 0:
        raise AssetFormatError(f"roughness mesh must cover texels of its texture, got none in {mesh}. Check its UVs.")
    nearest = cKDTree(positions).query(cloud.positions, workers=-1)[1]
    return values.ravel()[indices[nearest]].astype(np.float32)
