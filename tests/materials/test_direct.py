"""Decomposition: recover base colour whose captured radiance is known, say how sure, and flag what was not measured."""

from functools import cache

import numpy as np
import pytest
import warp as wp
from support.shapes import cloud_of, colored, disc_points, sphere_points, tiles

from beam_warp import Scene, irradiance
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.base_color import solve_base_color
from beam_warp.materials.direct import measure_materials
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.materials.exposure import estimate_exposure
from beam_warp.materials.light_rays import MaterialOptions, view_set
from beam_warp.materials.normals import SurfaceNormals, SurfacePoints
from beam_warp.world.directions import even_directions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import Observability

EVEN = EnvironmentMap.constant((1.0, 1.0, 1.0), height=16)
ROUGHNESS = 0.8
SPECULAR_ALBEDO = 0.04
"""Error of a rough dielectric over the views that count, about 0.02: a view-independent capture cannot resolve it."""


def certain(cloud, scene, normals, offset="auto"):
    """Light is gathered at the centres, under normals that are known."""
    count = len(normals)
    surface = SurfaceNormals(np.asarray(normals, np.float32), np.ones(count, np.float32), np.ones(count, bool))
    return SurfacePoints.at_centers(cloud, scene, surface, offset)


prepared = cache(PreparedEnvironment)
"""Blurring a light for every roughness takes its time on a CPU: the same light is prepared once."""


def decompose(cloud, normals, environment, device, options=None, frames=(0,)):
    scene = Scene.from_gaussians(cloud, device)
    light = prepared(environment, device)
    roughness = np.full(len(cloud), ROUGHNESS, np.float32)
    evidence = None
    chosen = options or MaterialOptions()
    points = certain(cloud, scene, normals, chosen.offset)
    for frame in frames:
        measured = measure_materials(cloud, scene, points, roughness, light, options=chosen, frame=frame)
        evidence = measured.evidence if evidence is None else evidence + measured.evidence
    known = cloud.with_arrays(normal_confidence=np.ones(len(cloud), np.float32))
    return solve_base_color(known, evidence, light.mean_irradiance), measured


def reflected(base_color, irradiance):
    """Radiance of an open surface: diffuse less the specular share, and the lobe under uniform light."""
    return (1.0 - SPECULAR_ALBEDO) * base_color * irradiance / np.pi + SPECULAR_ALBEDO * irradiance / np.pi


@cache
def sky():
    """Bright above, dim below, with a warm sun: nothing uniform about it."""
    radiance = EnvironmentMap.constant((0.3, 0.4, 0.6), height=32).radiance.copy()
    radiance[16:] *= 0.3
    radiance[7:9, 15:18] += np.float32((60.0, 45.0, 30.0))
    return EnvironmentMap(radiance)


class TestConvexBody:
    def test_base_colour_under_uniform_light(self, device, rng):
        points, spacing = sphere_points(1500)
        truth = rng.uniform(0.1, 0.9, (1500, 3))
        cloud = colored(cloud_of(tiles(points, points, spacing)), reflected(truth, np.pi))
        solved, measured = decompose(cloud, points, EVEN, device)
        assert measured.ambient_occlusion.mean() > 0.99
        # the specular albedo varies by 0.02 over views, and an error of 0.02 in it is one of 0.02 (1 - rho)
        assert np.abs(solved.base_color - truth).max() < 0.03
        assert not (solved.observability & np.uint8(Observability.FILLED)).any()

    def test_base_colour_under_a_sunny_sky(self, device, rng):
        points, spacing = sphere_points(1500)
        truth = rng.uniform(0.1, 0.9, (1500, 3))
        environment = sky()
        cosine = np.maximum(environment.directions().reshape(-1, 3) @ points.T, 0.0)
        weighted = environment.radiance.reshape(-1, 3) * environment.solid_angles().reshape(-1, 1)
        irradiance = cosine.T @ weighted
        # Lambert alone in the capture: the decomposition subtracts a specular part that is not there, at most
        # 0.06 of the light, so it must come out darker by that and no more
        cloud = colored(cloud_of(tiles(points, points, spacing)), truth * irradiance / np.pi)
        solved, _ = decompose(cloud, points, environment, device)
        error = solved.base_color - truth
        assert error.max() < 0.1 * truth.max()
        assert -0.09 < np.median(error) < 0.03


