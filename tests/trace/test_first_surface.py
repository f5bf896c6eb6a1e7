"""What rays see: closed forms, then a float64 sort and blend, rounds of the buffer, ties, and what must be refused."""

from dataclasses import fields

import numpy as np
import pytest
import warp as wp
from reference.closest_surface import closest_surface_reference
from scipy.spatial.transform import Rotation
from support.shapes import aligned, along_x, random_cloud, random_rays, unit

from beam_warp import Scene, visibility
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.trace.closest_surface import BUFFER_SIZE
from beam_warp.stability.tracing import traced_cloud
from beam_warp.trace.first_surface import SurfaceHits, closest_surface
from beam_warp.trace.reference import FLOAT32_ROUNDOFF
from beam_warp.trace.transmittance import TraceOptions
from beam_warp.world.quaternions import rotation_matrices

WHOLE = TraceOptions(stop=0.0)
FIELDS = [field.name for field in fields(SurfaceHits)]


def blend(alphas, values):
    """Front to back, by hand."""
    weights = np.asarray(alphas) * np.cumprod(np.r_[1.0, 1.0 - np.asarray(alphas)])[:-1]
    return weights @ np.asarray(values) / weights.sum()


def seen_along_x(cloud, device, **options):
    return closest_surface(Scene.from_gaussians(cloud, device), *along_x(), **options)


def oracle_of(scene, cloud, rays, **options):
    return closest_surface_reference(traced_cloud(cloud, scene), *rays, middle=scene.origin, **options)


def three_in_a_row():
    """Not in the order of their rows."""
    return aligned([[2, 0, 0], [0, 0, 0], [1, 0, 0]], [0.3, 0.1, 0.6])


