"""Stress captures of surfaces that images say little about: unlit by shape, mirror-like, or finer than a pixel."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from beam_warp.stability.capture_cases.case import CaptureStress
from beam_warp.stability.capture_cases.studio import StressStudio
from beam_warp.stability.capture_cases.subjects import GREY_ROUGHNESS, plain
from beam_warp.stability.suite import stability_case
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.mesh import MaterialMesh, vertex_normals

POLISH = 0.08
"""Roughness of the figure that is mirror-like."""

STAFF = 0.7
"""Diameter of the staff [pixel]."""

STRANDS, STRAND = 60, 0.25
"""Hairs of the wig, and the diameter of one [pixel]."""

LAYERS_APART = 0.5
"""Distance of the two sheets [pixel]."""

HEAD = (0.0, 0.0, 1.62)
"""Where the hairs begin, about [m]."""

DARK, PALE, BLUE = (0.08, 0.05, 0.03), (0.7, 0.6, 0.45), (0.06, 0.12, 0.5)
"""Base colours of staff and hair, and of the two sheets."""


def pixel(at: StressStudio) -> float:
    """Return about how much of the figure a pixel shows [m]."""
    return float(np.ptp(at.figure.rest.vertices, axis=0).max()) / at.size


def accompanied(at: StressStudio, name: str, *others: MaterialMesh) -> CaptureStress:
    """Return the capture of the figure beside still objects."""
    return CaptureStress(
        capture=at.traced(name, lambda: [reduce(MaterialMesh.beside, others, mesh) for mesh in at.dancing()])
    )


@stability_case(
    "no texture, no shading",
    "light from everywhere hides shape, too: only outlines are left, and what is hollow bulges to the hull",
    "outlines hold the surface",
)
def no_shading(at: StressStudio) -> CaptureStress:
    """The figure in one grey, under light that is the same from everywhere."""
    light = EnvironmentMap.constant((1.0, 1.0, 1.0))
    return CaptureStress(
        capture=at.traced("no texture, no shading", lambda: [plain(mesh) for mesh in at.dancing()], light)
    )


@stability_case(
    "mirror-like",
    "each camera sees other things in the same place: reflections are built behind the surface",
    "outlines hold the surface; no camera is blamed",
)
def mirror_like(at: StressStudio) -> CaptureStress:
    """The figure, polished."""

    def polished() -> list[MaterialMesh]:
        return [replace(mesh, roughness=np.full_like(mesh.roughness, POLISH)) for mesh in at.dancing()]

    return CaptureStress(capture=at.traced("mirror-like", polished))


@stability_case(
    "a staff thinner than a pixel",
    "no pixel is full of it: masks and the hull cut it off",
    "the rest as good as without it",
)
def thin_staff(at: StressStudio) -> CaptureStress:
    """A dark staff stands beside the figure."""
    staff = rod((0.45, -0.3, 0.02), (0.45, -0.3, 1.5), STAFF * pixel(at), DARK)
    return accompanied(at, "a staff thinner than a pixel", staff)


@stability_case(
    "hair", "each strand covers a part of a pixel, and another one in each view", "the rest as good as without it"
)
def hair(at: StressStudio) -> CaptureStress:
    """Strands hang about the figure's head."""
    rng = np.random.default_rng(0)
    thickness = STRAND * pixel(at)
    turns = rng.uniform(0.0, 2.0 * np.pi, STRANDS)
    around = np.stack([np.cos(turns), np.sin(turns), np.zeros(STRANDS)], axis=-1)
    roots = np.asarray(HEAD) + 0.1 * around + rng.uniform(-0.02, 0.1, (STRANDS, 1)) * (0.0, 0.0, 1.0)
    tips = roots + 0.08 * around * rng.uniform(0.5, 1.5, (STRANDS, 1)) - (0.0, 0.0, 0.25)
    strands = [rod(root, tip, thickness, DARK) for root, tip in zip(roots, tips, strict=True)]
    return accompanied(at, "hair", *strands)


@stability_case(
    "two layers closer than a pixel",
    "Gaussians of both sides are one blend: the colour behind shines through",
    "the rest as good as without them",
)
def close_layers(at: StressStudio) -> CaptureStress:
    """Two sheets, pale before blue, stand beside the figure."""
    gap = LAYERS_APART * pixel(at)
    sheets = [sheet(offset * gap, color, 0.1 * gap) for offset, color in ((-0.5, PALE), (0.5, BLUE))]
    return accompanied(at, "two layers closer than a pixel", *sheets)


def rod(start: ArrayLike, end: ArrayLike, thickness: float, color: ArrayLike) -> MaterialMesh:
    """Return a round rod between two points."""
    solid = trimesh.creation.cylinder(thickness / 2.0, segment=np.asarray([start, end]), sections=8)
    return painted(solid, color)


def sheet(place: float, color: ArrayLike, thickness: float) -> MaterialMesh:
    """Return an upright sheet at a distance [m] from where both are."""
    solid = trimesh.creation.box((0.3, thickness, 0.5))
    return painted(solid.apply_translation((0.45, -0.25 + place, 0.6)), color)


def painted(solid: trimesh.Trimesh, color: ArrayLike) -> MaterialMesh:
    """Return a solid in one colour, with the normals of its faces."""
    vertices, faces = solid.triangles.reshape(-1, 3), np.arange(3 * len(solid.faces)).reshape(-1, 3)
    return MaterialMesh(
        vertices=vertices.astype(np.float32),
        faces=faces.astype(np.int32),
        normals=vertex_normals(vertices, faces).astype(np.float32),
        base_color=np.tile(np.asarray(color, np.float32), (len(vertices), 1)),
        roughness=np.full(len(vertices), GREY_ROUGHNESS, np.float32),
    )
