"""The rigidity term of tracking: joints move rigidly with their neighbours, as far as images allow (E_smooth).

As in `beam_warp.raster.losses`, the term called adds its gradients to arrays that other terms add to as well, and
returns its value in an array of one element that it owns: valid until its next call. Nothing is allocated in a call and
nothing waits for the device: calls may be captured in a CUDA graph, where weights stay as they were captured. Sums go
in a fixed order: same device, same input, same bits.

The value is a mean in units that follow from the joints: a weight means the same for any number of joints and any unit
of length.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from beam_warp.checks import require_number
from beam_warp.device.array_checks import require_vectors
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.kernels.common.fixed_sums import SumBuffers, launch_sum_floats
from beam_warp.kernels.reconstruction.rigidity import EdgeArrays, JointPoses, launch_add_rigidity
from beam_warp.reconstruction.joints.graph import JointGraph


class RigidityLoss:
    """The part of the joints' motion that is not rigid around each of them (E_smooth, as rigid as possible).

    Source: Jiang et al. 2024, DualGS, E_smooth; there a sum over all edges in squared units of the world, here a mean
    over the joints in squared joint spacings. `docs/tracking.md` says which weight is which.
    """

    def __init__(self, graph: JointGraph, *, device: Any = None) -> None:
        """Upload a graph.

        Args:
            graph: Graph of the joints; its spacing is the unit of length.
            device: Warp device; the first GPU without, or the CPU where there is none.

        Raises:
            DeviceError: The device is not there.
        """
        self.device = resolve_device(device)
        self._count = len(graph.neighbors)
        self._spacing = graph.spacing
        self._edges = EdgeArrays()
        self._edges.neighbors = upload(graph.neighbors, int, self.device)
        self._edges.weights = upload(graph.weights, float, self.device)
        self._edges.incoming = upload(graph.incoming, int, self.device)
        self._edges.incoming_starts = upload(graph.incoming_starts, int, self.device)
        self._terms = wp.empty(self._count, dtype=float, device=self.device)
        self._value = wp.zeros(1, dtype=float, device=self.device)
        self._sums = SumBuffers(self.device)

    def __call__(
        self,
        rotations: wp.array,
        positions: wp.array,
        previous_rotations: wp.array,
        previous_positions: wp.array,
        *,
        weight: float = 1.0,
        rotation_gradients: wp.array | None = None,
        position_gradients: wp.array | None = None,
        value: bool = True,
    ) -> wp.array:
        """Return weight / (M s^2) sum_i sum_j w_ij |R_i R_i,p^T (x_i - x_j)_p - (x_i - x_j)|^2, and add its gradients.

        The sums are over the M joints and their edges, p is what came before, s is the graph's spacing. With the pose
        at rest as the previous one (rotations of 0, 0, 0, 1) it is how far the shape is from the one at rest.

        Args:
            rotations: Rotations of the joints now, against rest, xyzw, ``(M,)`` quat or vec4; of any length but 0.
            positions: Positions of the joints now, ``(M,)`` vec3.
            previous_rotations: Rotations before, like ``rotations``, without a gradient.
            previous_positions: Positions before, like ``positions``, without a gradient.
            weight: The factor of the term, at least 0.
            rotation_gradients: The derivative with respect to ``rotations`` is added to it, ``(M,)`` quat or vec4;
                orthogonal to them, as their length changes nothing.
            position_gradients: The derivative with respect to ``positions`` is added to it, ``(M,)`` vec3.
            value: Whether the sum is found; else what is returned is that of before.

        Raises:
            InvalidArrayError: An array has another type, length or device.
            InvalidOptionError: ``weight`` is negative.
        """
        scale = require_number("weight", weight, 0.0) / (self._count * self._spacing**2)
        launch_add_rigidity(
            self._edges,
            joint_poses("", rotations, positions, self._count, self.device),
            joint_poses("previous_", previous_rotations, previous_positions, self._count, self.device),
            scale,
            self._terms,
            None if rotation_gradients is None else self._vectors("rotation_gradients", rotation_gradients, 4),
            None if position_gradients is None else self._vectors("position_gradients", position_gradients, 3),
            self.device,
        )
        if value:
            launch_sum_floats(self._terms, scale, self._sums, self._value, self.device)
        return self._value

    def _vectors(self, name: str, value: wp.array, width: int) -> wp.array:
        return require_vectors(name, value, self._count, width, self.device)


def joint_poses(prefix: str, rotations: Any, positions: Any, count: int, device: Any) -> JointPoses:
    """Return the poses of ``count`` joints as kernels read them; a prefix of both names says which poses these are.

    Raises:
        InvalidArrayError: An array has another type, length or device.
    """
    poses = JointPoses()
    poses.rotations = require_vectors(f"{prefix}rotations", rotations, count, 4, device)
    poses.positions = require_vectors(f"{prefix}positions", positions, count, 3, device)
    return poses
