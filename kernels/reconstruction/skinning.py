"""Skin Gaussians carried by the joints that they are anchored to, and how a loss on the skin changes with the joints.

Every skin has k slots of (joint, weight). With unit rotations q_a, signs s_a that turn them to the side of the first
slot's, and y_a = R_a (x - x_a,rest) + x_a, where joint a alone would carry the skin,

    b = sum w_a s_a q_a,    orientation' = (b / |b|) orientation,
    linear:  x' = sum w_a y_a,
    dual:    x' = vec(e conj(b)) / |b|^2,    e = sum w_a s_a (y_a, 0) q_a.

The latter is dual quaternion blending (Kavan et al. 2008): it does not depend on the origins that rest and posed points
are measured from, so the skin itself can be the rest origin, which leaves y_a as the translation of joint a. Both are
measured from the first slot's joint here: e is a difference of products, and far from the origin would lose its digits.

Gradients go the other way in three steps: every skin finds dL/db and dL/de; every run of at most `RUN` of the skins
that hang on one joint adds up what this tells the joint; every joint adds up its runs. Nothing is shared, orders are
fixed. Skins come in any order, so what they tell is laid down by their first joint: a joint then reads a few stretches
of memory, not hundreds of places (a third of the time on a CPU).
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
    pure,
    rotate_adjoint,
    vector_part,
)
from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.reconstruction.rigidity import JointPoses

wp.set_module_options({"enable_backward": False})

RUN = 32
"""Skins that one thread adds up for a joint. A joint carries hundreds, and there are too few joints for a GPU."""

MESSAGE = wp.constant(3)
"""Rows in which a skin tells its joints what they need: its position at rest and first joint; dL/db; dL/dx', or dL/de
for dual blends."""

MOST_JOINTS = 2**24
"""Joint numbers travel in messages as float32, which holds them up to here."""


@wp.struct
class RestSkin:
    """Skins and joints at rest, and their anchors. Slots are (k, N): neighbouring threads read neighbours."""

    positions: wp.array[wp.vec3]  # of the skins
    orientations: wp.array[wp.vec4]
    joints: wp.array2d[int]
    weights: wp.array2d[float]
    joint_positions: wp.array[wp.vec3]
    places: wp.array[int]  # of each skin's message; those of one first joint lie together
    dual: int


@wp.struct
class Runs:
    """Pairs of skins and joints, cut into runs: pairs of a run are neighbours, and so are the runs of a joint."""

    places: wp.array[int]  # of each pair: where its skin's message is; ascending in each joint
    weights: wp.array[float]
    first_pairs: wp.array[int]  # of each run, and the end of the last
    joints: wp.array[int]  # of each run
    first_runs: wp.array[int]  # of each joint, and the end of the last


@wp.struct
class Messages:
    """What skins and runs of skins tell their joints, on the way to the gradients of the joints' poses."""

    skins: wp.array[wp.vec4]  # `MESSAGE` rows for each skin
    run_rotations: wp.array[wp.vec4]
    run_positions: wp.array[wp.vec3]


@wp.struct
class Blend:
    rotation: wp.quat  # b, not of unit length
    swept: wp.quat  # e, from the origin; dual only
    moved: wp.vec3  # x', from the origin
    origin: wp.vec3


@wp.func
def signed_weight(weight: float, rotation: wp.quat, first: wp.quat) -> float:
    """The weight, negative if -rotation, the same rotation, is nearer to the first slot's."""
    result = weight
    if wp.dot(rotation, first) < 0.0:
        result = -weight
    return result


@wp.func
def blend_joints(rest: RestSkin, poses: JointPoses, skin: int) -> Blend:
    x = rest.positions[skin]
    head = rest.joints[0, skin]
    first = load_rotation(poses.rotations, head)
    blend = Blend()
    blend.origin = poses.positions[head]
    for slot in range(rest.joints.shape[0]):
        joint = rest.joints[slot, skin]
        weight = rest.weights[slot, skin]
        rotation = load_rotation(poses.rotations, joint)
        y = wp.quat_rotate(rotation, x - rest.joint_positions[joint]) + (poses.positions[joint] - blend.origin)
        signed = signed_weight(weight, rotation, first)
        blend.rotation += signed * rotation
        blend.moved += weight * y
        if rest.dual != 0:
            blend.swept += signed * (pure(y) * rotation)
    if rest.dual != 0:
        norm = wp.dot(blend.rotation, blend.rotation)
        blend.moved = vector_part(blend.swept * conjugate(blend.rotation)) / norm
    return blend


@wp.kernel
def warp_skin_kernel(
    first: int, rest: RestSkin, poses: JointPoses, out_positions: wp.array[wp.vec3], out_orientations: wp.array[wp.vec4]
):
    skin = first + wp.tid()
    blend = blend_joints(rest, poses, skin)
    out_positions[skin] = blend.origin + blend.moved
    out_orientations[skin] = as_row(wp.normalize(blend.rotation) * load_quaternion(rest.orientations, skin))


