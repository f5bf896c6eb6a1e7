"""Light at points and what it leaves in views, kernel by kernel, against float64: sums, residues, bounce, fit."""

from functools import cache

import numpy as np
import pytest
import warp as wp
from reference.harmonics import sh_color
from support.estimates import LARGEST_Z
from support.flat_scenes import brdf_twin
from support.shapes import cloud_of, disc_points, sphere_points, tiles
from support.structures import filled

from beam_warp import Scene
from beam_warp.device.arrays import zero_struct
from beam_warp.kernels.materials.residues import (
    ALBEDO_SCALING,
    FRESNEL_HV,
    ColorFit,
    GatheredLight,
    LightRays,
    Observations,
    ShadedPoints,
    launch_fit_color,
    launch_gather_light,
    launch_sample_radiance,
    launch_trace_bounce,
    launch_view_residues,
)
from beam_warp.kernels.trace.surface_rays import RayBatch
from beam_warp.light.ggx import DIELECTRIC_F0, schlick_weight, specular_albedo
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.light.uploaded import upload_lights
from beam_warp.materials.light_rays import reflected_light, view_set
from beam_warp.trace.transmittance import EXACT
from beam_warp.world.environment import EnvironmentMap, texel_directions

EPS = float(np.finfo(np.float32).eps)
TABLE_ERROR = 2e-3
"""Error of the directional albedo between the nodes of its table, see tests/light/test_ggx.py."""


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def single(array):
    """What a kernel will read, in float64: oracles start from the same rounded numbers."""
    return np.asarray(array, np.float32).astype(np.float64)


def structured(directions):
    """Radiance of a sky with a gradient, a warm lobe and a cool one, ``(..., 3)``."""
    warm, cool = unit(np.array([0.4, -0.5, 0.8])), unit(np.array([-0.7, 0.2, 0.3]))
    base = 1.0 + 0.6 * directions[..., 2]
    return (
        base[..., None] * np.array([0.5, 0.6, 0.8])
        + np.exp(8.0 * (directions @ warm - 1.0))[..., None] * np.array([6.0, 4.0, 2.0])
        + np.exp(5.0 * (directions @ cool - 1.0))[..., None] * np.array([0.5, 1.0, 3.0])
    )


class Points:
    """Points, rays and light of a launch: NumPy in, structs out. Rays of a point follow each other, as in a batch."""

    def __init__(self, normals, directions, weights, visibility, device, *, paired=False, bounce=0.0, roughness=0.5):
        count, samples = directions.shape[:2]
        self.device, self.count = device, count
        self.rows = np.arange(count)[::-1].copy()  # batches come in another order than rows
        self.batch = filled(RayBatch, device, normals=normals[self.rows], rows=self.rows, sample_count=samples)
        self.rays = filled(
            LightRays,
            device,
            directions=directions[self.rows].reshape(-1, 3),
            weights=weights[self.rows].reshape(-1, 3),
            visibility=visibility[self.rows].reshape(-1),
            paired=int(paired),
        )
        black, zero = np.zeros((count, 3)), np.zeros(count)
        self.light = filled(
            GatheredLight,
            device,
            unshadowed=black,
            arriving=black,
            bounce=black + bounce,
            noise=zero,
            tilt=zero,
            source_shares=np.ones((count, 4)),
        )
        self.surface = filled(ShadedPoints, device, normals=normals, roughness=np.full(count, roughness))

    def gather(self, ratio, unshadowed, sky=None):
        self.light.unshadowed.assign(np.asarray(unshadowed, np.float32))
        sources = upload_lights((), self.device) if sky is None else reflected_light(sky).sources
        inputs = (self.batch, self.rays, int(ratio), sources)
        launch_gather_light(len(self.batch.rows), *inputs, self.light, self.device)
        return {name: getattr(self.light, name).numpy().copy() for name in ("arriving", "noise", "tilt")}

    def residues(self, sky, views, diffuse_weight=ALBEDO_SCALING, weights=None):
        colors = np.zeros((*views.shape[:2], 4))
        colors[..., 3] = 1.0 if weights is None else weights
        found = filled(
            Observations,
            self.device,
            colors=colors,
            directions=views,
            specular=np.zeros(views.shape),
            diffuse_share=np.zeros(views.shape[:2]),
        )
        inputs = (self.batch, self.rays, self.light, reflected_light(sky), self.surface, int(diffuse_weight))
        launch_view_residues(*inputs, found, self.device)
        return found.specular.numpy(), found.diffuse_share.numpy()