def test_light_of_open_surfaces_is_the_unshadowed_irradiance(device):
    """Far from each other nothing is in the way: what is measured is the closed form, under a sun of one texel too."""
    normals, _ = sphere_points(200)
    cloud = cloud_of(tiles(1000.0 * normals, normals, 0.05))
    radiance = EnvironmentMap.constant((0.3, 0.4, 0.6), height=32).radiance.copy()
    radiance[7, 15] = (2e4, 1.5e4, 1e4)
    environment = EnvironmentMap(radiance)
    _, measured = decompose(colored(cloud, np.full((200, 3), 0.5)), normals, environment, device)
    free = irradiance(Scene.from_gaussians(cloud.select(np.arange(0)), device), normals, normals, environment)
    assert (measured.ambient_occlusion == 1.0).all()
    # the same closed form times a ratio of equal sums
    np.testing.assert_allclose(measured.evidence.irradiance, np.pi * free.value, rtol=1e-5)


class TestOccluded:
    def corner(self):
        """A floor beside a wall: half of the sky of the floor's edge is hidden, and the wall's light comes instead."""
        spacing = 0.06
        floor = disc_points(1.0, spacing)
        floor = floor[floor[:, 0] > 0.02]
        wall = np.stack([np.zeros(len(floor)), floor[:, 1], floor[:, 0]], axis=1)
        normals = np.repeat([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], len(floor), axis=0)
        parts = (tiles(floor, normals[: len(floor)], spacing), tiles(wall, normals[len(floor) :], spacing))
        return cloud_of(*parts), normals

    def test_one_bounce_takes_light_off_the_corner(self, device):
        """Radiosity of the corner, solved on the Gaussians themselves, is what a camera would have captured.

        Channel by channel, because what bounces is red here.
        """
        cloud, normals = self.corner()
        count = len(cloud)
        truth = np.array([0.8, 0.5, 0.2])
        offset = cloud.positions[None] - cloud.positions[:, None]
        distance = np.linalg.norm(offset, axis=2) + np.eye(count)
        cos_here = np.maximum(np.einsum("ijk,ik->ij", offset, normals) / distance, 0.0)
        cos_there = np.maximum(-np.einsum("ijk,jk->ij", offset, normals) / distance, 0.0)
        form = cos_here * cos_there / (np.pi * distance**2) * 0.06**2
        # neighbours at the edge: at most 1/2
        form *= np.minimum(1.0, 0.5 / np.maximum(form.sum(1, keepdims=True), 1e-9))
        sky_part = 1.0 - form.sum(1)
        captured = []
        for kept in truth * (1.0 - SPECULAR_ALBEDO):
            radiosity = np.linalg.solve(np.eye(count) - kept * form, kept * sky_part)
            captured.append((kept + SPECULAR_ALBEDO) * (sky_part + form @ radiosity))
        cloud = colored(cloud, np.stack(captured, axis=1))
        x, y, z = cloud.positions.T
        edge = (np.abs(x + z - 0.15) < 0.1) & (np.abs(y) < 0.6)
        bounced, _ = decompose(cloud, normals, EVEN, device)
        direct, _ = decompose(cloud, normals, EVEN, device, MaterialOptions(bounce=False))
        with_bounce = np.abs(bounced.base_color - truth)[edge].mean(axis=0)
        without = np.abs(direct.base_color - truth)[edge].mean(axis=0)
        assert (with_bounce < 0.05).all()
        assert (with_bounce < 0.5 * without).all()

    def test_buried_gaussians_are_filled_from_neighbours_and_flagged(self, device):
        points, spacing = sphere_points(1500)
        shell = tiles(points, points, spacing, opacity=0.99)
        inside, _ = sphere_points(50)
        core = tiles(inside * 0.5, inside, spacing)
        cloud = cloud_of(shell, core)
        color = np.concatenate([np.full((1500, 3), reflected(0.3, np.pi)), np.full((50, 3), 0.9)])
        solved, _ = decompose(colored(cloud, color), np.concatenate([points, inside]), EVEN, device)
        flags = solved.observability[1500:]
        assert (flags & np.uint8(Observability.UNSEEN) != 0).all()
        assert (flags & np.uint8(Observability.FILLED) != 0).all()
        assert np.abs(solved.base_color[1500:] - 0.3).max() < 0.05  # the shell's colour, not 0.9
        assert (solved.standard_error[1500:] > 0.0).all()


