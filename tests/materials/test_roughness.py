"""Roughness from photographs: known ones come back within their stated error; where data is mute nothing is claimed."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp
from reference.glossy_reflection import SmoothSky, irradiance_over_pi, reflected_radiance
from support.flat_scenes import brdf_twin
from support.shapes import cloud_of, colored, sphere_points, tiles
from support.structures import filled

from beam_warp import Scene
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.materials.residues import GatheredLight, LightRays, Observations
from beam_warp.kernels.materials.roughness_profile import (
    ProfileFit,
    launch_lobe_shares,
    launch_profile,
    launch_reflections,
)
from beam_warp.kernels.trace.surface_rays import RayBatch
from beam_warp.light.ggx import specular_albedo
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.materials.light_rays import MaterialOptions, reflected_light
from beam_warp.materials.normals import Neighborhoods, SurfacePoints
from beam_warp.materials.roughness import GRID, MODEL_ERROR, SHARED, RoughnessPrior, as_seen, solve_roughness
from beam_warp.materials.roughness_profile import CANDIDATES, RoughnessProfile, measure_roughness_profile
from beam_warp.world.environment import EnvironmentMap, texel_directions

NOISE = 0.01
"""Noise of every view's colour, as a part of what a white surface shows: a good photograph of a well known surface."""

SKY = SmoothSky(
    (0.25, 0.3, 0.4),
    [(0.2, 0.3, 0.93), (-0.8, 0.5, 0.4), (0.7, -0.6, 0.2), (0.1, 0.9, -0.3), (-0.5, -0.8, 0.1)],
    [40.0, 25.0, 30.0, 20.0, 35.0],
    [(9.0, 8.0, 6.0), (4.0, 5.0, 6.0), (7.0, 6.0, 5.0), (3.0, 3.0, 3.0), (5.0, 6.0, 7.0)],
)
EVEN = SmoothSky((0.8, 0.8, 0.8), [(0.0, 0.0, 1.0)], [1.0], [(0.0, 0.0, 0.0)])

OPTIONS = MaterialOptions(sample_count=16, bounce=False)


@cache
def light_of(sky, device):
    rows = 16 if sky is EVEN else 64
    environment = EnvironmentMap(sky.radiance(texel_directions(rows, 2 * rows)).astype(np.float32))
    return PreparedEnvironment(environment, wp.get_device(device))


def tilted(normals, angle):
    """Unit normals that are off by independent angles, ``angle`` in the root mean square [rad]."""
    off = normals + np.random.default_rng(7).normal(scale=angle / np.sqrt(2.0), size=normals.shape)
    return off / np.linalg.norm(off, axis=1, keepdims=True)


def profile_of(
    sky, roughness, device, *, count=800, view_count=20, noise=NOISE, frame=0, base_color=None, tilt=0.0, together=1
):
    """What a lone sphere of known roughness says, its photographs computed by the full integral; and its points."""
    rng = np.random.default_rng(1000 * view_count + frame)
    normals, spacing = sphere_points(count)
    directions = sphere_points(view_count)[0]  # towards cameras far away
    rough = np.broadcast_to(roughness, count)
    paint = np.random.default_rng(5).uniform(0.15, 0.6, (count, 3))
    if base_color is not None:
        paint[:] = base_color
    white = irradiance_over_pi(sky, normals).mean(axis=1, keepdims=True)
    colors = np.zeros((view_count, count, 4), np.float32)
    for view, direction in enumerate(directions):
        towards = np.broadcast_to(direction, normals.shape)
        shown = reflected_radiance(sky, normals, towards, paint, rough)
        colors[view, :, :3] = np.maximum(shown + noise * white * rng.normal(size=shown.shape), 0.0)
        colors[view, :, 3] = normals @ direction > 0.1
    cloud = colored(cloud_of(tiles(normals, normals, spacing)), np.full((count, 3), 0.5))
    scene = Scene.from_gaussians(cloud, device)

    def vectors(values):
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device=scene.device)

    ones = np.ones(count, np.float32)
    lifts = wp.full(count, 4.0 * spacing, dtype=float, device=scene.device)
    points = SurfacePoints(vectors(normals), vectors(tilted(normals, tilt)), lifts, ones > 0.0, 0.0 * ones, ones)
    views = ViewEvidence(
        points.positions,
        points.normals,
        wp.ones(count, dtype=float, device=scene.device),
        ones,
        ones > 0.0,
        0.0 * ones,
        wp.array(colors, dtype=wp.vec4, device=scene.device),
        vectors(np.broadcast_to(directions[:, None], (view_count, count, 3))),
        np.zeros((count, 3), np.float32),
    )
    points = replace(points, around=Neighborhoods.of(cloud, views, scene.device))
    light = light_of(sky, str(scene.device))
    profile = measure_roughness_profile(cloud, scene, points, light, views, options=OPTIONS, frame=frame)
    return normals, profile