def random_rays(rng, count, samples):
    """Directions above each normal, and their weights f = L cos / (pi pdf) for any L and pdf."""
    normals = unit(rng.normal(size=(count, 3)))
    directions = unit(rng.normal(size=(count, samples, 3)))
    below = np.einsum("pi,pki->pk", normals, directions) < 0.0
    directions[below] *= -1.0
    cosine = np.einsum("pi,pki->pk", single(normals), single(directions))
    weights = rng.gamma(0.5, 2.0, (count, samples, 3)) * np.maximum(cosine, 0.0)[..., None]
    visibility = np.where(rng.random((count, samples)) < 0.5, rng.uniform(0.05, 1.0, (count, samples)), 1.0)
    return normals, directions, weights, visibility


class TestGatheredLight:
    @pytest.mark.parametrize("samples", [7, 64])
    @pytest.mark.parametrize("paired", [True, False])
    def test_arriving_light_and_its_noise(self, device, rng, samples, paired):
        rays = random_rays(rng, 70, samples)
        points = Points(*rays, device, paired=paired)
        unshadowed = rng.uniform(0.5, 2.0, (70, 3))
        weights, visibility = single(rays[2]), single(rays[3])
        seen, free = (weights * visibility[..., None]).sum(1), weights.sum(1)
        shared = points.gather(True, unshadowed)
        tolerance = 4 * samples * EPS  # two sums of as many positive terms, their quotient
        np.testing.assert_allclose(shared["arriving"], single(unshadowed) * seen / free, rtol=tolerance, atol=1e-30)
        plain = points.gather(False, unshadowed)
        np.testing.assert_allclose(plain["arriving"], seen / samples, rtol=tolerance, atol=1e-30)
        total = seen.sum(1)
        for found, center in ((shared, total / free.sum(1)), (plain, np.zeros(70))):
            terms = weights.sum(2) * (visibility - center[:, None])
            np.testing.assert_allclose(
                found["noise"],
                np.sqrt(variance_of_sum(terms, paired)) / total,
                # terms differ by cancellation: their rounding is that of what they are made of
                rtol=50 * samples * EPS,
                atol=10 * samples * EPS * weights.sum(2).max() / total.min(),
            )

    def test_tilt_is_what_a_turn_of_the_normal_does(self, device, rng):
        """E(n) = mean of (L V / (pi pdf)) n.w is n.F: d ln E / d angle is F's part across n over its part along n."""
        rays = random_rays(rng, 40, 64)
        found = Points(*rays, device).gather(True, np.ones((40, 3)))["tilt"]
        normals, directions, weights, visibility = (single(array) for array in rays)
        per_cosine = weights.sum(2) * visibility / np.einsum("pi,pki->pk", normals, directions)
        flux = np.einsum("pk,pki->pi", per_cosine, directions)
        along = (flux * normals).sum(1, keepdims=True)
        expected = np.linalg.norm(flux - along * normals, axis=1) / along[:, 0]
        # dividing by small cosines magnifies the rounding of n.w
        np.testing.assert_allclose(found, expected, rtol=64 * EPS / 1e-2)

    def test_points_without_light_are_stated_unknown_not_divided(self, device):
        normals = np.tile([0.0, 0.0, 1.0], (3, 1))
        directions = np.tile(unit(np.array([0.3, 0.1, 0.9])), (3, 8, 1))
        weights = np.ones((3, 8, 3))
        weights[0] = 0.0  # no ray found light
        weights[2, :, 1] = 0.0  # none in one channel
        visibility = np.ones((3, 8))
        visibility[1] = 0.0  # all blocked
        found = Points(normals, directions, weights, visibility, device).gather(True, np.full((3, 3), 2.0))
        np.testing.assert_array_equal(found["arriving"], [[1, 1, 1], [0, 0, 0], [2, 1, 2]])
        np.testing.assert_array_equal(found["noise"][:2], 1.0)
        assert np.isfinite(found["tilt"]).all()


