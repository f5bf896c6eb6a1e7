"""Skinning: closed forms, float64 twins and their differences, threads, refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import skinning as twin
from reference.image_losses import slope
from scipy.spatial.transform import Rotation
from support.float32 import EPSILON, relative_error, require_same_in_a_graph, single, vectors, zeros
from support.threads import require_same_on_any_threads

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.reconstruction.joints.skinning import Anchors, Skin

BLENDS = ("linear", "dual")


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
    forces = (None if force is None else vectors(force, skin.device) for force in (to_positions, to_orientations))
    skin.add_gradients(vectors(rotations, skin.device), vectors(positions, skin.device), *forces, *out)
    return out[0].numpy().astype(float), out[1].numpy().astype(float)


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
    @pytest.mark.parametrize(("skin_count", "joint_count", "neighbor_count"), [(1, 1, 8), (9, 3, 8), (200, 3, 2)])
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

    def test_rigid_motion(self, device, rng, blend):
        rest, *_ = scene(rng, 300, 40)
        whole, shift = Rotation.from_rotvec([0.4, -1.1, 2.0]), np.array([3.0, -2.0, 1.0])
        turned = np.tile(whole.as_quat(), (40, 1)) * rng.choice([-1.0, 3.0], (40, 1))
        positions, orientations = warped(make(rest, blend, device), turned, whole.apply(rest[4]) + shift)
        # positions below 8 are rounded as input and output, joints' offsets below 4 some 20 times
        assert np.abs(positions - (whole.apply(rest[0]) + shift)).max() <= (2.0 * 8.0 + 20.0 * 4.0) * EPSILON
        expected = twin.product(np.tile(whole.as_quat(), (300, 1)), rest[1])
        assert np.abs(np.abs((orientations * expected).sum(1)) - 1.0).max() <= 20.0 * EPSILON

    def test_twist(self, device, blend):
        """A bar between a joint at rest and one twisted by t about it: the candy wrapper, and what dual blending cures.

        In the middle, a distance r off the axis, linear blending leaves cos(t / 2) r of r, dual blending all of it.
        Both turn the orientation by t / 2.
        """
        joints, x = np.array([[0.0, 0, 0], [0, 0, 2.0]]), np.array([[0.5, 0, 1.0]])
        skin = Skin(x, [[0, 0, 0, 1.0]], Anchors.fit(x, joints), joints, blend=blend, device=device)
        for twist in (0.5, 1.5, 2.5, 3.1):
            half = 0.5 * twist
            positions, orientations = warped(skin, [[0, 0, 0, 1], [0, 0, np.sin(half), np.cos(half)]], joints)
            radius = 0.5 * (np.cos(half) if blend == "linear" else 1.0)
            expected = [radius * np.cos(half), radius * np.sin(half), 1.0]
            # |b| = cos(t / 4) is above 0.7
            assert np.abs(positions[0] - expected).max() <= 40.0 * EPSILON
            assert np.abs(orientations[0] - [0, 0, np.sin(0.5 * half), np.cos(0.5 * half)]).max() <= 20.0 * EPSILON

    def test_the_sign_of_a_rotation_changes_nothing(self, device, rng, blend):
        rest, rotations, positions = scene(rng, 200, 20)
        skin = make(rest, blend, device)
        flipped = rotations * rng.choice([-1.0, 1.0], (20, 1))
        one, other = warped(skin, rotations, positions), warped(skin, flipped, positions)
        assert (one[0] == other[0]).all()
        assert (np.abs(one[1]) == np.abs(other[1])).all()

    def test_far_from_the_origin(self, device, rng, blend):
        """A capture 1 km away loses the digits of its positions, no more."""
        rest, rotations, positions = scene(rng, 200, 20)
        far = np.array([1000.0, -500.0, 200.0])
        x, orientations, joints, weights, joint_rest = rest
        moved = single(x + far), orientations, joints, weights, single(joint_rest + far)
        found = warped(make(moved, blend, device), rotations, positions + far)
        expected = warped(make(rest, blend, device), rotations, positions)
        # three positions below 1024 are rounded, each as if by 1024 x 2^-24, and so is the result
        assert np.abs(found[0] - far - expected[0]).max() <= 8.0 * 1024.0 * EPSILON

    def test_gradients_add(self, device, rng, blend):
        rest, rotations, positions = scene(rng, 100, 10)
        skin, force = make(rest, blend, device), vectors(rng.standard_normal((100, 3)), device)
        poses = vectors(rotations, device), vectors(positions, device)
        once, twice = ((zeros(10, 4, device), zeros(10, 3, device)) for _ in range(2))
        skin.add_gradients(*poses, force, None, *once)
        for _ in range(2):
            skin.add_gradients(*poses, force, None, *twice)
        for one, two in zip(once, twice, strict=True):
            assert (two.numpy() == 2.0 * one.numpy()).all()

    def test_same_bits_for_every_number_of_threads(self, device, rng, blend, monkeypatch):
        rest, rotations, positions = scene(rng, 3500, 1500, 4)
        to_positions, to_orientations = rng.standard_normal((3500, 3)), rng.standard_normal((3500, 4))

        def run():
            skin = make(rest, blend, device)
            moved = warped(skin, rotations, positions)
            return *moved, *gradients(skin, rotations, positions, to_positions, to_orientations)

        require_same_on_any_threads(monkeypatch, run)

    @pytest.mark.parametrize("count", [1, 32, 33, 65])
    def test_runs_of_one_joint(self, device, rng, blend, count):
        """Every skin on one joint, as many as straddle runs: the joint's gradient is the sum of them."""
        rest, rotations, positions = scene(rng, count, 1)
        skin, force = make(rest, blend, device), single(rng.standard_normal((count, 3)))
        _, to_positions = gradients(skin, rotations, positions, force, None)
        assert np.abs(to_positions[0] - force.sum(0)).max() <= (count + 8.0) * EPSILON * np.abs(force).sum(0).max()

    def test_a_joint_that_carries_nothing(self, device, rng, blend):
        rest, rotations, positions = scene(rng, 20, 6)
        rest = (*rest[:2], np.zeros_like(rest[2]), np.tile([1.0, 0, 0, 0, 0, 0], (20, 1)), rest[4])
        found = gradients(make(rest, blend, device), rotations, positions, np.ones((20, 3)), np.ones((20, 4)))
        assert (found[0][1:] == 0.0).all()
        assert (found[1][1:] == 0.0).all()
        assert found[1][0] == pytest.approx([20.0, 20.0, 20.0], rel=20.0 * EPSILON)

    def test_capture_in_a_graph(self, device, rng, blend):
        rest, rotations, positions = scene(rng, 500, 30)
        skin, poses = make(rest, blend, device), (vectors(rotations, device), vectors(positions, device))
        upstream = vectors(rng.standard_normal((500, 3)), device), vectors(rng.standard_normal((500, 4)), device)
        out = zeros(500, 3, device), zeros(500, 4, device), zeros(30, 4, device), zeros(30, 3, device)

        def step():
            skin.warp(*poses, *out[:2])
            skin.add_gradients(*poses, *upstream, *out[2:])

        require_same_in_a_graph(step, out, device)

    def test_refusals(self, rng, blend):
        rest, rotations, positions = scene(rng, 20, 6)
        skin = make(rest, blend, "cpu")
        with pytest.raises(InvalidArrayError, match="joint_positions must be a contiguous warp array of 6 vec3 on cpu"):
            warped(skin, rotations, positions[:5])
        with pytest.raises(InvalidArrayError, match="joint_rotations must be a contiguous warp array of 6 quat on cpu"):
            skin.warp(rotations, vectors(positions, "cpu"), zeros(20, 3, "cpu"), zeros(20, 4, "cpu"))
        x, orientations, joints, weights, joint_rest = rest
        with pytest.raises(InvalidArrayError, match=r"anchors\.joints must lie in \[0, 4\], got 5"):
            make((x, orientations, joints, weights, joint_rest[:5]), blend, "cpu")
        with pytest.raises(InvalidArrayError, match=r"anchors\.weights must add up to 1 in each row and begin with"):
            make((x, orientations, joints, weights[:, ::-1], joint_rest), blend, "cpu")
        with pytest.raises(InvalidArrayError, match=r"anchors\.joints must have at least one column"):
            make((x, orientations, joints[:, :0], weights[:, :0], joint_rest), blend, "cpu")
        with pytest.raises(InvalidArrayError, match="rest_positions must be finite, got NaN or infinity at row 3"):
            make((np.where(np.arange(20)[:, None] == 3, np.nan, x), *rest[1:]), blend, "cpu")
        with pytest.raises(InvalidOptionError, match="blend must be one of linear, dual, got 'cubic'"):
            make(rest, "cubic", "cpu")