@wp.kernel
def write_messages_kernel(
    first: int,
    rest: RestSkin,
    poses: JointPoses,
    position_gradients: wp.array[wp.vec3],
    orientation_gradients: wp.array[wp.vec4],
    out_messages: Messages,
):
    skin = first + wp.tid()
    blend = blend_joints(rest, poses, skin)
    g = wp.vec3(0.0, 0.0, 0.0)
    if position_gradients:
        g = position_gradients[skin]
    to_rotation = wp.quat(0.0, 0.0, 0.0, 0.0)
    if orientation_gradients:
        upstream = load_quaternion(orientation_gradients, skin) * conjugate(load_quaternion(rest.orientations, skin))
        to_rotation = normalization_adjoint(blend.rotation, upstream)
    to_position = pure(g)
    if rest.dual != 0:
        # x' = vec(e conj(b)) / |b|^2 and <(g, 0), e conj(b)> = <(g, 0) b, e> = <-(g, 0) e, b>
        norm = wp.dot(blend.rotation, blend.rotation)
        to_rotation -= (pure(g) * blend.swept + (2.0 * wp.dot(g, blend.moved)) * blend.rotation) / norm
        to_position = pure(g) * blend.rotation / norm
    x = rest.positions[skin]
    message = MESSAGE * rest.places[skin]
    out_messages.skins[message] = wp.vec4(x[0], x[1], x[2], float(rest.joints[0, skin]))
    out_messages.skins[message + 1] = as_row(to_rotation)
    out_messages.skins[message + 2] = as_row(to_position)


@wp.kernel
def sum_runs_kernel(first: int, rest: RestSkin, runs: Runs, poses: JointPoses, out_messages: Messages):
    run = first + wp.tid()
    joint = runs.joints[run]
    rotation = load_rotation(poses.rotations, joint)
    position = poses.positions[joint]
    joint_rest = rest.joint_positions[joint]
    to_rotation = wp.quat(0.0, 0.0, 0.0, 0.0)
    to_position = wp.vec3(0.0, 0.0, 0.0)
    for pair in range(runs.first_pairs[run], runs.first_pairs[run + 1]):
        message = MESSAGE * runs.places[pair]
        weight = runs.weights[pair]
        row = load_row(out_messages.skins, message)
        v = wp.vec3(row[0], row[1], row[2]) - joint_rest
        head = int(row[3])
        signed = signed_weight(weight, rotation, load_rotation(poses.rotations, head))
        upstream = load_quaternion(out_messages.skins, message + 2)
        g = weight * vector_part(upstream)
        to_rotation += signed * load_quaternion(out_messages.skins, message + 1)
        if rest.dual != 0:
            y = wp.quat_rotate(rotation, v) + (position - poses.positions[head])
            to_rotation -= signed * (pure(y) * upstream)
            g = signed * vector_part(upstream * conjugate(rotation))
        to_position += g
        to_rotation += rotate_adjoint(rotation, v, g)
    out_messages.run_rotations[run] = as_row(to_rotation)
    out_messages.run_positions[run] = to_position


@wp.kernel
def add_joint_gradients_kernel(
    first: int,
    runs: Runs,
    poses: JointPoses,
    messages: Messages,
    out_rotations: wp.array[wp.vec4],
    out_positions: wp.array[wp.vec3],
):
    joint = first + wp.tid()
    to_rotation = wp.quat(0.0, 0.0, 0.0, 0.0)
    to_position = wp.vec3(0.0, 0.0, 0.0)
    for run in range(runs.first_runs[joint], runs.first_runs[joint + 1]):
        to_rotation += load_quaternion(messages.run_rotations, run)
        to_position += messages.run_positions[run]
    to_rotation = normalization_adjoint(load_quaternion(poses.rotations, joint), to_rotation)
    out_rotations[joint] += as_row(to_rotation)
    out_positions[joint] += to_position


def launch_warp_skin(rest: Any, poses: Any, out_positions: Any, out_orientations: Any, device: Any) -> None:
    """Write where the joints carry every skin, and how they turn it."""
    outputs = [out_positions, out_orientations]
    launch(warp_skin_kernel, out_positions.size, inputs=[rest, poses], outputs=outputs, device=device)


def launch_add_pose_gradients(
    rest: Any,
    runs: Any,
    poses: Any,
    position_gradients: Any,
    orientation_gradients: Any,
    out_messages: Any,
    out_rotations: Any,
    out_positions: Any,
    device: Any,
) -> None:
    """Add the gradients of the joints' poses, given those of the skins' positions and orientations, or None.

    Runs add up rotations as if they were unit quaternions; the joints' sums go through the normalisation.
    """
    inputs = [rest, poses, position_gradients, orientation_gradients]
    launch(write_messages_kernel, len(rest.places), inputs=inputs, outputs=[out_messages], device=device)
    launch(sum_runs_kernel, len(runs.joints), inputs=[rest, runs, poses], outputs=[out_messages], device=device)
    inputs = [runs, poses, out_messages]
    outputs = [out_rotations, out_positions]
    launch(add_joint_gradients_kernel, out_positions.size, inputs=inputs, outputs=outputs, device=device)