def variance_of_sum(terms, paired):
    """Float64 twin of `beam_warp.kernels.common.spread`."""
    count = terms.shape[1]
    if not paired:
        return count * terms.var(axis=1, ddof=1)
    even = count - count % 2
    result = ((terms[:, 0:even:2] - terms[:, 1:even:2]) ** 2).sum(1)
    if count % 2:
        a, b, c = terms[:, -3], terms[:, -2], terms[:, -1]
        result = result + 0.5 * ((a - c) ** 2 + (b - c) ** 2 - (a - b) ** 2)
    return result


@pytest.fixture(scope="module")
def sky():
    radiance = structured(texel_directions(64, 128)).astype(np.float32)
    return cache(lambda device: PreparedEnvironment(EnvironmentMap(radiance), device=device))


def even_rays(normals, samples):
    """Rays evenly over the sphere (density 1 / 4 pi) under the structured sky; half of them lie below the surface."""
    count = len(normals)
    directions = np.tile(sphere_points(samples)[0], (count, 1, 1))
    cosine = np.maximum(np.einsum("pi,pki->pk", normals, directions), 0.0)
    weights = structured(directions) * (4.0 * cosine)[..., None]
    return directions, weights, np.ones((count, samples))


def views_of(normals, cosines, rng):
    """Directions towards viewers at given cosines, ``(V, N, 3)``."""
    across = np.stack([np.linalg.svd(n[None])[2][1:] for n in normals])
    phi = rng.uniform(0.0, 2.0 * np.pi, (len(cosines), len(normals)))
    around = np.cos(phi)[..., None] * across[:, 0] + np.sin(phi)[..., None] * across[:, 1]
    c = np.asarray(cosines)[:, None, None]
    return c * normals + np.sqrt(1.0 - c * c) * around


