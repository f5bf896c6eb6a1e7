"""Joints on the host: which Gaussians they are, how they hang together, which ones are torn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from support.float32 import EPSILON

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.reconstruction.joints.graph import JointGraph, torn_fraction
from beam_warp.reconstruction.joints.selection import select_joints


def sphere(rng, count):
    points = rng.standard_normal((count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def two_sheets(side, gap):
    """Square grids of joints 1 apart that face away from each other."""
    y, x = np.mgrid[:side, :side].reshape(2, -1)
    joints = np.concatenate([np.stack([x, y, 0 * x + z], axis=1) for z in (0.0, gap)])
    return joints, np.repeat([[0, 0, -1.0], [0, 0, 1.0]], side * side, axis=0)


class TestSelection:
    @pytest.mark.parametrize(("gaussian_count", "count"), [(20_000, 300), (2000, 500), (300, 300), (50, 3)])
    def test_even(self, rng, gaussian_count, count):
        """No gap is wider than what farthest points of the candidates leave, and no two joints are much nearer."""
        points = sphere(rng, gaussian_count)
        rows = select_joints(points, count)
        assert len(rows) == len(set(rows.tolist())) == count
        apart = cKDTree(points[rows]).query(points[rows], k=2)[0][:, 1].min()
        widest = cKDTree(points[rows]).query(points)[0].max()
        # Of what is chosen from, none is farther from a joint than any two joints from each other. A Gaussian is
        # within a cell's diagonal of the one that stands for its cell; the sphere of side 2 has 4 pi / 4 * 6 / 4 cells
        # of side h for each h^-2 at least (as a cube's faces would), so that 5 count cells have h of at most
        cell = 2.0 / np.sqrt(5.0 * count / 6.0) * np.sqrt(3.0)
        assert widest <= apart + (cell if gaussian_count > 7.5 * count else 1e-6)

    def test_density_does_not_matter(self, rng):
        """Half of the Gaussians lie on a twentieth of the sphere: it gets about a twentieth of the joints."""
        points = sphere(rng, 20_000)
        dense = points[:, 2] > 0.9
        face = sphere(rng, 400_000)
        points = np.concatenate([points[~dense], face[face[:, 2] > 0.9][:19_000]])
        share = (points[select_joints(points, 400)][:, 2] > 0.9).mean()
        # 20 joints, and those within half a spacing (0.09) of the edge, which is 2.7 long: 5 more or fewer
        assert abs(share - 0.05) <= 5.0 / 400.0

    def test_isolated_gaussians(self, rng):
        body, far = sphere(rng, 10_000), 3.0 * sphere(rng, 40)
        rows = select_joints(np.concatenate([body, far]), 500)
        assert len(rows) == 500
        assert (rows < 10_000).all()

    def test_second_object(self, rng):
        """A surface apart from the others is not isolated."""
        ball = 0.1 * sphere(rng, 200) + np.array([3.0, 0, 0])
        rows = select_joints(np.concatenate([sphere(rng, 10_000), ball]), 1000)
        assert 1 <= (rows >= 10_000).sum() <= 50

    def test_faint_gaussians(self, rng):
        opacities = np.where(np.arange(1000) % 2, 0.05, 0.5)
        assert (select_joints(sphere(rng, 1000), 100, opacities=opacities) % 2 == 0).all()

    def test_prefixes_are_spread_out(self, rng):
        points = sphere(rng, 5000)
        first = select_joints(points, 400)[:12]
        # twelve points on a sphere are at most 1.05 apart (an icosahedron); greedy ones at least half of that
        assert cKDTree(points[first]).query(points[first], k=2)[0][:, 1].min() >= 0.525

    def test_points_that_coincide(self):
        assert len(select_joints(np.ones((5000, 3)), 10)) == 1
        assert len(select_joints(np.repeat(np.eye(3), 1000, axis=0), 10)) == 3

    @pytest.mark.parametrize("count", [1, 2, 3])
    def test_few(self, count):
        assert sorted(select_joints(np.eye(3)[:count], count)) == list(range(count))

    @given(scale=st.floats(1e-3, 1e3), seed=st.integers(0, 1000))
    @settings(max_examples=20, deadline=None)
    def test_units_do_not_matter(self, scale, seed):
        """Powers of two are exact, so choices are the same."""
        points = np.random.default_rng(seed).uniform(size=(400, 3))
        power = 2.0 ** np.round(np.log2(scale))
        assert (select_joints(points, 40) == select_joints(power * points, 40)).all()

    def test_refusals(self):
        with pytest.raises(InvalidOptionError, match=r"count must be an integer in \[1, 3\], got 4"):
            select_joints(np.eye(3), 4)
        with pytest.raises(InvalidArrayError, match="positions must be finite, got NaN or infinity at row 1"):
            select_joints([[0, 0, 0], [0, np.nan, 0]], 1)
        with pytest.raises(InvalidArrayError, match=r"positions must hold Gaussians of an opacity of at least 0.1"):
            select_joints(np.eye(3), 1, opacities=np.zeros(3))
        with pytest.raises(InvalidArrayError, match=r"opacities must have shape \(3,\), got \(2,\)"):
            select_joints(np.eye(3), 1, opacities=np.ones(2))


class TestGraph:
    def test_line(self):
        """Joints 1 apart on a line: distances 1, 1 and 2, l = 1.5."""
        graph = JointGraph.build(np.arange(5.0)[:, None] * [1.0, 0, 0], 3)
        assert graph.spacing == 1.0
        assert set(graph.neighbors[0]) == {1, 2, 3}
        assert set(graph.neighbors[2][:2]) == {1, 3}
        one, two = np.exp(-1.0 / 2.25), np.exp(-4.0 / 2.25)
        expected = np.array([one, one, two]) / (2.0 * one + two)
        assert graph.weights[2] == pytest.approx(expected, rel=4.0 * EPSILON)

    @pytest.mark.parametrize(("count", "neighbor_count"), [(1, 8), (2, 8), (9, 8), (9, 3), (200, 8)])
    def test_brute_force(self, rng, count, neighbor_count):
        joints = rng.uniform(size=(count, 3))
        graph = JointGraph.build(joints, neighbor_count)
        degree = min(neighbor_count, count - 1)
        assert graph.neighbors.shape == graph.weights.shape == (count, degree)
        distance = np.linalg.norm(joints[:, None] - joints, axis=-1)
        np.fill_diagonal(distance, np.inf)
        assert (graph.neighbors == np.argsort(distance, axis=1)[:, :degree]).all()
        if degree:
            assert np.abs(graph.weights.sum(axis=1) - 1.0).max() <= degree * EPSILON
        for joint in range(count):
            found = graph.incoming[graph.incoming_starts[joint] : graph.incoming_starts[joint + 1]]
            assert (found == np.flatnonzero(graph.neighbors.ravel() == joint)).all()

    @pytest.mark.parametrize("gap", [1.0, 0.25])
    def test_sheets_in_contact(self, gap):
        """An arm on a hip: no edge goes from one to the other, and every joint keeps its edges on its own sheet."""
        joints, facing = two_sheets(8, gap)
        sheet = np.arange(128) // 64
        graph = JointGraph.build(joints, normals=facing)
        there = graph.weights > 0.0
        assert (sheet[graph.neighbors] == sheet[:, None]).all()
        assert (there.sum(axis=1) == 8).all()
        blind = JointGraph.build(joints)
        assert (sheet[blind.neighbors] != sheet[:, None]).any(axis=1).all()

    def test_fewer_neighbors_that_face_the_same_way(self):
        """Three joints face up, one faces down: edges that are not there lead to the joint itself and weigh nothing."""
        joints = np.array([[0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 0.5]])
        graph = JointGraph.build(joints, normals=[[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, -1.0]])
        assert ((graph.weights > 0.0).sum(axis=1) == [2, 2, 2, 3]).all()  # the last has no other than those
        assert (graph.neighbors[:3, 2] == [0, 1, 2]).all()
        assert len(graph.incoming) == 9

    def test_smallest_cosine(self):
        """The edge of a box: its faces hang together, unless asked otherwise; a joint of unknown direction with all."""
        joints = np.array([[0.1, 0, 1], [1.0, 0, 1], [1.1, 0, 0.9], [1.1, 0, 0], [0.6, 0, 0.6]])
        facing = np.array([[0, 0, 1.0], [0, 0, 1], [1, 0, 0], [1, 0, 0], [0, 0, 0]])
        box = JointGraph.build(joints, 4, normals=facing)
        assert (box.weights > 0.0).all()
        faces = JointGraph.build(joints, 4, normals=facing, smallest_cosine=0.5)
        ends = [set(row[weights > 0.0]) for row, weights in zip(faces.neighbors, faces.weights, strict=True)]
        assert ends == [{1, 4}, {0, 4}, {3, 4}, {2, 4}, {0, 1, 2, 3}]

    def test_joints_that_coincide(self):
        """A pair of twins among others: each is the other's neighbour, and not its own."""
        joints = np.concatenate([np.eye(3), np.ones((1, 3)), np.ones((1, 3))])
        graph = JointGraph.build(joints, 2)
        assert (graph.neighbors != np.arange(5)[:, None]).all()
        assert graph.neighbors[3, 0] == 4
        assert np.isfinite(graph.weights).all()

    def test_refusals(self):
        with pytest.raises(InvalidArrayError, match="joint_positions must be apart"):
            JointGraph.build(np.zeros((4, 3)))
        with pytest.raises(InvalidArrayError, match=r"normals must have shape \(3, 3\), got \(2, 3\)"):
            JointGraph.build(np.eye(3), normals=np.ones((2, 3)))
        with pytest.raises(InvalidOptionError, match="neighbor_count must be an integer in"):
            JointGraph.build(np.eye(3), 65)