class TestClosedForm:
    @pytest.mark.parametrize(("y", "z"), [(0.0, 0.0), (0.1, 0.0), (0.15, -0.3)])
    def test_one_gaussian(self, device, y, z):
        scales, opacity = np.array([0.1, 0.2, 0.3]), 0.9
        scene = Scene.from_gaussians(aligned([[0, 0, 0]], opacity, scales), device)
        hit = closest_surface(scene, *along_x(y, z), attributes=[[3.0, -1.0]], threshold=0.8)
        squared = (y / 0.2) ** 2 + (z / 0.3) ** 2
        entry = np.array([-np.sqrt(2.0 * np.log(255.0 * opacity) - squared), y / 0.2, z / 0.3])
        normal = entry / scales
        assert hit.transmittance == pytest.approx(1.0 - opacity * np.exp(-0.5 * squared), abs=1e-6)
        assert hit.depth == pytest.approx(2.0, abs=1e-6)
        assert hit.expected_depth == pytest.approx(2.0, abs=1e-6)
        assert hit.normals[0] == pytest.approx(normal / np.linalg.norm(normal), abs=1e-6)
        assert hit.attributes[0] == pytest.approx([3.0, -1.0], rel=1e-6)
        assert (hit.gaussians[0], hit.hit_counts[0], hit.mesh_faces[0]) == (0, 1, -1)
        assert np.isinf(hit.mesh_depth[0])

    def test_normal_of_a_turned_gaussian(self, device, rng):
        """R S^-1 y, against the gradient of the squared whitened distance at the entry."""
        cloud = aligned([[0, 0, 0]], 0.9, (0.3, 0.1, 0.02)).with_arrays(orientations=unit(rng.normal(size=(1, 4))))
        origin, direction = along_x(0.01, 0.02)
        whitening = rotation_matrices(cloud.orientations)[0].T / cloud.scales[0].astype(float)[:, None]
        a, b = whitening @ origin[0], whitening @ direction[0]
        radius = 2.0 * np.log(255.0 * float(cloud.opacities[0]))
        t = (-a @ b - np.sqrt((a @ b) ** 2 - (b @ b) * (a @ a - radius))) / (b @ b)
        gradient = whitening.T @ (a + t * b)
        hit = closest_surface(Scene.from_gaussians(cloud, device), origin, direction)
        truth = closest_surface_reference(cloud, origin, direction)
        assert truth.normals[0] == pytest.approx(gradient / np.linalg.norm(gradient), abs=1e-9)
        assert np.linalg.norm(hit.normals - truth.normals) <= truth.normal_error[0] < 1e-3

    def test_three_on_a_ray(self, device):
        colors = np.eye(3)
        hit = seen_along_x(three_in_a_row(), device, attributes=colors)
        alphas, order = [0.1, 0.6, 0.3], [1, 2, 0]
        assert hit.transmittance == pytest.approx(0.9 * 0.4 * 0.7, abs=1e-6)
        assert hit.attributes[0] == pytest.approx(blend(alphas, colors[order]), abs=1e-6)
        assert hit.expected_depth == pytest.approx(blend(alphas, [2.0, 3.0, 4.0]), abs=1e-6)
        assert hit.depth == pytest.approx(3.0, abs=1e-6)  # 0.9, then 0.36
        assert (hit.gaussians[0], hit.hit_counts[0]) == (2, 3)
        assert hit.normals[0] == pytest.approx([-1.0, 0.0, 0.0], abs=1e-6)

    @pytest.mark.parametrize(("threshold", "row"), [(1.0, 1), (0.91, 1), (0.89, 2), (0.37, 2), (0.35, 0), (0.26, 0)])
    def test_threshold(self, device, threshold, row):
        hit = seen_along_x(three_in_a_row(), device, threshold=threshold)
        assert (hit.gaussians[0], hit.depth[0]) == (row, pytest.approx([4.0, 2.0, 3.0][row], abs=1e-6))

    def test_threshold_that_is_not_met(self, device):
        hit = seen_along_x(aligned([[2, 0, 0]], 0.3), device, threshold=0.5)
        assert (hit.gaussians[0], hit.depth[0], hit.hit_counts[0]) == (-1, np.inf, 1)
        assert hit.expected_depth == pytest.approx(4.0, abs=1e-6)

    def test_reach_ends_before_peaks(self, device):
        scene = Scene.from_gaussians(aligned([[0, 0, 0], [1, 0, 0]], [0.3, 0.4]), device)
        hit = closest_surface(scene, *along_x(count=3), t_max=[1.9, 2.5, 9])
        assert hit.hit_counts.tolist() == [0, 1, 2]
        assert hit.transmittance == pytest.approx([1.0, 0.7, 0.42], abs=1e-6)

    def test_blending_ends_below_the_stop(self, device):
        hit = seen_along_x(aligned(np.arange(9)[:, None] * [1.0, 0, 0], 0.5), device, options=TraceOptions(stop=0.2))
        assert (hit.hit_counts[0], hit.transmittance[0]) == (3, pytest.approx(0.125, abs=1e-6))

    def test_nothing_to_see(self, device):
        for cloud in (aligned(np.zeros((0, 3)), []), aligned([[0, 5, 0]], 0.5), aligned([[0, 0, 0]], 0.0)):
            hit = seen_along_x(cloud, device, attributes=np.ones((len(cloud), 2)))
            assert (hit.depth[0], hit.expected_depth[0], hit.transmittance[0]) == (np.inf, np.inf, 1.0)
            assert (hit.gaussians[0], hit.hit_counts[0]) == (-1, 0)
            assert not hit.normals.any()
            assert not hit.attributes.any()

    def test_no_rays(self, device, rng):
        scene = Scene.from_gaussians(random_cloud(rng, 5), device)
        hit = closest_surface(scene, np.zeros((0, 3)), np.zeros((0, 3)), attributes=np.zeros((5, 4)))
        shapes = [getattr(hit, name).shape for name in FIELDS]
        assert shapes == [(0,), (0,), (0, 3), (0, 4), (0,), (0,), (0,), (0,), (0,)]

    def test_rays_that_graze_the_support_have_finite_results(self, device):
        """Leaf and packed rows may round to different sides of the edge; 0 / 0 was the outcome."""
        rng = np.random.default_rng(0)
        q, count = rng.normal(size=(1, 4)), 20_000
        cloud = aligned([[0.3, 0.2, 0.1]], 0.8, (0.3, 0.01, 0.1)).with_arrays(orientations=q / np.linalg.norm(q))
        rotation, scales = rotation_matrices(cloud.orientations)[0], cloud.scales[0].astype(float)
        y = rng.normal(size=(count, 3))
        y /= np.linalg.norm(y, axis=1, keepdims=True)
        edge = cloud.positions + (np.sqrt(2.0 * np.log(255.0 * 0.8)) * y * scales) @ rotation.T
        d = unit(np.cross((y / scales) @ rotation.T, rng.normal(size=(count, 3))))
        hit = closest_surface(Scene.from_gaussians(cloud, device), edge - d, d, attributes=[[1.0]])
        met = hit.hit_counts > 0
        assert 0.1 < met.mean() < 0.9
        assert np.isfinite(hit.expected_depth[met]).all()
        assert (hit.transmittance[met] < 1.0).all()
        assert hit.attributes[met] == pytest.approx(1.0, abs=1e-6)
        assert np.linalg.norm(hit.normals[met], axis=1) == pytest.approx(1.0, abs=1e-5)


