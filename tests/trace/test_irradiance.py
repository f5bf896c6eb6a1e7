"""Irradiance: every density, sampler and ratio against closed forms, honest errors, light that is hard to find."""

from functools import cache
from itertools import product

import numpy as np
import pytest
import warp as wp
from support.estimates import LARGEST_Z, require_density, require_honest, require_zero_mean
from support.kernel_runs import run_kernel
from support.shapes import cloud_of, disc_points, random_cloud, tiles, unit
from support.split_sum import texels_of

from beam_warp import Scene, ambient_occlusion
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.metrics import root_mean_square
from beam_warp.kernels.light.environment_sampling import EnvironmentDistribution
from beam_warp.kernels.light.product_sampling import EnvironmentBlocks
from beam_warp.kernels.trace.incident_light import Technique, draw_light, launch_sum_unshadowed, mixture_pdf
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.light.sampled import light_moments
from beam_warp.trace.incident import DENSITIES, irradiance, techniques
from beam_warp.trace.sampling import SAMPLERS
from beam_warp.trace.transmittance import TraceOptions
from beam_warp.world.environment import EnvironmentMap

UP = np.array([0.0, 0.0, 1.0])


def sky(peak=60.0, height=32, ground=0.05):
    """A bright zenith, a ground and a sun of one texel, of different colours; the sun ``peak`` times the mean."""
    environment = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32))
    z = environment.directions()[..., 2]
    radiance = np.where(z > 0.0, 0.4 + 0.6 * z, ground)[..., None] * np.array([0.5, 0.8, 1.2])
    radiance[height // 4, height // 3] = peak * radiance.mean() * np.array([1.2, 1.0, 0.7])
    return EnvironmentMap(radiance.astype(np.float32))


def exact_unshadowed(environment, normals):
    """E / pi by a float64 sum over the texels of a fine grid: closed form but for texels cut by the horizon."""
    fine = environment.resized(256, 512)
    lit = fine.radiance.any(axis=-1)
    weights = (fine.radiance.astype(np.float64) * fine.solid_angles()[..., None])[lit]
    directions = fine.directions()[lit]
    parts = np.array_split(normals, 20)
    return np.concatenate([np.maximum(part @ directions.T, 0.0) @ weights for part in parts]) / np.pi


@cache
def arriving():
    """Normals, what of the sky arrives at them, and how far cells at the horizon may be off."""
    normals = unit(np.random.default_rng(3).normal(size=(600, 3)))
    return normals, exact_unshadowed(sky(), normals), horizon_error(sky(), normals)


def horizon_error(environment, normals):
    """Bound of what cells of 32 rows err by where a horizon cuts them, and of float32: (N, 1), like E / pi.

    The mean of max(0, height) for heights of mean m within m - a to m + a is at least max(0, m) and at most a / 2 more,
    however the light lies in the cell; the estimate keeps to the same limits.
    """
    coarse = environment.resized(32, 64)
    reach = np.pi / 32 * np.sqrt(0.5)
    power = (coarse.radiance.max(axis=-1) * coarse.solid_angles()).ravel()
    cut = np.abs(normals @ coarse.directions().reshape(-1, 3).T) < reach
    return ((cut * power).sum(axis=1) * reach / 2.0 / np.pi)[:, None] + 1e-5 * power.sum() / np.pi


@cache
def cluttered(device, count=200):
    """Soft Gaussians at random, and points with normals among them: visibilities of every kind."""
    rng = np.random.default_rng(11)
    cloud = random_cloud(rng, 600, scale=(-2.5, 0.4), opacity=(0.3, 1.0))
    return (
        Scene.from_gaussians(cloud, device),
        rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        unit(rng.normal(size=(count, 3))),
    )


def in_the_clutter(device, light, **options):
    return irradiance(*cluttered(device), light, offset=0.05, **options)


@cache
def gentle_light(device):
    """Light that no density draws badly, and what of it arrives at the points above, to a 20th of 64 rays' noise."""
    light = PreparedEnvironment(sky(8.0, ground=0.4), device)
    return light, in_the_clutter(device, light, sample_count=2048, seed=5).value


@cache
def openness(device):
    """Ambient occlusion of the points above, to a 20th of 64 rays' noise."""
    return ambient_occlusion(*cluttered(device), offset=0.05, sample_count=2048, seed=5).visibility


def empty(device):
    return Scene.from_gaussians(random_cloud(np.random.default_rng(0), 3).select(np.arange(0)), device)


@pytest.mark.parametrize(
    ("density", "sampler"), [*((density, "owen") for density in DENSITIES), *(("mis", other) for other in SAMPLERS[1:])]
)
class TestUnbiased:
    """Every density by the default sampler, and every sampler by the density that shares its set between techniques."""

    def test_nothing_in_the_way(self, device, density, sampler):
        """The plain estimate against the sum over texels; the ratio estimate is that sum."""
        normals, truth, cells = arriving()
        light, points = PreparedEnvironment(sky(), device), np.zeros((600, 3))
        options = {"sample_count": 32, "density": density, "sampler": sampler}
        plain = irradiance(empty(device), points, normals, light, **options, ratio=False)
        # texels of the fine grid that the horizon cuts: (pi / 256)^2 / 12 of the light
        require_zero_mean(plain.value - truth, 1.3e-5 * truth.max())
        exact = irradiance(empty(device), points, normals, light, **options)
        # half give or take half: none of 32 rays by the environment found the ground
        found = exact.standard_error < 0.4 * exact.value
        assert found.mean() > 0.99
        error = np.abs(exact.value - truth)
        assert (error <= cells + np.where(found, 0.0, exact.standard_error)).all()
        # V - ratio is a rounding of 1, times f of up to some hundred
        assert exact.standard_error[found].max() < 1e-4 * truth.max()

    @pytest.mark.parametrize("ratio", [False, True])
    def test_even_light_gives_the_ambient_occlusion(self, device, density, sampler, ratio):
        """E / pi = L A for even light, whatever is in the way."""
        even = EnvironmentMap.constant((1.0, 2.0, 0.5))
        result = in_the_clutter(device, even, sample_count=64, density=density, sampler=sampler, ratio=ratio)
        errors = result.value / np.array([1.0, 2.0, 0.5]) - openness(device)[:, None]
        # A ratio's bias is at most its standard error times the coefficient of variation of its denominator (Hartley
        # and Ross 1954). For 64 rays by the environment half of f is 0 and the rest 2 cos: variance 5/3 of the mean's
        # square; the other densities vary less.
        bias = np.sqrt((errors**2).mean()) * np.sqrt(5.0 / 3.0 / 64.0) if ratio else 0.0
        require_zero_mean(errors, bias)
        # channels see the same rays
        assert np.allclose(result.value[:, 1], 2.0 * result.value[:, 0], rtol=1e-5)

    def test_errors_are_honest(self, device, density, sampler):
        """Squared errors are on average what is stated for independent samples, and less for strata."""
        light, truth = gentle_light(device)
        for ratio in (False, True):
            result = in_the_clutter(device, light, density=density, sampler=sampler, ratio=ratio)
            # the ratio's error is linearised: its variance is off by the order of the square of what f varies by over
            # the count, (2 / 8)^2
            require_honest(
                result.value - truth,
                result.standard_error,
                independent=sampler == "iid",
                allowance=1.0 / 16.0 if ratio else 0.0,
            )

    def test_error_falls_with_the_count(self, device, density, sampler):
        """16 times the rays: a quarter of the error for independent samples, less for the others."""
        light, truth = gentle_light(device)

        def error(count):
            options = {"sample_count": count, "density": density, "sampler": sampler, "ratio": False}
            return root_mean_square(in_the_clutter(device, light, **options).value - truth)

        few, many = error(16), error(256)
        # 200 points: a root mean square is known to 4 % if errors are normal, and to 10 % for heavier tails
        if sampler == "iid":
            assert 4.0 * 0.7 < few / many < 4.0 / 0.7
        else:
            assert few / many > 4.0


@pytest.mark.parametrize("density", DENSITIES)
def test_floor_before_a_wall(device, density):
    """The floor at distance x from an endless wall of height H sees 0.5 (1 + x / sqrt(x^2 + H^2)) of the sky."""
    height, spacing, half_length = 1.0, 0.06, 12.0
    y, z = np.meshgrid(
        np.arange(-half_length, half_length, spacing), np.arange(spacing / 2.0, height, spacing), indexing="ij"
    )
    wall = np.stack([np.zeros(y.size), y.ravel(), z.ravel()], axis=1)
    scene = Scene.from_gaussians(
        cloud_of(tiles(wall, np.tile([1.0, 0.0, 0.0], (len(wall), 1)), spacing, opacity=0.99)), device
    )
    x = np.linspace(0.4, 2.0, 60)
    points = np.stack([x, np.zeros(60), np.zeros(60)], axis=1)
    truth = 0.5 * (1.0 + x / np.sqrt(x**2 + height**2))
    result = irradiance(
        scene, points, np.tile(UP, (60, 1)), EnvironmentMap.constant((1.0, 1.0, 1.0)), density=density, offset=0.0
    )
    # Tiling: the upper edge is soft, between the last centre and the reach of its Gaussian, 3.3 deviations above it.
    low, high = height - spacing / 2.0, height - spacing / 2.0 + 3.3 * 0.65 * spacing
    bounds = [(0.5 * (1.0 + x / np.sqrt(x**2 + h**2))).mean() for h in (high, low)]
    # The wall ends at 12 H: beyond, seen from x <= 2, an angle of 2 * 2 / 12 of 180 degrees' worth less than 0.002.
    noise = LARGEST_Z * np.sqrt((result.standard_error[:, 0] ** 2).sum()) / 60
    assert bounds[0] - noise < result.value[:, 0].mean() < bounds[1] + 0.002 + noise
    assert abs(truth.mean() - result.value[:, 0].mean()) < 0.02


@pytest.mark.parametrize(("density", "sample_count"), [("cosine", 31), ("environment", 31), ("mis", 62)])
def test_one_column_of_strata_takes_most_of_the_error(device, density, sample_count):
    """A prime count has strata along y alone, and light that grows along y varies little within one: both show."""
    environment = EnvironmentMap.constant((1.0, 1.0, 1.0), height=64)
    light = EnvironmentMap((1.0 + 0.9 * environment.directions()[..., 1:2]) * environment.radiance)
    count = 200
    errors = {}
    for sampler in ("stratified", "iid"):
        options = {"density": density, "sampler": sampler, "sample_count": sample_count, "ratio": False}
        result = irradiance(empty(device), np.zeros((count, 3)), np.tile(UP, (count, 1)), light, **options)
        errors[sampler] = result.value.std(), root_mean_square(result.standard_error)
    assert (np.array(errors["stratified"]) < 0.5 * np.array(errors["iid"])).all()


class TestMultipleImportance:
    def test_weights_sum_to_one(self, device, rng):
        cosine, environment = techniques("mis", "owen", 50)
        assert cosine.samples.count + environment.samples.count == 50
        assert environment.begin == cosine.samples.count
        cosines, pdfs = rng.uniform(0.0, 1.0, 500), np.exp(rng.normal(0.0, 6.0, 500))
        (mixed,) = run_kernel(mixture_kernel, 500, [cosine, (cosines, float), (pdfs, float)], [float], device)
        weights = (25 / 50 * cosines / np.pi + 25 / 50 * pdfs) / mixed
        np.testing.assert_allclose(weights, 1.0, rtol=1e-6)
        assert (cosine.cosine_share, cosine.environment_share) == (0.5, 0.5)
        odd = techniques("mis", "owen", 7)[0]
        assert odd.cosine_share + odd.environment_share == pytest.approx(1.0, rel=1e-6)
        for density in ("cosine", "environment"):
            (alone,) = techniques(density, "owen", 8)
            assert alone.cosine_share + alone.environment_share == 1.0

    def test_directions_of_both_together_have_the_mixed_density(self, device, rng):
        environment, normal = sky(200.0), np.array([0.0, 0.6, 0.8])
        light = PreparedEnvironment(environment, device)
        squares = rng.random((40_000, 2)).astype(np.float32)
        directions, pdfs = [], []
        for technique in techniques("mis", "iid", 64):
            nothing = wp.empty((0, 0), dtype=float, device=device)
            inputs = [technique, light.distribution, light.blocks, nothing, wp.vec3(*normal), (squares, wp.vec2)]
            direction, pdf = run_kernel(draw_light_kernel, len(squares), inputs, (wp.vec3, float), device)
            directions.append(direction)
            pdfs.append(pdf)
        directions = np.concatenate(directions)
        height, width = environment.height, environment.width
        row, column = texels_of(directions, height)
        counts = np.bincount(row * width + column, minlength=height * width).astype(float)
        # expected: environment's part exact, the cosine's by 16 x 16 midpoints a texel
        fine = EnvironmentMap.constant((1.0, 1.0, 1.0), height=16 * height)
        cosine = np.maximum(fine.directions() @ normal, 0.0) / np.pi * fine.solid_angles()
        cosine = cosine.reshape(height, 16, width, 16).sum((1, 3))
        power = environment.radiance.astype(np.float64) @ [0.2126, 0.7152, 0.0722] * environment.solid_angles()
        expected = (0.5 * cosine + 0.5 * power / power.sum()).ravel()
        assert expected.sum() == pytest.approx(1.0, abs=1e-4)
        require_density(counts, expected)
        # the density that samples are divided by is the one they have: the mean of 1 / pdf is the sphere's part that
        # either reaches, all of it
        inverse = 1.0 / np.concatenate(pdfs).astype(np.float64)
        assert abs(inverse.mean() - 4.0 * np.pi) < LARGEST_Z * inverse.std() / np.sqrt(len(inverse))


@wp.kernel
def mixture_kernel(technique: Technique, cosines: wp.array[float], pdfs: wp.array[float], out: wp.array[float]):
    i = wp.tid()
    out[i] = mixture_pdf(technique, cosines[i], pdfs[i])


@wp.kernel
def draw_light_kernel(
    technique: Technique,
    distribution: EnvironmentDistribution,
    blocks: EnvironmentBlocks,
    cumulative: wp.array2d[float],
    normal: wp.vec3,
    squares: wp.array[wp.vec2],
    out_direction: wp.array[wp.vec3],
    out_pdf: wp.array[float],
):
    i = wp.tid()
    drawn = draw_light(technique, distribution, blocks, cumulative, 0, normal, squares[i][0], squares[i][1])
    out_direction[i] = drawn.direction
    out_pdf[i] = drawn.pdf


def unshadowed(environment, normals, device):
    """What arrives at normals with nothing in the way, by the sums of moments."""
    out = wp.empty(len(normals), dtype=wp.vec3, device=device)
    at = wp.array(normals, dtype=wp.vec3, device=device)
    launch_sum_unshadowed(len(at), light_moments(environment, wp.get_device(device)), at, out, device)
    return out.numpy()


class TestUnshadowed:
    @pytest.mark.parametrize(("peak", "height"), [(51.0, 112), (1.6e3, 32), (2e4, 256)])
    def test_against_the_sum_over_texels(self, device, rng, peak, height):
        environment, normals = sky(peak, height), unit(rng.normal(size=(300, 3)))
        truth = exact_unshadowed(environment, normals)
        # the oracle takes fine texels for points: (pi / 256)^2 / 12 of the sun
        allowed = horizon_error(environment, normals) + 1.3e-5 * truth.max()
        assert (np.abs(unshadowed(environment, normals, device) - truth) <= allowed).all()

    def test_even_light(self, device, rng):
        """A hard horizon loses (pi / 32)^2 / 12 = 8e-4, always; spreading the cells' light leaves less than a third."""
        normals = unit(rng.normal(size=(500, 3)))
        relative = unshadowed(EnvironmentMap.constant((1.0, 2.0, 0.5)), normals, device) / [1.0, 2.0, 0.5] - 1.0
        assert np.abs(relative).max() < 8e-4 / 3.0
        assert abs(relative.mean()) < 8e-4 / 30.0


class TestHardLight:
    def test_darkness_is_zero(self, device):
        black = PreparedEnvironment(EnvironmentMap.constant((0.0, 0.0, 0.0)), device)
        for density, ratio in product(DENSITIES, (False, True)):
            result = irradiance(*cluttered(device, 20), black, density=density, ratio=ratio)
            assert not result.value.any()
            assert not result.standard_error.any()

    @pytest.mark.parametrize("density", DENSITIES)
    @pytest.mark.parametrize("ratio", [False, True])
    def test_a_single_bright_texel(self, device, rng, density, ratio):
        """All light from 1/2000 of the sphere: found by all but cosine, which says so where it can."""
        radiance = np.zeros((32, 64, 3), np.float32)
        radiance[6, 20] = (3e4, 2e4, 1e4)
        environment = EnvironmentMap(radiance)
        normals = unit(rng.normal(size=(400, 3)))
        truth = exact_unshadowed(environment, normals)
        result = irradiance(empty(device), np.zeros((400, 3)), normals, environment, density=density, ratio=ratio)
        assert np.isfinite(result.value).all()
        assert np.isfinite(result.standard_error).all()
        sun = environment.directions()[6, 20]
        # normals that see all of the texel, or none; half its diagonal is 0.08
        lit, dark = normals @ sun > 0.08, normals @ sun < -0.08
        assert not result.value[dark].any()
        assert not result.standard_error[dark].any()
        if density != "cosine":
            # Within the texel f is the cosine alone: its spread over 0.1 rad is all the noise of plain estimates. The
            # ratio has none: what is left are fine texels of the oracle taken for points, once for their size and once
            # for their shape.
            exact = 2.0 * (np.pi / 256) ** 2 / 12 * truth.max()
            np.testing.assert_allclose(result.value[lit], truth[lit], rtol=0.0 if ratio else 0.3, atol=exact)
        elif ratio:
            # 64 rays in the hemisphere find 1/2000 of the sphere once in 15 points; the others know nothing
            missed = np.isclose(result.value[lit, 0], 0.5 * truth[lit, 0], rtol=1e-3)
            assert missed.mean() > 0.5
            assert (np.abs(result.value - truth) <= result.standard_error * 1.001 + 1e-3 * truth.max())[lit].all()

    def test_normals_away_from_all_light(self, device):
        radiance = np.zeros((32, 64, 3), np.float32)
        radiance[:8] = 1.0
        light = PreparedEnvironment(EnvironmentMap(radiance), device)
        for density, ratio in product(DENSITIES, (False, True)):
            result = irradiance(empty(device), np.zeros((1, 3)), -UP[None], light, density=density, ratio=ratio)
            assert not result.value.any()
            assert not result.standard_error.any()

    def test_bernoulli_acceptance_has_the_same_mean(self, device):
        light = PreparedEnvironment(sky(), device)
        options = TraceOptions(acceptance="bernoulli")
        exact = in_the_clutter(device, light, sample_count=256, ratio=False, seed=1)
        drawn = in_the_clutter(device, light, options=options, ratio=False, seed=2)
        require_zero_mean(drawn.value - exact.value)


class TestCalls:
    def test_chunks_and_threads_do_not_matter_and_seeds_do(self, monkeypatch):
        light = PreparedEnvironment(sky(), "cpu")
        for density in DENSITIES:
            options = {"density": density, "sample_count": 16}
            whole = in_the_clutter("cpu", light, **options)
            with monkeypatch.context() as patch:
                patch.setenv("BEAM_WARP_THREADS", "3")
                patch.setattr("beam_warp.trace.rays.RAYS_AT_ONCE", 16 * 70)
                parts = in_the_clutter("cpu", light, **options)
            assert np.array_equal(whole.value, parts.value)
            assert np.array_equal(whole.standard_error, parts.standard_error)
            other = in_the_clutter("cpu", light, seed=1, **options)
            later = in_the_clutter("cpu", light, frame=1, **options)
            assert not np.array_equal(whole.value, other.value)
            assert not np.array_equal(whole.value, later.value)

    def test_maps_and_prepared_maps_and_warp_arrays_agree(self, device):
        scene, points, normals = cluttered(device, 40)
        environment = sky(height=50)  # no multiple of 16: fitted
        plain = irradiance(scene, points, normals, environment)
        light = PreparedEnvironment(environment, scene.device)
        on_device = [wp.array(a, dtype=wp.vec3, device=device) for a in (points, normals)]
        prepared = irradiance(scene, *on_device, light)
        assert np.array_equal(prepared.value.numpy(), plain.value)
        assert plain.value.shape == plain.standard_error.shape == (40, 3)

    @pytest.mark.parametrize("count", [0, 1, 255, 257])
    def test_any_number_of_points(self, device, count):
        result = irradiance(
            empty(device), np.zeros((count, 3)), np.tile(UP, (count, 1)), EnvironmentMap.constant((1, 1, 1))
        )
        assert result.value.shape == (count, 3)
        np.testing.assert_allclose(result.value, 1.0, atol=8e-4 / 3.0)  # the moments' cells at the horizon

    @pytest.mark.parametrize(
        "options",
        [
            {"sample_count": 1},
            {"sample_count": 3, "density": "mis"},
            {"density": "light"},
            {"sampler": "sobol"},
            {"offset": "big"},
            {"seed": -1},
            {"frame": 2**32},
        ],
    )
    def test_refusals(self, options):
        with pytest.raises(InvalidOptionError, match=f"^{next(iter(options))} must be"):
            irradiance(empty("cpu"), np.zeros((1, 3)), UP[None], EnvironmentMap.constant((1, 1, 1)), **options)
        with pytest.raises(InvalidArrayError, match="normals must have as many rows"):
            irradiance(empty("cpu"), np.zeros((2, 3)), UP[None], EnvironmentMap.constant((1, 1, 1)))


def test_a_disc_floor_is_not_in_its_own_light(device):
    """The automatic offset: a tiled floor under a dome keeps nearly all of its light."""
    points = disc_points(1.0, 0.05)
    up = np.tile(UP, (len(points), 1))
    scene = Scene.from_gaussians(cloud_of(tiles(points, up, 0.05)), device)
    result = irradiance(scene, points, up, EnvironmentMap.constant((1.0, 1.0, 1.0)))
    assert result.value.min() > 0.998  # the tails of neighbours