class TestTorn:
    def test_closed_form(self):
        """A line of joints 1 apart, its middle edge stretched to more and to less than twice as long."""
        joints = np.arange(4.0)[:, None] * [1.0, 0, 0]
        graph = JointGraph.build(joints, 2)
        for length, torn in ((2.5, 0.5), (1.9, 0.0), (0.4, 0.5)):
            now = np.array([0.0, 1.0, 1.0 + length, 2.0 + length])[:, None] * [1.0, 0, 0]
            assert torn_fraction(graph, joints, now) == torn  # joints 1 and 2, from either side

    def test_rigid_motion(self, rng):
        joints = rng.uniform(size=(50, 3))
        now = Rotation.from_rotvec([1.0, 2.0, -0.5]).apply(joints) + 3.0
        assert torn_fraction(JointGraph.build(joints), joints, now) == 0.0

    def test_edges_that_are_not_there(self):
        joints, facing = two_sheets(2, 0.1)
        now = joints + np.array([0, 0, 5.0]) * (np.arange(8) >= 4)[:, None]
        assert torn_fraction(JointGraph.build(joints, normals=facing), joints, now) == 0.0
        assert torn_fraction(JointGraph.build(joints), joints, now) == 1.0

    def test_one_joint(self):
        assert torn_fraction(JointGraph.build(np.zeros((1, 3))), np.zeros((1, 3)), np.ones((1, 3))) == 0.0

    def test_refusals(self):
        graph = JointGraph.build(np.eye(3))
        with pytest.raises(InvalidArrayError, match=r"positions must have shape \(3, 3\), got \(2, 3\)"):
            torn_fraction(graph, np.eye(3), np.eye(3)[:2])
