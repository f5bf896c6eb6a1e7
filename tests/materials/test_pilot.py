"""Rays where they are needed: how many a point gets, sets that go on, means that stay unbiased."""

from functools import cache

import numpy as np
import pytest
from support.estimates import LARGEST_Z, require_zero_mean
from support.shapes import cloud_of, colored, sphere_points, tiles

from beam_warp import Scene
from beam_warp.errors import InvalidOptionError
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.light_rays import MaterialOptions, light_batches, lit_points
from beam_warp.materials.normals import SurfaceNormals, SurfacePoints
from beam_warp.materials.pilot import RATE, SHARE, economy, rays_needed, summary
from beam_warp.world.environment import EnvironmentMap

COUNTS = (16, 32, 64, 128, 256)


@cache
def scene(device):
    """A ball half in the shade of a moon under a sky that is bright on one side."""
    points, spacing = sphere_points(1200)
    blob, _ = sphere_points(400)
    ball = tiles(points, points, spacing, opacity=0.99)
    moon = tiles(blob * 0.4 + (0.9, 0.0, 1.2), blob, spacing * 0.7, opacity=0.99)
    cloud = colored(cloud_of(ball, moon), np.full((1600, 3), 0.3))
    occluders = Scene.from_gaussians(cloud, device)
    normals = np.concatenate([points, blob]).astype(np.float32)
    surface = SurfaceNormals(normals, np.ones(1600, np.float32), np.ones(1600, bool))
    sky = EnvironmentMap.constant((0.3, 0.4, 0.6), height=32)
    z = sky.directions()[..., 2:]
    light = PreparedEnvironment(EnvironmentMap((sky.radiance * np.exp(2.0 * z)).astype(np.float32)), device)
    return cloud, occluders, SurfacePoints.at_centers(cloud, occluders, surface, "auto"), light


def light_of(device, **options):
    """Arriving light, its stated relative error and rays of the ball's upper half, lit or in the shade."""
    cloud, occluders, points, light = scene(device)
    chosen = MaterialOptions(bounce=False, **options)
    rows = np.flatnonzero(cloud.positions[:1200, 2] > 0.0)
    measured = lit_points(cloud, points, np.full(1600, 0.5, np.float32), light, rows, None)
    for _ in light_batches(occluders, points, light, measured, chosen, None, 0, lambda *_: None):
        pass
    return measured.light.arriving.numpy(), measured.light.noise.numpy(), measured.rays


def bounce_of(device, **options):
    """Bounced light of the upper half, its error over all light, and its rays; the moon glows more the further up."""
    cloud, occluders, points, light = scene(device)
    rows = np.flatnonzero(cloud.positions[:1200, 2] > 0.0)
    measured = lit_points(cloud, points, np.full(1600, 0.5, np.float32), light, rows, None)
    glow = np.repeat(np.exp(2.0 * cloud.positions[:, 2:]), 3, axis=1).astype(np.float32)
    for _ in light_batches(occluders, points, light, measured, MaterialOptions(**options), glow, 0, lambda *_: None):
        pass
    return measured.light.bounce.numpy(), measured.bounce_noise(), measured.bounce_rays, measured.bounce_share()


class TestHowMany:
    def test_a_point_at_the_target_gets_the_count(self):
        at_first = 0.05 * (64 / 16) ** RATE
        for factor, expected in ((1.0, 64), (2.0 ** (1.0 / SHARE), 128), (0.0, 16), (100.0, 256)):
            errors = np.full(40, factor * at_first)
            assert (rays_needed(errors, 16, 256, count=64, target=0.05) == expected).all()

    def test_sets_double_also_where_the_most_is_no_power_of_two(self):
        assert (rays_needed(np.ones(40), 4, 20, count=5, target=0.05) == 16).all()

    def test_its_own_error_does_not_count(self, rng):
        errors = rng.uniform(0.0, 0.1, 60)
        before = rays_needed(errors, 16, 256, count=64, target=0.05)
        errors[30] = 1.0
        after = rays_needed(errors, 16, 256, count=64, target=0.05)
        assert after[30] == before[30]
        assert (after >= before).all()
        assert (after > before).any()

    def test_who_is_alone_gets_all(self):
        assert rays_needed(np.zeros(1), 16, 256, count=64, target=0.05) == 256
        assert len(rays_needed(np.zeros(0), 16, 256, count=64, target=0.05)) == 0

    @pytest.mark.parametrize("error", [-0.1, np.nan, 2.0])
    def test_impossible_targets_are_refused(self, error):
        with pytest.raises(InvalidOptionError, match="light_error must"):
            MaterialOptions(light_error=error)


