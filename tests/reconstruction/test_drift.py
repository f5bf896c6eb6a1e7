"""Drift: nothing for what moves with the surface, the slip for what slips, whatever the order of the rows."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.shapes import aligned

from beam_warp.errors import InvalidArrayError
from beam_warp.reconstruction.drift import tracking_drift
from beam_warp.world.camera import Camera

FLOAT32_STEP = 2.0**-23

ROUNDING_MM = 1e3 * 20.0 * FLOAT32_STEP * 2.0
"""Some twenty roundings of float32 coordinates and quaternions of at most 2 m."""

IDS = np.arange(500)

SPHERE = trimesh.creation.icosphere(subdivisions=3, radius=0.5)


def cloud(positions, turn=None, ids=None, opacities=0.9):
    count = len(positions)
    orientations = np.tile((turn or Rotation.identity()).as_quat(), (count, 1))
    found = aligned(positions, opacities, 0.02, ids=np.arange(count) if ids is None else ids)
    return found.with_arrays(orientations=orientations)


def drift(clouds, meshes=None, device="cpu", **options):
    """The drift over the sphere, which stays as it is unless ``meshes`` say otherwise."""
    meshes = [SPHERE.vertices] * len(clouds) if meshes is None else meshes
    return tracking_drift(clouds, meshes, SPHERE.faces, device=device, **options)


@pytest.fixture
def points(rng):
    """Points up to 5 mm above or below the sphere's facets."""
    corners = SPHERE.triangles[rng.integers(len(SPHERE.faces), size=500)]
    on = np.einsum("nk,nkc->nc", rng.dirichlet([1, 1, 1], 500), corners)
    return on + 0.005 * rng.uniform(-1, 1, (500, 1)) * on / np.linalg.norm(on, axis=1, keepdims=True)


class TestDrift:
    def test_what_moves_rigidly_with_the_surface_does_not_drift(self, device, points):
        turn = Rotation.from_euler("xyz", (20, -35, 50), degrees=True)
        move = np.array([0.3, -0.1, 0.2])
        meshes = [SPHERE.vertices, turn.apply(SPHERE.vertices) + move]
        found = drift([cloud(points), cloud(turn.apply(points) + move, turn)], meshes, device)
        for frame in found:
            assert frame.followed == 1.0
            assert frame.gaussians.p95_mm < ROUNDING_MM
            assert frame.vertices.p95_mm < ROUNDING_MM
        assert found[0].gaussians.count == 500
        assert found[0].vertices.count == len(SPHERE.vertices)

    def test_a_slip_is_found_as_it_is(self, device, points):
        turn = Rotation.from_euler("z", 0.02)  # a slide over the surface, 0.02 times the distance to the axis
        found = drift([cloud(points), cloud(turn.apply(points), turn)], device=device)[1]
        slip = 1e3 * 2.0 * np.sin(0.01) * np.linalg.norm(points[:, :2], axis=1)
        assert found.gaussians.mean_mm == pytest.approx(slip.mean(), abs=ROUNDING_MM)
        assert found.gaussians.median_mm == pytest.approx(np.median(slip), abs=ROUNDING_MM)
        assert found.gaussians.p95_mm == pytest.approx(np.quantile(slip, 0.95), abs=ROUNDING_MM)
        at_vertices = 1e3 * 2.0 * np.sin(0.01) * np.linalg.norm(SPHERE.vertices[:, :2], axis=1)
        assert found.vertices.mean_mm == pytest.approx(at_vertices.mean(), abs=ROUNDING_MM)

    def test_points_of_a_stretched_surface_do_not_drift(self, device):
        stretched = SPHERE.vertices * (1.1, 1.0, 0.9)
        on = SPHERE.triangles.mean(axis=1)
        after = stretched[SPHERE.faces].mean(axis=1)
        found = drift([cloud(on), cloud(after)], [SPHERE.vertices, stretched], device)[1]
        assert found.gaussians.p95_mm < ROUNDING_MM

    def test_rows_are_matched_by_identity(self, points, rng):
        order = rng.permutation(500)
        ids = 7 * np.arange(500) + 3
        later = cloud(points[order], ids=ids[order])
        found = drift([cloud(points, ids=ids), later])[1]
        assert found.gaussians.p95_mm < ROUNDING_MM

    def test_what_is_gone_is_not_followed(self, points):
        later = cloud(np.concatenate([points[:400], points[:50]]), ids=np.r_[0:400, 1000:1050])
        found = drift([cloud(points), later])[1]
        assert found.followed == 0.8
        assert found.gaussians.count == 400

    def test_far_and_faint_gaussians_do_not_count(self, points):
        away = points.copy()
        away[:100] *= 2.0
        start = cloud(away, opacities=np.where(np.arange(500) < 450, 0.9, 0.01))
        found = drift([start, start])[1]
        assert found.gaussians.count == 350

    def test_only_vertices_that_a_camera_sees_count(self, points):
        camera = Camera.orbit((0, 0, 0), 4.0, 90.0, 0.0, width=64, height=64, vertical_fov=40.0)
        found = drift([cloud(points)], cameras=[camera])[0]
        assert 0.3 < found.vertices.count / len(SPHERE.vertices) < 0.55


class TestErrors:
    @pytest.mark.parametrize(
        ("shift", "ids", "match"),
        [
            (0.0, [None], "clouds must have ids, got none in frame 0"),
            (0.0, [IDS, IDS + 500], "clouds must keep ids of the first frame, got none in frame 1"),
            (9.0, [IDS], "clouds must start within"),
        ],
    )
    def test_clouds_that_cannot_be_followed_are_refused(self, points, shift, ids, match):
        with pytest.raises(InvalidArrayError, match=match):
            drift([cloud(points + shift).with_arrays(ids=own) for own in ids])

    def test_another_topology_is_refused(self, points):
        with pytest.raises(InvalidArrayError, match="vertices must have"):
            drift([cloud(points)] * 2, [SPHERE.vertices, SPHERE.vertices[:-1]])
