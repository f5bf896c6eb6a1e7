"""A take whose motion is known: Gaussians that stay with the skin of the demo's figure while it dances."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from beam_warp.demo.figure import Figure
from beam_warp.demo.stand_in import sample_surface, tangent_frames
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.mesh import MaterialMesh

FRAMES_PER_SECOND = 30.0

DANCE_SECONDS = 1.5
"""Period of the dance: its hands move at 1 to 2 m/s."""

OPACITY = 0.95

AO_GAUSSIANS, AO_RAYS = 8_000, 16
"""Gaussians at which occlusion is traced, and rays of each."""

RAYS = 64
"""Rays whose noise occlusion has in the take, a Gaussian and frame."""

NORMAL_NOISE = 0.02
"""Deviation of normals from the surface, another one in each frame [rad]."""

FloatArray = NDArray[np.float64]


def take(
    figure: Figure, count: int, frames: int, seed: int = 0, period: float = DANCE_SECONDS
) -> Iterator[tuple[MaterialMesh, GaussianCloud]]:
    """Yield the frames of a take: the surface, and the Gaussians on it, with the noise that estimates leave.

    Args:
        figure: Who dances.
        count: Number of Gaussians.
        frames: Number of frames.
        seed: Of the noise.
        period: Period of the dance [s].
    """
    rng = np.random.default_rng(seed)
    samples = sample_surface(figure.rest, count, rng)
    coarse = sample_surface(figure.rest, AO_GAUSSIANS, np.random.default_rng(1))
    kept, start = len(samples.faces), np.linalg.inv(_shapes(figure.rest, samples.faces))
    upright = _normals(figure.rest, samples.faces, samples.weights)
    first = tangent_frames(upright, samples.turn, samples.tilt)
    sigma = 0.6 * samples.spacing * np.exp(rng.normal(0.0, 0.3, (kept, 3))) * [1.0, 1.0, 0.15]
    painted = {
        name: figure.rest.interpolate(getattr(figure.rest, name), samples.faces, samples.weights)
        for name in ("base_color", "roughness")
    }
    for frame in range(frames):
        mesh = figure.at(frame / FRAMES_PER_SECOND / period)
        left, _, right = np.linalg.svd(_shapes(mesh, samples.faces) @ start)
        turned = left @ right
        points = mesh.interpolate(mesh.vertices, samples.faces, samples.weights)
        normals = _normals(mesh, samples.faces, samples.weights)
        normals = normals + rng.normal(0.0, NORMAL_NOISE, normals.shape)
        open_part = _occlusion(mesh, coarse.faces, coarse.weights, points, normals, coarse.spacing)
        noise = np.sqrt(open_part * (1.0 - open_part) / RAYS) * rng.normal(size=kept)
        yield (
            mesh,
            GaussianCloud(
                positions=points,
                orientations=Rotation.from_matrix(turned @ first).as_quat(),
                scales=sigma,
                opacities=np.full(kept, OPACITY),
                normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
                ambient_occlusion=np.clip(open_part + noise, 0.0, 1.0),
                ids=np.arange(kept),
                **{name: np.clip(values, 0.0, 1.0) for name, values in painted.items()},
            ),
        )


def _normals(mesh: MaterialMesh, faces: NDArray[np.int64], weights: FloatArray) -> FloatArray:
    normals = mesh.interpolate(mesh.normals, faces, weights)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _shapes(mesh: MaterialMesh, faces: NDArray[np.int64]) -> FloatArray:
    """Return two edges and a unit normal of triangles as columns, ``(N, 3, 3)``: they turn and stretch with these."""
    corners = mesh.vertices[mesh.faces[faces]].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    length = float(np.median(np.linalg.norm(edges, axis=2)))
    return np.stack([edges[:, 0], edges[:, 1], length * normals], axis=2)


def _occlusion(
    mesh: MaterialMesh,
    faces: NDArray[np.int64],
    weights: FloatArray,
    points: FloatArray,
    normals: FloatArray,
    spacing: float,
) -> FloatArray:
    """Return ambient occlusion at points, the mean of the three nearest of those at which it is traced."""
    places, towards = mesh.interpolate(mesh.vertices, faces, weights), _normals(mesh, faces, weights)
    frames = tangent_frames(towards, np.zeros(len(places)), np.zeros((len(places), 2)))
    cloud = GaussianCloud(
        positions=places,
        orientations=Rotation.from_matrix(frames).as_quat(),
        scales=np.tile([0.6 * spacing, 0.6 * spacing, 0.05 * spacing], (len(places), 1)),
        opacities=np.full(len(places), OPACITY),
    )
    scene = Scene.from_gaussians(cloud)
    traced = ambient_occlusion(scene, cloud.positions, towards.astype(np.float32), sample_count=AO_RAYS).visibility
    near = cKDTree(np.hstack([places, 0.05 * towards])).query(np.hstack([points, 0.05 * normals]), k=3)[1]
    return np.asarray(traced, np.float64)[near].mean(axis=1)
