"""The demo figure in motion: meshed once at rest, skinned to its bones, posed at any moment of a dance.

Vertex i is the same point of the surface in every pose, so that everything sampled on it persists.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from beam_warp.checks import require_number
from beam_warp.demo.paint import paint
from beam_warp.demo.shape import (
    ANKLE,
    BRAID,
    ELBOW,
    HIP,
    KNEE,
    PARTS,
    SCARF_TAIL,
    SHOULDER,
    SIDES,
    WRIST,
    FloatArray,
    mirrored,
    part_distances,
    rest_distance,
    rest_field,
)
from beam_warp.world.mesh import MaterialMesh, vertex_normals

LOWER, UPPER = np.array([-0.66, -0.36, -0.04]), np.array([0.66, 0.36, 1.80])
"""Box around the figure at rest [m]."""

SKIN_WIDTH = 0.010
"""Distance over which one part's bone gives way to another's, before smoothing [m]."""

SKIN_SPREAD = 0.035
"""Distance along the surface over which bone weights are smoothed [m]: about the radius of a limb."""


@dataclass(frozen=True)
class Bone:
    """A joint of the skeleton: what it hangs from, and where it turns at rest [m]."""

    name: str
    parent: str | None
    joint: tuple[float, float, float]


def _skeleton() -> tuple[Bone, ...]:
    bones = [
        Bone("pelvis", None, (0.0, 0.0, 0.86)),
        Bone("dress", "pelvis", (0.0, 0.0, 0.96)),
        Bone("spine", "pelvis", (0.0, 0.0, 0.97)),
        Bone("chest", "spine", (0.0, 0.0, 1.08)),
        Bone("head", "chest", (0.0, 0.01, 1.33)),
        Bone("braid", "head", tuple(BRAID[0])),
        Bone("braid end", "braid", tuple(BRAID[2])),
        Bone("scarf", "chest", tuple(SCARF_TAIL[0])),
        Bone("scarf end", "scarf", tuple(SCARF_TAIL[2])),
    ]
    for name, side in SIDES.items():
        chain = (("arm", "chest", SHOULDER), ("forearm", "arm", ELBOW), ("hand", "forearm", WRIST))
        leg = (("thigh", "pelvis", HIP), ("shin", "thigh", KNEE), ("foot", "shin", ANKLE))
        for bone, parent, joint in (*chain, *leg):
            above = parent if parent in ("chest", "pelvis") else f"{name} {parent}"
            bones.append(Bone(f"{name} {bone}", above, tuple(mirrored(joint, side))))
    return tuple(bones)


SKELETON = _skeleton()
"""Every bone; parents come before their children."""


def dance(phase: float) -> dict[str, tuple[float, float, float]]:
    """Return the turn of each bone about the rest axes x, y, z [degree] at a moment of the dance; period 1."""
    s, c = float(np.sin(2.0 * np.pi * phase)), float(np.cos(2.0 * np.pi * phase))
    left, right = 0.5 * (1.0 + s), 0.5 * (1.0 - s)
    return {
        "pelvis": (0.0, 4.0 * c, 12.0 * s),
        "dress": (3.0 * c, -4.0 * c, -14.0 * s),
        "spine": (2.0, -4.0 * c, -6.0 * s),
        "chest": (-3.0, -4.0 * c, -8.0 * s),
        "head": (-4.0, 7.0 * c, 10.0 * s),
        "braid": (8.0 + 8.0 * c, 10.0 * s, 0.0),
        "braid end": (6.0 * c, 14.0 * s, 0.0),
        "scarf": (0.0, 8.0 * c, 10.0 * s),
        "scarf end": (0.0, 16.0 * s, 14.0 * c),
        "left arm": (0.0, -66.0 - 14.0 * s, 8.0 * c),
        "left forearm": (0.0, -42.0 - 22.0 * c, 10.0 * s),
        "left hand": (0.0, -14.0 * c, 0.0),
        "right arm": (0.0, 16.0 - 16.0 * c, 22.0 + 12.0 * s),
        "right forearm": (0.0, 24.0 - 14.0 * s, 26.0),
        "right hand": (0.0, 12.0 * s, 10.0),
        "left thigh": (-26.0 * left, 0.0, 0.0),
        "left shin": (44.0 * left, 0.0, 0.0),
        "left foot": (4.0 * left, 0.0, 0.0),
        "right thigh": (-26.0 * right, 0.0, 0.0),
        "right shin": (44.0 * right, 0.0, 0.0),
        "right foot": (4.0 * right, 0.0, 0.0),
    }


@dataclass(frozen=True, eq=False)
class Figure:
    """The figure at rest and its rig.

    Attributes:
        rest: The mesh at rest, arms held out, in the internal world (rfu).
        bone_weights: How much each bone of `SKELETON` carries each vertex, ``(V, bones)`` float64; rows sum to 1.
    """

    rest: MaterialMesh
    bone_weights: FloatArray

    def at(self, phase: float) -> MaterialMesh:
        """Return the figure at a moment of its dance, standing on z = 0; the dance repeats after 1."""
        return self.posed(dance(require_number("phase", phase, -1e6, 1e6)))

    def posed(self, turns: Mapping[str, tuple[float, float, float]]) -> MaterialMesh:
        """Return the figure with its bones turned, standing on z = 0.

        Linear blend skinning: bends stay moderate, where it loses little volume.

        Args:
            turns: Turn about the rest axes x, y, z [degree] by name of a bone of `SKELETON`; other bones stay.
        """
        transforms = _bone_transforms(turns)
        blended = np.einsum("vb,bij->vij", self.bone_weights, transforms)
        rest = self.rest.vertices.astype(np.float64)
        posed = np.einsum("vij,vj->vi", blended[:, :, :3], rest) + blended[:, :, 3]
        posed[:, 2] -= posed[:, 2].min()
        return replace(self.rest, vertices=posed, normals=vertex_normals(posed, self.rest.faces))


def build_figure(spacing: float = 0.011) -> Figure:
    """Mesh and rig the figure.

    Args:
        spacing: Side of the grid cells that it is meshed with [m]; 0.011 gives about 75,000 triangles.

    Raises:
        InvalidOptionError: The spacing is not in [0.006, 0.02]: beyond it the thin parts fall apart.
    """
    step = require_number("spacing", spacing, 0.006, 0.02)
    counts = np.ceil((UPPER - LOWER) / step).astype(int) + 1
    vertices, faces, _, _ = marching_cubes(
        rest_field(LOWER, counts, step), 0.0, spacing=(step,) * 3, allow_degenerate=False
    )
    points = _onto_surface(vertices + LOWER)
    color, roughness = paint(points)
    rest = MaterialMesh(
        vertices=points.astype(np.float32),
        faces=faces,
        normals=vertex_normals(points, faces).astype(np.float32),
        base_color=color.astype(np.float32),
        roughness=roughness.astype(np.float32),
    )
    return Figure(rest, _bone_weights(points, faces, step))


def rest_gradient(points: FloatArray) -> FloatArray:
    """Return the gradient of the rest distance at points ``(N, 3)`` by central differences."""
    step = 1e-4  # [m]
    offsets = step * np.eye(3)
    return np.stack([(rest_distance(points + o) - rest_distance(points - o)) / (2.0 * step) for o in offsets], axis=-1)


def _onto_surface(points: FloatArray) -> FloatArray:
    """Move points by one Newton step onto the surface, at most 2 mm: marching cubes interpolates linearly."""
    gradient = rest_gradient(points)
    move = rest_distance(points) / np.maximum((gradient**2).sum(-1), 0.25)
    return points - np.clip(move, -0.002, 0.002)[:, None] * gradient


def _bone_weights(points: FloatArray, faces: NDArray[np.int32], step: float) -> FloatArray:
    """Weigh bones by how near their parts are, then let the weights diffuse along the surface.

    Diffusion follows the surface, not space: the dress and the legs inside it keep apart.
    """
    distances = part_distances(points)
    nearness = np.exp((distances.min(axis=1, keepdims=True) - distances) / SKIN_WIDTH)
    weights = np.stack(
        [nearness[:, [part.bone == bone.name for part in PARTS]].sum(axis=1) for bone in SKELETON], axis=-1
    )
    weights /= weights.sum(axis=1, keepdims=True)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ones = np.ones(len(edges))
    neighbors = scipy.sparse.csr_array((ones, (edges[:, 0], edges[:, 1])), shape=(len(points), len(points)))
    average = scipy.sparse.diags_array(1.0 / neighbors.sum(axis=1)) @ neighbors
    # A step to the mean of the neighbours moves weight by about one cell in a random direction.
    for _ in range(round((SKIN_SPREAD / step) ** 2)):
        weights = 0.5 * (weights + average @ weights)
    return weights / weights.sum(axis=1, keepdims=True)


def _bone_transforms(turns: Mapping[str, tuple[float, float, float]]) -> FloatArray:
    """Return each bone's transform from rest to pose, ``(bones, 3, 4)``."""
    placed: dict[str, FloatArray] = {}
    for bone in SKELETON:
        turn = Rotation.from_euler("xyz", turns.get(bone.name, (0.0, 0.0, 0.0)), degrees=True).as_matrix()
        joint = np.asarray(bone.joint)
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = turn, joint - turn @ joint
        placed[bone.name] = local if bone.parent is None else placed[bone.parent] @ local
    return np.stack([placed[bone.name][:3] for bone in SKELETON])
