"""A take of a reconstructed person: the Gaussians of one frame walk on with the skin of the capture's model.

The capture ``walker`` shows CesiumMan, a glTF model of 19 joints that walks for 48 frames; the capture's first frame is
`START`. Its true images exist for some of its frames, so that the take can be judged against these.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from beam_warp.image.color import srgb_to_linear
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.gaussians import GaussianCloud

FRAMES_PER_SECOND = 24.0

START = 4
"""Key of the model's animation that the capture begins with: its surface is that of the capture's first true mesh."""

HEIGHT = 1.7
"""How tall the capture's first frame is [m]: it stands with its middle above the origin, on the floor."""

NEAREST = 8
"""Vertices whose joints a Gaussian follows, weighted by the inverse of their distances."""

RAYS = 64
"""Rays whose noise occlusion has, a Gaussian and frame: as many as `beam run` takes."""

TRACED_EVERY = 8
"""Gaussians of which one has its occlusion traced at each frame; the change since the first is blended from there."""

NORMAL_NOISE = 0.02
"""Deviation of normals from the surface, another one in each frame [rad]."""

FloatArray = NDArray[np.float64]


class SkinnedModel:
    """The model of a binary glTF: its vertices, and how its joints move, z up."""

    def __init__(self, path: Path) -> None:
        """Read the first mesh, skin and animation."""
        content = path.read_bytes()
        (length,) = struct.unpack_from("<I", content, 12)
        self._facts, self._binary = json.loads(content[20 : 20 + length]), content[28 + length :]
        primitive = self._facts["meshes"][0]["primitives"][0]
        attributes = primitive["attributes"]
        self.vertices = self._rows(attributes["POSITION"])
        self.normals = self._rows(attributes["NORMAL"])
        self.texture_places = self._rows(attributes["TEXCOORD_0"])
        self.faces = self._rows(primitive["indices"]).astype(np.int64).reshape(-1, 3)
        count, joints = len(self.vertices), self._rows(attributes["JOINTS_0"]).astype(int)
        self.weights = np.zeros((count, len(self._facts["skins"][0]["joints"])))
        np.add.at(self.weights, (np.arange(count)[:, None], joints), self._rows(attributes["WEIGHTS_0"]))

    def _rows(self, number: int) -> FloatArray:
        accessor = self._facts["accessors"][number]
        view = self._facts["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        kind = {5123: np.dtype("<u2"), 5125: np.dtype("<u4"), 5126: np.dtype("<f4")}[accessor["componentType"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        strides = view.get("byteStride", width * kind.itemsize), kind.itemsize
        return np.ndarray((accessor["count"], width), kind, self._binary, start, strides).astype(np.float64)

    def joint(self, name: str) -> int:
        """Return the column of `weights` of the joint of a name."""
        nodes = [self._facts["nodes"][node]["name"] for node in self._facts["skins"][0]["joints"]]
        return nodes.index(name)

    def base_color(self, places: FloatArray) -> FloatArray:
        """Return the texture, scene-linear, of the texels next to texture coordinates ``(N, 2)``, ``(N, 3)``."""
        view = self._facts["bufferViews"][self._facts["images"][0]["bufferView"]]
        start = view.get("byteOffset", 0)
        image = np.asarray(Image.open(io.BytesIO(self._binary[start : start + view["byteLength"]])).convert("RGB"))
        height, width = image.shape[:2]
        column, row = (np.floor(places * (width, height)).astype(int) % (width, height)).T
        return srgb_to_linear(image[row, column] / 255.0)

    def posed(self, key: int) -> FloatArray:
        """Return the vertices at a key, in the capture's world, ``(V, 3)`` [m]."""
        middle, to_model = self.floor
        return (_moved(self._blended(key), self.vertices) - middle) / to_model

    @cached_property
    def floor(self) -> tuple[FloatArray, float]:
        """Return the model's place of the capture's origin, and its length of a metre."""
        posed = _moved(self._blended(START), self.vertices)
        middle = 0.5 * (posed.min(axis=0) + posed.max(axis=0)) * [1.0, 1.0, 0.0] + [0.0, 0.0, posed[:, 2].min()]
        return middle, float(np.ptp(posed[:, 2])) / HEIGHT

    def _blended(self, key: int) -> FloatArray:
        return np.einsum("nj,jkl->nkl", self.weights, self.joints(key))

    def joints(self, key: int) -> FloatArray:
        """Return the matrices that take vertices at rest to where each joint has them at a key, ``(J, 4, 4)``."""
        animation, moved = self._facts["animations"][0], dict[int, dict[str, Any]]()
        for channel in animation["channels"]:
            rows = self._rows(animation["samplers"][channel["sampler"]]["output"])
            moved.setdefault(channel["target"]["node"], {})[channel["target"]["path"]] = rows[key]
        found: dict[int, FloatArray] = {}
        upright = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
        waiting = [(node, upright) for node in self._facts["scenes"][0]["nodes"]]
        while waiting:
            node, above = waiting.pop()
            found[node] = above @ _matrix(self._facts["nodes"][node] | moved.get(node, {}))
            waiting += [(child, found[node]) for child in self._facts["nodes"][node].get("children", ())]
        skin = self._facts["skins"][0]
        inverse = self._rows(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        return np.stack([found[node] for node in skin["joints"]]) @ inverse


def _matrix(node: dict[str, Any]) -> FloatArray:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    made = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", (0.0, 0.0, 0.0, 1.0))).as_matrix()
    made[:3, :3], made[:3, 3] = turn * node.get("scale", (1.0, 1.0, 1.0)), node.get("translation", (0.0, 0.0, 0.0))
    return made


def walk(first: GaussianCloud, model: SkinnedModel, frames: int) -> Iterator[GaussianCloud]:
    """Yield the frames of a take: Gaussians moved by the joints of the skin around them, occlusion traced anew.

    Args:
        first: Gaussians of the capture's first frame, in the world's axes.
        model: That of the capture.
        frames: Number of frames, the first one included.
    """
    rng, start = np.random.default_rng(0), model.joints(START)
    blended = np.einsum("nj,jkl->nkl", model.weights, start)
    posed = _moved(blended, model.vertices)
    middle, to_model = model.floor
    here = first.positions * to_model + middle
    facing = np.einsum("nij,nj->ni", blended[:, :3, :3], model.normals)
    towards = 0.05 * np.asarray(first.normals, np.float64)
    away, near = cKDTree(np.hstack([posed, 0.05 * facing])).query(np.hstack([here, towards]), k=NEAREST)
    share = 1.0 / np.maximum(away, 1e-4)
    weights = np.einsum("nk,nkj->nj", share / share.sum(axis=1, keepdims=True), model.weights[near])
    back = np.linalg.inv(np.einsum("nj,jkl->nkl", weights, start))
    some = slice(None, None, TRACED_EVERY)
    around = cKDTree(first.positions[some]).query(first.positions, k=3)[1]
    open_first = _openness(first, some)
    for frame in range(frames):
        since = np.einsum("nj,jkl->nkl", weights, model.joints(START + frame)) @ back
        left, _, right = np.linalg.svd(since[:, :3, :3])
        turn = Rotation.from_matrix(left @ right)
        normals = turn.apply(first.normals) + rng.normal(0.0, NORMAL_NOISE, first.positions.shape)
        moved = first.with_arrays(
            positions=(_moved(since, here) - middle) / to_model,
            orientations=(turn * Rotation.from_quat(first.orientations)).as_quat(),
            normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
            ids=np.arange(len(first)),
        )
        now = np.clip(first.ambient_occlusion + (_openness(moved, some) - open_first)[around].mean(axis=1), 0.0, 1.0)
        noise = np.sqrt(now * (1.0 - now) / RAYS) * rng.normal(size=len(now))
        yield moved.with_arrays(ambient_occlusion=np.clip(now + noise, 0.0, 1.0))


def _openness(cloud: GaussianCloud, some: slice) -> FloatArray:
    """Return the occlusion of some Gaussians, traced with the same rays in every frame."""
    assert cloud.normals is not None
    scene = Scene.from_gaussians(cloud)
    traced = ambient_occlusion(scene, cloud.positions[some], cloud.normals[some], sample_count=RAYS).visibility
    return np.asarray(traced, np.float64)


def _moved(matrices: FloatArray, points: NDArray[np.floating]) -> FloatArray:
    return np.einsum("nij,nj->ni", matrices[:, :3, :3], points) + matrices[:, :3, 3]
