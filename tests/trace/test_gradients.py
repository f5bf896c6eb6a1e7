"""Gradients of visibility: closed forms, float64 differences with frozen decisions, identities, refusals."""

import numpy as np
import pytest
import warp as wp
from reference.visibility import FrozenVisibility
from support.float32 import relative_error
from support.shapes import aligned, along_x, one_gaussian, random_cloud, random_rays, unit

from beam_warp import Scene, visibility
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.trace import gradients
from beam_warp.trace.gradients import visibility_gradients
from beam_warp.trace.transmittance import TraceOptions
from beam_warp.world.quaternions import rotation_matrices

WHOLE = TraceOptions(stop=0.0)
ATTRIBUTES = ("positions", "orientations", "scales", "opacities", "origins", "directions")


def rounding(cloud, gradient):
    """Expected relative error of a gradient in float32, in the 2-norm over hundreds of hits, times 3.

    The closest point is found relative to the centre through six roundings (centre, origin, difference, projection,
    product, sum) of lengths about sqrt(2), the root mean square distance of two points in the cube that clouds and
    rays fill: each 2^-24 / sqrt(3) of the length, independent. Whitening divides by the smallest scale; the gradient
    is a smooth function of the whitened point with a relative slope about 2.
    """
    inverse = 1.0 / cloud.scales.min(axis=1).astype(np.float64)
    if len(gradient) == len(cloud):
        size = np.linalg.norm(gradient.reshape(len(gradient), -1), axis=1)
    else:  # of rays: a hit counts as its gradient, which is as large as the inverse scale
        size = inverse
    return (
        3.0 * 2.0 * np.sqrt(6.0 / 3.0) * 2.0**-24 * np.sqrt(2.0) * np.linalg.norm(size * inverse) / np.linalg.norm(size)
    )


def solve(cloud, device, rays, adjoints):
    """Gradients of a fresh scene, with no early stop."""
    return visibility_gradients(Scene.from_gaussians(cloud, device), *rays, adjoints, options=WHOLE)


def assert_same(one, other, factor=1.0):
    for name in ATTRIBUTES:
        assert np.array_equal(factor * getattr(one, name), getattr(other, name)), name


def assert_close(cloud, found, expected):
    """Equal but for single precision; ``expected`` holds an array for each name."""
    for name, array in expected.items():
        assert relative_error(getattr(found, name), array) <= rounding(cloud, array), name


def arrays_of(result):
    return {name: getattr(result, name) for name in ATTRIBUTES}


