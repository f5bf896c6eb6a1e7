"""Ambient occlusion: closed forms on tiled shapes, honest errors, bit-exact repeats, refusals."""

import numpy as np
import pytest
from shapes import cloud_of, disc_points, random_cloud, sphere_points, tiles

from beam_warp import Scene, ambient_occlusion
from beam_warp.errors import InvalidArrayError, InvalidOptionError

UP = np.array([0.0, 0.0, 1.0])


def plane(spacing=0.05, radius=1.0):
    points = disc_points(radius, spacing)
    return points, np.tile(UP, (len(points), 1)), tiles(points, np.tile(UP, (len(points), 1)), spacing)


class TestClosedForm:
    """What sees everything; shapes that see less are in test_analytic_occlusion.py."""

    def test_open_plane_sees_everything(self, device):
        points, normals, parts = plane()
        result = ambient_occlusion(Scene.from_gaussians(cloud_of(parts), device), points, normals)
        assert result.visibility.min() > 0.999  # nothing but the tails of neighbours is in the way

    def test_convex_body_sees_everything(self, device):
        points, spacing = sphere_points(4000)
        scene = Scene.from_gaussians(cloud_of(tiles(points, points, spacing)), device)
        assert ambient_occlusion(scene, points, points).visibility.mean() > 0.995

    def test_no_occluders(self, device, rng):
        scene = Scene.from_gaussians(random_cloud(rng, 3).select(np.arange(0)), device)
        result = ambient_occlusion(scene, np.zeros((5, 3)), np.tile(UP, (5, 1)))
        assert (result.visibility == 1.0).all()
        assert (result.standard_error == 0.0).all()


class TestOffset:
    def test_zero_offset_hides_the_surface_behind_itself(self, device):
        """The failure that the automatic offset handles."""
        points, normals, parts = plane()
        scene = Scene.from_gaussians(cloud_of(parts), device)
        middle = np.linalg.norm(points, axis=1) < 0.7
        bare = ambient_occlusion(scene, points[middle], normals[middle], offset=0.0).visibility.mean()
        lifted = ambient_occlusion(scene, points[middle], normals[middle]).visibility.mean()
        assert bare < 0.7
        assert lifted > 0.999

    def test_automatic_offset_follows_the_scale_of_the_scene(self, device):
        results = []
        for scale in (1.0, 1e-3, 1e3):
            points, normals, parts = plane()
            parts = {**parts, "positions": parts["positions"] * scale, "scales": parts["scales"] * scale}
            scene = Scene.from_gaussians(cloud_of(parts), device)
            results.append(ambient_occlusion(scene, points * scale, normals).visibility)
        assert np.abs(results[0] - results[1]).max() < 1e-3
        assert np.abs(results[0] - results[2]).max() < 1e-3

    @pytest.mark.parametrize("height", [-0.004, 0.004])
    def test_points_off_the_surface_are_projected_onto_it(self, device, height):
        """Means of trained Gaussians lie millimetres off the surface; without projection the lower ones go dark."""
        points, _, parts = plane()
        scene = Scene.from_gaussians(cloud_of(parts), device)
        moved = points[np.linalg.norm(points, axis=1) < 0.7] + (0.0, 0.0, height)
        result = ambient_occlusion(scene, moved, np.tile(UP, (len(moved), 1)))
        assert result.visibility.mean() > 0.99

    def test_tilted_neighbours_do_not_shade(self, device, rng):
        """Edges of flat Gaussians stick up where their axes are noisy: here by 9 degrees per axis."""
        points, spacing = sphere_points(8000)
        tilted = points + 0.15 * rng.normal(size=points.shape)
        tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
        scene = Scene.from_gaussians(cloud_of(tiles(points, tilted, spacing, opacity=0.9)), device)
        assert ambient_occlusion(scene, points, points).visibility.mean() > 0.99


