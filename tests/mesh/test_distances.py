"""Distances between surfaces: closed forms on planes and spheres, a brute-force twin, and what cameras see."""

import numpy as np
import pytest
import trimesh

from beam_warp.errors import InvalidArrayError
from beam_warp.mesh.distances import SurfaceTree, surface_distances
from beam_warp.world.camera import Camera

FLOAT32_STEP = 2.0**-23

SMALL = {"width": 64, "height": 64, "vertical_fov": 40.0}


def above(vertical_fov=40.0):
    return Camera.look_at((0, 0, 5), (0, 0, 0), up=(0, 1, 0), **{**SMALL, "vertical_fov": vertical_fov})


DOME = [
    Camera.orbit((0, 0, 0), 4.0, azimuth, elevation, **SMALL)
    for azimuth in range(0, 360, 60)
    for elevation in (-50.0, 0.0, 50.0)
]


def square(z=0.0, side=2.0):
    vertices = 0.5 * side * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0.0, 0.0, z]
    return trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], process=False)


def tree_of(mesh, device="cpu"):
    return SurfaceTree(mesh.vertices, mesh.faces, device=device)


def twin_distances(points, corners):
    """Distances to the closest of some triangles: its inside where the foot of the perpendicular is, else its edges."""
    a, b, c = (corners[None, :, i] for i in range(3))
    p = points[:, None]
    normal = np.cross(b - a, c - a)
    area = (normal**2).sum(-1)
    foot = p - ((p - a) * normal).sum(-1, keepdims=True) / area[..., None] * normal
    inside = np.ones(foot.shape[:2], bool)
    best = np.full(foot.shape[:2], np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        inside &= (np.cross(edge, foot - start) * normal).sum(-1) >= 0.0
        t = np.clip(((p - start) * edge).sum(-1) / (edge**2).sum(-1), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(p - start - t[..., None] * edge, axis=-1))
    plane = np.abs(((p - a) * normal).sum(-1)) / np.sqrt(area)
    return np.where(inside, plane, best).min(axis=1)


class TestTree:
    @pytest.mark.parametrize("count", [0, 1, 255, 257])
    def test_distances_are_those_of_brute_force(self, device, rng, count):
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.8)
        vertices = mesh.vertices * (1.0, 0.5, 1.5) + (30.0, -20.0, 4.0)  # far off: rounding must not follow
        points = rng.uniform((28.5, -21.0, 2.0), (31.5, -19.0, 6.0), (count, 3))
        found = SurfaceTree(vertices, mesh.faces, device=device).closest(points)
        # float32 coordinates of at most 2 m from the middle, some ten roundings of them in a query.
        tolerance = 10.0 * FLOAT32_STEP * 2.0
        np.testing.assert_allclose(found.distances, twin_distances(points, vertices[mesh.faces]), atol=tolerance)
        np.testing.assert_allclose(found.weights.sum(axis=1), 1.0, atol=4.0 * FLOAT32_STEP)

    def test_samples_are_uniform_by_area(self):
        corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [8, 0, 0], [5, 3, 0]]
        faces, weights = SurfaceTree(corners, [[0, 1, 2], [3, 4, 5]], device="cpu").sample(10_000)
        # Stratified over triangles: of 9 to 1 in area, all but the one stratum that they share fall as they must.
        assert abs(np.count_nonzero(faces == 0) - 1000) <= 1
        np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
        # Uniform in a triangle: mean weight 1/3, variance 1/18, so a standard error of 0.0024; five of them.
        assert np.abs(weights.mean(axis=0) - 1.0 / 3.0).max() < 5.0 * np.sqrt(1.0 / 18.0 / 10_000)


