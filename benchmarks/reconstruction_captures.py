"""A capture at full resolution for the reconstruction benchmark: a known moving surface with a texture of its own.

The texture is a function of where a point is in the first frame, so that it stays with the surface; the mesh is
subdivided until its vertices are as dense as pixels. Path traced by the package itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture
from beam_warp.demo.capture import DomeCamera, dome_cameras, write_capture
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.mesh import MaterialMesh, vertex_normals

FloatArray = NDArray[np.float64]

SEED = 11

WAVES = ((0.40, 6), (0.12, 8), (0.035, 10), (0.011, 12))
"""Wavelengths of the texture [m] and how many waves of each: from clothes to stitches."""


def textured_meshes(
    source: Capture, frames: Sequence[int], subdivisions: int
) -> tuple[list[MaterialMesh], list[tuple[FloatArray, NDArray[np.int64]]]]:
    """Return the true surfaces of some frames with a texture, subdivided, and as they were, vertices and faces."""
    known = [read_truth_mesh(source, frame) for frame in frames]
    faces = np.asarray(known[0].faces, np.int64)
    plans = []
    count = len(known[0].vertices)
    fine = faces
    for _ in range(subdivisions):
        edges, fine = halved(fine, count)
        plans.append(edges)
        count += len(edges)
    rest = refined(np.asarray(known[0].vertices, np.float64), plans)
    color, roughness = texture(rest)
    meshes = []
    for mesh in known:
        vertices = np.asarray(mesh.vertices, np.float64)
        normals = refined(vertex_normals(vertices, faces), plans)
        meshes.append(
            MaterialMesh(
                vertices=refined(vertices, plans),
                faces=fine,
                normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
                base_color=color,
                roughness=roughness,
            )
        )
    return meshes, [(np.asarray(mesh.vertices, np.float64), faces) for mesh in known]


def halved(faces: NDArray[np.int64], vertex_count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the edges whose middles become vertices, in their order, and the four triangles of each triangle."""
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys, index = np.unique(sides[:, 0] * vertex_count + sides[:, 1], return_inverse=True)
    edges = np.stack([keys // vertex_count, keys % vertex_count], axis=-1)
    ab, bc, ca = (vertex_count + index.reshape(-1, 3)).T
    a, b, c = faces.T
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return edges, np.concatenate([np.stack(part, axis=-1) for part in parts])


def refined(vertices: FloatArray, plans: Sequence[NDArray[np.int64]]) -> FloatArray:
    """Return vertices with the middles of edges after them, plan by plan."""
    for edges in plans:
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
    return vertices


def texture(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return base colour ``(N, 3)`` and roughness ``(N,)`` at points of the first frame: waves of several lengths."""
    rng = np.random.default_rng(SEED)
    count = sum(waves for _, waves in WAVES)
    directions = rng.normal(size=(3, count))
    directions *= np.concatenate([np.full(waves, 2.0 * np.pi / length) for length, waves in WAVES]) / np.linalg.norm(
        directions, axis=0
    )
    amplitudes = rng.normal(size=(count, 3)) / np.concatenate([np.full(n, np.sqrt(n)) for _, n in WAVES])[:, None]
    phases = points.astype(np.float32) @ directions.astype(np.float32)
    waves = np.sin(phases + rng.uniform(0.0, 2.0 * np.pi, count).astype(np.float32))
    color = 0.06 + 0.5 / (1.0 + np.exp(-1.2 * (waves @ amplitudes.astype(np.float32))))
    return color, 0.45 + 0.2 * np.sin(points @ (17.0, 9.0, 23.0))


def write_large_capture(
    folder: Path,
    source: Capture,
    *,
    frames: Sequence[int],
    camera_count: int = 24,
    test_camera_count: int = 2,
    width: int = 1920,
    height: int = 1080,
    samples: int = 16,
    subdivisions: int = 2,
    device: str | None = None,
    progress: StageProgress = no_progress,
) -> Capture:
    """Path trace a known surface for a dome of cameras and write it as a capture; frames are numbered from 0."""
    meshes, surfaces = textured_meshes(source, frames, subdivisions)
    cameras: list[DomeCamera] = dome_cameras(
        [vertices for vertices, _ in surfaces], camera_count, test_camera_count, width, height
    )
    light = (
        EnvironmentMap.read(source.environment_path) if source.environment_path else EnvironmentMap.constant([1] * 3)
    )
    return write_capture(
        folder, meshes, cameras, light, surfaces=surfaces, samples=samples, device=device, progress=progress
    )