class TestErrorBars:
    def occluded(self):
        points, spacing = sphere_points(1200)
        blob, _ = sphere_points(400)
        ball = tiles(points, points, spacing, opacity=0.99)
        moon = tiles(blob * 0.4 + (0.9, 0.0, 1.2), blob, spacing * 0.7, opacity=0.99)
        cloud = cloud_of(ball, moon)
        return colored(cloud, np.full((1600, 3), 0.3)), np.concatenate([points, blob])

    def test_stated_noise_of_the_irradiance_covers_what_seeds_do(self):
        cloud, normals = self.occluded()
        relative, stated = [], []
        for seed in range(8):
            options = MaterialOptions(seed=seed, sample_count=16, bounce=False)
            _, measured = decompose(cloud, normals, sky(), "cpu", options)
            relative.append(measured.evidence.irradiance.sum(axis=1))
            stated.append(np.sqrt(measured.evidence.noise))
        spread = np.std(relative, axis=0, ddof=1) / np.maximum(np.mean(relative, axis=0), 1e-9)
        claim = np.sqrt(np.mean(np.square(stated), axis=0))
        noisy = (spread > 0.01) & (np.mean(relative, axis=0) > 0.3)
        assert noisy.sum() > 50
        ratio = np.sqrt(np.mean(spread[noisy] ** 2) / np.mean(claim[noisy] ** 2))
        assert 0.3 < ratio < 1.2  # errs on the safe side, but not by an order of magnitude

    def test_more_frames_shrink_the_stated_error(self):
        cloud, normals = self.occluded()
        one, _ = decompose(cloud, normals, sky(), "cpu", MaterialOptions(sample_count=16))
        four, _ = decompose(cloud, normals, sky(), "cpu", MaterialOptions(sample_count=16), frames=range(4))
        lit = (one.observability & np.uint8(Observability.FILLED)) == 0
        assert four.standard_error[lit].mean() < 0.75 * one.standard_error[lit].mean()

    def test_same_seed_same_bits(self, device):
        cloud, normals = self.occluded()
        first, _ = decompose(cloud, normals, sky(), device, MaterialOptions(sample_count=8))
        again, _ = decompose(cloud, normals, sky(), device, MaterialOptions(sample_count=8))
        assert np.array_equal(first.base_color, again.base_color)
        assert np.array_equal(first.standard_error, again.standard_error)


class TestFailures:
    def ball(self, *color):
        points, spacing = sphere_points(300)
        return colored(cloud_of(tiles(points, points, spacing)), *color), points

    def test_darkness_is_flagged_not_divided_by(self, device):
        solved, _ = decompose(*self.ball(np.full((300, 3), 0.2)), EVEN.scaled(0.0), device)
        assert (solved.observability & np.uint8(Observability.UNLIT) != 0).all()
        assert np.isfinite(solved.base_color).all()
        assert np.isfinite(solved.standard_error).all()

    def test_light_stated_too_dim_shows_as_clipping(self, device):
        solved, _ = decompose(*self.ball(np.full((300, 3), 0.8)), EVEN.scaled(0.2), device)
        assert solved.clipped_part > 0.99
        assert solved.base_color.max() <= 1.0

    def test_saturated_capture_is_flagged(self, device):
        color = np.full((300, 3), 0.4)
        color[:10] = 1.0
        solved, _ = decompose(*self.ball(color, DISPLAY_SRGB), EVEN, device)
        assert (np.flatnonzero(solved.observability & np.uint8(Observability.SATURATED)) == np.arange(10)).all()

    def test_no_radiance_is_refused(self):
        points, spacing = sphere_points(50)
        with pytest.raises(InvalidArrayError, match="radiance must be given to decompose materials, got None"):
            decompose(cloud_of(tiles(points, points, spacing)), points, EVEN, "cpu")

    def test_no_gaussians(self, device):
        cloud, points = self.ball(np.full((300, 3), 0.2))
        solved, _ = decompose(cloud.select(np.arange(0)), points[:0], EVEN, device)
        assert solved.base_color.shape == (0, 3)