def within(found, truth, errors):
    """Part of the Gaussians whose truth lies within so many stated errors."""
    return (np.abs(found.roughness - truth) < errors * found.standard_error).mean()


@pytest.mark.parametrize("roughness", [0.2, 0.4, 0.6])
@pytest.mark.parametrize("angle", [0.05, 0.1, 0.2])
def test_a_mean_of_tilted_lobes_is_a_wider_one(roughness, angle):
    """The lobe that is nearest to a mean of 4,000 tilted ones, in least squares over the hemisphere."""
    polar, tries = np.linspace(0.0, 1.2, 200), np.linspace(0.15, 0.7, 221)
    halves = np.stack([np.sin(polar), np.zeros(200), np.cos(polar)], axis=1)
    cosines = np.clip(halves @ tilted(np.tile([0.0, 0.0, 1.0], (4000, 1)), angle).T, 0.0, 1.0)

    def lobe(cosine, alpha):
        return alpha**2 / (np.pi * (cosine**2 * (alpha**2 - 1.0) + 1.0) ** 2)

    mean = lobe(cosines, roughness**2).mean(axis=1)
    apart = [(np.sin(polar) * (mean - lobe(np.cos(polar), r**2)) ** 2).sum() for r in tries]
    looks = (roughness**4 + angle**2) ** 0.25
    assert tries[np.argmin(apart)] == pytest.approx(looks, abs=0.02)  # a mean of GGX lobes is nearly one
    misfit = np.square(np.array(CANDIDATES) - looks)[None, None]
    assert GRID[np.argmin(as_seen(misfit, np.array([angle**2])))] == pytest.approx(roughness, abs=0.02)


class TestKnownSpheres:
    @pytest.mark.parametrize("truth", [0.2, 0.5, 0.8])
    def test_roughness_comes_back_within_its_stated_error(self, truth, device):
        positions, profile = profile_of(SKY, truth, device)
        found = solve_roughness(positions, profile)
        assert within(found, truth, 2.0) > 0.95  # a normal distribution's
        assert np.median(found.standard_error) < 0.1  # the prior's, before any data, is 0.21
        assert abs(found.report["prior_mean"] - truth) < 0.1

    def test_normals_that_scatter_make_lobes_look_rough_and_that_is_taken_back(self, device):
        angles = np.random.default_rng(2).uniform(0.05, 0.5, 800)
        positions, profile = profile_of(SKY, (0.35**4 + angles**2) ** 0.25, device)
        silent = solve_roughness(positions, profile)
        found = solve_roughness(positions, replace(profile, scatter=angles**2 * profile.views))
        assert np.median(silent.roughness) > 0.5
        assert within(silent, 0.35, 2.0) < 0.1
        assert found.report["scatter_part"] > 0.7
        assert within(found, 0.35, 2.0) > 0.95

    def test_normals_that_scatter_in_pixels_only_change_nothing(self, device):
        """Lobes do not look wider where normals scatter more: what scatters is noise."""
        angles = np.random.default_rng(2).uniform(0.05, 0.5, 800)
        positions, profile = profile_of(SKY, 0.35, device)
        silent = solve_roughness(positions, profile)
        found = solve_roughness(positions, replace(profile, scatter=angles**2 * profile.views))
        assert found.report["scatter_part"] < 0.1
        assert np.abs(found.roughness - silent.roughness).max() < 0.03

    def test_normals_that_are_off_one_by_one_hardly_matter(self, device):
        """Faces are what neighbours agree on; one by one, such normals would make it look like 0.52."""
        assert np.median(solve_roughness(*profile_of(SKY, 0.35, device, tilt=0.25)).roughness) < 0.43

    def test_stated_errors_cover_what_many_places_are_off(self, device):
        """Neighbours are wrong together: 1600 Gaussians are 100 places of 16, and their share binomial."""
        at = sphere_points(1600)[0]
        truth = 0.5 + 0.25 * np.sin(2.0 * at[:, 0] + at[:, 1]) * np.cos(2.0 * at[:, 2])
        positions, profile = profile_of(SKY, truth, device, count=1600, view_count=16, noise=0.03)
        found = solve_roughness(positions, profile)
        assert within(found, truth, 2.0) > 0.95 - 2.0 * np.sqrt(0.95 * 0.05 / 100)
        off = np.sqrt(np.mean(np.square(found.roughness - truth)))
        assert off < truth.std()  # better than any constant
        assert found.standard_error.mean() < 3.0 * off  # and not by stating the obvious

    def test_same_bits_for_any_number_of_threads(self, device, monkeypatch):
        found = []
        for threads in ("1", "2"):
            monkeypatch.setenv("BEAM_WARP_THREADS", threads)
            positions, profile = profile_of(SKY, 0.4, device, count=300, view_count=6)
            found.append((profile.misfit, solve_roughness(positions, profile).roughness))
        assert np.array_equal(found[0][0], found[1][0])
        assert np.array_equal(found[0][1], found[1][1])