class TestResidues:
    COSINES = (0.03, 0.3, 0.6, 0.9, 0.999)

    @pytest.mark.parametrize("roughness", [0.3, 0.7])
    def test_open_points_show_what_their_lobe_sees_of_the_sky_times_the_albedo(self, device, rng, sky, roughness):
        normals = unit(rng.normal(size=(33, 3)))
        bounce = np.array([0.25, 0.5, 0.1])
        points = Points(normals, *even_rays(normals, 64), device, roughness=roughness, bounce=bounce)
        points.gather(True, np.ones((33, 3)))
        views = views_of(normals, self.COSINES, rng)
        specular, share = points.residues(sky(device), views)
        albedo = specular_albedo(np.array(self.COSINES), np.full(len(self.COSINES), roughness))
        np.testing.assert_allclose(share, np.broadcast_to(1.0 - albedo[:, None], share.shape), atol=TABLE_ERROR)
        fine, _ = sphere_points(40_000)
        light = structured(fine)
        for v, p in ((1, 5), (2, 17), (3, 29), (4, 32)):
            up = fine @ normals[p] > 0.0
            lobe = brdf_twin(normals[p], views[v, p], fine[up], roughness) * (fine[up] @ normals[p])
            expected = ((lobe[:, None] * light[up]).sum(0) / lobe.sum() + bounce) * albedo[v]
            # tree blur 2 %, linear in log roughness between levels 2 %, and what four round lobes leave of a long one
            assert (np.abs(specular[v, p] - expected) < 0.05 * expected.max() + TABLE_ERROR).all()

    @pytest.mark.parametrize("roughness", [0.4, 0.8])
    def test_what_is_in_the_way_takes_its_share_of_the_lobe(self, device, rng, sky, roughness):
        normals = unit(rng.normal(size=(17, 3)))
        directions, weights, everything = even_rays(normals, 512)
        visibility = (directions @ unit(np.array([0.2, 1.0, 0.1])) < 0.1).astype(float)
        views = views_of(normals, self.COSINES, rng)
        speculars = []
        for seen in (visibility, everything):
            points = Points(normals, directions, weights, seen, device, roughness=roughness)
            points.gather(True, np.ones((17, 3)))
            speculars.append(points.residues(sky(device), views)[0][..., 0])
        share = speculars[0] / speculars[1]
        directions, weights = single(directions), single(weights)
        for v in range(len(self.COSINES)):
            for p in range(17):
                up = directions[p] @ normals[p] > 1e-6
                lobe = weights[p, up].sum(1) * brdf_twin(normals[p], views[v, p], directions[p, up], roughness)
                expected = (lobe * visibility[p, up]).sum() / lobe.sum()
                # float32 of n.h at D's peak: relative error of D is at most 4 eps / alpha^2
                assert abs(share[v, p] - expected) < 64 * EPS / roughness**4

    def test_fresnel_share_by_quadrature(self, device, rng, sky):
        normals = unit(rng.normal(size=(9, 3)))
        views = views_of(normals, self.COSINES, rng)
        points = Points(normals, *even_rays(normals, 4096), device)
        points.gather(True, np.ones((9, 3)))
        _, share = points.residues(sky(device), views, FRESNEL_HV)
        fine, _ = sphere_points(40_000)
        for v in range(len(self.COSINES)):
            for p, n in enumerate(normals):
                up = fine[fine @ n > 0.0]
                power = structured(up).sum(1) * (up @ n)
                h = unit(views[v, p] + up)
                fresnel = DIELECTRIC_F0 + (1.0 - DIELECTRIC_F0) * schlick_weight((h * views[v, p]).sum(1))
                expected = (power * (1.0 - fresnel)).sum() / power.sum()
                # 2048 even directions above the surface: the integrand's edge at the horizon errs by their spacing
                # squared times its slope, 4 pi / 4096 of at most 1
                assert abs(share[v, p] - expected) < 4.0 * np.pi / 4096

    def test_fresnel_share_is_the_mean_over_its_rays(self, device, rng, sky):
        """Few rays, each with its power: what is left of the light that is not reflected, to rounding."""
        normals = unit(rng.normal(size=(9, 3)))
        directions, weights, everything = even_rays(normals, 8)
        visibility = everything * rng.uniform(0.2, 1.0, everything.shape)
        views = views_of(normals, self.COSINES, rng)
        points = Points(normals, directions, weights, visibility, device)
        points.gather(True, np.ones((9, 3)))
        _, share = points.residues(sky(device), views, FRESNEL_HV)
        directions, power = single(directions), single(weights).sum(2) * single(visibility)
        for v in range(len(self.COSINES)):
            half = unit(views[v][:, None] + directions)
            left = 1.0 - DIELECTRIC_F0 - (1.0 - DIELECTRIC_F0) * schlick_weight((half * views[v][:, None]).sum(2))
            np.testing.assert_allclose(share[v], (power * left).sum(1) / power.sum(1), atol=64 * EPS)

    @pytest.mark.parametrize("roughness", [0.1, 1.0])
    def test_white_furnace(self, device, rng, roughness):
        """A white open surface under uniform light of radiance 1 sends 1 to every view: L_D share + L_S."""
        white = PreparedEnvironment(EnvironmentMap.constant((1.0, 1.0, 1.0), height=16), device=device)
        normals = unit(rng.normal(size=(33, 3)))
        directions, _, visibility = even_rays(normals, 256)
        weights = np.maximum(np.einsum("pi,pki->pk", normals, directions), 0.0)[..., None] * 4.0 * np.ones(3)
        points = Points(normals, directions, weights, visibility, device, roughness=roughness)
        arriving = points.gather(True, np.ones((33, 3)))["arriving"]
        specular, share = points.residues(white, views_of(normals, self.COSINES, rng))
        # the same albedo on both sides, and a mean of ones: only rounding is left
        np.testing.assert_allclose(arriving * share[..., None] + specular, 1.0, atol=64 * EPS)

    def test_views_from_below_and_views_without_weight_have_no_residue(self, device, rng, sky):
        normals = unit(rng.normal(size=(5, 3)))
        points = Points(normals, *even_rays(normals, 64), device)
        points.gather(True, np.ones((5, 3)))
        for views, weights in ((views_of(normals, (-0.5, 0.01), rng), 1.0), (views_of(normals, (0.9,), rng), 0.0)):
            specular, share = points.residues(sky(device), views, weights=weights)
            assert (specular == 0.0).all()
            assert (share == 0.0).all()