class TestErrors:
    @pytest.mark.parametrize("sample_count", [64, 50])
    def test_standard_errors_are_honest(self, device, rng, sample_count):
        """Against 4,096 rays: errors of the estimate, in units of the stated error, have a root mean square near 1.

        Stratified counts err on the safe side by construction; a sixth of them would be suspicious.
        """
        cloud = random_cloud(rng, 800, scale=(-2.5, 0.4), opacity=(0.3, 1.0))
        scene = Scene.from_gaussians(cloud, device)
        n = rng.normal(size=(300, 3))
        n = (n / np.linalg.norm(n, axis=1, keepdims=True)).astype(np.float32)
        points = cloud.positions[:300]
        truth = ambient_occlusion(scene, points, n, sample_count=4096, offset=0.1, seed=9).visibility
        result = ambient_occlusion(scene, points, n, sample_count=sample_count, offset=0.1)
        noisy = result.standard_error > 1e-3
        z = (result.visibility - truth)[noisy] / result.standard_error[noisy]
        assert noisy.sum() > 100
        assert abs(z.mean()) * np.sqrt(len(z)) < 4.0
        assert 0.3 < np.sqrt((z**2).mean()) < 1.15

    def test_error_falls_faster_than_independent_samples(self, device, rng):
        cloud = random_cloud(rng, 800, scale=(-2.5, 0.4), opacity=(0.3, 1.0))
        scene = Scene.from_gaussians(cloud, device)
        points, n = cloud.positions[:300], np.tile(UP, (300, 1))
        truth = ambient_occlusion(scene, points, n, sample_count=4096, offset=0.1, seed=9).visibility
        rms = [
            np.sqrt(np.mean((ambient_occlusion(scene, points, n, sample_count=k, offset=0.1).visibility - truth) ** 2))
            for k in (16, 256)
        ]
        assert rms[1] < rms[0] / 4.0  # 16 times the rays: 4 for independent samples


class TestRepeats:
    def test_same_seed_same_bits_other_seed_or_frame_other_noise(self, device, rng):
        cloud = random_cloud(rng, 500, scale=(-2.5, 0.4))
        scene = Scene.from_gaussians(cloud, device)
        n = np.tile(UP, (500, 1))

        def estimate(**options):
            return ambient_occlusion(scene, cloud.positions, n, sample_count=16, offset=0.05, **options).visibility

        assert np.array_equal(estimate(seed=3), estimate(seed=3))
        assert not np.array_equal(estimate(seed=3), estimate(seed=4))
        assert not np.array_equal(estimate(frame=1), estimate(frame=2))

    def test_result_does_not_depend_on_chunks_or_threads(self, rng, monkeypatch):
        cloud = random_cloud(rng, 3000, scale=(-2.5, 0.4))
        scene = Scene.from_gaussians(cloud, "cpu")
        n = np.tile(UP, (3000, 1))
        whole = ambient_occlusion(scene, cloud.positions, n, sample_count=8)
        monkeypatch.setenv("BEAM_WARP_THREADS", "3")
        monkeypatch.setattr("beam_warp.lighting.RAYS_AT_ONCE", 8 * 700)
        parts = ambient_occlusion(scene, cloud.positions, n, sample_count=8)
        assert np.array_equal(whole.visibility, parts.visibility)
        assert np.array_equal(whole.standard_error, parts.standard_error)


class TestRefusals:
    @pytest.fixture
    def scene(self, rng):
        return Scene.from_gaussians(random_cloud(rng, 5), "cpu")

    def test_normals(self, scene):
        with pytest.raises(InvalidArrayError, match=r"normals must have unit length, got \|v\| = 0.31 at row 1"):
            ambient_occlusion(scene, np.zeros((2, 3)), [[0, 0, 1.0], [0, 0, 0.31]])

    @pytest.mark.parametrize("options", [{"sample_count": 0}, {"seed": -1}, {"offset": "big"}, {"offset": np.nan}])
    def test_options(self, scene, options):
        with pytest.raises(InvalidOptionError, match=f"^{next(iter(options))} must be"):
            ambient_occlusion(scene, np.zeros((1, 3)), [[0, 0, 1.0]], **options)