class TestClosedForm:
    @pytest.mark.parametrize("degree", [2, 4])
    def test_axis_parallel_ray(self, device, degree):
        y, z, opacity, adjoint = 0.25, -0.3, 0.9, 1.7
        scene = Scene.from_gaussians(one_gaussian(opacity), device, response_degree=degree)
        result = visibility_gradients(scene, *along_x(y, z), [adjoint])
        a, b = y / 0.2, z / 0.3
        distance = a * a + b * b
        alpha = opacity * (np.exp(-0.5 * distance) if degree == 2 else np.exp(-(distance**2) / 18.0))
        slope = -adjoint * alpha * (-0.5 if degree == 2 else -distance / 9.0)  # dL/dD
        tolerance = {"rel": 1e-5, "abs": 1e-6}  # 6 roundings of 2 m over sigma 0.2 and slopes up to 4: 1.5e-5 absolute
        assert result.opacities[0] == pytest.approx(-adjoint * alpha / opacity, **tolerance)
        assert result.positions[0] == pytest.approx(np.array([0, -2 * a / 0.2, -2 * b / 0.3]) * slope, **tolerance)
        assert result.origins[0] == pytest.approx(np.array([0, 2 * a / 0.2, 2 * b / 0.3]) * slope, **tolerance)
        assert result.directions[0] == pytest.approx(np.array([0, 4 * a / 0.2, 4 * b / 0.3]) * slope, **tolerance)
        assert result.scales[0] == pytest.approx(np.array([0, -2 * a * a / 0.2, -2 * b * b / 0.3]) * slope, **tolerance)
        turn = 2 * a * b * (0.3 / 0.2 - 0.2 / 0.3) * slope  # about x; q = (sin(angle / 2), 0, 0, cos(angle / 2))
        assert result.orientations[0] == pytest.approx([2 * turn, 0, 0, 0], **tolerance)

    def test_three_on_a_ray(self, device):
        cloud = aligned([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [0.1, 0.2, 0.3])
        result = visibility_gradients(Scene.from_gaussians(cloud, device), *along_x(), [1.0])
        # Autodiff through the loop returns (0, -0.90, -0.648) here.
        assert result.opacities == pytest.approx([-0.8 * 0.7, -0.9 * 0.7, -0.9 * 0.8], rel=1e-6)
        assert np.abs(result.positions).max() == 0.0

    @pytest.mark.parametrize("opacity", [0.0, 1.0 / 255.0, 0.99, 1.0])
    def test_neither_dropped_nor_capped_gaussians_have_a_gradient(self, device, opacity):
        scene = Scene.from_gaussians(one_gaussian(opacity), device)
        result = visibility_gradients(scene, *along_x(), [1.0])
        assert all(np.abs(getattr(result, name)).max() == 0.0 for name in ATTRIBUTES)

    def test_behind_a_capped_gaussian_the_others_keep_theirs(self, device):
        cloud = aligned([[0, 0, 0], [1, 0, 0]], [1.0, 0.25])
        result = visibility_gradients(Scene.from_gaussians(cloud, device), *along_x(), [1.0])
        assert result.opacities == pytest.approx([0.0, -0.01], abs=1e-7)

    def test_only_what_counts_has_a_gradient(self, device):
        scene = Scene.from_gaussians(one_gaussian(0.5), device)
        # the support starts at -0.1 * sqrt(2 ln 127.5) = -0.311 along x
        for x, options, expected in (
            (-1e-3, WHOLE, -1.0),
            (1e-3, WHOLE, 0.0),
            (-0.30, TraceOptions(front="entry"), 0.0),
            (-0.32, TraceOptions(front="entry"), -1.0),
        ):
            result = visibility_gradients(scene, *along_x(x=x), [1.0], options=options)
            assert result.opacities[0] == pytest.approx(expected, abs=1e-4)
        for reach, expected in ((1.999, 0.0), (2.001, -1.0), ([1.999], 0.0), ([2.001], -1.0)):
            result = visibility_gradients(scene, *along_x(), [1.0], t_max=reach)
            assert result.opacities[0] == pytest.approx(expected, abs=1e-6)

    def test_culled_gaussians_have_no_gradient(self, device):
        for normal, expected in (([[-1, 0, 0]], -1.0), ([[1, 0, 0]], 0.0)):
            scene = Scene.from_gaussians(one_gaussian(0.5, normals=normal), device)
            result = visibility_gradients(scene, *along_x(), [1.0], options=TraceOptions(cull=True))
            assert result.opacities[0] == pytest.approx(expected, abs=1e-6)

    def test_raised_scales_are_held_still(self, device):
        """A disc of thickness 0 seen obliquely: its wide axes have gradients, the raised one has none."""
        half = np.sqrt(0.5)
        scene = Scene.from_gaussians(one_gaussian(0.5, (0.2, 0.2, 0.0)), device)
        origins = np.array([[0.1, 0.05, 0.0]]) - 2.0 * np.array([[0.0, half, half]])
        result = visibility_gradients(scene, origins, [[0.0, half, half]], [1.0])
        assert scene.report.raised_scales == 1
        # the ray meets the plane of the disc at (0.1, 0.05): D = (0.1^2 + 0.05^2) / 0.2^2
        alpha = 0.5 * np.exp(-0.5 * 0.3125)
        assert result.scales[0, :2] == pytest.approx(-alpha * np.array([0.01, 0.0025]) / 0.2**3, rel=1e-3)
        assert result.scales[0, 2] == 0.0


def case(rng, *, scale=(-2.0, 0.4), rays=300, **rules):
    """A cloud, rays away from ties, their adjoints, and the float64 twin."""
    cloud = random_cloud(rng, 200, scale=scale)
    cloud = cloud.with_arrays(normals=unit(rng.normal(size=(200, 3))))
    origins, directions = random_rays(rng, 2 * rays)
    t_max = rules.pop("t_max", np.full(2 * rays, np.inf, np.float32))
    clear = ~FrozenVisibility(cloud, origins, directions, t_max=t_max, **rules).near_tie
    kept = np.flatnonzero(clear)[:rays]
    assert len(kept) == rays
    frozen = FrozenVisibility(cloud, origins[kept], directions[kept], t_max=t_max[kept], **rules)
    adjoints = rng.normal(size=rays).astype(np.float32)
    return cloud, (origins[kept], directions[kept]), t_max[kept], adjoints, frozen


class TestAgainstDifferences:
    @pytest.mark.parametrize("degree", [2, 4])
    @pytest.mark.parametrize("front", ["peak", "entry"])
    @pytest.mark.parametrize("more", [False, True])  # culling and a reach for each ray
    def test_every_rule(self, device, rng, degree, front, more):
        t_max = rng.uniform(0.3, 2.0, 600).astype(np.float32) if more else np.full(600, np.inf, np.float32)
        cloud, rays, t_max, adjoints, frozen = case(rng, t_max=t_max, front=front, cull=more, degree=degree)
        scene = Scene.from_gaussians(cloud, device, response_degree=degree)
        options = TraceOptions(front=front, cull=more, stop=0.0)
        # a decision that differs changes V by 1/255 of it at least
        np.testing.assert_allclose(
            visibility(scene, *rays, t_max=t_max, options=options), frozen.visibility(), rtol=1e-3
        )
        result = visibility_gradients(scene, *rays, adjoints, t_max=t_max, options=options)
        for name, expected in frozen.gradients(adjoints).items():
            assert relative_error(getattr(result, name), expected) <= min(1e-5, rounding(cloud, expected)), name

    def test_small_and_uneven_gaussians(self, device, rng):
        cloud, rays, _, adjoints, frozen = case(rng, scale=(-3.5, 0.8), rays=1000)
        assert_close(cloud, solve(cloud, device, rays, adjoints), frozen.gradients(adjoints))

    @pytest.mark.parametrize("scales", [(0.3, 3e-4, 3e-4), (0.1, 0.1, 1e-4)])
    def test_needles_and_discs(self, device, rng, scales):
        count, rays = 100, 1000
        cloud = random_cloud(rng, count, opacity=(0.1, 0.95)).with_arrays(scales=np.tile(scales, (count, 1)))
        aims = rng.integers(0, count, rays)
        local = 0.7 * cloud.scales[aims] * rng.normal(size=(rays, 3))
        targets = cloud.positions[aims] + np.einsum("nij,nj->ni", rotation_matrices(cloud.orientations)[aims], local)
        _, directions = random_rays(rng, rays)
        origins = (targets - rng.uniform(0.2, 1.0, (rays, 1)) * directions).astype(np.float32)
        clear = ~FrozenVisibility(cloud, origins, directions).near_tie
        adjoints = rng.normal(size=clear.sum()).astype(np.float32)
        rays = origins[clear], directions[clear]
        expected = FrozenVisibility(cloud, *rays).gradients(adjoints)
        assert_close(cloud, solve(cloud, device, rays, adjoints), expected)
        assert all(rounding(cloud, array) < 1e-2 for array in expected.values())

    def test_far_from_the_origin(self, device, rng):
        """The scene is recentred: moved by a power of two it keeps its gradients but for the grid of 1/1024."""
        cloud, rays, _, adjoints, _ = case(rng)
        cloud = cloud.with_arrays(positions=np.round(cloud.positions * 1024.0) / 1024.0)
        origins, directions = (np.round(rays[0] * 1024.0) / 1024.0).astype(np.float32), rays[1]
        here = solve(cloud, device, (origins, directions), adjoints)
        moved = cloud.with_arrays(positions=cloud.positions + np.float32(8192.0))
        far = (origins + np.float32(8192.0)).astype(np.float32)
        assert_close(cloud, solve(moved, device, (far, directions), adjoints), arrays_of(here))


class TestIdentities:
    """V does not change when Gaussians and rays move, grow or turn together: float64 sums of products with it are 0."""

    @pytest.fixture
    def solved(self, device, rng):
        cloud, rays, _, adjoints, _ = case(rng)
        result = solve(cloud, device, rays, adjoints)
        fields = {name: array.astype(np.float64) for name, array in arrays_of(result).items()}
        return cloud, rays[0].astype(np.float64), rays[1].astype(np.float64), fields

    @staticmethod
    def assert_cancels(cloud, *parts):
        total = sum(part.sum(axis=0) for part in parts)
        # errors of single hits are independent: they add up as the terms' 2-norm does
        size = max(np.linalg.norm(part) for part in parts)
        assert np.abs(total).max() <= rounding(cloud, parts[0]) * size

    def test_translation(self, solved):
        cloud, _, _, g = solved
        self.assert_cancels(cloud, g["positions"], g["origins"])

    def test_growth(self, solved):
        cloud, origins, _, g = solved
        self.assert_cancels(
            cloud,
            (g["positions"] * cloud.positions).sum(1),
            (g["scales"] * cloud.scales).sum(1),
            (g["origins"] * origins).sum(1),
        )

    def test_rotation(self, solved):
        cloud, origins, directions, g = solved
        # turning by a about world axes adds (a / 2, 0) n to a quaternion n
        x, y, z, w = cloud.orientations.T.astype(np.float64)
        turned = 0.5 * np.array([[w, -z, y, -x], [z, w, -x, -y], [-y, x, w, -z]])
        self.assert_cancels(
            cloud,
            np.cross(cloud.positions, g["positions"]),
            np.einsum("kjn,nj->nk", turned, g["orientations"]),
            np.cross(origins, g["origins"]),
            np.cross(directions, g["directions"]),
        )

    def test_quaternions_and_directions_keep_their_length(self, solved):
        cloud, _, directions, g = solved
        for name, vectors in (("orientations", cloud.orientations), ("directions", directions)):
            along = (g[name] * vectors).sum(1)
            assert np.abs(along).max() <= 8 * 2.0**-23 * np.abs(g[name]).max() * 3.0  # four products and a few sums

    def test_quaternions_that_are_not_quite_unit(self, device, rng):
        cloud, rays, _, adjoints, _ = case(rng)
        longer = cloud.with_arrays(orientations=cloud.orientations * np.float32(1.0 + 2.0**-10))
        one, other = (solve(c, device, rays, adjoints) for c in (cloud, longer))
        expected = one.orientations / (1.0 + 2.0**-10)
        assert relative_error(other.orientations, expected) <= rounding(cloud, expected) < 2.0**-11

    def test_opposite_quaternions_have_opposite_gradients(self, device, rng):
        cloud, rays, _, adjoints, _ = case(rng)
        opposite = cloud.with_arrays(orientations=-cloud.orientations)
        one, other = (solve(c, device, rays, adjoints) for c in (cloud, opposite))
        assert np.array_equal(one.orientations, -other.orientations)

    def test_adjoints_enter_linearly(self, device, rng):
        cloud, rays, _, adjoints, _ = case(rng)
        scene = Scene.from_gaussians(cloud, device)
        one = visibility_gradients(scene, *rays, adjoints)
        assert_same(one, visibility_gradients(scene, *rays, -4.0 * adjoints), factor=-4.0)


class TestStop:
    def test_gradient_is_that_of_the_product_so_far(self, device):
        opacities = np.array([0.3, 0.4, 0.5, 0.6, 0.7])
        cloud = aligned([[k, 0, 0] for k in range(5)], opacities)
        scene = Scene.from_gaussians(cloud, device)
        options = TraceOptions(stop=0.5)
        v = visibility(scene, *along_x(), options=options)[0]
        result = visibility_gradients(scene, *along_x(), [1.0], options=options).opacities
        met = result != 0.0
        assert 0 < met.sum() < 5
        assert v == pytest.approx((1.0 - opacities[met]).prod(), rel=1e-6)
        assert result[met] == pytest.approx(-v / (1.0 - opacities[met]), rel=1e-6)

    def test_error_is_bounded_by_the_stop(self, device, rng):
        """Each factor left out is at most 1, each divided out at least 0.01."""
        cloud = random_cloud(rng, 600, scale=(-1.7, 0.3), opacity=(0.2, 1.0))
        scene = Scene.from_gaussians(cloud, device)
        origins, directions = random_rays(rng, 100)
        worst = 0.0
        for k in range(100):
            ray = origins[k : k + 1], directions[k : k + 1]
            stopped = visibility_gradients(scene, *ray, [1.0], options=TraceOptions(stop=1e-4)).opacities
            whole = visibility_gradients(scene, *ray, [1.0], options=WHOLE).opacities
            worst = max(worst, np.abs(stopped - whole).max())
        assert 0.0 < worst < 1e-4 / 0.01


class TestBits:
    def test_runs_threads_and_parts_give_the_same(self, device, rng, monkeypatch):
        scene = Scene.from_gaussians(random_cloud(rng, 300, scale=(-2.0, 0.4)), device)
        count = 5000
        origins, directions = random_rays(rng, count)
        t_max = rng.uniform(0.2, 2.0, count).astype(np.float32)
        adjoints = rng.normal(size=count).astype(np.float32)

        def solve(threads, hits_at_once, rays=count):
            monkeypatch.setenv("BEAM_WARP_THREADS", threads)
            monkeypatch.setattr(gradients, "HITS_AT_ONCE", hits_at_once)
            return visibility_gradients(scene, origins[:rays], directions[:rays], adjoints[:rays], t_max=t_max[:rays])

        whole, few = solve("1", 1 << 22), solve("1", 1 << 22, 50)
        others = [solve("1", 1 << 22), solve("2", 1 << 22), solve("2", 2000)]
        ray_by_ray = solve("1", 1, 50)
        assert all(array.any() for array in arrays_of(whole).values())
        for other in others:
            assert_same(whole, other)
        assert_same(few, ray_by_ray)

    @pytest.mark.parametrize("first", [0, 1, 255, 256, 257])
    @pytest.mark.parametrize("second", [1, 255, 256, 257, 2000])
    def test_sums_over_blocks_of_hits_add_each_hit_once(self, device, first, second):
        cloud = aligned([[0, 0, 0], [0, 5, 0], [0, 9, 0]], [0.5, 0.5, 0.5])
        scene = Scene.from_gaussians(cloud, device)
        origins = np.tile([-2.0, 0.0, 0.0], (first + second, 1))
        origins[first:, 1] = 5.0
        directions = np.tile([1.0, 0.0, 0.0], (first + second, 1))
        mixed = np.argsort(np.arange(first + second) * 7 % 11, kind="stable")
        result = visibility_gradients(scene, origins[mixed], directions, np.ones(first + second))
        assert result.opacities.tolist() == [-first, -second, 0.0]

    def test_many_rays_through_few_gaussians(self, device, rng, monkeypatch):
        cloud = random_cloud(rng, 3, scale=(-0.7, 0.2), opacity=(0.3, 0.9))
        origins, directions = random_rays(rng, 3000)
        clear = ~FrozenVisibility(cloud, origins, directions).near_tie
        rays = origins[clear], directions[clear]
        adjoints = rng.normal(size=clear.sum()).astype(np.float32)
        scene = Scene.from_gaussians(cloud, device)
        whole = visibility_gradients(scene, *rays, adjoints, options=WHOLE)
        monkeypatch.setenv("BEAM_WARP_THREADS", "2")
        again = visibility_gradients(scene, *rays, adjoints, options=WHOLE)
        monkeypatch.setattr(gradients, "HITS_AT_ONCE", 1000)
        parts = visibility_gradients(scene, *rays, adjoints, options=WHOLE)
        assert_close(cloud, whole, FrozenVisibility(cloud, *rays).gradients(adjoints))
        assert_same(whole, again)
        # other parts, other blocks, other roundings of float64 sums: the last bit of float32 may differ
        assert all(relative_error(getattr(parts, name), array) <= 2.0**-23 for name, array in arrays_of(whole).items())

    @pytest.mark.parametrize("more", [-1, 1])
    def test_a_tie_that_the_traversals_decide_differently_overflows_no_slot(self, device, rng, monkeypatch, more):
        """A compiler may round one test differently in the two kernels: the loss of a hit is all that may cause."""
        scene = Scene.from_gaussians(random_cloud(rng, 300, scale=(-2.0, 0.4)), device)
        rays, adjoints = random_rays(rng, 200), np.ones(200, np.float32)
        expected = visibility_gradients(scene, *rays, adjoints, options=WHOLE)
        launch_count_hits = gradients.launch_count_hits
        changed = []

        def count_differently(*arguments):
            launch_count_hits(*arguments)
            counts = arguments[-2].count.numpy()
            changed.append(counts.copy())
            counts[10:20] += more * (counts[10:20] > 0)
            arguments[-2].count.assign(counts)

        monkeypatch.setattr(gradients, "launch_count_hits", count_differently)
        result = visibility_gradients(scene, *rays, adjoints, options=WHOLE)
        assert (changed[0][10:20] > 0).any()
        others = np.r_[:10, 20:200]
        assert np.array_equal(result.origins[others], expected.origins[others])
        if more == 1:  # slots stay free
            assert_same(result, expected)
        else:
            assert not np.array_equal(result.opacities, expected.opacities)

    @pytest.mark.parametrize("counts", [[], [0], [0, 0], [3], [0, 3, 0], [9, 0, 1, 2, 3, 4], [2, 3, 2, 2], [5] * 20])
    def test_parts_cover_every_hit_once_and_are_bounded(self, counts, monkeypatch):
        monkeypatch.setattr(gradients, "HITS_AT_ONCE", 4)
        seen = np.zeros(len(counts), int)
        for part, total in gradients._parts(np.array(counts, np.int32)):
            seen[part] += 1
            assert total == sum(counts[part])
            assert 0 < total <= 4 or part.stop - part.start == 1
        assert (seen[np.array(counts, int) > 0] == 1).all()
        assert seen.max(initial=0) <= 1

    def test_warp_arrays_in_and_out(self, device, rng):
        scene = Scene.from_gaussians(random_cloud(rng, 50), device)
        origins, directions = random_rays(rng, 20)
        adjoints = rng.normal(size=20).astype(np.float32)
        there = visibility_gradients(
            scene, origins, directions, wp.array(adjoints, dtype=float, device=scene.device), options=WHOLE
        )
        here = visibility_gradients(scene, origins, directions, adjoints, options=WHOLE)
        for name in ATTRIBUTES:
            assert isinstance(getattr(there, name), wp.array)
            assert np.array_equal(getattr(there, name).numpy(), getattr(here, name))

    def test_devices_agree(self, device, rng):
        cloud, rays, _, adjoints, _ = case(rng)
        here, cpu = (solve(cloud, where, rays, adjoints) for where in (device, "cpu"))
        assert_close(cloud, here, arrays_of(cpu))


class TestSizes:
    @pytest.mark.parametrize("rays", [0, 1, 63, 64, 65, 1025])
    @pytest.mark.parametrize("count", [0, 1, 2, 257])
    def test_shapes(self, device, rng, rays, count):
        cloud = random_cloud(rng, 300, scale=(-1.0, 0.2)).select(np.arange(count))
        scene = Scene.from_gaussians(cloud, device)
        result = visibility_gradients(scene, *random_rays(rng, rays), np.ones(rays), t_max=np.full(rays, 2.0))
        shapes = {"positions": (count, 3), "orientations": (count, 4), "scales": (count, 3), "opacities": (count,)}
        shapes |= {"origins": (rays, 3), "directions": (rays, 3)}
        for name, shape in shapes.items():
            value = getattr(result, name)
            assert (value.shape, value.dtype) == (shape, np.float32)
            assert np.isfinite(value).all()
            assert not (count and rays > 60) or np.abs(value).max() > 0.0

    def test_a_moved_scene_has_the_gradients_of_where_it_is(self, device, rng):
        cloud, rays, _, adjoints, _ = case(rng)
        other = random_cloud(rng, 200, scale=(-2.0, 0.4)).with_arrays(opacities=cloud.opacities)
        moved = Scene.from_gaussians(other, device)
        moved.move(cloud.positions, cloud.orientations, cloud.scales)
        result = visibility_gradients(moved, *rays, adjoints, options=WHOLE)
        assert_close(cloud, result, arrays_of(solve(cloud, device, rays, adjoints)))

    def test_zero_adjoints(self, device, rng):
        scene = Scene.from_gaussians(random_cloud(rng, 50, scale=(-1.0, 0.2)), device)
        result = visibility_gradients(scene, *random_rays(rng, 30), np.zeros(30))
        assert not any(array.any() for array in arrays_of(result).values())

    def test_ten_thousand_coincident_gaussians(self, device):
        cloud = aligned(np.zeros((10_000, 3)), 1.0 / 250.0)
        scene = Scene.from_gaussians(cloud, device)
        result = visibility_gradients(scene, *along_x(), [1e10], options=WHOLE)
        # 1 - alpha is rounded by up to 2^-25, the same way in all 1e4 factors
        assert result.opacities == pytest.approx(np.full(10_000, -1e10 * 0.996**9999), rel=1e4 * 2.0**-25)


class TestRefusals:
    @pytest.fixture
    def scene(self, rng):
        return Scene.from_gaussians(random_cloud(rng, 5), "cpu")

    @pytest.mark.parametrize(
        ("adjoints", "options", "error", "match"),
        [
            ([1.0], {"acceptance": "bernoulli"}, InvalidOptionError, r"options.acceptance must be 'product' for grad"),
            ([1.0], {"cull": True}, InvalidOptionError, "cull must be False for a scene without normals"),
            ([1.0, 1.0], {}, InvalidArrayError, r"adjoints must have as many rows as origins \(1\), got 2"),
            ([np.nan], {}, InvalidArrayError, "adjoints must be finite, got NaN or infinity at row 0"),
        ],
    )
    def test_adjoints_and_options(self, scene, adjoints, options, error, match):
        with pytest.raises(error, match=match):
            visibility_gradients(scene, *along_x(), adjoints, options=TraceOptions(**options))

    def test_type_of_warp_adjoints(self, scene):
        with pytest.raises(InvalidArrayError, match="adjoints must be a one-dimensional warp array of float32 on cpu"):
            visibility_gradients(scene, *along_x(), wp.zeros(1, dtype=wp.float64, device="cpu"))

    def test_rays(self, scene):
        with pytest.raises(InvalidArrayError, match=r"directions must have unit length"):
            visibility_gradients(scene, np.zeros((1, 3)), [[2.0, 0, 0]], [1.0])
        with pytest.raises(InvalidOptionError, match="t_max must be a number in"):
            visibility_gradients(scene, *along_x(), [1.0], t_max=-1.0)