class TestSmallSources:
    """A lamp of 3 degrees in a dim sky: what a lobe sees of it is known texel by texel."""

    LAMP = unit(np.array([0.3, -0.4, 0.6]))

    @pytest.fixture
    def lit(self):
        directions = texel_directions(256, 512)
        radiance = np.full((256, 512, 3), 0.01)
        radiance[np.arccos(np.clip(directions @ self.LAMP, -1.0, 1.0)) < np.radians(3.0)] = (300.0, 200.0, 100.0)
        environment = EnvironmentMap(radiance.astype(np.float32))
        return environment, cache(lambda device: PreparedEnvironment(environment, device=device))

    def points(self, rng, device, count=24, **options):
        """Points that see a quarter of the lamp by four rays, and all of a dim ray elsewhere."""
        across = unit(np.cross(self.LAMP, rng.normal(size=(count, 3))))
        angle = rng.uniform(0.2, 1.3, (count, 1))
        normals = np.cos(angle) * self.LAMP + np.sin(angle) * across
        directions = np.tile(self.LAMP, (count, 5, 1))
        directions[:, 4] = normals
        weights = np.full((count, 5, 3), 2.0)
        weights[:, 4] = 0.1
        visibility = np.tile([1.0, 0.0, 0.0, 0.0, 1.0], (count, 1))
        return normals, Points(normals, directions, weights, visibility, device, **options)

    @pytest.mark.parametrize("roughness", [0.25, 0.5])
    def test_a_lamp_is_seen_in_lobes_of_any_angle(self, device, rng, lit, roughness):
        environment, prepared = lit
        normals, points = self.points(rng, device, roughness=roughness)
        points.gather(True, np.ones((len(normals), 3)), prepared(device))
        np.testing.assert_allclose(points.light.source_shares.numpy()[:, 0], 0.25)
        cosines = (0.3, 0.6, 0.9)
        views = views_of(normals, cosines, rng)
        specular, _ = points.residues(prepared(device), views)
        sky = 0.01 * specular_albedo(np.array(cosines), np.full(3, roughness))
        near = environment.directions() @ self.LAMP > np.cos(np.radians(4.0))
        towards = environment.directions()[near]
        power = environment.radiance[near] * environment.solid_angles()[near][:, None]
        expected = np.zeros_like(specular)
        for v in range(len(views)):
            for p, n in enumerate(normals):
                lobe = brdf_twin(n, views[v, p], towards, roughness) * np.maximum(towards @ n, 0.0)
                expected[v, p] = 0.25 * (lobe[:, None] * power).sum(0) + sky[v]
        strong = expected > 0.1 * expected.max()
        # a disc's lobe is widened, not integrated: of roughness 0.25 it is as narrow as the lamp
        np.testing.assert_allclose(specular[strong], expected[strong], rtol=0.12 if roughness < 0.4 else 0.04)

    def test_what_is_in_the_way_of_the_sky_is_not_in_the_way_of_the_lamp(self, device, rng, lit):
        """Rays to the lamp say nothing of the sky's share, and the other way round."""
        _, prepared = lit
        shown = []
        for lamp in (0.0, 1.0):
            normals, points = self.points(np.random.default_rng(5), device, roughness=0.5)
            seen = points.rays.visibility.numpy().reshape(-1, 5)
            seen[:, :4] = lamp
            points.rays.visibility.assign(seen.ravel())
            points.gather(True, np.ones((len(normals), 3)), prepared(device))
            shown.append(points.residues(prepared(device), views_of(normals, (0.8,), np.random.default_rng(6)))[0])
        albedo = specular_albedo(np.array([0.8]), np.array([0.5]))[0]
        np.testing.assert_allclose(shown[0], 0.01 * albedo, rtol=0.02)  # of the sky, by its own ray
        assert (shown[1] > shown[0]).all()


