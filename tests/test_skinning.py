"""Skinning: closed forms, float64 twins and their differences, threads, refusals."""

import numpy as np
import pytest
import warp as wp
from reference import skinning as twin
from scipy.spatial.transform import Rotation

from beam_warp.skinning import Anchors, Skin

EPSILON = 2.0**-24
"""Largest relative rounding of a float32."""

BLENDS = ("linear", "dual")


def vectors(array, device):
    array = np.asarray(array, np.float32)
    return wp.array(array, dtype=wp.vec3 if array.shape[1] == 3 else wp.quat, device=device)


def zeros(count, width, device):
    return wp.zeros(count, dtype=wp.vec3 if width == 3 else wp.quat, device=device)


def single(array):
    """Values that float32 holds, in float64."""
    return np.asarray(array, np.float32).astype(float)


def scene(rng, skin_count, joint_count, neighbor_count=8, turn=0.8):
    """Rest = (x, orientations, joints, weights, joint positions), and the joints' poses."""
    joint_rest = single(rng.uniform(-1.0, 1.0, (joint_count, 3)))
    x = single(rng.uniform(-1.0, 1.0, (skin_count, 3)))
    anchors = Anchors.fit(x, joint_rest, neighbor_count=neighbor_count)
    orientations = single(twin.unit(rng.standard_normal((skin_count, 4))))
    turns = Rotation.from_rotvec(turn * rng.uniform(-1.0, 1.0, (joint_count, 3))).as_quat()
    lengths = rng.uniform(0.5, 2.0, (joint_count, 1)) * rng.choice([-1.0, 1.0], (joint_count, 1))
    positions = single(joint_rest + 0.2 * rng.standard_normal((joint_count, 3)))
    rest = (x, orientations, anchors.joints, anchors.weights.astype(float), joint_rest)
    return rest, single(lengths * turns), positions


def make(rest, blend, device):
    x, orientations, joints, weights, joint_rest = rest
    return Skin(x, orientations, Anchors(joints, weights.astype(np.float32)), joint_rest, blend=blend, device=device)


def warped(skin, rotations, positions):
    count = len(skin.rest_positions)
    out = zeros(count, 3, skin.device), zeros(count, 4, skin.device)
    skin.warp(vectors(rotations, skin.device), vectors(positions, skin.device), *out)
    return out[0].numpy().astype(float), out[1].numpy().astype(float)


def gradients(skin, rotations, positions, to_positions, to_orientations):
    count = len(rotations)
    out = zeros(count, 4, skin.device), zeros(count, 3, skin.device)
    skin.add_gradients(
        vectors(rotations, skin.device),
        vectors(positions, skin.device),
        None if to_positions is None else vectors(to_positions, skin.device),
        None if to_orientations is None else vectors(to_orientations, skin.device),
        *out,
    )
    return out[0].numpy().astype(float), out[1].numpy().astype(float)


def slope(loss, array, step=1e-5):
    """Central differences."""
    found = np.empty(array.shape)
    for i in np.ndindex(*array.shape):
        moved = np.zeros(array.shape)
        moved[i] = step
        found[i] = (loss(array + moved) - loss(array - moved)) / (2.0 * step)
    return found


def relative_error(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("blend", BLENDS)
class TestWarp:
    @pytest.mark.parametrize(
        ("skin_count", "joint_count", "neighbor_count"),
        [(1, 1, 8), (5, 3, 8), (1, 40, 4), (1023, 50, 8), (1024, 50, 1), (1025, 7, 5)],
    )
    def test_twin(self, device, rng, blend, skin_count, joint_count, neighbor_count):
        rest, rotations, positions = scene(rng, skin_count, joint_count, neighbor_count)
        found = warped(make(rest, blend, device), rotations, positions)
        expected = twin.warp(rest, rotations, positions, blend)
        # some 40 roundings of numbers below 4, in quaternions below 1; cancellation in b at these turns is below 2
        assert np.abs(found[0] - expected[0]).max() <= 2.0 * 40.0 * 4.0 * EPSILON
        assert np.abs(found[1] - expected[1]).max() <= 2.0 * 40.0 * EPSILON

    @pytest.mark.parametrize("parts", ["both", "positions", "orientations"])
    @pytest.mark.parametrize(
        ("skin_count", "joint_count", "neighbor_count"), [(1, 1, 8), (9, 3, 8), (70, 6, 4), (200, 3, 2)]
    )
    def test_gradients(self, device, rng, blend, skin_count, joint_count, neighbor_count, parts):
        rest, rotations, positions = scene(rng, skin_count, joint_count, neighbor_count)
        to_positions = None if parts == "orientations" else single(rng.standard_normal((skin_count, 3)))
        to_orientations = None if parts == "positions" else single(rng.standard_normal((skin_count, 4)))
        found = gradients(make(rest, blend, device), rotations, positions, to_positions, to_orientations)
        sign = twin.signs(rotations, rest[2])

        def loss(q, x):
            moved, turned = twin.warp(rest, q, x, blend, sign)
            to_x = 0.0 if to_positions is None else (to_positions * moved).sum()
            return to_x + (0.0 if to_orientations is None else (to_orientations * turned).sum())

        expected = slope(lambda q: loss(q, positions), rotations), slope(lambda x: loss(rotations, x), positions)
        assert relative_error(found[0], expected[0]) <= 1e-5
        if parts == "orientations":
            assert (found[1] == 0.0).all()
        else:
            assert relative_error(found[1], expected[1]) <= 1e-5
        along = (found[0] * rotations).sum(1) / np.linalg.norm(rotations, axis=1)
        assert np.abs(along).max() <= 16.0 * EPSILON * np.linalg.norm(found[0], axis=1).max()
