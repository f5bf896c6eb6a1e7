"""What a refit changes of merged Gaussians, which then move as these do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from beam_warp.world.clusters import unit
from beam_warp.world.gaussians import MATERIAL_CHANNELS, GaussianCloud

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Changes:
    """What a refit adds to merged Gaussians, in the axes that they have in the reference frame.

    Attributes:
        shift: Of positions [m], ``(K, 3)``.
        turn: Rotation that the orientation is multiplied by, on its right, quaternions xyzw ``(K, 4)``.
        stretch: Natural logarithms of factors of scales, ``(K, 3)``.
        logit: Of opacities, ``(K,)``.
        materials: Of materials in the order of `MATERIAL_CHANNELS`, ``(K, 8)``.
    """

    shift: FloatArray
    turn: FloatArray
    stretch: FloatArray
    logit: FloatArray
    materials: FloatArray


def changed(cloud: GaussianCloud, turn: Rotation, changes: Changes) -> GaussianCloud:
    """Return merged Gaussians with what a refit adds to them.

    Args:
        cloud: Of any frame.
        turn: How they are turned since the reference frame, see `beam_warp.world.clusters.Clusters.motion`.
        changes: See `Changes`.
    """
    own = Rotation.from_quat(cloud.orientations) * Rotation.from_quat(changes.turn)
    materials = {name: cast("FloatArray", getattr(cloud, name)) for name in MATERIAL_CHANNELS}
    color, rough, occlusion, lean = np.split(changes.materials, (3, 4, 5), axis=1)
    return cloud.with_arrays(
        positions=cloud.positions + turn.apply(changes.shift),
        orientations=own.as_quat(),
        scales=cloud.scales * np.exp(changes.stretch),
        opacities=sigmoid(logit_of(cloud.opacities.astype(np.float64)) + changes.logit),
        base_color=np.clip(materials["base_color"] + color, 0.0, 1.0),
        roughness=np.clip(materials["roughness"] + rough[:, 0], 0.0, 1.0),
        ambient_occlusion=np.clip(materials["ambient_occlusion"] + occlusion[:, 0], 0.0, 1.0),
        normals=unit(materials["normals"] + turn.apply(lean), materials["normals"]),
    )


def sigmoid(logit: FloatArray) -> FloatArray:
    """Return the opacities of logits."""
    return 1.0 / (1.0 + np.exp(-logit))


def logit_of(opacity: FloatArray) -> FloatArray:
    """Return the logits of opacities, those of 0 and 1 finite."""
    kept = np.clip(opacity, 1e-4, 1.0 - 1e-4)
    return np.log(kept / (1.0 - kept))
