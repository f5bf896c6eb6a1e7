"""The tracing benchmark: its scene is what it says, its baselines compute the same V, and all of it runs."""

import json
from contextlib import ExitStack

import numpy as np
import pytest
import tracing as benchmark
import warp as wp
from parts import measure
from support.shapes import random_cloud, random_rays
from timing import Times, launch_threads
from tracing_baselines import EmbreeScene, EmbreeUnavailableError, PlainBvh, pack_gaussians
from tracing_plot import draw_growth
from tracing_scenes import (
    FLATNESS,
    LIFT,
    Rays,
    brute_force_visibility,
    bumpy_torus,
    camera_rays,
    cosine_rays,
    morton_codes,
    torus_area,
    torus_surface,
)

from beam_warp.device.arrays import resolve_device
from beam_warp.kernels.common.launching import thread_count
from beam_warp.trace.reference import visibility_reference
from beam_warp.world.quaternions import rotation_matrices

pytestmark = pytest.mark.slow  # a benchmark's own tests

# As in test_tracing.py: the stop, and float32 rounding of responses.
VISIBILITY_TOLERANCE = 2e-4

# Of responses in float32: 6e-8 times distance over smallest scale, here up to 1 m over 0.1 spacing, 2.5 mm less jitter.
ROUNDING = 5e-5


@pytest.fixture
def embree():
    """Makes Embree scenes and closes them; skips where there is no Embree or no compiler."""
    opened = []

    def make(cloud):
        try:
            opened.append(EmbreeScene(pack_gaussians(cloud)))
        except EmbreeUnavailableError as error:
            pytest.skip(str(error))
        return opened[-1]

    yield make
    for scene in opened:
        scene.close()


