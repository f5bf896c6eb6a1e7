"""Energy of joints that do not move rigidly with their neighbours, and its gradients with respect to their poses.

An edge from joint i to joint j leaves, with D_i = q_i conj(q_i,previous), the residual

    r_ij = R(D_i) (x_i - x_j)_previous - (x_i - x_j) = (R(D_i) v - v) - (d_i - d_j),

v = (x_i - x_j)_previous and d the joints' displacements. The latter form is what is computed: between two frames both
parts are small, while the edges themselves differ in their last digits only. Every joint reads the edges that leave it
and those that come to it, the latter once more than needed: nothing is shared, orders are fixed.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.common.quaternions import (
    as_row,
    conjugate,
    load_quaternion,
    load_rotation,
    normalization_adjoint,
    rotate_adjoint,
    vector_part,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class EdgeArrays:
    """`beam_warp.reconstruction.joints.graph.JointGraph` on a device."""

    neighbors: wp.array2d[int]
    weights: wp.array2d[float]
    incoming: wp.array[int]
    incoming_starts: wp.array[int]


@wp.struct
class JointPoses:
    """Rotations of joints against their rest, of any length but 0, and their positions."""

    rotations: wp.array[wp.vec4]
    positions: wp.array[wp.vec3]


@wp.func
def turned_since(now: JointPoses, previous: JointPoses, joint: int) -> wp.quat:
    """D, of unit length."""
    return load_rotation(now.rotations, joint) * conjugate(load_rotation(previous.rotations, joint))


@wp.func
def residual(now: JointPoses, previous: JointPoses, turn: wp.quat, joint: int, other: int) -> wp.vec3:
    """r of the edge from ``joint``, that has turned by ``turn``, to ``other``."""
    v = previous.positions[joint] - previous.positions[other]
    u = vector_part(turn)
    swept = 2.0 * (turn[3] * wp.cross(u, v) + wp.cross(u, wp.cross(u, v)))
    moved = now.positions[joint] - previous.positions[joint]
    return swept - (moved - (now.positions[other] - previous.positions[other]))


@wp.kernel
def add_rigidity_kernel(
    first: int,
    edges: EdgeArrays,
    now: JointPoses,
    previous: JointPoses,
    scale: float,
    out_terms: wp.array[float],
    out_rotation_gradients: wp.array[wp.vec4],
    out_position_gradients: wp.array[wp.vec3],
):
    joint = first + wp.tid()
    turn = turned_since(now, previous, joint)
    degree = edges.neighbors.shape[1]
    term = float(0.0)
    to_position = wp.vec3(0.0, 0.0, 0.0)
    to_turn = wp.quat(0.0, 0.0, 0.0, 0.0)
    for slot in range(degree):
        weight = edges.weights[joint, slot]
        if weight > 0.0:
            other = edges.neighbors[joint, slot]
            r = residual(now, previous, turn, joint, other)
            term += weight * wp.dot(r, r)
            g = (2.0 * scale * weight) * r
            to_position -= g
            to_turn += rotate_adjoint(turn, previous.positions[joint] - previous.positions[other], g)
    out_terms[joint] = term
    if out_rotation_gradients:
        to_rotation = to_turn * load_rotation(previous.rotations, joint)  # <G, q conj(p)> = <G p, q>
        to_rotation = normalization_adjoint(load_quaternion(now.rotations, joint), to_rotation)
        out_rotation_gradients[joint] += as_row(to_rotation)
    if out_position_gradients:
        for entry in range(edges.incoming_starts[joint], edges.incoming_starts[joint + 1]):
            edge = edges.incoming[entry]
            other = edge / degree
            r = residual(now, previous, turned_since(now, previous, other), other, joint)
            to_position += (2.0 * scale * edges.weights[other, edge % degree]) * r
        out_position_gradients[joint] += to_position


def launch_add_rigidity(
    edges: Any,
    now: Any,
    previous: Any,
    scale: float,
    out_terms: Any,
    out_rotation_gradients: Any,
    out_position_gradients: Any,
    device: Any,
) -> None:
    """Write every joint's weighted sum of squared residuals, and add ``scale`` times its gradients."""
    inputs = [edges, now, previous, scale]
    outputs = [out_terms, out_rotation_gradients, out_position_gradients]
    launch(add_rigidity_kernel, out_terms.size, inputs=inputs, outputs=outputs, device=device)