def test_sampled_radiance_is_what_viewers_around_the_normal_see(device, rng):
    """Harmonics of degree 2 along the way from each viewer, weighted by the projected area."""
    radiance, gaussians, views = rng.normal(0.0, 0.2, (9, 9, 3)), np.array([3, 8, 0, 3]), view_set()
    normals = unit(rng.normal(size=(4, 3)))
    rows = [wp.array(gaussians, dtype=int, device=device), 0, wp.array(normals, dtype=wp.vec3, device=device)]
    colors, directions = (wp.empty((len(views), 4), dtype=kind, device=device) for kind in (wp.vec4, wp.vec3))
    coefficients = wp.array(np.float32(radiance), dtype=wp.vec3, device=device)
    launch_sample_radiance(
        4, coefficients, *rows, wp.array(views, dtype=wp.vec3, device=device), colors, directions, device
    )
    for view, found, toward in zip(views, colors.numpy(), directions.numpy(), strict=True):
        np.testing.assert_allclose((toward * normals).sum(axis=1), view[2], atol=4 * EPS)
        np.testing.assert_allclose(found[:, 3], view[2])
        # nine terms of order 1
        np.testing.assert_allclose(found[:, :3], sh_color(radiance[gaussians], -toward), atol=20 * EPS)


def scene_of_views(rng, count, views):
    """Observations as a model makes them: light, shares, speculars, weights; and normals that views see at angles."""
    normals = unit(rng.normal(size=(count, 3)))
    toward = views_of(normals, rng.uniform(0.55, 1.0, views), rng)  # all face the surface and count fully
    arriving = rng.uniform(0.5, 2.0, (count, 3))
    share = rng.uniform(0.7, 1.0, (views, count))
    specular = rng.uniform(0.0, 0.2, (views, count, 3))
    weight = rng.uniform(0.5, 20.0, (views, count))
    return normals, toward, arriving, share, specular, weight


def fitted(colors, weight, toward, share, specular, normals, arriving, device, *, robust=False, bounce=0.0):
    colors = np.concatenate([colors, weight[..., None]], -1)
    found = filled(Observations, device, colors=colors, directions=toward, specular=specular, diffuse_share=share)
    light = filled(GatheredLight, device, arriving=arriving, bounce=np.full_like(arriving, bounce))
    surface = filled(ShadedPoints, device, normals=normals)
    black, zero = np.zeros(normals.shape), np.zeros(len(normals))
    fit = filled(ColorFit, device, numerator=black, denominator=black, observed=black, views=zero, facing=zero)
    launch_fit_color(found, light, surface, robust, fit, device)
    return {name: getattr(fit, name).numpy().astype(np.float64) for name in ColorFit.vars}


