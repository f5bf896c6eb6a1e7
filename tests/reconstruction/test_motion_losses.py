"""Terms of motion: closed forms, float64 twins and their differences, threads, refusals."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import motion_losses as twin
from reference.image_losses import slope
from reference.skinning import product
from scipy.spatial.transform import Rotation
from support.float32 import EPSILON, relative_error, require_same_in_a_graph, single, vectors, zeros
from support.moving_ball import ball_cloud
from support.threads import require_same_on_any_threads

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.reconstruction.joints.graph import JointGraph
from beam_warp.reconstruction.joints.rigidity import RigidityLoss
from beam_warp.reconstruction.parameters import GaussianParameters
from beam_warp.reconstruction.temporal import TemporalTerms

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def rigidity(graph, poses, device, weight=1.0):
    """Value and gradients of rotations and positions."""
    count = len(poses[0])
    out = zeros(count, 4, device), zeros(count, 3, device)
    found = RigidityLoss(graph, device=device)(
        *(vectors(pose, device) for pose in poses), weight=weight, rotation_gradients=out[0], position_gradients=out[1]
    )
    return float(found.numpy()[0]), out[0].numpy().astype(float), out[1].numpy().astype(float)


def turns(rng, count, angle):
    return Rotation.from_rotvec(angle * rng.uniform(-1.0, 1.0, (count, 3))).as_quat()


def motion(rng, count, *, angle, shift):
    """Joints before and after a motion that is not rigid; rotations of any length."""
    before = single(rng.uniform(-1.0, 1.0, (count, 3)))
    turned_before = single(turns(rng, count, 2.0) * rng.uniform(0.5, 2.0, (count, 1)))
    turned = single(product(turns(rng, count, angle), turned_before) * rng.choice([-1.0, 1.5], (count, 1)))
    return turned, single(before + shift * rng.standard_normal((count, 3))), turned_before, before


class TestRigidity:
    def test_stretched_pair(self, device):
        """Two joints, 1 apart and then 1.5: each sees 0.5^2 in spacings of 1."""
        before, now = np.array([[0, 0, 0], [1, 0, 0]]), np.array([[0, 0, 0], [1.5, 0, 0]])
        at_rest = np.tile(IDENTITY, (2, 1))
        found = rigidity(JointGraph.build(before), (at_rest, now, at_rest, before), device, weight=3.0)
        assert found[0] == 0.75
        # d/dx of 3 / 2 * 2 (x - 1)^2, at x = 1.5
        assert (found[2] == [[-3.0, 0, 0], [3.0, 0, 0]]).all()
        assert (found[1] == 0.0).all()  # an edge does not pull at what turns about it

    def test_turned_pair(self, device):
        """Both joints turn by 90 degrees and stay where they are: residuals are the diagonals of squares."""
        joints = np.array([[0, 0, 0], [2.0, 0, 0]])
        now = np.tile(Rotation.from_rotvec([0, 0, np.pi / 2]).as_quat(), (2, 1))
        found = rigidity(JointGraph.build(joints), (now, joints, np.tile(IDENTITY, (2, 1)), joints), device)
        assert found[0] == pytest.approx(2.0, rel=8.0 * EPSILON)

    def test_one_joint(self, device):
        poses = np.array([[0.0, 0, 1, 0]]), np.array([[1.0, 2, 3]]), IDENTITY[None], np.zeros((1, 3))
        found = rigidity(JointGraph.build(poses[3]), poses, device)
        assert found[0] == 0.0
        assert (found[1] == 0.0).all()
        assert (found[2] == 0.0).all()

    def test_rigid_motion_is_free(self, device, rng):
        before, turned_before = single(rng.uniform(-1.0, 1.0, (60, 3))), single(turns(rng, 60, 2.0))
        whole = Rotation.from_rotvec([0.3, -0.8, 0.5])
        now = single(whole.apply(before) + np.array([0.5, -1.0, 2.0]))
        turned = single(product(np.tile(whole.as_quat(), (60, 1)), turned_before))
        graph = JointGraph.build(before)
        found = rigidity(graph, (turned, now, turned_before, before), device)
        # two positions below 4 m are rounded, and quaternions that turn edges below 1 m, some 10 times
        assert found[0] <= ((2.0 * 4.0 + 10.0) * EPSILON / graph.spacing) ** 2

    @pytest.mark.parametrize(("count", "neighbor_count"), [(1, 8), (2, 8), (5, 8), (60, 3), (1025, 8)])
    def test_twin(self, device, rng, count, neighbor_count):
        poses = motion(rng, count, angle=0.5, shift=0.1)
        graph = JointGraph.build(poses[3], neighbor_count)
        found, *_ = rigidity(graph, poses, device, weight=0.3)
        # 20 roundings of numbers some ten times the residual
        expected = 0.3 * twin.rigidity(graph.neighbors, graph.weights, graph.spacing, *poses)
        assert found == pytest.approx(expected, rel=200.0 * EPSILON)

    @pytest.mark.parametrize(("count", "neighbor_count"), [(2, 8), (40, 3)])
    @pytest.mark.parametrize(("angle", "shift"), [(0.5, 0.1), (1e-3, 1e-3)])
    def test_gradients(self, device, rng, count, neighbor_count, angle, shift):
        """Also between two frames, where the motion is a thousandth of the edges."""
        poses = motion(rng, count, angle=angle, shift=shift)
        graph = JointGraph.build(poses[3], neighbor_count)
        _, to_rotations, to_positions = rigidity(graph, poses, device)

        def loss(rotations, positions):
            return twin.rigidity(graph.neighbors, graph.weights, graph.spacing, rotations, positions, *poses[2:])

        # float32 quaternions know a rotation by a thousandth to some 1e-4 of it, and so is the residual known
        tolerance = 1e-5 if angle > 0.1 else 10.0 * EPSILON / angle
        assert relative_error(to_positions, slope(lambda x: loss(poses[0], x), poses[1])) <= tolerance
        assert relative_error(to_rotations, slope(lambda q: loss(q, poses[1]), poses[0])) <= tolerance

    def test_adds(self, device, rng):
        poses = [vectors(pose, device) for pose in motion(rng, 30, angle=0.5, shift=0.1)]
        loss = RigidityLoss(JointGraph.build(poses[3].numpy()), device=device)
        once, twice = (zeros(30, 3, device) for _ in range(2))
        loss(*poses, position_gradients=once)
        for _ in range(2):
            loss(*poses, position_gradients=twice)
        assert (twice.numpy() == 2.0 * once.numpy()).all()

    def test_same_bits_for_every_number_of_threads(self, device, rng, monkeypatch):
        poses = motion(rng, 3000, angle=0.5, shift=0.1)
        graph = JointGraph.build(poses[3])
        require_same_on_any_threads(monkeypatch, lambda: rigidity(graph, poses, device))

    @given(scale=st.floats(1e-3, 1e3), copies=st.integers(1, 3))
    @settings(max_examples=10, deadline=None)
    def test_neither_the_unit_nor_the_number_of_joints_matters(self, scale, copies):
        poses = motion(np.random.default_rng(3), 30, angle=0.5, shift=0.1)
        far = 100.0 * np.arange(copies).repeat(30)[:, None] * [1.0, 0.0, 0.0]
        many = [np.tile(pose, (copies, 1)) for pose in poses]
        many[1], many[3] = (scale * (many[i] + far) for i in (1, 3))
        one, *_ = rigidity(JointGraph.build(poses[3]), poses, "cpu")
        found, *_ = rigidity(JointGraph.build(many[3]), many, "cpu")
        # positions up to 200 are rounded, by which residuals of 0.1 change
        assert found == pytest.approx(one, rel=2.0 * 4.0 * 200.0 * EPSILON / 0.1)

    def test_capture_in_a_graph(self, device, rng):
        poses = [vectors(pose, device) for pose in motion(rng, 30, angle=0.5, shift=0.1)]
        loss = RigidityLoss(JointGraph.build(poses[3].numpy()), device=device)
        gradient, result = zeros(30, 3, device), loss(*poses)
        require_same_in_a_graph(lambda: loss(*poses, position_gradients=gradient), [gradient, result], device)

    def test_refusals(self, rng):
        poses = [vectors(pose, "cpu") for pose in motion(rng, 5, angle=0.5, shift=0.1)]
        loss = RigidityLoss(JointGraph.build(poses[3].numpy()), device="cpu")
        with pytest.raises(InvalidArrayError, match="positions must be a contiguous warp array of 5 vec3 on cpu"):
            loss(poses[0], poses[0], *poses[2:])
        with pytest.raises(InvalidArrayError, match="rotations must be a contiguous warp array of 5 quat on cpu"):
            loss(poses[0].numpy(), *poses[1:])
        with pytest.raises(InvalidOptionError, match="weight must be a number in"):
            loss(*poses, weight=float("nan"))


class TestTemporal:
    @pytest.mark.parametrize("count", [1, 1025])
    def test_each_attribute_is_held_in_its_own_unit(self, device, rng, count):
        """Gradients of means of squares add up; orientations are free, and so are rows held to what they became."""
        parameters = GaussianParameters(ball_cloud(count), wp.get_device(device))
        terms, before = TemporalTerms(parameters, 0.5), parameters.rows()
        before = {name: array.copy() for name, array in before.items()}
        parameters.set_rows({name: array + rng.normal(size=array.shape) for name, array in before.items()})
        for _ in range(2):
            terms.add_gradients(0.3)
        for name, unit in {"positions": 0.05, **TemporalTerms.UNITS}.items():
            change = parameters.rows()[name].astype(float) - before[name]
            expected = 2.0 * 2.0 * 0.3 * change / unit**2 / change.size
            assert relative_error(parameters.gradient(name).numpy(), expected) <= 8.0 * EPSILON
        assert not parameters.gradient("orientations").numpy().any()
        parameters.zero_gradients()
        terms.hold(np.arange(count) % 2 == 0)
        terms.add_gradients(0.3)
        found = parameters.gradient("logits").numpy()
        assert not found[::2].any()
        assert found[1::2].all()

    def test_gaussians_that_are_points_are_refused(self):
        parameters = GaussianParameters(ball_cloud(2), wp.get_device("cpu"))
        with pytest.raises(InvalidOptionError, match="spacing must be a number in"):
            TemporalTerms(parameters, 0.0)