class TestSeen:
    def test_the_far_side_of_a_sphere_is_not_seen(self, device):
        tree = tree_of(trimesh.creation.icosphere(subdivisions=3), device)
        camera = Camera.orbit((0, 0, 0), 4.0, 90.0, 0.0, **SMALL)  # from +x
        faces, weights = tree.sample(4000)
        seen = tree.seen_by([camera], faces, weights, least_cosine=0.0)
        x = tree.at(faces, weights)[:, 0]
        # A sphere of radius 1 is seen beyond x = 1 / distance; facets of 0.07 rad blur that by as much.
        assert seen[x > 0.25 + 0.1].all()
        assert not seen[x < 0.25 - 0.1].any()

    def test_what_is_behind_something_is_not_seen(self, device):
        tree = tree_of(trimesh.util.concatenate([square(0.0), square(1.0, side=4.0)]), device)
        faces, weights = tree.sample(1000)
        seen = tree.seen_by([above(80.0)], faces, weights)
        assert np.array_equal(seen, faces >= 2)

    def test_what_is_beside_the_image_is_not_seen(self, device):
        tree = tree_of(square(), device)
        faces, weights = tree.sample(2000)
        fov = np.degrees(2.0 * np.arctan(0.5 / 5.0))  # the middle metre
        inside = (np.abs(tree.at(faces, weights)[:, :2]) < 0.5).all(axis=1)
        assert np.array_equal(tree.seen_by([above(fov)], faces, weights), inside)


class TestSurfaceDistances:
    def test_of_a_surface_to_itself_is_nothing(self, device):
        sphere = trimesh.creation.icosphere(subdivisions=3)
        found = surface_distances(sphere, sphere, DOME, sample_count=3000, device=device)
        assert found.chamfer_mm < 1e3 * 10.0 * FLOAT32_STEP
        assert 0.9 < found.seen_share <= 1.0

    def test_of_concentric_spheres_is_the_difference_of_their_radii(self, device):
        truth, other = (trimesh.creation.icosphere(subdivisions=5, radius=radius) for radius in (1.0, 1.01))
        found = surface_distances(other, truth, DOME, sample_count=5000, device=device)
        # Facets of 0.02 rad stand off their sphere by up to 0.02^2 / 8 of the radius, 0.05 mm.
        assert found.to_truth_mm == pytest.approx(10.0, abs=0.05)
        assert found.to_reconstruction_mm == pytest.approx(10.0, abs=0.05)
        assert found.chamfer_mm == pytest.approx(0.5 * (found.to_truth_mm + found.to_reconstruction_mm))
        assert found.to_truth_p95_mm == pytest.approx(10.0, abs=0.06)

    def test_what_is_missing_counts_from_the_truth_only(self, device):
        half = square()
        half = trimesh.Trimesh(half.vertices * (0.5, 1.0, 1.0) - (0.5, 0.0, 0.0), half.faces, process=False)
        found = surface_distances(half, square(), [above()], sample_count=20_000, device=device)
        assert found.to_truth_mm < 1e3 * 10.0 * FLOAT32_STEP
        # Half of the square is missing, 0.5 m away in the mean: 250 mm; a standard error of 2 mm over 20,000 points.
        assert found.to_reconstruction_mm == pytest.approx(250.0, abs=10.0)

    def test_what_no_camera_sees_counts_on_neither_side(self, device):
        box = trimesh.creation.box((1.0, 1.0, 1.0))
        lid = box.vertices[:, 2] > 0.0
        wrong_below = trimesh.Trimesh(np.where(lid[:, None], box.vertices, box.vertices - (0, 0, 0.4)), box.faces)
        found = surface_distances(wrong_below, box, [above()], sample_count=5000, device=device)
        assert found.seen_share == pytest.approx(1.0 / 6.0, abs=0.01)
        assert found.chamfer_mm < 1e3 * 10.0 * FLOAT32_STEP

    def test_truth_that_no_camera_sees_is_refused(self):
        away = [Camera.look_at((0, 0, 5), (0, 0, 9), up=(0, 1, 0), width=8, height=8, vertical_fov=40.0)]
        with pytest.raises(InvalidArrayError, match="cameras must see the truth"):
            surface_distances(square(), square(), away, sample_count=100, device="cpu")