class TestWeights:
    """Misfits that are exact negative log-likelihoods of independent normal errors: T = 1 is right."""

    SPREAD = 0.3

    def profile(self, rng, truth, frames=1, spread=SPREAD):
        values = np.array(CANDIDATES)
        halves = np.zeros((2, len(truth), len(values)))
        for _ in range(frames):
            seen = truth + spread * rng.normal(size=(2, len(truth)))
            halves += np.square((values - seen[..., None]) / spread) / 2.0
        return RoughnessProfile(np.concatenate([halves.sum(0, keepdims=True), halves]), np.ones(len(truth)), frames)

    def sheet(self, rng, count=4000):
        return np.concatenate([rng.uniform(0.0, 1.0, (count, 2)), np.zeros((count, 1))], axis=1)

    def test_precision_is_found(self, rng):
        positions = self.sheet(rng)
        truth = 0.5 + 0.2 * np.sin(6.0 * positions[:, 0])
        found = solve_roughness(positions, self.profile(rng, truth))
        # the precisions that are tried lie a factor 1.47 apart, and the truth may lie between two
        assert SHARED / 1.5 < found.report["near"]["precision"] < SHARED * 1.5
        # evidence that counts a quarter states twice the error: within one lie nearly all
        assert within(found, truth, 1.0) > 0.9

    def test_the_prior_is_found(self, rng):
        positions = self.sheet(rng)
        truth = 0.55 + 0.15 * np.sqrt(2.0) * np.sin(6.0 * positions[:, 0])
        found = solve_roughness(positions, self.profile(rng, truth))
        # some 60 places of 64 clusters: their mean is off by 0.15 / sqrt(60) and 0.02, their spread by half of that
        # and by the step of those that are tried, a factor 1.19
        assert abs(found.prior.mean - truth.mean()) < 2 * 0.02 + 0.025
        assert 0.15 / 1.3 < found.prior.spread < 0.15 * 1.3

    @pytest.mark.parametrize("truth", [0.3, 0.7])
    def test_the_start_of_the_prior_counts_as_much_as_one_place(self, rng, truth):
        """One place, 256 Gaussians, leaves the mean between the start's and its own; four outvote the start."""
        certain = np.tile(np.square((np.array(CANDIDATES) - truth) / 0.05), (3, 1024, 1))
        certain[0] *= 2.0
        means = [
            solve_roughness(self.sheet(rng, n), RoughnessProfile(certain[:, :n], np.ones(n))).prior.mean
            for n in (256, 1024)
        ]
        assert 0.0 < (means[0] - 0.5) / (truth - 0.5) < 0.9
        assert means[1] == pytest.approx(truth)

    def test_more_frames_smaller_error(self, rng):
        positions = self.sheet(rng)
        truth = np.full(len(positions), 0.5)
        errors = []
        for frames in (1, 2, 4):
            found = solve_roughness(positions, self.profile(rng, truth, frames, 1.2), prior=RoughnessPrior(0.5, 1.0))
            errors.append(np.median(np.sqrt(np.square(found.standard_error) - MODEL_ERROR**2)))
        # twice the data, the error over 1.41; the grid of precisions leaves a factor sqrt(1.47) = 1.21 either way
        assert 0.58 < errors[1] / errors[0] < 0.86
        assert 0.58 < errors[2] / errors[1] < 0.86

    def test_strong_places_do_not_take_what_is_around_them(self, rng):
        """Two materials with a sharp border: away from it by the width of a place, neither bleeds into the other."""
        positions = self.sheet(rng)
        truth = np.where(positions[:, 0] < 0.5, 0.3, 0.7)
        found = solve_roughness(positions, self.profile(rng, truth, frames=64))
        away = np.abs(positions[:, 0] - 0.5) > 0.1
        assert np.abs(found.roughness - truth)[away].max() < 0.1
        assert found.report["step"] > 0.0