class TestScene:
    def test_normals_are_perpendicular_to_the_surface_and_point_out(self, rng):
        u, v = rng.uniform(0.0, 2.0 * np.pi, (2, 500))
        step = 1e-6
        surface = torus_surface(u, v)
        along_u = (torus_surface(u + step, v).points - torus_surface(u - step, v).points) / (2.0 * step)
        along_v = (torus_surface(u, v + step).points - torus_surface(u, v - step).points) / (2.0 * step)
        crossed = np.cross(along_u, along_v)
        # Central differences: rounding 1e-16 / step, truncation step^2 times third derivatives of up to 11^3.
        np.testing.assert_allclose(surface.densities[:, None] * surface.normals, crossed, atol=1e-7)
        # By the divergence theorem the flux of x / 3 is the enclosed volume: positive for outward normals.
        assert (np.einsum("nk,nk->n", surface.points, surface.normals) * surface.densities).mean() > 0.0

    def test_area_is_the_stated_one_and_below_its_bound(self, rng):
        area, highest = torus_area()
        assert area == pytest.approx(2.45, abs=0.005)
        assert torus_surface(*rng.uniform(0.0, 2.0 * np.pi, (2, 20_000))).densities.max() < highest

    def test_gaussians_lie_flat_on_the_surface(self):
        cloud, spacing = bumpy_torus(3000, overlap=1.5, opacity=0.4)
        assert len(cloud) == 3000
        assert spacing == pytest.approx(np.sqrt(torus_area()[0] / 3000))
        axes = rotation_matrices(cloud.orientations)
        np.testing.assert_allclose(axes[:, :, 2], cloud.normals, atol=1e-6)
        logs = np.log(cloud.scales / (1.5 * spacing * np.array([1.0, 1.0, FLATNESS])))
        assert np.abs(logs.mean(axis=0)).max() < 4.0 * 0.2 / np.sqrt(3000)
        assert np.abs(logs.std(axis=0) - 0.2).max() < 4.0 * 0.2 / np.sqrt(2 * 3000)
        assert (cloud.opacities == np.float32(0.4)).all()

    def test_gaussians_are_spread_evenly(self):
        cloud, _ = bumpy_torus(5000)
        middles = (np.arange(256) + 0.5) * (2.0 * np.pi / 256)
        surface = torus_surface(*np.meshgrid(middles, middles))
        weights = surface.densities / surface.densities.sum()
        mean = np.einsum("uv,uvk->k", weights, surface.points)
        variance = np.einsum("uv,uvk->k", weights, (surface.points - mean) ** 2)
        assert (np.abs(cloud.positions.mean(axis=0) - mean) < 4.0 * np.sqrt(variance / 5000)).all()

    def test_same_seed_same_cloud(self):
        first, again, other = (bumpy_torus(100, seed=seed)[0] for seed in (3, 3, 4))
        assert (first.positions == again.positions).all()
        assert (first.scales == again.scales).all()
        assert (first.positions != other.positions).any()

    def test_rays_are_cosine_distributed_about_the_normals(self):
        cloud, _ = bumpy_torus(2000)
        rays = cosine_rays(cloud, 400, 50)
        assert rays.origins.shape == rays.directions.shape == (20_000, 3)
        np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1.0, atol=1e-6)
        starts = rays.origins[::50]
        distances = np.linalg.norm(starts[:, None] - cloud.positions - LIFT * cloud.normals, axis=2)
        nearest = distances.argmin(axis=1)
        assert distances.min(axis=1).max() < 1e-6
        cosines = np.einsum("nk,nk->n", rays.directions, np.repeat(cloud.normals[nearest], 50, axis=0))
        # cos^2 is uniform in [0, 1]: mean 1/2, variance 1/12; the cosine has mean 2/3 and variance 1/18.
        assert cosines.min() > -1e-6
        assert abs(cosines.mean() - 2.0 / 3.0) < 4.0 * np.sqrt(1.0 / 18.0 / 20_000)
        assert abs((cosines**2).mean() - 0.5) < 4.0 * np.sqrt(1.0 / 12.0 / 20_000)

    def test_points_of_rays_are_in_an_order_that_keeps_neighbours_near(self):
        cloud, _ = bumpy_torus(5000)
        starts = cosine_rays(cloud, 2000, 1).origins
        steps = np.linalg.norm(np.diff(starts, axis=0), axis=1)
        shuffled = np.linalg.norm(np.diff(np.random.default_rng(0).permutation(starts), axis=0), axis=1)
        assert steps.mean() < 0.2 * shuffled.mean()

    def test_camera_rays_leave_one_point_towards_the_cloud(self):
        cloud, _ = bumpy_torus(2000)
        rays = camera_rays(cloud, 12, 8)
        assert rays.origins.shape == (96, 3)
        assert (rays.origins == rays.origins[0]).all()
        towards = -rays.origins[0] / np.linalg.norm(rays.origins[0])
        assert (rays.directions @ towards).min() > 0.7

    def test_brute_force_is_the_reference(self, rng, monkeypatch):
        monkeypatch.setattr("tracing_scenes.PAIRS_AT_ONCE", 7 * 300)  # rays do not fill whole steps
        cloud = random_cloud(rng, 300, scale=(-2.5, 0.8))
        rays = Rays(*random_rays(rng, 100))
        expected = visibility_reference(cloud, rays.origins, rays.directions)
        assert expected.min() < 0.5
        np.testing.assert_allclose(brute_force_visibility(cloud, rays), expected, rtol=1e-12)