def seen_in_noise(points, shown, rng, *, noise):
    """Eight views of a unit sphere in colours of its own, each with noise of its own over what it shows, on the CPU."""
    directions, count = even_directions(8), len(points)
    weights = np.maximum(directions @ points.T, 0.0)
    colors = shown * (1.0 + noise * rng.normal(size=(8, count, 3)))
    normals = upload(points.astype(np.float32), wp.vec3, "cpu")
    return ViewEvidence(
        positions=normals,
        normals=normals,
        agreement=wp.ones(count, dtype=float, device="cpu"),
        weight=weights.sum(axis=0).astype(np.float32),
        seen=np.ones(count, bool),
        saturated=np.zeros(count, np.float32),
        colors=upload(np.dstack([colors, weights]).astype(np.float32), wp.vec4, "cpu"),
        directions=upload(np.repeat(directions[:, None], count, axis=1).astype(np.float32), wp.vec3, "cpu"),
        misfit=np.zeros((count, 3), np.float32),
    )


class TestExposure:
    def found(self, truth, stops, **given):
        """Estimate the scale of a light that is some stops off, from a ball of greys [stop]."""
        points, spacing = sphere_points(1500)
        cloud = colored(cloud_of(tiles(points, points, spacing)), reflected(truth * np.ones(3), np.pi), DISPLAY_SRGB)
        scene = Scene.from_gaussians(cloud, "cpu")
        surface, rough = certain(cloud, scene, points), np.full(1500, ROUGHNESS, np.float32)
        light = prepared(EVEN, "cpu").scaled(2.0**stops)
        return np.log2(estimate_exposure(cloud, scene, surface, rough, light, options=MaterialOptions(), **given))

    @pytest.mark.parametrize("stops", [-2.0, 0.0, 6.0])
    def test_unknown_scale_of_the_light_is_found(self, rng, stops):
        """Whites of 0.8 and blacks of 0.05, captured at some exposure: the light comes back to a quarter stop."""
        truth = rng.choice([0.05, 0.3, 0.8], (1500, 1), p=[0.4, 0.4, 0.2])
        assert abs(self.found(truth, stops) + stops) < 0.25

    @pytest.mark.parametrize(
        ("stops", "expected"),
        [(0.0, (0.0, 0.0)), (0.5, (0.0, 0.0)), (-1.0, (0.7, 1.0))],
        ids=["right", "bright", "dim"],
    )
    def test_noise_is_no_evidence_against_a_measured_light(self, rng, stops, expected):
        """White clothes, a third of which noise puts above 1 by chance; a light that is too dim is still found."""
        points, _ = sphere_points(1500)
        truth = rng.choice([0.5, 0.95], (1500, 1), p=[0.3, 0.7])
        views = seen_in_noise(points, reflected(truth * np.ones(3), np.pi), rng, noise=0.2)
        assert expected[0] <= self.found(truth, stops, views=views, is_measured=True) <= expected[1]

    @pytest.mark.parametrize(
        ("whites", "stops", "expected"),
        [(0.5, 0.0, (0.0, 0.0)), (0.5, 0.5, (0.0, 0.0)), (0.8, -2.0, (1.4, 2.0))],
        ids=["grey clothes", "grey clothes, too bright", "whites above 1"],
    )
    def test_a_measured_light_is_changed_only_by_what_is_impossible(self, rng, whites, stops, expected):
        """A subject without white does not make it brighter; base colours above 1 do, as far as they must."""
        truth = rng.choice([0.1, 0.3, whites], (1500, 1))
        assert expected[0] <= self.found(truth, stops, is_measured=True) <= expected[1]


def test_views_are_unit_and_on_the_visible_side():
    views = view_set()
    assert np.abs(np.linalg.norm(views, axis=1) - 1.0).max() < 1e-6
    assert views[:, 2].min() > 0.2
    assert np.abs(views[:, :2].mean(axis=0)).max() < 0.15  # evenly around the normal


def test_scaled_light_is_light_prepared_from_a_scaled_environment(device):
    one = prepared(sky(), device).scaled(4.0)
    other = PreparedEnvironment(sky().scaled(4.0), device)
    assert one.mean_irradiance == pytest.approx(other.mean_irradiance, rel=1e-6)
    for name in ("radiance", "luminance", "block_power", "row_cdf", "column_cdf", "block_direction"):
        ours, theirs = (getattr(light.blocks, name).numpy() for light in (one, other))
        assert np.allclose(ours, theirs, rtol=1e-5, atol=1e-6)
    for name in ("irradiance", "texels"):
        ours, theirs = (getattr(light.blurred, name).numpy() for light in (one, other))
        assert np.allclose(ours, theirs, rtol=1e-4, atol=1e-6)
