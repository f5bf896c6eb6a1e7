"""Visibility: closed forms, then a float64 brute force, then properties, then what must be refused."""

import numpy as np
import pytest
import warp as wp
from support.shapes import aligned, along_x, one_gaussian, random_cloud, random_rays, unit

from beam_warp import Scene, visibility
from beam_warp.errors import DeviceError, InvalidArrayError, InvalidOptionError
from beam_warp.kernels.common import launching
from beam_warp.trace.reference import (
    RayPairs,
    ReferenceGaussians,
    candidate_pairs,
    visibility_enclosure,
    visibility_reference,
)
from beam_warp.trace.transmittance import TraceOptions

# V is over-estimated by less than the stop threshold, 1e-4; float32 rounding of the response adds up to 6e-8 times
# distance over smallest scale (about 1e3 here), on alphas whose slope in the response is at most 1.
VISIBILITY_TOLERANCE = 2e-4


class TestClosedForm:
    @pytest.mark.parametrize(("opacity", "alpha"), [(0.01, 0.01), (0.3, 0.3), (0.95, 0.95), (1.0, 0.99)])
    def test_through_the_centre_passes_one_minus_opacity_which_is_capped(self, device, opacity, alpha):
        scene = Scene.from_gaussians(one_gaussian(opacity), device)
        assert visibility(scene, *along_x()) == pytest.approx(1.0 - alpha, abs=1e-6)

    @pytest.mark.parametrize(("y", "z"), [(0.1, 0.0), (0.0, 0.5), (0.25, -0.3)])
    def test_beside_the_centre_follows_the_response(self, device, y, z):
        scene = Scene.from_gaussians(one_gaussian(0.9), device)
        response = np.exp(-0.5 * ((y / 0.2) ** 2 + (z / 0.3) ** 2))
        assert visibility(scene, *along_x(y, z)) == pytest.approx(1.0 - 0.9 * response, abs=1e-6)

    @pytest.mark.parametrize(
        ("degree", "radius"), [(2, (2.0 * np.log(255.0 * 0.9)) ** 0.5), (4, (18.0 * np.log(255.0 * 0.9)) ** 0.25)]
    )
    def test_cut_where_alpha_reaches_one_step_of_eight_bits(self, device, degree, radius):
        cloud = one_gaussian(0.9)
        scene = Scene.from_gaussians(cloud, device, response_degree=degree)
        inside, outside = along_x(z=0.3 * (radius - 1e-3)), along_x(z=0.3 * (radius + 1e-3))
        assert visibility(scene, *inside)[0] < 1.0 - 1.0 / 255.0 + 1e-6
        assert visibility(scene, *outside)[0] == 1.0
        assert visibility_reference(cloud, *inside, response_degree=degree)[0] < 1.0 - 1.0 / 255.0
        assert visibility_reference(cloud, *outside, response_degree=degree)[0] == 1.0

    def test_only_peaks_in_front_and_before_t_max_count(self, device):
        scene = Scene.from_gaussians(one_gaussian(0.5), device)
        assert visibility(scene, *along_x(x=1e-3))[0] == 1.0
        assert visibility(scene, *along_x(x=-1e-3)) == pytest.approx(0.5, abs=1e-4)
        assert visibility(scene, *along_x(), t_max=1.999)[0] == 1.0
        assert visibility(scene, *along_x(), t_max=2.001) == pytest.approx(0.5, abs=1e-6)

    def test_product_over_gaussians(self, device):
        cloud = aligned([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [0.1, 0.2, 0.3])
        assert visibility(Scene.from_gaussians(cloud, device), *along_x()) == pytest.approx(0.9 * 0.8 * 0.7, abs=1e-6)

    def test_rotated_needle_is_hit_across_and_missed_beside(self, device):
        half = np.sqrt(0.5)
        needle = one_gaussian(0.9, (1.0, 1e-3, 1e-3), orientation=(0, 0, half, half))  # now along y
        scene = Scene.from_gaussians(needle, device)
        assert visibility(scene, *along_x(y=0.5)) == pytest.approx(1.0 - 0.9 * np.exp(-0.125), abs=1e-5)
        assert visibility(scene, *along_x(z=0.01))[0] == 1.0


class TestAgainstBruteForce:
    @pytest.mark.parametrize("scale", [(-3.5, 0.8), (-2.5, 0.3), (-5.0, 1.5)])
    def test_random_clouds(self, device, rng, scale):
        cloud = random_cloud(rng, 1500, scale=scale)
        origins, directions = random_rays(rng, 1000)
        directions[:60] = np.eye(3)[rng.integers(0, 3, 60)]  # axis-parallel
        result = visibility(Scene.from_gaussians(cloud, device), origins, directions)
        expected = visibility_reference(cloud, origins, directions)
        assert np.abs(result - expected).max() <= VISIBILITY_TOLERANCE
        assert ((result >= 0.0) & (result <= 1.0)).all()

    def test_axis_parallel_rays_on_box_planes_are_not_lost(self, device):
        """Warp's slab test computes 0 * inf there; without the direction floor 32 of 36 such rays are lost."""
        cloud = aligned([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [0.9, 0.9], 0.5)
        scene = Scene.from_gaussians(cloud, device)
        edge = 0.5 * np.sqrt(2.0 * np.log(255.0 * 0.9)) * 0.999
        for y in (-edge, 0.0, edge):
            for z in (0.0, -0.0):
                origins, directions = np.array([[-5.0, y, z]]), np.array([[1.0, 0.0, -0.0]])
                expected = visibility_reference(cloud, origins, directions)
                assert visibility(scene, origins, directions) == pytest.approx(expected, abs=1e-5)
                assert expected[0] < 1.0

    def test_far_from_the_origin(self, device, rng):
        cloud = random_cloud(rng, 500)
        origins, directions = random_rays(rng, 300)
        shift = np.float32(8192.0)  # a power of two: positions round to a grid of 1/1024, equally in both clouds
        moved = cloud.with_arrays(positions=cloud.positions + shift)
        expected = visibility_reference(moved, (origins + shift).astype(np.float32), directions)
        result = visibility(Scene.from_gaussians(moved, device), (origins + shift).astype(np.float32), directions)
        assert np.abs(result - expected).max() <= VISIBILITY_TOLERANCE

    def test_coincident_gaussians(self, device):
        cloud = aligned(np.zeros((10_000, 3)), 1.0 / 250.0)
        scene = Scene.from_gaussians(cloud, device)
        assert visibility(scene, *along_x())[0] < 1e-4  # 0.996^10000 = 4e-18
        assert visibility(scene, *along_x(z=1.0))[0] == 1.0


class TestEnclosure:
    @pytest.mark.parametrize(("thickness", "leverage"), [(0.25, 4.0), (2.0**-7, 4.0 * np.sqrt(2.0))])
    def test_errors_are_the_roundings_counted_by_hand(self, thickness, leverage):
        """A ray along x passes a sphere of radius 1/4, or crosses a disc of it, 1/8 beside the centre.

        The nearest point to the centre is the peak, so t is that point's own. An error in whitened space is an error of
        t after division by |v| = 1 / thickness.
        """
        center, origin, beside = np.array([3.0, 0.0, 4.0]), np.array([-2.0, 0.125, 4.0]), 0.125
        cloud, u = aligned([center], 0.75, (thickness, 0.25, 0.25)), 2.0**-12
        gaussians = ReferenceGaussians.of(cloud, np.zeros(3), 2)
        ray = origin[None], np.array([[1.0, 0.0, 0.0]])
        pair = RayPairs.of(gaussians, *ray, np.zeros(1, int), u)
        coordinates = np.linalg.norm(origin) + np.linalg.norm(center)
        p, t, whitened = np.hypot(5.0, beside), 5.0, beside / 0.25
        point = coordinates + p + t + 25.0 * beside  # one rounding of each, and 24 of M on what is across
        across = point * leverage + 2.0 * whitened + 4.0 * whitened  # the products of q x v, then norm and quotient
        assert (pair.distance, pair.t) == (whitened, t)
        assert pair.distance_error == pytest.approx(u * (across + 8.0 * pair.radius), rel=1e-12)
        # o, c and p as they enter p . d; the peak's point; q's own roundings; M's error of v in q . v / |v|^2, thrice
        along = coordinates + 4.0 * p + point + 3.0 * whitened * thickness + 3.0 * whitened * 24.0 * thickness
        assert pair.t_error == pytest.approx(u * along, rel=1e-12)
        low, high = (0.75 * np.exp(-0.5 * (whitened + sign * u * across) ** 2) for sign in (1.0, -1.0))
        assert pair.alpha_low == pytest.approx(low * (1.0 - 24.0 * u), rel=1e-12)
        assert pair.alpha_high == pytest.approx(high * (1.0 + 24.0 * u), rel=1e-12)

    @pytest.mark.parametrize("degree", [2, 4])
    @pytest.mark.parametrize(("front", "cull"), [("peak", False), ("entry", True)])
    def test_without_roundoff_it_is_the_value_itself(self, rng, degree, front, cull):
        cloud = random_cloud(rng, 300).with_arrays(normals=unit(rng.normal(size=(300, 3))))
        options = {"front": front, "cull": cull, "response_degree": degree, "roundoff": 0.0}
        found = visibility_enclosure(cloud, *random_rays(rng, 200), t_max=1.0, **options)
        np.testing.assert_array_equal(found.low, found.exact)
        np.testing.assert_array_equal(found.high, found.exact)
        assert found.exact.min() < 0.5

    def test_candidates_are_all_pairs_that_may_count(self, rng):
        """Coarse rounding, ten metres off: no pair is left out that only rounding lets count."""
        roundoff, middle = 2.0**-12, np.array([10.0, 0.0, 0.0])
        gaussians = ReferenceGaussians.of(random_cloud(rng, 300, opacity=(0.1, 1.0)), middle, 2)
        origins, directions = (rows.astype(np.float64) for rows in random_rays(rng, 100))
        rays = origins - middle, directions
        every_ray, every_index = (rows.ravel() for rows in np.mgrid[:100, :300])
        pair = RayPairs.of(gaussians, *(rows[every_ray] for rows in rays), every_index, roundoff)
        counting, possible, _ = pair.decide(np.full(len(every_ray), np.inf), "peak", roundoff)
        found = np.zeros((100, 300), bool)
        for ray, index in candidate_pairs(gaussians, *rays, roundoff):
            found[ray, index] = True
        assert found[every_ray[possible], every_index[possible]].all()
        assert (possible & ~counting).any()
        assert found.mean() < 0.5


class TestProperties:
    def test_order_of_gaussians_matters_only_by_rounding(self, device, rng):
        cloud = random_cloud(rng, 400)
        rays = random_rays(rng, 300)
        one = visibility(Scene.from_gaussians(cloud, device), *rays)
        other = visibility(Scene.from_gaussians(cloud.select(rng.permutation(400)), device), *rays)
        # an early stop may come earlier or later: both are below its threshold
        assert np.abs(one - other).max() <= 1e-4

    def test_never_rises_with_reach(self, device, rng):
        scene = Scene.from_gaussians(random_cloud(rng, 400), device)
        rays = random_rays(rng, 200)
        reaches = [visibility(scene, *rays, t_max=t) for t in (0.0, 0.2, 0.5, 1.0, np.inf)]
        assert (reaches[0] == 1.0).all()
        assert (np.diff(reaches, axis=0) <= 1e-4).all()

    def test_same_bits_for_any_number_of_threads(self, rng, monkeypatch):
        scene = Scene.from_gaussians(random_cloud(rng, 500), "cpu")
        rays = random_rays(rng, 5000)
        results = []
        for threads in ("1", "2", "5"):
            monkeypatch.setenv("BEAM_WARP_THREADS", threads)
            assert launching.thread_count() == int(threads)
            results.append(visibility(scene, *rays))
        assert np.ptp(results, axis=0).max() == 0.0

    def test_devices_agree(self, device, rng):
        cloud, rays = random_cloud(rng, 500), random_rays(rng, 500)
        here = visibility(Scene.from_gaussians(cloud, device), *rays)
        cpu = visibility(Scene.from_gaussians(cloud, "cpu"), *rays)
        assert np.abs(here - cpu).max() <= 1e-4  # where both stopped early; see the benchmark for the rest

    def test_warp_arrays_in_and_out(self, device, rng):
        scene = Scene.from_gaussians(random_cloud(rng, 50), device)
        rays = random_rays(rng, 20)
        there = visibility(scene, *(wp.array(x, dtype=wp.vec3, device=device) for x in rays))
        assert isinstance(there, wp.array)
        assert np.array_equal(there.numpy(), visibility(scene, *rays))


class TestScene:
    def test_invisible_gaussians_are_dropped_and_reported(self, device):
        cloud = aligned(np.zeros((4, 3)), [0.0, 1.0 / 255.0, 0.5, 1.0])
        scene = Scene.from_gaussians(cloud, device)
        assert (scene.report.traced, scene.report.dropped) == (2, 2)

    def test_scales_that_float32_cannot_resolve_are_raised_and_reported(self, device):
        scene = Scene.from_gaussians(one_gaussian(0.5, (1.0, 0.0, 1e-9)), device)
        assert scene.report.raised_scales == 1
        assert visibility(scene, *along_x()) == pytest.approx(0.5, abs=1e-4)

    @pytest.mark.parametrize("count", [0, 1, 2, 7])
    def test_few_gaussians(self, device, rng, count):
        cloud, rays = random_cloud(rng, 7).select(np.arange(count)), random_rays(rng, 10)
        scene = Scene.from_gaussians(cloud, device)
        assert visibility(scene, *rays) == pytest.approx(visibility_reference(cloud, *rays), abs=1e-4)
        assert len(scene) == count
        assert scene.report.traced + scene.report.dropped + scene.report.not_finite == count

    def test_culling_needs_normals(self, device, rng):
        scene = Scene.from_gaussians(random_cloud(rng, 5), device)
        with pytest.raises(InvalidOptionError, match="cull must be False for a scene without normals, got True"):
            visibility(scene, *along_x(), options=TraceOptions(cull=True))

    def test_normals_may_come_later(self, device, rng):
        cloud, rays = random_cloud(rng, 200), random_rays(rng, 50)
        scene, facing = Scene.from_gaussians(cloud, device), TraceOptions(cull=True)
        normals = unit(rng.normal(size=(len(cloud), 3))).astype(np.float32)
        given = cloud.with_arrays(normals=normals)
        scene.face(normals)
        found = visibility(scene, *rays, options=facing)
        assert np.array_equal(found, visibility(Scene.from_gaussians(given, device), *rays, options=facing))
        assert (found >= visibility(scene, *rays)).all()
        assert (found > visibility(scene, *rays)).any()
        with pytest.raises(InvalidArrayError, match="normals must have as many rows"):
            scene.face(normals[1:])

    def test_no_rays(self, device, rng):
        scene = Scene.from_gaussians(random_cloud(rng, 5), device)
        assert visibility(scene, np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)

    def test_unknown_device_is_named(self, rng):
        with pytest.raises(DeviceError, match=r"device must be one of cpu.*, got 'cuda:99'"):
            Scene.from_gaussians(random_cloud(rng, 5), "cuda:99")


class TestRefusals:
    @pytest.fixture
    def scene(self, rng):
        return Scene.from_gaussians(random_cloud(rng, 5), "cpu")

    @pytest.mark.parametrize(
        ("origins", "directions", "match"),
        [
            (np.zeros((3, 4)), np.zeros((3, 4)), r"origins must have shape \(N, 3\), got \(3, 4\)"),
            ([[0, 0, 0], [0, 0, np.nan]], [[1.0, 0, 0]] * 2, "origins must be finite, got NaN or infinity at row 1"),
            ([[0, 0, 0]], [[2.0, 0, 0]], r"directions must have unit length, got \|v\| = 2 at row 0"),
            ([[0, 0, 0]] * 2, [[1.0, 0, 0]], r"directions must have as many rows as origins \(2\), got 1"),
        ],
    )
    def test_rays(self, scene, origins, directions, match):
        with pytest.raises(InvalidArrayError, match=match):
            visibility(scene, origins, directions)

    @pytest.mark.parametrize("t_max", [-1.0, np.nan])
    def test_reach(self, scene, t_max):
        with pytest.raises(InvalidOptionError, match="t_max must be a number in"):
            visibility(scene, np.zeros((1, 3)), [[1.0, 0, 0]], t_max=t_max)


def test_one_reach_a_ray(device):
    scene = Scene.from_gaussians(one_gaussian(0.5), device)
    found = visibility(scene, *along_x(count=2), t_max=np.array([1.9, 2.1]))
    assert found == pytest.approx([1.0, 0.5], abs=1e-6)
    on_device = wp.array([1.9, 2.1], dtype=float, device=scene.device)
    assert (visibility(scene, *along_x(count=2), t_max=on_device) == found).all()
    with pytest.raises(InvalidArrayError, match=r"t_max must be a one-dimensional warp array of float32 on"):
        visibility(scene, *along_x(), t_max=wp.zeros(1, dtype=wp.float64, device=scene.device))


def test_a_stop_returns_the_product_so_far(device):
    """Two hundred Gaussians of opacity 0.8 in a row: 0.2^6 is the first product below 1e-4."""
    count = 200
    cloud = aligned(np.stack([np.arange(count) * 0.1, np.zeros(count), np.zeros(count)], axis=1), 0.8, 0.02)
    scene = Scene.from_gaussians(cloud, device)
    assert visibility(scene, *along_x()) == pytest.approx(0.2**6, rel=1e-5)
    assert visibility(scene, *along_x(), options=TraceOptions(stop=0.0)) == pytest.approx(0.0, abs=1e-38)
