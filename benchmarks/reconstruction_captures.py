"""Captures for the benchmarks of reconstruction, path traced by the package itself.

`write_large_capture` shows a known moving surface at full resolution. Its texture is a function of where a point is in
the first frame, so that it stays with the surface; the mesh is subdivided until its vertices are as dense as pixels.
`write_walking_capture` shows the walker's model for longer than its own capture does, with or without a case in its
hand that is put down.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from walking_take import FRAMES_PER_SECOND, START, SkinnedModel

from beam_warp.capture.capture import Capture
from beam_warp.demo.capture import DomeCamera, dome_cameras, write_capture
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.mesh import MaterialMesh, vertex_normals

FloatArray = NDArray[np.float64]

SEED = 11

CASE = (0.12, 0.30, 0.54)
"""Sides of the case [m]."""

CASE_ASIDE, CASE_BELOW = 0.08, 0.03
"""Distance of the middle of the case outwards of the hand, and of its top below it [m]: so the leg swings past it."""

PUT_DOWN = 8
"""Frame in which the hand lets go of the case, at the end of its swing: it falls 0.2 m, straight down, and stays."""

GRAVITY = 9.81

ROUGHNESS = 0.6
"""Roughness of the walking model."""

RIGHT_HAND = "Skeleton_arm_joint_R__3_"

WAVES = ((0.40, 6), (0.12, 8), (0.035, 10), (0.011, 12))
"""Wavelengths of the texture [m] and how many waves of each: from clothes to stitches."""


def textured_meshes(
    source: Capture, frames: Sequence[int], subdivisions: int
) -> tuple[list[MaterialMesh], list[tuple[FloatArray, NDArray[np.int64]]]]:
    """Return the true surfaces of some frames with a texture, subdivided, and as they were, vertices and faces."""
    known = [read_truth_mesh(source, frame) for frame in frames]
    faces = np.asarray(known[0].faces, np.int64)
    plans, fine = subdivided(faces, len(known[0].vertices), subdivisions)
    rest = refined(np.asarray(known[0].vertices, np.float64), plans)
    color, roughness = texture(rest)
    meshes = []
    for mesh in known:
        vertices = np.asarray(mesh.vertices, np.float64)
        normals = refined(vertex_normals(vertices, faces), plans)
        meshes.append(_mesh(refined(vertices, plans), fine, normals, color, roughness))
    return meshes, [(np.asarray(mesh.vertices, np.float64), faces) for mesh in known]


def subdivided(
    faces: NDArray[np.int64], vertex_count: int, times: int
) -> tuple[list[NDArray[np.int64]], NDArray[np.int64]]:
    """Return the plans that `refined` takes, and the triangles, each cut into four so many times."""
    plans = []
    for _ in range(times):
        edges, faces = halved(faces, vertex_count)
        plans.append(edges)
        vertex_count += len(edges)
    return plans, faces


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
) -> Capture:
    """Path trace a known surface for a dome of cameras and write it as a capture; frames are numbered from 0."""
    meshes, surfaces = textured_meshes(source, frames, subdivisions)
    cameras: list[DomeCamera] = dome_cameras(
        [vertices for vertices, _ in surfaces], camera_count, test_camera_count, width, height
    )
    light = (
        EnvironmentMap.read(source.environment_path) if source.environment_path else EnvironmentMap.constant([1] * 3)
    )
    return write_capture(folder, meshes, cameras, light, surfaces=surfaces, samples=samples, device=device)


def write_walking_capture(
    folder: Path,
    model: SkinnedModel,
    light: EnvironmentMap,
    *,
    frame_count: int,
    case: bool,
    camera_count: int = 24,
    test_camera_count: int = 2,
    size: int = 320,
    samples: int = 32,
    subdivisions: int = 2,
    device: str | None = None,
) -> Capture:
    """Path trace the walker's model for a dome of cameras and write it as a capture.

    Args:
        folder: Where to.
        model: That of the capture, with its own texture.
        light: What it stands in.
        frame_count: Frames, of which the walker has 24 a second.
        case: Whether a case is carried in the right hand until it is `PUT_DOWN`.
        camera_count: Training cameras.
        test_camera_count: Cameras with truth.
        size: Side of every image [pixel].
        samples: Paths of a pixel.
        subdivisions: Times that triangles of the model, of 30 mm, are cut into four.
        device: Warp device.
    """
    posed = [model.posed(START + frame) for frame in range(frame_count)]
    edges, faces = subdivided(model.faces, len(model.vertices), subdivisions)
    color = model.base_color(refined(model.texture_places, edges))
    rough = np.full(len(color), ROUGHNESS)
    _, first, place = np.unique(model.vertices, axis=0, return_index=True, return_inverse=True)
    meshes = []
    for vertices in posed:  # vertices at one place, cut apart where the texture is, have one normal
        normals = vertex_normals(vertices[first], place[model.faces])[place]
        meshes.append(_mesh(refined(vertices, edges), faces, refined(normals, edges), color, rough))
    if case:
        hand = model.weights[:, model.joint(RIGHT_HAND)] > 0.5
        places = case_places(np.stack([vertices[hand].mean(axis=0) for vertices in posed]))
        corners, sides = box(CASE)
        cuts, sides = subdivided(sides, len(corners), subdivisions + 3)
        corners = refined(corners, cuts)
        looks = texture(corners)
        upright = vertex_normals(corners, sides)
        meshes = [
            mesh.beside(_mesh(corners + place, sides, upright, *looks))
            for mesh, place in zip(meshes, places, strict=True)
        ]
    cameras = dome_cameras([mesh.vertices for mesh in meshes], camera_count, test_camera_count, size, size)
    return write_capture(folder, meshes, cameras, light, samples=samples, device=device)


def case_places(hand: FloatArray) -> FloatArray:
    """Return the middle of the case in every frame, ``(F, 3)``: carried upright, then falling, then on the floor.

    Args:
        hand: Middle of the hand in every frame, ``(F, 3)`` [m].
    """
    held = hand - (CASE_ASIDE, 0.0, CASE_BELOW + 0.5 * CASE[2])
    fallen = np.maximum(np.arange(len(hand)) - PUT_DOWN, 0) / FRAMES_PER_SECOND
    down = held[np.minimum(np.arange(len(hand)), PUT_DOWN)]
    down[:, 2] = np.maximum(down[:, 2] - 0.5 * GRAVITY * fallen**2, 0.5 * CASE[2])
    return down


def box(sides: tuple[float, float, float]) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return corners around the origin, each once for each of its three faces, and triangles of a box."""
    corners, faces = [], []
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            start = len(corners)
            for a, b in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)):
                corner = np.zeros(3)
                corner[[axis, one, two]] = sign, sign * a, b
                corners.append(0.5 * corner * sides)
            faces += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    return np.stack(corners), np.array(faces)


def _mesh(
    vertices: FloatArray, faces: NDArray[np.int64], normals: FloatArray, color: FloatArray, roughness: FloatArray
) -> MaterialMesh:
    return MaterialMesh(
        vertices=vertices,
        faces=faces,
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        base_color=color,
        roughness=roughness,
    )