class TestBaselines:
    @pytest.fixture
    def torus(self):
        cloud, _ = bumpy_torus(4000, overlap=1.5)
        rays = cosine_rays(cloud, 100, 10)
        return cloud, rays, visibility_reference(cloud, *rays)

    @pytest.mark.parametrize(
        "form", [*benchmark.PLAIN_ON_CPU, *benchmark.STRONGEST_ON_CUDA], ids=lambda form: form.name
    )
    def test_plain_bvh_meets_the_reference(self, torus, device, form):
        cloud, rays, expected = torus
        target, packed = resolve_device(device), pack_gaussians(cloud)
        if form.sorted:
            packed = packed.sorted_by(np.argsort(morton_codes(packed.rows[:, 0, :3])))
        plain = PlainBvh(packed, target, form.constructor, fast_math=form.fast_math)
        origins, directions = (wp.array(array, dtype=wp.vec3, device=target) for array in rays)
        assert expected.min() < 1e-3
        assert np.abs(plain.visibility(origins, directions).numpy() - expected).max() < VISIBILITY_TOLERANCE

    def test_embree_meets_the_reference(self, torus, embree):
        cloud, rays, expected = torus
        scene = embree(cloud)
        assert scene.version.startswith("4.")
        assert np.abs(scene.visibility(*rays) - expected).max() < VISIBILITY_TOLERANCE

    def test_embree_stops_early_and_only_then(self, torus, embree):
        cloud, rays, expected = torus
        scene = embree(cloud)
        all_of_it, stopped = scene.visibility(*rays, stop=0.0), scene.visibility(*rays, stop=0.5)
        assert np.abs(all_of_it - expected).max() < ROUNDING
        ended = stopped != all_of_it
        assert (stopped[ended] < 0.5).all()
        assert (stopped[ended] > all_of_it[ended]).all()
        assert ended.any()

    def test_embree_leaves_out_what_no_ray_sees(self, rng, embree):
        cloud = random_cloud(rng, 200, scale=(-2.0, 0.5), opacity=(0.0, 0.02))
        rays = random_rays(rng, 200)
        assert np.abs(embree(cloud).visibility(*rays) - visibility_reference(cloud, *rays)).max() < ROUNDING

    def test_report_says_why_embree_is_absent(self, monkeypatch):
        monkeypatch.setattr("tracing_baselines.embree_library", lambda: "libembree4.so")
        monkeypatch.setattr("tracing_baselines.shutil.which", lambda name: None)
        cloud, _ = bumpy_torus(100)
        with ExitStack() as closing:
            found, absent = benchmark.contenders_for(
                cloud, cosine_rays(cloud, 5), resolve_device("cpu"), closing, plain_forms=()
            )
        assert absent == {"Embree 4": "no gcc"}
        assert "Embree 4" not in found

    def test_library_that_is_not_embree_is_named(self, monkeypatch, tmp_path):
        (tmp_path / "libembree4.so").write_bytes(b"not a library")
        monkeypatch.setattr("tracing_baselines.embree_library", lambda: tmp_path / "libembree4.so")
        monkeypatch.setattr("tracing_baselines.shutil.which", lambda name: "gcc")
        with pytest.raises(EmbreeUnavailableError, match="does not load"):
            EmbreeScene(pack_gaussians(bumpy_torus(10)[0]))


class TestTimes:
    def test_ratio_is_taken_within_each_turn(self):
        quiet_then_busy = np.array([1.0, 10.0, 1.0])
        assert Times(quiet_then_busy).faster_than(Times(3.0 * quiet_then_busy)) == pytest.approx(3.0)

    def test_thread_gain_needs_both_measurements(self):
        assert Times(np.ones(2)).thread_gain() is None
        assert Times(np.ones(2), np.array([2.0, 3.0]), np.array([1.0, 2.0])).thread_gain() == pytest.approx(1.75)

    def test_threads_are_set_and_put_back(self, monkeypatch):
        monkeypatch.setenv("BEAM_WARP_THREADS", "3")
        with launch_threads(1):
            assert thread_count() == 1
        assert thread_count() == 3


def test_everything_is_measured(device, tmp_path):
    pytest.importorskip("matplotlib")
    effort = benchmark.Effort(
        gaussians=1500,
        points=40,
        repeats=2,
        truth_rays=40,
        seeds=20,
        counts=(500, 1500),
        overlaps=(0.5, 1.0),
        opacities=(0.9, 0.2),
        growth_rays=500,
        growth_repeats=1,
        image=(8, 8),
        parity_rays=500,
    )
    written = []
    sections = benchmark.sections(effort)
    keep = lambda found: written.append(json.dumps(found))  # noqa: E731
    result = measure(sections, resolve_device(device), keep=keep)
    assert len(written) == len(sections)
    assert json.loads(written[-1]) == json.loads(json.dumps(result))
    assert result["failed"] == []
    contenders = result["torus"]["contenders"]
    assert contenders["wide product"]["largest_error"] < VISIBILITY_TOLERANCE
    assert abs(result["torus"]["bernoulli"]["mean_z"]) < 4.0 * result["torus"]["bernoulli"]["standard_error_of_mean_z"]
    assert contenders[result["torus"]["strongest_wp_bvh"]]["over_wp_bvh"]["median"] == 1.0
    assert [row["gaussians"] for row in result["growth"]] == [500, 1500, 1500, 1500]
    # Packed rows of 64 bytes and normals of 12 a Gaussian are the least that a scene holds.
    assert min(result["builds"]["bytes_per_gaussian"].values()) > 76
    draw_growth(result | {"measured": {"machine": {"device": device}}}, tmp_path / "growth.png")
    assert (tmp_path / "growth.png").stat().st_size > 10_000