def require_agreement(hit, truth, least_decided):
    """Every decided ray within its own derived bounds; the others at least finite."""
    sure = truth.decided
    assert sure.mean() > least_decided
    assert np.array_equal(hit.hit_counts[sure], truth.hit_counts[sure])
    assert np.array_equal(hit.gaussians[sure], truth.gaussians[sure])
    assert np.array_equal(np.isinf(hit.depth), hit.gaussians < 0)
    assert np.array_equal(np.isinf(hit.expected_depth), hit.hit_counts == 0)
    met = sure & (truth.hit_counts > 0)
    ends = sure & (truth.gaussians >= 0)
    assert (np.abs(hit.transmittance - truth.transmittance) <= truth.transmittance_error + FLOAT32_ROUNDOFF)[sure].all()
    assert (np.abs(hit.depth[ends] - truth.depth[ends]) <= truth.depth_error[ends]).all()
    assert (np.abs(hit.expected_depth[met] - truth.expected_depth[met]) <= truth.expected_depth_error[met]).all()
    assert (np.abs(hit.attributes - truth.attributes) <= truth.attribute_error)[met].all()
    assert (np.linalg.norm(hit.normals - truth.normals, axis=1) <= truth.normal_error)[met].all()
    for values in (hit.transmittance, hit.normals, hit.attributes, hit.expected_depth[hit.hit_counts > 0]):
        assert np.isfinite(values).all()


class TestAgainstBruteForce:
    @pytest.mark.parametrize(
        ("scale", "channels"), [((-3.5, 0.8), 0), ((-2.0, 0.3), 1), ((-4.0, 1.2), 5), ((-3.5, 0.8), 5)]
    )
    def test_random_clouds(self, device, rng, scale, channels):
        cloud = random_cloud(rng, 600, scale=scale, opacity=(0.05, 1.0))
        origins, directions = random_rays(rng, 300)
        directions[:30] = np.eye(3)[rng.integers(0, 3, 30)]
        values = rng.normal(size=(600, channels)).astype(np.float32)
        scene = Scene.from_gaussians(cloud, device)
        hit = closest_surface(scene, origins, directions, attributes=values if channels else None)
        truth = oracle_of(scene, cloud, (origins, directions), attributes=values)
        assert hit.attributes.shape == (300, channels)
        require_agreement(hit, truth, least_decided=0.8)
        assert np.median(truth.normal_error) < 1e-2
        assert np.median(truth.expected_depth_error) < 1e-3

    @pytest.mark.parametrize(
        "rules",
        [
            {"front": "entry"},
            {"cull": True},
            {"response_degree": 4},
            {"stop": 0.0},
            {"stop": 0.2},
            {"t_max": 0.6},
            {"t_max": np.linspace(0.0, 2.0, 200)},
            {"threshold": 0.9},
            {"threshold": 0.05, "stop": 0.01, "front": "entry", "cull": True, "response_degree": 4, "t_max": 1.0},
        ],
        ids=str,
    )
    def test_every_rule(self, device, rng, rules):
        cloud = random_cloud(rng, 500, scale=(-2.5, 0.5), opacity=(0.05, 0.9))
        cloud = cloud.with_arrays(normals=unit(rng.normal(size=(500, 3))))
        rays, values = random_rays(rng, 200), rng.normal(size=(500, 2)).astype(np.float32)
        degree = rules.get("response_degree", 2)
        scene = Scene.from_gaussians(cloud, device, response_degree=degree)
        options = {"stop": 1e-3} | {name: rules[name] for name in ("front", "cull", "stop") if name in rules}
        others = {name: rules[name] for name in ("t_max", "threshold") if name in rules}
        hit = closest_surface(scene, *rays, attributes=values, options=TraceOptions(**options), **others)
        truth = oracle_of(scene, cloud, rays, attributes=values, **rules)
        require_agreement(hit, truth, least_decided=0.8)
        assert truth.hit_counts.mean() > 1.0