class TestFit:
    @pytest.mark.parametrize("views", [1, 33])
    def test_plain_least_squares_is_lstsq(self, device, rng, views):
        normals, toward, arriving, share, specular, weight = scene_of_views(rng, 70, views)
        bounce = np.array([0.25, 0.5, 0.1])
        diffuse = (arriving + bounce) * share[..., None]
        colors = rng.uniform(0.2, 0.8, (70, 3)) * diffuse + specular + rng.normal(0.0, 0.02, (views, 70, 3))
        fit = fitted(colors, weight, toward, share, specular, normals, arriving, device, bounce=bounce)
        found = fit["numerator"] / fit["denominator"]
        residual = fit["observed"] - found * fit["numerator"]
        for p in range(70):
            root = np.sqrt(weight[:, p])
            for c in range(3):
                solution, squares, *_ = np.linalg.lstsq(
                    (root * diffuse[:, p, c])[:, None], root * (colors - specular)[:, p, c], rcond=None
                )
                # three sums of so many terms; the largest target is 2.3 and rounds before it is subtracted from
                assert abs(found[p, c] - solution[0]) < 8 * (views + 4) * EPS
                scale = fit["observed"][p, c]
                assert abs(residual[p, c] - (squares[0] if len(squares) else 0.0)) < 8 * (views + 4) * EPS * scale
        np.testing.assert_allclose(fit["views"], weight.sum(0) ** 2 / (weight**2).sum(0), rtol=4 * views * EPS)
        np.testing.assert_allclose(fit["facing"], 1.0, rtol=2 * views * EPS)

    def test_a_view_that_disagrees_has_little_influence(self, device, rng):
        normals, toward, arriving, share, specular, weight = scene_of_views(rng, 70, 16)
        weight[:] = 1.0
        truth = rng.uniform(0.2, 0.8, (70, 3))
        colors = truth * arriving * share[..., None] + specular
        spoiled = colors.copy()
        spoiled[3] += 5.0 * arriving
        arguments = (weight, toward, share, specular, normals, arriving, device)
        robust = fitted(spoiled, *arguments, robust=True)
        plain = fitted(spoiled, *arguments)
        error = np.abs(robust["numerator"] / robust["denominator"] - truth)
        naive = np.abs(np.clip(plain["numerator"] / plain["denominator"], 0.0, 1.0) - truth)
        # Cauchy's weight of residual r at spread s is s^2 / (s^2 + r^2): at s <= .2 and r >= 4 below 1/400 of the rest
        assert naive.mean() > 0.15
        assert error.max() < 0.02
        assert (robust["views"] < 15.5).all()  # what hardly counts is not counted
        assert (robust["views"] > 14.5).all()

    @pytest.mark.parametrize(("targets", "bound"), [([-0.1, -0.5, -2.0], 0.0), ([1.2, 1.4, 3.0], 1.0)])
    def test_views_are_weighed_by_what_a_base_colour_explains(self, device, rng, targets, bound):
        """All show less than the highlight alone, or more than white: they are off from black, or from white.

        The sums themselves are those of the data: cutting their quotient is the solver's.
        """
        normals, toward, arriving, share, specular, _ = scene_of_views(rng, 5, 3)
        arriving[:], share[:] = 1.0, 1.0
        target = np.array(targets)[:, None, None]
        fit = fitted(
            target + specular, np.ones((3, 5)), toward, share, specular, normals, arriving, device, robust=True
        )
        spread = max(0.1 * bound, 0.01)
        weight = spread**2 / (spread**2 + 3.0 * (target[:, 0, 0] - bound) ** 2)
        # residues of 0.1 are differences of numbers of about 1; their squares decide the weights
        np.testing.assert_allclose(
            fit["numerator"] / fit["denominator"], weight @ targets / weight.sum(), rtol=50 * EPS
        )
        np.testing.assert_allclose(fit["views"], weight.sum() ** 2 / (weight**2).sum(), rtol=50 * EPS)

    def test_grazing_views_count_less_and_are_told(self, device, rng):
        normals = unit(rng.normal(size=(10, 3)))
        cosines = np.array([0.9, 0.35, 0.2, 0.1, -0.3])
        toward = views_of(normals, cosines, rng)
        share, specular = np.ones((5, 10)), np.zeros((5, 10, 3))
        colors = np.broadcast_to(np.arange(5.0)[:, None, None] / 10.0, (5, 10, 3))
        fit = fitted(colors, np.ones((5, 10)), toward, share, specular, normals, np.ones((10, 3)), device)
        counted = np.clip((cosines - 0.2) / 0.3, 0.0, 1.0)
        expected = (counted * np.arange(5) / 10.0).sum() / counted.sum()
        np.testing.assert_allclose(fit["numerator"] / fit["denominator"], expected, rtol=100 * EPS, atol=1e-6)
        np.testing.assert_allclose(fit["facing"], counted.sum() / 5.0, atol=1e-6)

    def test_points_that_nothing_shows_or_lights_stay_zero(self, device, rng):
        normals, toward, arriving, share, specular, weight = scene_of_views(rng, 4, 3)
        weight[:, 0] = 0.0
        arriving[1] = 0.0
        colors = np.ones((3, 4, 3))
        fit = fitted(colors, weight, toward, share, specular, normals, arriving, device, robust=True)
        assert (fit["denominator"][:2] == 0.0).all()
        assert (fit["numerator"][:2] == 0.0).all()
        assert fit["views"][0] == 0.0
        assert all(np.isfinite(values).all() for values in fit.values())


