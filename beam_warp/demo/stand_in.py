"""Stand-ins for trained Gaussians: what a training on photographs of a mesh would leave, with its usual errors."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from beam_warp.image.color import DISPLAY_SRGB, linear_to_srgb
from beam_warp.trace.mesh_paths import TracedMesh, outgoing_radiance
from beam_warp.world.directions import even_directions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import sh_basis
from beam_warp.world.mesh import MaterialMesh

TANGENTIAL_DEVIATION = 0.7
"""Deviation of a Gaussian along the surface, in spacings: neighbours overlap so that composited alpha is above 0.99."""

FLATNESS = 0.12
"""Deviation across the surface over that along it."""

NORMAL_NOISE = 0.05
"""Standard deviation of the tilt of a Gaussian, per axis [rad]: 2.9 degrees, what a good training leaves."""

POSITION_NOISE = 0.3
"""Standard deviation of a Gaussian's distance from the surface, in deviations across the surface."""

OPACITY = (0.94, 0.99)
SH_DEGREE = 2
DIRECTION_COUNT = 12
PATHS_PER_DIRECTION = 12
SH_RIDGE = 0.03
"""Weight that keeps bands above 0 small, against one direction's residual: half of the sphere is never seen."""


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points that stay with a moving surface, and the random errors that stay with each point."""

    faces: NDArray[np.int64]
    weights: NDArray[np.float64]
    spacing: float
    turn: NDArray[np.float64]
    tilt: NDArray[np.float64]
    lift: NDArray[np.float64]
    opacities: NDArray[np.float64]


def sample_surface(mesh: MaterialMesh, count: int, rng: np.random.Generator) -> SurfaceSamples:
    """Spread points evenly by dart throwing, which leaves a little fewer than asked for."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    spacing = float(np.sqrt(shape.area / count))
    # Three quarters of the darts stay; the library's warning about that is not for our users.
    logging.getLogger("trimesh").setLevel(logging.ERROR)
    points, faces = trimesh.sample.sample_surface_even(
        shape, round(count / 0.76), radius=0.63 * spacing, seed=int(rng.integers(2**31))
    )
    weights = np.clip(trimesh.triangles.points_to_barycentric(shape.triangles[faces], points), 0.0, 1.0)
    weights /= weights.sum(axis=1, keepdims=True)
    kept = len(points)
    return SurfaceSamples(
        np.asarray(faces),
        weights,
        float(np.sqrt(shape.area / kept)),
        rng.uniform(0.0, 2.0 * np.pi, kept),
        rng.normal(0.0, NORMAL_NOISE, (kept, 2)),
        rng.normal(0.0, POSITION_NOISE, kept),
        rng.uniform(*OPACITY, kept),
    )


def trained_gaussians(
    mesh: MaterialMesh, traced: TracedMesh, samples: SurfaceSamples, light: EnvironmentMap, seed: int
) -> GaussianCloud:
    """Return Gaussians as a training would leave them: places with noise, and the radiance that leaves the surface."""
    points = mesh.interpolate(mesh.vertices, samples.faces, samples.weights)
    normals = mesh.interpolate(mesh.normals, samples.faces, samples.weights)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sigma = TANGENTIAL_DEVIATION * samples.spacing
    axes = tangent_frames(normals, samples.turn, samples.tilt)
    count = len(points)
    outward = _seen_directions(normals)
    radiance = outgoing_radiance(
        traced, samples.faces, samples.weights, outward, light, sample_count=PATHS_PER_DIRECTION, seed=seed
    )
    return GaussianCloud(
        positions=points + normals * (samples.lift * FLATNESS * sigma)[:, None],
        orientations=Rotation.from_matrix(axes).as_quat().astype(np.float32),
        scales=np.tile([sigma, sigma, FLATNESS * sigma], (count, 1)),
        opacities=samples.opacities.astype(np.float32),
        radiance=_fit_harmonics(linear_to_srgb(np.clip(radiance, 0.0, 1.0)), -outward).astype(np.float32),
        radiance_color_space=DISPLAY_SRGB,
        ids=np.arange(count),
    )


def tangent_frames(
    normals: NDArray[np.float64], turn: NDArray[np.float64], tilt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return rotations ``(N, 3, 3)`` whose third column is the tilted normal and whose others are turned about it."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(helper, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    third = normals + tilt[:, :1] * first + tilt[:, 1:] * second
    third /= np.linalg.norm(third, axis=1, keepdims=True)
    around = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
    around -= (around * third).sum(axis=1, keepdims=True) * third
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    return np.stack([around, np.cross(third, around), third], axis=2)


def _seen_directions(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the directions in which a dome of cameras sees each point, evenly over its visible side, ``(N, D, 3)``."""
    frames = tangent_frames(normals, np.zeros(len(normals)), np.zeros((len(normals), 2)))
    return np.einsum("nij,dj->ndi", frames, even_directions(DIRECTION_COUNT, last=0.15))


def _fit_harmonics(colors: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit ``colour = 0.5 + sum Y_k(d) c_k`` to colours ``(N, D, 3)`` seen along ``(N, D, 3)``."""
    basis = sh_basis(directions, SH_DEGREE)
    ridge = np.full(basis.shape[-1], SH_RIDGE * directions.shape[1])
    ridge[0] = 0.0
    normal = np.einsum("ndk,ndl->nkl", basis, basis) + np.diag(ridge)
    right = np.einsum("ndk,ndc->nkc", basis, np.asarray(colors, np.float64) - 0.5)
    return np.linalg.solve(normal, right)