class TestNothingToTell:
    def mute(self, found, prior):
        assert not found.informed.any()
        np.testing.assert_allclose(found.roughness, found.report["prior_mean"], rtol=1e-6)
        assert (found.standard_error >= found.report["prior_spread"]).all()
        assert found.report["prior_spread"] > 0.8 * prior.spread  # what the cut to [0.1, 1] leaves of 0.25: 0.21
        assert found.prior == prior

    @pytest.mark.parametrize(("sky", "said"), [(EVEN, {"base_color": 1.0, "count": 300}), (SKY, {"view_count": 2})])
    def test_a_white_furnace_or_two_views(self, device, sky, said):
        """A white sphere under even light shows that light from all sides, whatever its roughness.

        Each half of two views is one view, which any roughness explains with a base colour of its own.
        """
        positions, profile = profile_of(sky, 0.3, device, **said)
        self.mute(solve_roughness(positions, profile), RoughnessPrior())

    def test_no_views(self):
        profile = RoughnessProfile(np.zeros((3, 5, len(CANDIDATES))), np.zeros(5))
        self.mute(solve_roughness(np.zeros((5, 3)), profile), RoughnessPrior())

    def test_halves_that_contradict_each_other(self, rng):
        """Every place is certain, its halves of different values: nothing is claimed."""
        values = np.array(CANDIDATES)
        halves = np.stack([np.square((values - rng.uniform(0.2, 0.9, (400, 1))) / 0.1) for _ in range(2)])
        profile = RoughnessProfile(np.concatenate([halves.sum(0, keepdims=True), halves]), np.ones(400))
        apart = 10.0 * np.repeat(rng.normal(size=(100, 3)), 4, axis=0)
        found = solve_roughness(apart, profile, prior=RoughnessPrior())
        assert found.report["near"]["precision"] < 1.0  # taken at its word it would be 1 / SHARED of that


def test_a_given_prior_is_what_is_left(device):
    positions, profile = profile_of(SKY, 0.3, device, view_count=2)
    found = solve_roughness(positions, profile, prior=RoughnessPrior(0.7, 0.05))
    np.testing.assert_allclose(found.roughness, 0.7, atol=1e-3)  # the cut at 1 is six deviations away


def test_gaussians_that_no_view_shows_take_their_neighbours():
    values = np.array(CANDIDATES)
    misfit = np.tile(np.square((values - 0.4) / 0.05), (3, 64, 1))
    views = np.ones(64)
    misfit[:, 10:20], views[10:20] = 0.0, 0.0
    positions = np.stack([np.arange(64.0), np.zeros(64), np.zeros(64)], axis=1)
    found = solve_roughness(positions, RoughnessProfile(misfit, views))
    assert np.abs(found.roughness - 0.4).max() < 0.03


def test_bad_input_is_refused():
    profile = RoughnessProfile(np.zeros((3, 5, len(CANDIDATES))), np.zeros(5))
    with pytest.raises(InvalidArrayError, match="misfit must have shape"):
        RoughnessProfile(np.zeros((3, 5, 7)), np.zeros(5))
    with pytest.raises(InvalidArrayError, match="profiles must be of the same Gaussians"):
        _ = profile + RoughnessProfile(np.zeros((3, 4, len(CANDIDATES))), np.zeros(4))
    with pytest.raises(InvalidArrayError, match="positions must have shape"):
        solve_roughness(np.zeros((4, 3)), profile)
    with pytest.raises(InvalidOptionError, match="spread"):
        RoughnessPrior(0.5, 0.0)