class TestBounce:
    SAMPLES = 4096

    def gathered(self, points, cloud, radiance, device, seed=0):
        scene = Scene.from_gaussians(cloud, device)
        batch = filled(
            RayBatch,
            device,
            positions=points,
            normals=np.tile([0.0, 0.0, 1.0], (len(points), 1)),
            offsets=np.full(len(points), 1e-4),
            rows=np.arange(len(points)),
            base=scene.occluders.origin,
            sample_count=self.SAMPLES,
        )
        out = zero_struct(GatheredLight, len(points), device)
        sent = wp.array(np.float32(radiance), dtype=wp.vec3, device=device)
        counts = wp.full(len(points), self.SAMPLES, dtype=int, device=device)
        launch_trace_bounce(scene, EXACT.settings(scene), batch, sent, (seed, 0), counts, out)
        self.error = out.bounce_error.numpy()
        return out.bounce.numpy()

    def test_a_disc_overhead_sends_its_radiance_times_its_form_factor(self, device):
        """R^2 / (R^2 + h^2) of a coaxial parallel disc; opaque tiles, several deep wherever a ray goes."""
        spacing, radius, height = 0.02, 0.5, 0.5
        disc = disc_points(radius, spacing) + np.array([0.0, 0.0, height])
        up = np.tile([0.0, 0.0, 1.0], (len(disc), 1))
        layers = [tiles(disc + np.array([0.0, 0.0, 0.002 * k]), up, spacing, opacity=0.99) for k in range(3)]
        cloud = cloud_of(*layers)
        radiance = np.tile([1.0, 0.5, 2.0], (len(cloud), 1))
        found = self.gathered(np.zeros((1, 3)), cloud, radiance, device)[0]
        # tiles reach about one spacing over the edge or fall short of it; noise of independent rays is an upper bound
        edge = 2.0 * spacing * radius * height**2 / (radius**2 + height**2) ** 2 * 1.0
        noise = LARGEST_Z * 0.5 / np.sqrt(self.SAMPLES)
        np.testing.assert_allclose(found / [1.0, 0.5, 2.0], 0.5, atol=edge + noise)
        share = found[0]  # of rays that hit, all of the same radiance, whose channels add up to 3.5
        independent = 3.5 * np.sqrt(share * (1.0 - share) / (self.SAMPLES - 1))
        assert self.error[0] == pytest.approx(independent, rel=1e-3)

    def test_open_sky_bounces_nothing(self, device):
        disc = disc_points(0.5, 0.1) - np.array([0.0, 0.0, 1.0])
        cloud = cloud_of(tiles(disc, np.tile([0.0, 0.0, 1.0], (len(disc), 1)), 0.1))
        assert (self.gathered(np.zeros((3, 3)), cloud, np.ones((len(cloud), 3)), device) == 0.0).all()

    def test_seeds_differ_and_repeat(self, device):
        disc = disc_points(0.5, 0.1) + np.array([0.0, 0.0, 0.5])
        cloud = cloud_of(tiles(disc, np.tile([0.0, 0.0, 1.0], (len(disc), 1)), 0.1, opacity=0.5))
        one, again, other = (
            self.gathered(np.zeros((5, 3)), cloud, np.ones((len(cloud), 3)), device, s) for s in (0, 0, 1)
        )
        np.testing.assert_array_equal(one, again)
        assert (one != other).any()
