"""Skinning: anchors of Gaussians to joints, the warp by the joints' poses, and its gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_choice, require_count, require_finite, require_range
from beam_warp.device.array_checks import require_vectors
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError
from beam_warp.kernels.reconstruction.skinning import (
    MESSAGE,
    MOST_JOINTS,
    RUN,
    Messages,
    RestSkin,
    Runs,
    launch_add_pose_gradients,
    launch_warp_skin,
)
from beam_warp.reconstruction.joints.graph import (
    REACH,
    SMALLEST_COSINE,
    group_by,
    joint_spacing,
    nearest_joints,
    proximity_weights,
    stable_order,
)
from beam_warp.reconstruction.joints.rigidity import joint_poses
from beam_warp.world.framing import require_points

BLENDS = ("linear", "dual")
"""Ways to blend the motions of several joints: of the points that they move, or of dual quaternions."""


@dataclass(frozen=True, eq=False)
class Anchors:
    """The joints that carry each skin Gaussian, and their weights.

    Attributes:
        joints: Numbers of the joints, nearest first, ``(N, k)`` int32.
        weights: Weights of the joints, ``(N, k)`` float32: not negative, the first the largest of its row; each row
            adds up to 1.
    """

    joints: NDArray[np.int32]
    weights: NDArray[np.float32]

    @classmethod
    def fit(
        cls,
        positions: ArrayLike,
        joint_positions: ArrayLike,
        *,
        neighbor_count: int = 8,
        normals: ArrayLike | None = None,
        joint_normals: ArrayLike | None = None,
        smallest_cosine: float = SMALLEST_COSINE,
    ) -> Anchors:
        """Anchor skins to their nearest joints, with weights exp(-d^2 / l^2), l = 1.5 joint spacings, that add up to 1.

        A skin that is far from every joint (several l) follows the nearest.

        Args:
            positions: Positions of the skins at rest, ``(N, 3)``.
            joint_positions: Positions of the joints at rest, ``(M, 3)``.
            neighbor_count: Joints for a skin, k; M if there are fewer.
            normals: Which way the surface faces at each skin, outward, ``(N, 3)`` of any length; 0 where unknown.
            joint_normals: The same of the joints, ``(M, 3)``. With both, joints that face apart from a skin do not
                carry it, unless all near ones do; see `JointGraph.build`.
            smallest_cosine: Least cosine between the normals of a skin and a joint that do not face apart.

        Raises:
            InvalidArrayError: An array has another shape, is not finite, or most joints coincide.
            InvalidOptionError: ``neighbor_count`` is out of range.
        """
        skins, joints = require_points("positions", positions), require_points("joint_positions", joint_positions)
        count = min(require_count("neighbor_count", neighbor_count, 1, 64), len(joints))
        nearest, squared = nearest_joints(skins, joints, count, normals, joint_normals, smallest_cosine)
        reach = REACH * joint_spacing(joints, None if normals is None else joint_normals, smallest_cosine)
        return cls(nearest.astype(np.int32), proximity_weights(squared, reach))


class Skin:
    """Gaussians at rest that joints carry along.

    A joint's pose is where it is and how it is turned against its rest, a quaternion xyzw of any length but 0. With
    y_a = R_a (x - x_a,rest) + x_a, where joint a alone would carry the skin x,

    - the orientation becomes b / |b| times the one at rest, b = sum of w_a s_a q_a over the unit quaternions of the
      anchors; s_a = -1 for those of which -q_a is nearer to the first anchor's;
    - ``"linear"``: the position becomes sum w_a y_a (linear blend skinning; joints that are turned apart pull the skin
      inwards, by a half for 120 degrees and into the middle for 180);
    - ``"dual"``: that of dual quaternion blending, which keeps volume where joints twist, and bulges where they bend.

    All arrays stay on the device. Nothing is allocated in a call and nothing waits for the device: calls may be
    captured in a CUDA graph. Sums go in a fixed order: same device, same input, same bits.

    Attributes:
        rest_positions: ``(N,)`` vec3; may be written to between calls.
        rest_orientations: ``(N,)`` quat; likewise. Their lengths are kept.
        joint_rest_positions: ``(M,)`` vec3; likewise.
        blend: ``"linear"`` or ``"dual"``.
        device: Warp device that holds them.

    Source: Jiang et al. 2024, DualGS (anchors, linear blend); Kavan et al. 2008, "Geometric Skinning with Approximate
    Dual Quaternion Blending"; `docs/tracking.md` lists what differs.
    """

    def __init__(
        self,
        rest_positions: ArrayLike,
        rest_orientations: ArrayLike,
        anchors: Anchors,
        joint_rest_positions: ArrayLike,
        *,
        blend: str = "linear",
        device: Any = None,
    ) -> None:
        """Upload skins and joints at rest; about 16 k + 80 bytes a skin.

        Args:
            rest_positions: ``(N, 3)``.
            rest_orientations: Quaternions xyzw, ``(N, 4)``.
            anchors: Anchors of the N skins to the M joints.
            joint_rest_positions: ``(M, 3)``.
            blend: ``"linear"`` or ``"dual"``.
            device: Warp device; the first GPU without, or the CPU where there is none.

        Raises:
            InvalidArrayError: Arrays do not fit together, or are not finite.
            InvalidOptionError: There is no such blend.
            DeviceError: The device is not there.
        """
        skins = require_points("rest_positions", rest_positions)
        orientations = require_array("rest_orientations", rest_orientations, (len(skins), 4))
        require_finite("rest_orientations", orientations)
        joints = require_points("joint_rest_positions", joint_rest_positions)
        slots, weights = _slots(anchors, len(skins), len(joints))
        # The host is done before the first upload, which waits for whatever the device is at.
        order = stable_order(slots[:, 0], len(joints))
        places = np.empty(len(order), np.int32)
        places[order] = np.arange(len(order))
        runs = _runs(slots[order], weights[order], len(joints))
        self.blend = require_choice("blend", blend, BLENDS)
        self.device = resolve_device(device)
        self._counts = (len(skins), len(joints))
        self.rest_positions = upload(skins.astype(np.float32), wp.vec3, self.device)
        self.rest_orientations = upload(orientations, wp.quat, self.device)
        self.joint_rest_positions = upload(joints.astype(np.float32), wp.vec3, self.device)
        self._rest = RestSkin()
        self._rest.positions = self.rest_positions
        self._rest.orientations = self.rest_orientations.view(wp.vec4)
        self._rest.joints = upload(slots.T, int, self.device)
        self._rest.weights = upload(weights.T, float, self.device)
        self._rest.joint_positions = self.joint_rest_positions
        self._rest.dual = int(self.blend == "dual")
        self._rest.places = upload(places, int, self.device)
        self._runs = Runs()
        for name, array in runs.items():
            setattr(self._runs, name, upload(array, float if name == "weights" else int, self.device))
        self._messages = Messages()
        self._messages.skins = wp.empty(MESSAGE * len(skins), dtype=wp.vec4, device=self.device)
        self._messages.run_rotations = wp.empty(len(self._runs.joints), dtype=wp.vec4, device=self.device)
        self._messages.run_positions = wp.empty(len(self._runs.joints), dtype=wp.vec3, device=self.device)

    def warp(
        self, joint_rotations: wp.array, joint_positions: wp.array, out_positions: wp.array, out_orientations: wp.array
    ) -> None:
        """Write where the joints carry the skins.

        Args:
            joint_rotations: Against rest, xyzw, ``(M,)`` quat or vec4; of any length but 0.
            joint_positions: ``(M,)`` vec3.
            out_positions: Written, ``(N,)`` vec3.
            out_orientations: Written, ``(N,)`` quat or vec4.

        Raises:
            InvalidArrayError: An array has another type, length or device.
        """
        launch_warp_skin(
            self._rest,
            joint_poses("joint_", joint_rotations, joint_positions, self._counts[1], self.device),
            require_vectors("out_positions", out_positions, self._counts[0], 3, self.device),
            require_vectors("out_orientations", out_orientations, self._counts[0], 4, self.device),
            self.device,
        )

    def add_gradients(
        self,
        joint_rotations: wp.array,
        joint_positions: wp.array,
        position_gradients: wp.array | None,
        orientation_gradients: wp.array | None,
        out_rotation_gradients: wp.array,
        out_position_gradients: wp.array,
    ) -> None:
        """Add the gradient of a loss with respect to the joints' poses, given those with respect to the warped skins.

        Which of q and -q a rotation is blended as is held still.

        Args:
            joint_rotations: As for `warp`.
            joint_positions: As for `warp`.
            position_gradients: With respect to the warped positions, ``(N,)`` vec3; None for 0.
            orientation_gradients: With respect to the warped orientations, ``(N,)`` quat or vec4; None for 0.
            out_rotation_gradients: dL/drotation is added to it, ``(M,)`` quat or vec4; orthogonal to the rotations, as
                their length changes nothing.
            out_position_gradients: dL/dposition is added to it, ``(M,)`` vec3.

        Raises:
            InvalidArrayError: An array has another type, length or device.
        """
        skin_count, joint_count = self._counts
        upstream = [
            None if array is None else require_vectors(name, array, skin_count, width, self.device)
            for name, array, width in (
                ("position_gradients", position_gradients, 3),
                ("orientation_gradients", orientation_gradients, 4),
            )
        ]
        launch_add_pose_gradients(
            self._rest,
            self._runs,
            joint_poses("joint_", joint_rotations, joint_positions, joint_count, self.device),
            upstream[0],
            upstream[1],
            self._messages,
            require_vectors("out_rotation_gradients", out_rotation_gradients, joint_count, 4, self.device),
            require_vectors("out_position_gradients", out_position_gradients, joint_count, 3, self.device),
            self.device,
        )


def _slots(anchors: Anchors, skin_count: int, joint_count: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return what skins are anchored to, checked."""
    require_count("the number of joints", joint_count, 1, MOST_JOINTS)
    joints = require_array("anchors.joints", anchors.joints, (skin_count, None), np.int32)
    weights = require_array("anchors.weights", anchors.weights, joints.shape)
    if not joints.shape[1]:
        raise InvalidArrayError("anchors.joints must have at least one column, got none. Take it from Anchors.fit.")
    require_range("anchors.joints", joints, 0, joint_count - 1, "Fit the anchors to these joints.")
    require_range("anchors.weights", weights, 0.0, 1.0, "Divide each row by its sum.")
    # The first anchor is what quaternions are turned towards: with the largest weight it keeps their sum from 0.
    first, total = weights[:, 0], weights.sum(axis=1)
    if not ((first >= weights.max(axis=1)) & (np.abs(total - 1.0) <= 1e-4)).all():
        raise InvalidArrayError(
            "anchors.weights must add up to 1 in each row and begin with the largest, got other rows. "
            "Take them from Anchors.fit."
        )
    return joints, weights


def _runs(slots: NDArray[np.int32], weights: NDArray[np.float32], joint_count: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of `Runs`: what hangs on each joint in runs of at most `RUN` skins, as their messages lie."""
    pairs, starts = group_by(slots.ravel(), np.flatnonzero(weights.ravel() > 0.0), joint_count)
    runs_of = -(-np.diff(starts) // RUN)
    first_runs = np.concatenate([[0], np.cumsum(runs_of)])
    joints = np.repeat(np.arange(joint_count), runs_of)
    first_pairs = starts[joints] + RUN * (np.arange(len(joints)) - first_runs[joints])
    return {
        "places": (pairs // slots.shape[1]).astype(np.int32),
        "weights": weights.ravel()[pairs],
        "first_pairs": np.append(first_pairs, len(pairs)).astype(np.int32),
        "joints": joints.astype(np.int32),
        "first_runs": first_runs.astype(np.int32),
    }
