"""What views show of Gaussians: closed forms on tiled spheres and planes, and what is behind a surface."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from reference.harmonics import sh_color
from support.shapes import cloud_of, colored, disc_points, sphere_points, tiles, unit

from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.metrics import block_means
from beam_warp.kernels.materials.neighborhoods import (
    FaceRule,
    launch_judge_faces,
    launch_mean_of_face,
    launch_take_faces,
)
from beam_warp.materials.evidence import RADII, view_evidence
from beam_warp.materials.normals import SurfacePoints
from beam_warp.raster.channels import RADIANCE
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import samples_of_fit
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import EXACT
from beam_warp.world.camera import Camera
from beam_warp.world.harmonics import SH_C0

SIDE = 96
LOW_ON_THE_RIGHT = {"width": 2 * SIDE, "height": 2 * SIDE, "center_x": 1.4 * SIDE, "center_y": 1.3 * SIDE}
"""Where a subject is in an image that must be cut to it on all sides."""


def around(count=8):
    golden = 180.0 * (3.0 - 5.0**0.5)
    places = [(golden * k % 360.0, float(np.degrees(np.arcsin(1.0 - (2 * k + 1) / count)))) for k in range(count)]
    return [Camera.orbit((0, 0, 0), 4.0, *place, width=SIDE, height=SIDE, vertical_fov=35.0) for place in places]


@pytest.fixture
def ball(rng):
    """A unit sphere of tiles with colours at random."""
    points, spacing = sphere_points(3000)
    return colored(cloud_of(tiles(points, points, spacing)), rng.uniform(0.1, 0.9, (3000, 3)))


def captured(cloud, cameras, change=lambda color: color, device="cpu"):
    views = []
    for k, camera in enumerate(cameras):
        buffer = rasterize(cloud, camera, channels=(RADIANCE,), device=device)
        color = change(buffer.channels[RADIANCE] * buffer.alpha[..., None]).astype(np.float32)
        views.append(CapturedView(name=str(k), camera=camera, color=color, alpha=buffer.alpha))
    return views


def shown_colors(*arguments, device):
    """Colours of all Gaussians towards all cameras, ``(V, N, 4)``, and which of them are shown."""
    colors = view_evidence(*arguments, device=device).colors.numpy()
    return colors, colors[..., 3] > 0.1


class TestSurface:
    def test_points_and_normals_of_a_sphere(self, ball, device):
        cameras = [replace(camera, focal_x=0.9 * camera.focal_y) for camera in around()]  # pixels need not be square
        found = view_evidence(ball, cameras, device=device)
        seen = found.seen
        assert seen.mean() > 0.95
        radius = np.linalg.norm(found.positions.numpy()[seen], axis=1)
        # What is seen is a layer of overlapping flat tiles, whose means lie inside by parts of a tile's deviation.
        deviation = float(ball.scales.max())
        assert np.abs(np.median(radius) - 1.0) < 0.5 * deviation
        assert radius.min() > 1.0 - 1.5 * deviation
        assert radius.max() < np.hypot(1.0, RADII * deviation)  # the rim of a tile that is drawn
        cosine = (found.normals.numpy()[seen] * ball.positions[seen]).sum(axis=1)
        assert np.degrees(np.arccos(np.median(cosine))) < 2.0
        assert found.agreement.numpy()[seen].min() > 0.8

    def test_what_is_inside_is_not_seen_and_keeps_its_place(self, device):
        inner, _ = sphere_points(200)
        shell, spacing = sphere_points(3000)
        layers = cloud_of(tiles(shell, shell, spacing, opacity=0.99), tiles(0.5 * inner, inner, 0.1))
        both = colored(layers, np.full((3200, 3), 0.5))
        found = view_evidence(both, around(), device=device)
        hidden = np.flatnonzero(~found.seen[3000:]) + 3000
        assert len(hidden) > 50
        np.testing.assert_array_equal(found.positions.numpy()[hidden], both.positions[hidden])
        assert (found.normals.numpy()[hidden] == 0.0).all()
        assert (found.agreement.numpy()[hidden] == 0.0).all()

    def test_a_side_that_shines_through_faces_every_ray(self, device):
        """The front of a ball lets a little of its back through, whose place and normal pixels cannot know."""
        points, spacing = sphere_points(2000)
        ball = colored(cloud_of(tiles(points, points, spacing, opacity=0.6)), np.full((2000, 3), 0.5))
        cameras = [
            Camera.look_at((3.0, y, 0.4), (0.0, 0.0, 0.0), width=SIDE, height=SIDE, vertical_fov=42.0)
            for y in (-1.0, 0.0, 1.0)
        ]
        found, scene = view_evidence(ball, cameras, device=device), Scene.from_gaussians(ball, device)
        SurfacePoints.seen_by(ball, found, scene)
        normals = scene.occluders.gaussians.normals.numpy()
        back, front = points[:, 0] < -0.5, points[:, 0] > 0.5
        assert (found.seen[back]).mean() > 0.1
        assert not normals[back].any()
        assert ((normals * points)[front].sum(axis=1) > 0.9).mean() > 0.99

    def test_a_layer_behind_a_plane_is_moved_onto_what_is_seen(self, device):
        flat = disc_points(1.0, 0.05)
        up = np.tile([0.0, 0.0, 1.0], (len(flat), 1))
        behind = flat - [0.0, 0.0, 0.004]
        both = colored(
            cloud_of(tiles(flat, up, 0.05, opacity=0.6), tiles(behind, up, 0.05)), np.full((2 * len(flat), 3), 0.5)
        )
        cameras = [
            Camera.look_at((0.3 * k, 0.2, 3.0), (0.0, 0.0, 0.0), width=SIDE, height=SIDE, vertical_fov=35.0)
            for k in (-1, 0, 1)
        ]
        found = view_evidence(both, cameras, device=device)
        inside = np.linalg.norm(both.positions[:, :2], axis=1) < 0.7
        height = found.positions.numpy()[inside & found.seen, 2]
        assert (height > -0.0041).all()
        assert (height < 1e-4).all()
        scene = Scene.from_gaussians(both, device)
        points = SurfacePoints.seen_by(both, found, scene)

        def openness(tracing):
            given = {"offset": points.offsets, "options": tracing, "sample_count": 16}
            found = ambient_occlusion(scene, points.positions, points.normals, **given)
            return found.visibility.numpy()[inside & points.seen]

        assert openness(points.tracing).min() > 0.999  # nothing of the layer that rays start in shades them
        assert np.median(openness(EXACT)) < 0.5


class TestFaces:
    """Normals where light is gathered: crisp beside edges, no worse on what is smooth."""

    @staticmethod
    def tilted(normals, rng, by=0.08):
        leaning = normals + by * rng.normal(size=normals.shape)
        return leaning / np.linalg.norm(leaning, axis=1, keepdims=True)

    @staticmethod
    def degrees(cloud, device, truth):
        cloud = colored(cloud, np.full((len(cloud), 3), 0.5))
        found = view_evidence(cloud, around(12), device=device)
        points = SurfacePoints.seen_by(cloud, found, Scene.from_gaussians(cloud, device))
        seen = found.seen
        return seen, *(
            np.degrees(np.arccos(np.clip((normals.numpy()[seen] * truth[seen]).sum(axis=1), -1.0, 1.0)))
            for normals in (points.normals, found.normals)
        )

    def test_an_edge_is_not_rounded(self, device, rng):
        """A box of noisy discs as wide as pixels: beside its edges blends err by more than the axes do."""
        spacing = 0.06
        u, v = (side.ravel() for side in np.meshgrid(*2 * [np.arange(-0.57, 0.6, spacing)]))
        sides = [np.insert(np.column_stack([u, v]), axis, 0.6 * sign, axis=1) for axis in range(3) for sign in (-1, 1)]
        normals = [np.tile(sign * np.eye(3)[axis], (len(u), 1)) for axis in range(3) for sign in (-1, 1)]
        points, truth = np.concatenate(sides), np.concatenate(normals)
        box = cloud_of(tiles(points, self.tilted(truth, rng), spacing))
        seen, crisp, blended = self.degrees(box, device, truth)
        rim = np.sort(np.abs(points[seen]), axis=1)[:, 1] > 0.6 - 1.1 * spacing
        assert rim.sum() > 300
        assert np.mean(blended[rim]) > 10.0  # twice the noise of the axes, or this scene asks for nothing
        assert np.mean(crisp[rim]) < 0.5 * np.mean(blended[rim])
        assert np.mean(crisp[~rim]) < np.mean(blended[~rim]) + 0.5

    def test_noise_on_a_sphere_is_no_larger(self, device, rng):
        points, spacing = sphere_points(3000)
        _, crisp, blended = self.degrees(cloud_of(tiles(points, self.tilted(points, rng), spacing)), device, points)
        assert np.mean(crisp) < np.mean(blended) + 0.3

    def test_means_of_faces_as_numpy_has_them(self, device, rng):
        points, normals = rng.normal(size=(40, 3)), self.tilted(np.tile([0.0, 0.0, 1.0], (40, 1)), rng, 0.3)
        weights, near = rng.uniform(0.1, 1.0, 40), np.argsort(np.linalg.norm(points[:, None] - points, axis=2))[:, :9]
        found = wp.empty(40, dtype=wp.vec3, device=device)
        arrays = upload(points, wp.vec3, device), upload(normals, wp.vec3, device), upload(weights, float, device)
        launch_mean_of_face(40, *arrays, upload(near, int, device), 9, 0.2, found, device)
        reach = np.linalg.norm(points[near[:, -1]] - points, axis=1)[:, None]
        apart = np.linalg.norm(points[near] - points[:, None], axis=2) / reach
        turned = np.linalg.norm(normals[near] - normals[:, None], axis=2) / 0.2
        mean = ((weights[near] * np.exp(-2.0 * apart**2 - 0.5 * turned**2))[..., None] * normals[near]).sum(axis=1)
        np.testing.assert_allclose(found.numpy(), mean / np.linalg.norm(mean, axis=1, keepdims=True), atol=1e-5)

    @staticmethod
    def rule(least_flat):
        rule = FaceRule()
        rule.spread, rule.flat_spread, rule.least_flat = 0.2, 0.05, least_flat
        rule.around, rule.reach, rule.off_plane, rule.turn = 1.1, 1.6, 0.16, 0.35
        return rule

    def taken(self, points, normals, weights, near, rule, device):
        """Run one pass of both kernels: normals, and how flat the surface around each point is."""
        count = len(points)
        arrays = *(upload(it, wp.vec3, device) for it in (points, normals)), upload(weights, float, device)
        near, found = upload(near, int, device), wp.empty(count, dtype=wp.vec3, device=device)
        support, flatness = (wp.empty(count, dtype=float, device=device) for _ in range(2))
        launch_judge_faces(count, *arrays, near, rule, support, flatness, device)
        launch_take_faces(count, *arrays, near, support, flatness, rule, found, device)
        return found.numpy(), flatness.numpy()

    @pytest.mark.parametrize("least_flat", [0.0, 0.3])
    def test_faces_are_taken_as_numpy_takes_them(self, device, rng, least_flat):
        count, rule = 60, self.rule(least_flat)
        points = rng.uniform(size=(count, 3)) * (1.0, 1.0, 0.05)
        normals = self.tilted(np.tile([0.0, 0.0, 1.0], (count, 1)), rng, 0.05)
        normals[::4] = self.tilted(normals[::4], rng, 0.3)
        weights, near = (
            rng.uniform(0.1, 1.0, count),
            np.argsort(np.linalg.norm(points[:, None] - points, axis=2))[:, :20],
        )
        found, _ = self.taken(points, normals, weights, near, rule, device)

        def bell(distance, deviation):
            return np.exp(-0.5 * (distance / deviation) ** 2)

        offset = points[:, None] - points[near]
        apart, turned = np.linalg.norm(offset, axis=2), np.linalg.norm(normals[near] - normals[:, None], axis=2)
        spacing = apart[:, 8:9]
        around = weights[near] * bell(apart, rule.around * spacing)
        support, flat = (
            (around * bell(turned, by)).sum(axis=1) / around.sum(axis=1) for by in (rule.spread, rule.flat_spread)
        )
        off_plane = (offset * normals[near]).sum(axis=2)
        speaks = support[near] ** 2 * bell(apart, rule.reach * spacing) * bell(turned, rule.turn)
        speaks *= bell(off_plane, rule.off_plane * spacing)
        best = near[np.arange(count), speaks.argmax(axis=1)]
        same = (
            weights[near] * speaks * bell(np.linalg.norm(normals[near] - normals[best][:, None], axis=2), rule.spread)
        )
        expected = unit((same[..., None] * normals[near]).sum(axis=1))
        takes = flat[best] > least_flat
        assert takes.any()
        assert takes.all() == (least_flat == 0.0)
        np.testing.assert_allclose(found, np.where(takes[:, None], expected, normals), atol=1e-5)

    def test_a_rounded_edge_between_flat_faces_becomes_crisp(self, device):
        """A roof whose normals are blended over four spacings beside its ridge."""
        spacing = 0.1
        x, y = (
            side.ravel() for side in np.meshgrid(np.arange(-1.0, 1.05, spacing) + 0.5 * spacing, np.arange(0, 1, 0.1))
        )
        slope = np.radians(35.0)
        points = np.column_stack([x * np.cos(slope), y, -np.abs(x) * np.sin(slope)])
        truth = np.column_stack([np.sign(x) * np.sin(slope), 0.0 * x, np.full(len(x), np.cos(slope))])
        lean = slope * np.clip(x / (2.0 * spacing), -1.0, 1.0)
        normals = np.column_stack([np.sin(lean), 0.0 * x, np.cos(lean)])
        near = np.argsort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)[:, :33]
        for _ in range(2):
            normals, _ = self.taken(points, normals, np.ones(len(x)), near, self.rule(0.4), device)
        degrees = np.degrees(np.arccos(np.clip((normals * truth).sum(axis=1), -1.0, 1.0)))
        before = np.degrees(np.abs(lean - slope * np.sign(x)))
        assert np.sqrt(np.mean(degrees**2)) < 0.6 * np.sqrt(np.mean(before**2))
        assert np.mean(degrees > 5.0) < 0.6 * np.mean(before > 5.0)

    def test_what_is_round_stays_as_it_is(self, device):
        """A ball whose normals turn by a tenth from neighbour to neighbour is nowhere flat."""
        points, _ = sphere_points(800)
        near = np.argsort(np.linalg.norm(points[:, None] - points, axis=2))[:, :33]
        found, flatness = self.taken(points, points, np.ones(800), near, self.rule(0.4), device)
        assert flatness.max() < 0.4
        np.testing.assert_array_equal(found, points.astype(np.float32))

    def test_roughness_has_normals_of_faces_that_are_not_flat(self, ball, device):
        found = view_evidence(ball, around(12), device=device)
        points = SurfacePoints.seen_by(ball, found, Scene.from_gaussians(ball, device))
        on_faces = points.on_faces()
        assert on_faces.positions is points.positions
        normals, before = on_faces.normals.numpy()[found.seen], points.normals.numpy()[found.seen]
        assert (normals != before).any()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
        assert np.degrees(np.arccos(np.clip((normals * before).sum(axis=1), -1.0, 1.0))).max() < 15.0


class TestColors:
    @pytest.mark.parametrize(
        ("more", "place", "tolerance"),
        # where pixels have other numbers, rounding leaves out other rims of splats, which are below 1 / 255
        [(0.0, {}, 2e-5), (0.125, {}, 1e-4), (0.0, LOW_ON_THE_RIGHT, 1.0 / 255.0)],
    )
    def test_what_the_fit_does_not_explain_is_added(self, ball, device, more, place, tolerance):
        """Image and rendering are the same function of the same Gaussians: without more, nothing is spread back."""
        cameras = [replace(camera, **place) for camera in around()]
        views = captured(ball, cameras, lambda color: color + more * (color.sum(axis=-1, keepdims=True) > 0.0), device)
        colors, shown = shown_colors(ball, cameras, views, device=device)
        truth = np.broadcast_to(0.5 + more + SH_C0 * ball.radiance[:, 0], colors[..., :3].shape)
        np.testing.assert_allclose(colors[shown][:, :3], truth[shown], atol=tolerance)

    def test_a_pixel_is_the_mean_of_its_samples(self, device, rng):
        """Tiles finer than pixels: a photograph shows means, which a sample a pixel does not."""
        points, spacing = sphere_points(12000)
        ball = colored(cloud_of(tiles(points, points, spacing)), rng.uniform(0.1, 0.9, (12000, 3)))
        raster, cameras, views = RasterOptions(antialiased=True, low_pass=0.1), around(4), []
        side = samples_of_fit(ball, cameras, raster)
        assert side > 1
        for k, camera in enumerate(cameras):
            drawn = rasterize(ball, camera.supersampled(side), channels=(RADIANCE,), options=raster, device=device)
            color = block_means(drawn.channels[RADIANCE] * drawn.alpha[..., None], side).astype(np.float32)
            alpha = block_means(drawn.alpha, side).astype(np.float32)
            views.append(CapturedView(name=str(k), camera=camera, color=color, alpha=np.minimum(alpha, 1.0)))
        truth = 0.5 + SH_C0 * ball.radiance[:, 0]
        off = {}
        for samples in (side, 1, "auto"):
            found = view_evidence(ball, cameras, views, options=raster, samples=samples, device=device)
            colors = found.colors.numpy()
            shown = colors[..., 3] > 0.1
            off[samples] = np.abs(colors[..., :3] - truth)[shown]
            assert 0.8 < found.weight.sum() / sum(view.alpha.sum() for view in views) < 1.0  # pixels, not samples
        assert off[side].max() < 2e-4
        assert off[1].max() > 0.02
        np.testing.assert_array_equal(off["auto"], off[side])

    def test_samples_that_are_none_are_refused(self, ball):
        with pytest.raises(InvalidOptionError, match=r"samples must be .*, got 0"):
            view_evidence(ball, around(1), samples=0, device="cpu")

    def test_colours_are_those_that_each_camera_sees(self, ball, device, rng):
        """Harmonics of degree 3 are evaluated along the way from the camera: the other side shows other colours."""
        cameras = around(4)
        glossy = ball.with_arrays(radiance=rng.normal(0.0, 0.1, (3000, 16, 3)))
        colors, shown = shown_colors(glossy, cameras, captured(glossy, cameras, device=device), device=device)
        for camera, found, rows in zip(cameras, colors, shown, strict=True):
            away = unit(glossy.positions[rows] - camera.position)
            np.testing.assert_allclose(found[rows, :3], sh_color(glossy.radiance[rows], away), atol=2e-5)

    def test_display_colour_is_decoded(self, ball, device):
        cameras = around(4)
        linear = np.full((3000, 3), 0.3)
        display = colored(ball, linear, DISPLAY_SRGB)
        views = captured(colored(ball, linear), cameras)
        colors, shown = shown_colors(display, cameras, views, device=device)
        np.testing.assert_allclose(colors[shown][:, :3], 0.3, atol=2e-3)  # pixels of alpha .95 blend unlike light

    def test_pixels_at_the_ceiling_count_for_nothing_and_are_told(self, ball, device):
        cameras = around()
        left = ball.positions[:, 0] < 0.0
        halves = colored(ball, np.where(left[:, None], 0.9, 0.2) * np.ones(3))
        views = captured(halves, cameras, lambda color: np.minimum(2.0 * color, 1.0))
        found = view_evidence(halves, cameras, views, ceiling=1.0, device=device)
        clear = found.seen & (np.abs(ball.positions[:, 0]) > 0.2)
        assert found.saturated[clear & left].min() > 0.5
        assert found.saturated[clear & ~left].max() < 0.05
        assert (found.colors.numpy()[..., :3].max() < 2.0).all()

    def test_misfit_is_what_pixels_differ_by(self, ball, device):
        cameras, grey = around(4), colored(ball, np.full((3000, 3), 0.3))
        checks = 0.05 * (1.0 - 2.0 * (np.indices((SIDE, SIDE)).sum(axis=0) % 2))[..., None]
        found = view_evidence(grey, cameras, captured(grey, cameras, lambda color: color + checks), device=device)
        np.testing.assert_allclose(found.misfit[found.seen], 0.05**2, rtol=0.02)

    def test_noise_is_no_misfit(self, ball, device, rng):
        cameras, grey, step = around(4), colored(ball, np.full((3000, 3), 0.3)), 1e-3
        views = captured(grey, cameras, lambda color: step * rng.poisson(np.maximum(color, 0.0) / step))
        found = view_evidence(grey, cameras, views, device=device)
        shown = found.colors.numpy()[..., 3].sum(axis=0) > 10.0
        assert shown.sum() > 300
        assert found.misfit[shown].mean() < 0.4 * step * 0.3  # its own noise, and a level that is known to a fifth

    def test_silhouettes_count_for_nothing(self, ball, device):
        cameras = around(2)
        views = [replace(view, color=view.color * 0.0, alpha=view.alpha * 0.5) for view in captured(ball, cameras)]
        found = view_evidence(ball, cameras, views, device=device)
        assert (found.colors.numpy()[..., 3] == 0.0).all()
        assert found.seen.any()


def test_views_in_any_grouping_give_the_same(ball, device, monkeypatch):
    cameras = around(6)
    views = captured(ball, cameras)
    whole = view_evidence(ball, cameras, views, device=device)
    monkeypatch.setattr("beam_warp.materials.evidence.PIXELS_AT_ONCE", SIDE * SIDE)
    single = view_evidence(ball, cameras, views, device=device)
    for name in ("positions", "normals", "agreement", "colors", "directions"):
        np.testing.assert_array_equal(getattr(whole, name).numpy(), getattr(single, name).numpy())
    np.testing.assert_array_equal(whole.weight, single.weight)


def test_what_is_refused(ball):
    cameras = around(2)
    with pytest.raises(InvalidArrayError, match="radiance must be given"):
        view_evidence(cloud_of(tiles(*[sphere_points(10)[0]] * 2, 0.5)), cameras, device="cpu")
    with pytest.raises(InvalidArrayError, match="images must be one for each of 2 cameras, got 1"):
        view_evidence(ball, cameras, captured(ball, cameras)[:1], device="cpu")
