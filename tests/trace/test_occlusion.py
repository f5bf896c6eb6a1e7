"""Ambient occlusion: closed forms on tiled shapes, honest errors, bit-exact repeats, refusals."""

from functools import cache

import numpy as np
import pytest
from support.estimates import require_honest, require_zero_mean
from support.shapes import cloud_of, disc_points, random_cloud, sphere_points, tiles, unit

from beam_warp import Scene, ambient_occlusion
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.metrics import root_mean_square
from beam_warp.trace.sampling import SAMPLERS

UP = np.array([0.0, 0.0, 1.0])


def plane():
    points = disc_points(1.0, 0.05)
    normals = np.tile(UP, (len(points), 1))
    return points, normals, tiles(points, normals, 0.05)


class TestClosedForm:
    """What sees everything; shapes that see less are in test_analytic_occlusion.py."""

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
        points, normals, parts = plane()
        results = []
        for scale in (1.0, 1e-3, 1e3):
            scaled = {**parts, "positions": parts["positions"] * scale, "scales": parts["scales"] * scale}
            scene = Scene.from_gaussians(cloud_of(scaled), device)
            results.append(ambient_occlusion(scene, points * scale, normals).visibility)
        assert np.ptp(results, axis=0).max() < 1e-3
        assert results[0].min() > 0.999  # an open plane: nothing but the tails of neighbours is in the way

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
        tilted = unit(points + 0.15 * rng.normal(size=points.shape))
        scene = Scene.from_gaussians(cloud_of(tiles(points, tilted, spacing, opacity=0.9)), device)
        assert ambient_occlusion(scene, points, points).visibility.mean() > 0.99


@cache
def cluttered(device):
    """Soft Gaussians, points in their midst, and their occlusion by 2,048 rays: a 20th of 64 rays' noise."""
    rng = np.random.default_rng(20260)
    cloud = random_cloud(rng, 800, scale=(-2.5, 0.4), opacity=(0.3, 1.0))
    scene = Scene.from_gaussians(cloud, device)
    n = unit(rng.normal(size=(300, 3)))
    points = cloud.positions[:300]
    truth = ambient_occlusion(scene, points, n, sample_count=2048, offset=0.1, seed=9).visibility
    return scene, points, n, truth


class TestErrors:
    @pytest.mark.parametrize("sampler", SAMPLERS)
    @pytest.mark.parametrize("sample_count", [64, 50, 37])
    def test_estimates_and_their_errors_are_honest(self, device, sample_count, sampler):
        """Powers of two, other counts and primes: no bias, and errors as stated or, for strata, below."""
        scene, points, n, truth = cluttered(device)
        result = ambient_occlusion(scene, points, n, sample_count=sample_count, offset=0.1, sampler=sampler)
        require_zero_mean(result.visibility - truth)
        require_honest(result.visibility - truth, result.standard_error, independent=sampler == "iid")

    @pytest.mark.parametrize("sampler", SAMPLERS)
    def test_one_ray_knows_nothing(self, device, rng, sampler):
        scene = Scene.from_gaussians(random_cloud(rng, 50), device)
        result = ambient_occlusion(scene, np.zeros((3, 3)), np.tile(UP, (3, 1)), sample_count=1, sampler=sampler)
        assert (result.standard_error == 0.5).all()

    @pytest.mark.parametrize("sampler", SAMPLERS)
    def test_error_falls_with_the_count(self, device, sampler):
        """16 times the rays: a quarter of the error for independent samples, less for the others."""
        scene, points, n, truth = cluttered(device)

        def error(count):
            result = ambient_occlusion(scene, points, n, sample_count=count, offset=0.1, sampler=sampler)
            return root_mean_square(result.visibility - truth)

        # 300 points know a root mean square to 1 / sqrt(600) if errors are normal, and to three times that if not
        gain = error(16) / error(256)
        assert 4.0 / 1.6 < gain < 4.0 * 1.6 if sampler == "iid" else gain > 4.0


def test_same_seed_same_bits_other_seed_or_frame_other_noise(device):
    """Chunks and threads are in test_rays.py."""
    scene, points, n, _ = cluttered(device)

    def estimate(**options):
        return ambient_occlusion(scene, points, n, sample_count=16, offset=0.05, **options).visibility

    assert np.array_equal(estimate(seed=3), estimate(seed=3))
    assert not np.array_equal(estimate(seed=3), estimate(seed=4))
    assert not np.array_equal(estimate(frame=1), estimate(frame=2))


class TestRefusals:
    @pytest.fixture
    def scene(self, rng):
        return Scene.from_gaussians(random_cloud(rng, 5), "cpu")

    def test_normals(self, scene):
        with pytest.raises(InvalidArrayError, match=r"normals must have unit length, got \|v\| = 0.31 at row 1"):
            ambient_occlusion(scene, np.zeros((2, 3)), [[0, 0, 1.0], [0, 0, 0.31]])

    @pytest.mark.parametrize(
        "options", [{"sample_count": 0}, {"seed": -1}, {"offset": "big"}, {"offset": np.nan}, {"sampler": "sobol"}]
    )
    def test_options(self, scene, options):
        with pytest.raises(InvalidOptionError, match=f"^{next(iter(options))} must be"):
            ambient_occlusion(scene, np.zeros((1, 3)), [[0, 0, 1.0]], **options)