def test_the_oracle_agrees_with_a_plain_loop(rng):
    """One Gaussian at a time along each ray, in double precision, with nothing of the oracle's."""
    cloud, rays = random_cloud(rng, 60, scale=(-1.5, 0.5)), random_rays(rng, 30)
    values = rng.normal(size=60)
    truth = closest_surface_reference(cloud, *rays, attributes=values[:, None], stop=0.2)
    for ray, (o, d) in enumerate(zip(*(x.astype(float) for x in rays), strict=True)):
        hits = []
        for k, rotation in enumerate(Rotation.from_quat(cloud.orientations).as_matrix()):
            p, v = ((x @ rotation) / cloud.scales[k] for x in (o - cloud.positions[k], d))
            t = -(p @ v) / (v @ v)
            alpha = min(0.99, cloud.opacities[k] * np.exp(-0.5 * np.sum((p + t * v) ** 2)))
            hits += [(t, k, alpha)] if t > 0.0 and alpha >= 1.0 / 255.0 else []
        passed, total, color, first = 1.0, 0.0, 0.0, (np.inf, -1)
        for t, k, alpha in sorted(hits):
            if passed >= 0.2:
                total, color = total + passed * alpha, color + passed * alpha * values[k]
                first = (t, k) if passed >= 0.5 > passed * (1.0 - alpha) else first
                passed *= 1.0 - alpha
        assert (truth.depth[ray], truth.gaussians[ray]) == (pytest.approx(first[0]), first[1])
        assert truth.transmittance[ray] == pytest.approx(passed, abs=1e-12)
        assert truth.attributes[ray] == pytest.approx(color / total if total else 0.0, abs=1e-9)


class TestRounds:
    """Rounds of `BUFFER_SIZE` hits: none is lost or met twice at their boundaries."""

    SIZES = (1, 17, 47, 48, 49, 96, 97, 100)

    def test_sizes_straddle_the_buffer(self):
        assert {BUFFER_SIZE - 1, BUFFER_SIZE, BUFFER_SIZE + 1, 2 * BUFFER_SIZE, 2 * BUFFER_SIZE + 1} <= set(self.SIZES)

    @pytest.mark.parametrize("count", SIZES)
    @pytest.mark.parametrize("gap", [0.0, 1e-6, 1e-3])
    def test_close_hits_are_blended_by_depth_and_row(self, device, rng, count, gap):
        """Gaps of nothing, of 8 ulp of the depth and of 8,000; rows in any order, which alone counts without a gap."""
        places = rng.permutation(count)
        alphas, values = rng.uniform(0.01, 0.1, count).astype(np.float32), rng.normal(size=(count, 2))
        cloud = aligned(places[:, None] * [gap, 0.0, 0.0], alphas)
        hit = seen_along_x(cloud, device, attributes=values, options=WHOLE, threshold=0.0)
        order = np.argsort(places) if gap else np.arange(count)
        rounding = 4.0 * (count + 4) * FLOAT32_ROUNDOFF
        blended = blend(alphas.astype(float)[order], np.c_[values, 2.0 + gap * places][order])
        assert hit.hit_counts[0] == count
        assert hit.transmittance == pytest.approx(np.prod(1.0 - alphas.astype(float)), rel=rounding)
        assert hit.attributes[0] == pytest.approx(blended[:2], abs=rounding * np.abs(values).max())
        assert hit.expected_depth == pytest.approx(blended[2], abs=blended[2] * rounding)

    @pytest.mark.parametrize("stop", [0.0, 1e-3])
    def test_ten_thousand_in_one_place(self, device, stop):
        count, alpha = 10_000, np.float32(1.0 / 250.0)
        hit = seen_along_x(aligned(np.zeros((count, 3)), alpha), device, options=TraceOptions(stop=stop))
        log = np.log1p(-float(alpha))
        expected = count if stop == 0.0 else int(np.ceil(np.log(stop) / log))
        assert hit.hit_counts[0] == expected
        # Each factor is rounded twice, and alpha itself as the response's exponential is.
        growth = expected * (2.0 + 16.0 * float(alpha)) * FLOAT32_ROUNDOFF
        assert hit.transmittance == pytest.approx(np.exp(expected * log), rel=growth, abs=1e-30)
        assert hit.gaussians[0] == int(np.ceil(np.log(0.5) / log)) - 1

    def test_row_settles_ties(self, device):
        """Two that coincide, behind a third: the row that comes first is met first, in either order of the rows."""
        for rows in ([0.9, 0.2], [0.2, 0.9]):
            cloud = aligned([[1, 0, 0], [1, 0, 0], [0, 0, 0]], [*rows, 0.1])
            assert seen_along_x(cloud, device, threshold=0.85).gaussians[0] == 0