def test_sets_go_on(device):
    """A point that gets n rays shows what n rays for each show it, bit for bit: no ray is lost or counted twice."""
    value, noise, rays = light_of(device, light_error=0.02)
    assert set(rays) >= {64, 128, 256}
    for count in COUNTS:
        fixed, stated, _ = light_of(device, light_error=0.0, sample_count=count)
        np.testing.assert_array_equal(value[rays == count], fixed[rays == count])
        np.testing.assert_array_equal(noise[rays == count], stated[rays == count])


def test_rays_of_the_bounce_go_on(device):
    """Who sees nothing but the sky gets the fewest rays, and rays of others are those of a longer set, bit for bit."""
    value, noise, rays, share = bounce_of(device, light_error=0.05)
    assert set(rays) == {4, 8, 16, 32, 64}
    assert share[rays == 4].mean() < 0.1 * share[rays == 64].mean()
    for count in (8, 32):
        fixed, _, every, _ = bounce_of(device, light_error=0.0, sample_count=4 * count)
        assert (every == count).all()
        np.testing.assert_array_equal(value[rays == count], fixed[rays == count])
    assert np.isfinite(noise).all()


def test_the_bounce_stays_unbiased(device):
    truth = bounce_of(device, light_error=0.0, sample_count=4096, seed=1000)[0].sum(axis=1)
    errors = [bounce_of(device, light_error=0.1, seed=seed)[0].sum(axis=1) - truth for seed in range(6)]
    require_zero_mean(np.concatenate(errors))


@pytest.mark.parametrize("way", [{"sampler": "stratified"}, {"density": "mis"}, {"light_error": 0.0}])
def test_sets_that_do_not_go_on_take_as_many_each(way):
    assert MaterialOptions(**way).light_rays == (64, 64)
    assert MaterialOptions(**way).bounce_rays == (16, 16)
    assert MaterialOptions(sample_count=4).light_rays == (4, 16)
    assert MaterialOptions(sample_count=4).bounce_rays == (4, 8)


def test_means_stay_unbiased_where_stopping_would_not(device):
    """Errors average to nothing; those of points that stop when their own rays agree do not: the test can tell."""
    truth = light_of(device, light_error=0.0, sample_count=1024, ratio=False, seed=1000)[0].sum(axis=1)
    mean, target = truth.mean(), 0.05
    errors, stopped = [], []
    for seed in range(6):
        value, _, rays = light_of(device, light_error=target, ratio=False, seed=seed)
        assert len(set(rays)) > 1
        errors.append((value.sum(axis=1) - truth) / mean)
        least, stated, _ = light_of(device, light_error=0.0, sample_count=16, ratio=False, seed=seed)
        most = light_of(device, light_error=0.0, sample_count=256, ratio=False, seed=seed)[0]
        stopped.append((np.where(stated[:, None] <= target, least, most).sum(axis=1) - truth) / mean)
    require_zero_mean(np.concatenate(errors))
    wrong = np.concatenate(stopped)
    assert abs(wrong.mean()) > LARGEST_Z * wrong.std(ddof=1) / np.sqrt(len(wrong))


def test_what_was_left_out_adds_up_over_frames():
    one = economy(np.array([0.1, 0.2]), np.array([16, 256]), 256)
    two = economy(np.array([0.4]), np.array([64]), 256)
    found = summary([{"light": one}, {}, {"light": two}])
    assert found["light_rays_per_gaussian"] == (16 + 256 + 64) / 3
    assert found["light_rays_left_out"] == 240 + 192
    assert found["light_error"] == pytest.approx(np.sqrt((0.01 + 0.04 + 0.16) / 3))
    eighth = 16.0 ** (-2.0 * RATE), 4.0 ** (-2.0 * RATE)
    expected = np.sqrt((0.01 * eighth[0] + 0.04 + 0.16 * eighth[1]) / 3)
    assert found["light_error_with_all_rays"] == pytest.approx(expected)
    assert not any("bounce" in name for name in found)
    both = summary([{"light": one, "bounce": economy(np.array([0.1]), np.array([4]), 64, share=np.array([0.02]))}])
    assert (both["bounce_rays_left_out"], both["bounce_share"]) == (60, pytest.approx(0.02))
    assert summary([{}]) == {}