def test_shares_and_misfits_are_those_of_float64(rng, device):
    """Random normals, rays and views; the light is even, so that lobes have a closed form."""
    point_count, view_count, ray_count = 37, 7, 16
    light = PreparedEnvironment(EnvironmentMap.constant((1.0, 1.0, 1.0), height=16), device)

    def unit(*shape):
        d = rng.normal(size=(*shape, 3))
        return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)

    host = {
        "normals": unit(point_count),
        "towards": unit(view_count, point_count),
        "rays": unit(point_count, ray_count),
        "visibility": rng.uniform(size=(point_count, ray_count)).astype(np.float32),
        "colors": rng.uniform(0.05, 0.9, (view_count, point_count, 4)).astype(np.float32),
    }
    rows = np.arange(point_count)
    batch = filled(RayBatch, device, normals=host["normals"], rows=rows, sample_count=ray_count)
    cosine = np.maximum((host["rays"] * host["normals"][:, None]).sum(-1), 0.0)
    rays = filled(
        LightRays,
        device,
        directions=host["rays"].reshape(-1, 3),
        weights=np.repeat(cosine.reshape(-1, 1), 3, 1),
        visibility=host["visibility"].ravel(),
    )
    white = np.ones((point_count, 3))
    point_light = filled(GatheredLight, device, unshadowed=white, arriving=0.8 * white, bounce=0.1 * white)
    views = filled(Observations, device, colors=host["colors"], directions=host["towards"])
    shares = wp.full((point_count, view_count), wp.vec4(), dtype=wp.vec4, device=device)
    reflected = reflected_light(light)
    inputs = (batch, rays, point_light, batch.normals, views, reflected.sources)
    launch_lobe_shares(shares.size, *inputs, shares, device)
    fit = ProfileFit()
    fit.misfit = wp.zeros((3, point_count, len(CANDIDATES)), dtype=float, device=device)
    fit.views = wp.zeros(point_count, dtype=float, device=device)
    candidates = wp.array(np.array(CANDIDATES, np.float32), dtype=float, device=device)
    reflections = wp.zeros((point_count, view_count, len(CANDIDATES)), dtype=wp.vec4, device=device)
    inputs = (batch.rows, point_light, reflected, batch.normals, views, shares, candidates)
    launch_reflections(reflections.size, *inputs, reflections, device)
    launch_profile(fit.misfit.size, batch.rows, point_light, batch.normals, views, reflections, fit, device)
    normals, towards, directions = (host[name].astype(np.float64) for name in ("normals", "towards", "rays"))
    cosine = (towards * normals).sum(-1)
    faces = np.clip((cosine - 0.2) / 0.3, 0.0, 1.0)
    weight = np.minimum(host["colors"][..., 3], 1.0) * faces
    np.testing.assert_allclose(fit.views.numpy(), weight.sum(0), rtol=1e-5)
    expected = np.stack([open_share(normals, towards, directions, host["visibility"], r) for r in SHARES], -1)
    counted = (faces > 0.0).T
    # float32 dot products near 1 leave n.h of a lobe of alpha 0.0225 off by u / alpha^2, 1e-4
    np.testing.assert_allclose(shares.numpy()[counted], expected[counted], atol=2e-3)
    for number, r in enumerate(CANDIDATES):
        share = np.array([[np.interp(r, SHARES, column) for column in row] for row in expected]).T
        albedo = specular_albedo(np.clip(cosine, 0.0, 1.0), np.full_like(cosine, r))
        target = host["colors"][..., :3] - ((share + 0.1) * albedo)[..., None]
        for part, chosen in enumerate((slice(None), slice(0, None, 2), slice(1, None, 2))):
            twin = misfit_twin(target[chosen], 0.9 * (1.0 - albedo[chosen]), weight[chosen])
            # shares are off by 2e-3 of 0.04 to 0.1, so residuals by 1e-4, and the loss by 2 / s of that
            np.testing.assert_allclose(fit.misfit.numpy()[part, :, number], twin, atol=2e-3 * view_count)


SHARES = (0.15, 0.35, 0.6, 1.0)


def open_share(normals, towards, directions, visibility, roughness):
    """Part of the lobe's light that is open, (points, views): sums over rays of D V F cos, visible ones over all."""
    light = np.einsum("nsk,nk->ns", directions, normals)[:, None]
    view = np.einsum("vnk,nk->nv", towards, normals)[..., None]
    with np.errstate(all="ignore"):  # of what is below the surface, which is left out
        views, rays = np.swapaxes(towards, 0, 1)[:, :, None], directions[:, None]
        lobe = light * brdf_twin(normals[:, None, None], views, rays, roughness)
    lobe = np.where((light > 0.0) & (view > 0.0), lobe, 0.0)
    total = lobe.sum(-1)
    return np.where(total > 0.0, (lobe * visibility[:, None]).sum(-1) / np.where(total > 0.0, total, 1.0), 0.8)


def misfit_twin(target, diffuse, weight):
    """Cauchy's loss after three rounds of reweighting; everything is lit by one, so s is 0.06."""
    base = np.zeros(target.shape[1:])
    current = weight
    for _ in range(4):
        excess = np.square(target - base * diffuse[..., None]).sum(-1) / 0.06**2
        misfit = (weight * np.log1p(excess)).sum(0)
        if current is not weight:
            current = weight / (1.0 + excess)
        numerator = (current[..., None] * diffuse[..., None] * target).sum(0)
        denominator = (current * diffuse**2).sum(0)[:, None]
        base = np.clip(np.where(denominator > 0.0, numerator / np.maximum(denominator, 1e-300), 0.0), 0.0, 1.0)
        current = np.array(weight)
    return misfit