class TestProperties:
    @pytest.mark.parametrize("stop", [0.0, 1e-3, 0.1])
    def test_transmittance_is_visibility_up_to_the_stop(self, device, rng, stop):
        cloud, rays = random_cloud(rng, 500, scale=(-2.5, 0.5), opacity=(0.05, 0.9)), random_rays(rng, 300)
        scene = Scene.from_gaussians(cloud, device)
        options = TraceOptions(stop=stop)
        seen = closest_surface(scene, *rays, options=options)
        passed = visibility(scene, *rays, options=options)
        open_rays = np.maximum(seen.transmittance, passed) >= stop
        # Both round 1 - alpha and the product, in another order, and whiten by another factor of the same matrix.
        truth = oracle_of(scene, cloud, rays, stop=0.0)
        clear = truth.decided & open_rays & (truth.transmittance - truth.transmittance_error > stop)
        error = 2.0 * truth.transmittance_error[clear] + FLOAT32_ROUNDOFF
        assert clear.mean() > 0.2
        assert (np.abs(seen.transmittance - passed)[clear] <= error).all()
        assert ((seen.transmittance < stop) == (passed < stop))[truth.decided & ~open_rays].all()

    def test_same_bits_for_any_number_of_threads(self, rng, monkeypatch):
        scene = Scene.from_gaussians(random_cloud(rng, 500, scale=(-2.5, 0.5)), "cpu")
        rays, values = random_rays(rng, 3000), rng.normal(size=(500, 3))
        results = []
        for threads in ("1", "2"):
            monkeypatch.setenv("BEAM_WARP_THREADS", threads)
            results.append(closest_surface(scene, *rays, attributes=values))
        for name in FIELDS:
            assert np.array_equal(getattr(results[0], name), getattr(results[1], name)), name

    @pytest.mark.parametrize("build", ["quality", "fast"])
    def test_either_build_finds_every_hit(self, device, rng, build):
        cloud, rays = random_cloud(rng, 2000, scale=(-3.0, 0.5), opacity=(0.05, 0.5)), random_rays(rng, 200)
        hit = closest_surface(Scene.from_gaussians(cloud, device, build=build), *rays, options=WHOLE)
        truth = closest_surface_reference(cloud, *rays, stop=0.0)
        assert np.array_equal(hit.hit_counts[truth.decided], truth.hit_counts[truth.decided])

    def test_warp_arrays_in_and_out(self, device, rng):
        scene = Scene.from_gaussians(random_cloud(rng, 50), device)
        rays, values = random_rays(rng, 20), rng.normal(size=(50, 2))
        there = closest_surface(scene, *(wp.array(x, dtype=wp.vec3, device=device) for x in rays), attributes=values)
        here = closest_surface(scene, *rays, attributes=values)
        for name in FIELDS:
            assert isinstance(getattr(there, name), wp.array)
            assert np.array_equal(getattr(there, name).numpy(), getattr(here, name)), name


class TestRefusals:
    @pytest.fixture
    def scene(self, rng):
        return Scene.from_gaussians(random_cloud(rng, 5), "cpu")

    def test_bernoulli(self, scene):
        with pytest.raises(InvalidOptionError, match=r"options\.acceptance must be .product. here, got .bernoulli."):
            closest_surface(scene, *along_x(), options=TraceOptions(acceptance="bernoulli"))

    @pytest.mark.parametrize("threshold", [-0.1, 1.1, np.nan])
    def test_threshold_out_of_range(self, scene, threshold):
        with pytest.raises(InvalidOptionError, match=r"threshold must be a number in \[0, 1\]"):
            closest_surface(scene, *along_x(), threshold=threshold)

    def test_threshold_behind_the_stop(self, scene):
        with pytest.raises(InvalidOptionError, match=r"threshold must be at least options.stop, 0.1, got 0.05"):
            closest_surface(scene, *along_x(), threshold=0.05, options=TraceOptions(stop=0.1))

    @pytest.mark.parametrize(
        ("attributes", "match"),
        [
            (np.zeros((4, 1)), r"have as many rows as the scene \(5\), got 4"),
            (np.zeros(5), r"have shape \(N, N\), got \(5,\)"),
            ([[0.0], [0.0], [np.nan], [0.0], [0.0]], "be finite, got NaN or infinity at row 2"),
        ],
    )
    def test_attributes(self, scene, attributes, match):
        with pytest.raises(InvalidArrayError, match=f"attributes must {match}"):
            closest_surface(scene, *along_x(), attributes=attributes)

    def test_rays(self, scene):
        with pytest.raises(InvalidArrayError, match="directions must have unit length"):
            closest_surface(scene, [[0, 0, 0]], [[2.0, 0, 0]])
        with pytest.raises(InvalidArrayError, match=r"directions must have as many rows as origins \(2\), got 1"):
            closest_surface(scene, np.zeros((2, 3)), [[1.0, 0, 0]])
        with pytest.raises(InvalidOptionError, match="cull must be False for a scene without normals"):
            closest_surface(scene, *along_x(), options=TraceOptions(cull=True))
