"""Simple shapes tiled with flat Gaussians: scenes whose surfaces and normals are known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.world.directions import even_directions
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import turns_from_z

TANGENTIAL = 0.65
"""Tangential standard deviation in spacings: neighbours overlap so far that the surface is closed."""

FLATNESS = 0.1
OPACITY = 0.95


@dataclass(frozen=True, eq=False)
class TiledSurface:
    """A surface as evenly spread points, one for each Gaussian that is to tile it.

    Attributes:
        points: Positions [m], ``(N, 3)``.
        normals: Unit normals on the open side, ``(N, 3)``.
        spacing: Root of the area per point [m].
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    spacing: float


def rectangle(
    middle: NDArray[np.float64], side: NDArray[np.float64], up: NDArray[np.float64], spacing: float
) -> TiledSurface:
    """Return a grid over a rectangle whose half-sides are two orthogonal vectors; its normal is side × up."""
    widths = [np.linalg.norm(side), np.linalg.norm(up)]
    counts = [max(1, round(2.0 * width / spacing)) for width in widths]
    u, v = ((np.arange(count) + 0.5) * (2.0 / count) - 1.0 for count in counts)
    grid = u[:, None, None] * side + v[None, :, None] * up
    normal = np.cross(side, up) / (widths[0] * widths[1])
    return TiledSurface(middle + grid.reshape(-1, 3), np.broadcast_to(normal, (grid.size // 3, 3)), spacing)


def sphere_zone(middle: NDArray[np.float64], radius: float, low: float, high: float, spacing: float) -> TiledSurface:
    """Return a spherical Fibonacci set between two heights, in radii over the middle; normals point outwards."""
    normals = even_directions(max(1, round(2.0 * np.pi * radius**2 * (high - low) / spacing**2)), low, high)
    return TiledSurface(middle + radius * normals, normals, spacing)


def tile(surfaces: tuple[TiledSurface, ...]) -> GaussianCloud:
    """Return a cloud with one flat Gaussian on every point, its shortest axis along the normal; it has the normals."""
    normals = np.concatenate([surface.normals for surface in surfaces])
    spacing = np.concatenate([np.full(len(surface.points), surface.spacing) for surface in surfaces])
    return GaussianCloud(
        positions=np.concatenate([surface.points for surface in surfaces]).astype(np.float32),
        orientations=turns_from_z(normals),
        scales=(spacing[:, None] * TANGENTIAL * np.array([1.0, 1.0, FLATNESS])).astype(np.float32),
        opacities=np.full(len(normals), OPACITY),
        normals=normals.astype(np.float32),
    )


def still_life(count: int = 30_000) -> GaussianCloud:
    """Return a wall, a sphere and a bowl on a floor, 2 m wide, of about ``count`` Gaussians, z up."""

    def surfaces(spacing: float) -> tuple[TiledSurface, ...]:
        x, y, z = np.eye(3)
        bowl = sphere_zone(-0.4 * x - 0.3 * y + 0.36 * z, 0.36, -1.0, -0.1, spacing)
        return (
            rectangle(np.zeros(3), x, y, spacing),
            rectangle(y + 0.5 * z, x, 0.5 * z, spacing),
            sphere_zone(0.4 * x + 0.2 * y + 0.4 * z, 0.4, -1.0, 1.0, spacing),
            TiledSurface(bowl.points, -bowl.normals, spacing),
        )

    coarse = 0.05
    area = coarse**2 * sum(len(surface.points) for surface in surfaces(coarse))
    return tile(surfaces(float(np.sqrt(area / count))))