class TestAnchors:
    def test_closed_form(self):
        """Joints 1 apart: l = 1.5, and distances of 0 and 1 weigh 1 : exp(-1 / 2.25)."""
        anchors = Anchors.fit([[0.0, 0, 0]], [[0.0, 0, 0], [1.0, 0, 0]])
        other = np.exp(-1.0 / 2.25)
        assert (anchors.joints == [[0, 1]]).all()
        assert anchors.weights[0] == pytest.approx([1.0 / (1.0 + other), other / (1.0 + other)], rel=2.0 * EPSILON)

    def test_far_from_every_joint(self):
        anchors = Anchors.fit([[1e6, 1.0, 0]], np.eye(3))
        assert anchors.joints[0, 0] == 0
        assert (anchors.weights == [[1.0, 0.0, 0.0]]).all()

    @given(scale=st.floats(1e-4, 1e4))
    @settings(max_examples=20, deadline=None)
    def test_units_do_not_matter(self, scale):
        rng = np.random.default_rng(5)
        x, joints = rng.uniform(size=(50, 3)), rng.uniform(size=(20, 3))
        one, other = Anchors.fit(x, joints), Anchors.fit(scale * x, scale * joints)
        assert (one.joints == other.joints).all()
        assert np.abs(one.weights - other.weights).max() <= 4.0 * EPSILON

    def test_rows(self, rng):
        anchors = Anchors.fit(rng.uniform(size=(500, 3)), rng.uniform(size=(40, 3)), neighbor_count=5)
        assert anchors.joints.shape == anchors.weights.shape == (500, 5)
        assert (np.diff(anchors.weights, axis=1) <= 0.0).all()
        assert np.abs(anchors.weights.sum(axis=1) - 1.0).max() <= 5.0 * EPSILON

    def test_sheets_in_contact(self):
        """Two sheets that face apart, one spacing from each other: no skin hangs on joints of the other one."""
        y, x = np.mgrid[:8, :8].reshape(2, -1)
        joints = np.concatenate([np.stack([x, y, 0 * x + z], axis=1) for z in (0.0, 1.0)])
        facing = np.repeat([[0, 0, -1.0], [0, 0, 1.0]], 64, axis=0)
        skins, of = joints + np.array([0.2, 0.1, 0.0]), np.arange(128) // 64
        apart = Anchors.fit(skins, joints, normals=facing, joint_normals=facing)
        assert ((apart.joints // 64 == of[:, None]) | (apart.weights == 0.0)).all()
        assert (apart.weights[:, 7] > 0.0).all()
        blind = Anchors.fit(skins, joints)
        assert (blind.joints // 64 != of[:, None]).any(axis=1).all()

    def test_normals_that_all_disagree(self):
        """Nothing else is near: anchors are those without normals."""
        x, joints = np.zeros((1, 3)), np.array([[0.0, 0, 1], [0, 2.0, 0], [0, 0, 5.0]])
        found = Anchors.fit(x, joints, normals=[[0, 0, 1.0]], joint_normals=np.tile([0, 0, -1.0], (3, 1)))
        plain = Anchors.fit(x, joints)
        assert (found.joints == plain.joints).all()
        assert (found.weights == plain.weights).all()

    def test_refusals(self):
        with pytest.raises(InvalidArrayError, match="joint_positions must be apart, got 4 joints of which half"):
            Anchors.fit(np.zeros((1, 3)), np.zeros((4, 3)))
        with pytest.raises(InvalidArrayError, match="joint_positions must hold at least one point, got none"):
            Anchors.fit(np.zeros((1, 3)), np.zeros((0, 3)))
        with pytest.raises(InvalidOptionError, match="neighbor_count must be an integer in"):
            Anchors.fit(np.zeros((1, 3)), np.eye(3), neighbor_count=0)
        with pytest.raises(InvalidArrayError, match=r"joint_normals must have shape \(3, 3\), got \(2, 3\)"):
            Anchors.fit(np.zeros((1, 3)), np.eye(3), normals=np.ones((1, 3)), joint_normals=np.ones((2, 3)))
