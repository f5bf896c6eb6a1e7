"""The image path as a whole: known materials come back from closed-form captures; guards, fills, notes, refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.shapes import cloud_of, disc_points, sphere_points, tiles

from beam_warp import Camera, Scene
from beam_warp.capture.views import CapturedView
from beam_warp.errors import InvalidArrayError, InvalidOptionError, MissingPackageError
from beam_warp.light.ggx import specular_albedo
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials import images as image_path
from beam_warp.materials.images import CROP_MARGIN, ImagePathOptions, crop_to_subject, decompose_by_images
from beam_warp.raster.gbuffer import rasterize, rasterize_values
from beam_warp.trace import denoise as denoising
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap

ROUGHNESS = 0.6
FEW = {
    "occlusion_samples": 16,
    "light_samples": 32,
    "passes": 15,
    "denoiser": "bilateral",
    "diffuse_weight": "albedo_scaling",
    "surface_depth": "median",  # at 3 % that pass the front, the mean lies 6 cm inside the ball
    "offset": 0.05,  # Gaussians of few tests are thick
}


def around(count, size=40):
    return [
        Camera.orbit((0, 0, 0), 4.0, 360.0 * i / count, 20.0 * (-1) ** i, width=size, height=size, vertical_fov=36.0)
        for i in range(count)
    ]


@cache
def even_light(radiance, device):
    return PreparedEnvironment(EnvironmentMap.constant(radiance, height=16), device)


class Ball:
    """A convex body under even light: its radiance is rho (1 - E) + E, E the albedo of the specular lobe."""

    def __init__(self, device, count=500, views=4, truth=None):
        points, spacing = sphere_points(count)
        # colours that neighbours share: a Gaussian is told from its neighbours by what pixels resolve
        steps = np.floor(2.0 * points + 2.0)
        self.truth = np.float32(0.2 + 0.15 * steps if truth is None else np.full((count, 3), truth))
        self.cloud = cloud_of(tiles(points, points, spacing, opacity=0.95))
        self.scene = Scene.from_gaussians(self.cloud, device)
        self.light = even_light((1.0, 1.0, 1.0), device)
        self.roughness = np.full(count, ROUGHNESS, np.float32)
        self.views = [self.capture(camera, device, i) for i, camera in enumerate(around(views))]

    def capture(self, camera, device, number):
        drawn = rasterize_values(self.cloud, camera, self.truth, device=device)
        buffer = rasterize(self.cloud, camera, channels=["surface_normals"], device=device)
        cosine = -(buffer.channels["surface_normals"] * camera.directions()).sum(axis=-1)
        albedo = specular_albedo(np.clip(cosine, 1e-3, 1.0), np.full_like(cosine, ROUGHNESS))[..., None]
        color = drawn.values * (1.0 - albedo) + albedo * drawn.alpha[..., None]
        return CapturedView(
            name=f"view {number}", camera=camera, color=color.astype(np.float32), alpha=np.clip(drawn.alpha, 0.0, 1.0)
        )

    def decompose(self, views=None, light=None, **options):
        more = {k: options.pop(k) for k in ("previous", "frame", "progress") if k in options}
        shown = self.views if views is None else views
        chosen = ImagePathOptions(**(FEW | options))
        return decompose_by_images(self.cloud, self.scene, shown, self.roughness, light or self.light, chosen, **more)


@cache
def ball(device, **options):
    return Ball(device, **options)


class TestKnownMaterials:
    @pytest.mark.parametrize("solver", ["cg", "adam"])
    def test_ball_under_even_light(self, device, solver):
        made = ball(device)
        found = made.decompose(solver=solver, steps=300)
        seen = found.color_evidence > 2.0
        assert seen.mean() > 0.8
        # residues have a relative noise of 0.1 a pixel and less after denoising; a Gaussian is two pixels and more
        error = (found.base_color - made.truth)[seen]
        assert np.sqrt((error**2).mean()) < 0.04
        assert abs(error.mean()) < 0.01
        assert found.ambient_occlusion[seen].mean() > 0.985
        assert found.base_color.min() >= 0.0
        assert found.base_color.max() <= 1.0

    def test_floor_under_a_disc_is_darker(self, device):
        """Ambient occlusion h^2 / (R^2 + h^2) in the middle, base colour none the darker for it."""
        spacing, radius, height = 0.06, 0.5, 0.4
        floor, disc = disc_points(1.0, spacing), disc_points(radius, spacing) + np.array((0.0, 0.0, height))
        up = np.tile((0.0, 0.0, 1.0), (len(floor), 1))
        cloud = cloud_of(tiles(floor, up, spacing, opacity=0.99), tiles(disc, up[: len(disc)], spacing, opacity=0.99))
        scene = Scene.from_gaussians(cloud, device)
        light = even_light((1.0, 1.0, 1.0), device)
        views = []
        for azimuth in (0.0, 90.0, 180.0, 270.0):
            camera = Camera.orbit((0, 0, 0), 3.0, azimuth, 14.0, width=64, height=32, vertical_fov=24.0)
            drawn = rasterize_values(cloud, camera, np.zeros((len(cloud), 0), np.float32), device=device)
            color = np.repeat(0.3 * drawn.alpha[..., None], 3, axis=2)
            views.append(CapturedView(name="", camera=camera, color=color, alpha=np.clip(drawn.alpha, 0, 1)))
        roughness = np.full(len(cloud), 0.9, np.float32)
        found = decompose_by_images(cloud, scene, views, roughness, light, ImagePathOptions(**FEW))
        middle = np.linalg.norm(floor[:, :2], axis=1) < 0.1
        seen = found.occlusion_evidence[: len(floor)][middle] > 0.5
        assert seen.sum() > 3
        wanted = height**2 / (radius**2 + height**2)
        # the lift of 0.05 and the disc's soft edge of a spacing take 0.08 and 0.05 off
        assert abs(found.ambient_occlusion[: len(floor)][middle][seen].mean() - wanted) < 0.13


class TestResolution:
    def test_pixels_far_finer_than_splats_are_baked_in_blocks(self, device, monkeypatch):
        """Splats of five pixels: the note says so, and what is drawn of the result is as of a bake of all pixels."""
        made = ball(device, count=40)
        found = made.decompose()
        assert any(note.startswith("baked from means of 2 x 2 pixels") for note in found.notes)
        monkeypatch.setattr(image_path, "reduction_factor", lambda *_, **__: 1)
        whole = made.decompose()
        # evidence counts the images' own pixels either way
        assert found.color_evidence.sum() == pytest.approx(whole.color_evidence.sum(), rel=0.02)
        apart, wrong = [], []
        for camera in around(3):
            coarse, fine, truth = (
                rasterize_values(made.cloud, camera, colors, device=device).values
                for colors in (found.base_color, whole.base_color, made.truth)
            )
            apart.append(((coarse - fine) ** 2).mean())
            wrong.append(((fine - truth) ** 2).mean())
        assert np.mean(apart) < 0.02 * np.mean(wrong)  # 0.1 dB


class TestGuards:
    def test_black_and_overbright_pixels_stay_in_bounds(self, device):
        made = ball(device)
        dark = [replace(view, color=np.zeros_like(view.color)) for view in made.views]
        bright = [replace(view, color=view.color * np.float32(100.0)) for view in made.views]
        assert made.decompose(dark).base_color.max() < 0.01
        assert made.decompose(bright).base_color.min() > 0.99

    def test_pixels_not_of_the_subject_count_for_nothing(self, device):
        """Half of every image is said not to be the subject, and holds nonsense."""
        made = ball(device)
        wanted = made.decompose()
        damaged = []
        for view in made.views:
            color, alpha = view.color.copy(), view.alpha.copy()
            color[:, :20], alpha[:, :20] = 50.0, np.minimum(alpha[:, :20], 0.5)
            damaged.append(replace(view, color=color, alpha=alpha))
        found = made.decompose(damaged)
        seen = found.color_evidence > 2.0
        assert 0.3 < seen.mean() < 1.0
        assert np.abs(found.base_color - wanted.base_color)[seen].mean() < 0.02
        # occlusion needs no capture
        np.testing.assert_array_equal(found.occlusion_evidence, wanted.occlusion_evidence)

    def test_the_unlit_is_filled_from_neighbours(self, device):
        made = ball(device, truth=0.5)
        found = made.decompose(light=even_light((1.0, 1.0, 0.0), device))
        assert (found.color_evidence == 0.0).all()  # no light in the last channel
        assert found.filled[:, 0].all()
        assert not found.filled[:, 1].all()

    def test_what_no_view_sees_is_filled(self, device):
        """Ten Gaussians out of every image, nearest to the ball's top."""
        made = ball(device, views=2, truth=0.5)
        far = tiles(np.tile((0.0, 0.0, 9.0), (10, 1)), np.tile((0.0, 0.0, 1.0), (10, 1)), 0.1)
        near = {name: getattr(made.cloud, name) for name in far}
        cloud = cloud_of(near, far)
        scene, roughness = Scene.from_gaussians(cloud, device), np.full(len(cloud), ROUGHNESS, np.float32)
        found = decompose_by_images(cloud, scene, made.views, roughness, made.light, ImagePathOptions(**FEW))
        assert found.filled[-10:].all()
        assert not found.filled[:-10].all(axis=1).any()
        # the mean of eight Gaussians seen at grazing angles or through others
        assert np.abs(found.base_color[-10:] - 0.5).max() < 0.2
        assert (found.ambient_occlusion[-10:] > 0.5).all()

    def test_nothing_in_any_view(self, device):
        made = ball(device)
        elsewhere = Camera.orbit((0, 0, 99), 4.0, 0.0, 0.0, width=40, height=40, vertical_fov=36)
        found = made.decompose([replace(made.views[0], camera=elsewhere)])
        assert "no view shows a surface: every value is a prior" in found.notes
        assert found.filled.all()
        assert np.isfinite(found.base_color).all()


class TestBehaviour:
    def test_same_seed_same_bits_other_frame_other_noise(self, device, monkeypatch):
        made = ball(device, views=2)
        first = made.decompose(frame=3)
        monkeypatch.setenv("BEAM_WARP_THREADS", "3")
        again, other = made.decompose(frame=3), made.decompose(frame=4)
        for name in ("base_color", "ambient_occlusion", "color_evidence", "occlusion_evidence"):
            np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
        assert not np.array_equal(first.base_color, other.base_color)

    def test_every_view_of_every_frame_has_noise_of_its_own(self, made, monkeypatch):
        """The same view twice in each of two frames: what is to be baked differs four times, occlusion included."""
        found, usual = [], image_path.bake

        def bake(gaussians, targets, **options):
            found.extend(np.where(t.weights.numpy() > 0.0, t.targets.numpy(), 0.0) for t in targets)
            return usual(gaussians, targets, **options)

        monkeypatch.setattr(image_path, "bake", bake)
        for frame in (0, 1):
            made.decompose(2 * made.views, frame=frame, denoiser="none")
        for columns in (np.s_[..., :3], np.s_[..., 3:]):
            assert len({values[columns].tobytes() for values in found}) == 4

    def test_a_temporal_term_takes_flicker_off(self, device):
        made = ball(device, views=2)
        first = made.decompose(frame=0).base_color
        free = made.decompose(frame=1)
        held = made.decompose(frame=1, previous=first, temporal=10.0)
        assert np.abs(held.base_color - first).mean() < 0.5 * np.abs(free.base_color - first).mean()
        seen = held.occlusion_evidence > 1.0
        np.testing.assert_allclose(held.ambient_occlusion[seen], free.ambient_occlusion[seen], atol=1e-3)

    def test_stages_and_progress_are_told(self, device):
        made, calls = ball(device, views=2), []
        found = made.decompose(progress=lambda done, total: calls.append((done, total)))
        assert calls == [(1, 2), (2, 2)]
        assert list(found.seconds) == [
            "upload", "draw", "occlusion rays", "light rays", "denoise", "base colour", "bake", "fill",
        ]  # fmt: skip

    def test_denoiser_is_told(self, device, monkeypatch):
        made = ball(device, views=1)
        monkeypatch.setattr(denoising, "_open_image_denoise", lambda: None)
        found = made.decompose(denoiser="auto")
        (note,) = found.notes
        assert "joint bilateral filter" in note
        assert "extra denoise" in note
        assert made.decompose(denoiser="none").notes == ("not denoised",)
        with pytest.raises(MissingPackageError, match="denoise"):
            made.decompose(denoiser="oidn")

    def test_crops_leave_a_margin(self, device):
        camera = around(1, 100)[0]
        alpha = np.zeros((100, 100), np.float32)
        alpha[40:50, 3:60] = 0.5
        view = CapturedView(name="", camera=camera, color=np.zeros((100, 100, 3), np.float32), alpha=alpha)
        cropped = crop_to_subject(view)
        assert cropped.color.shape == (10 + 2 * CROP_MARGIN, 60 + CROP_MARGIN, 3)
        assert cropped.camera.center_y == camera.center_y - 40 + CROP_MARGIN
        assert cropped.camera.center_x == camera.center_x
        unknown = replace(view, alpha=None)
        assert crop_to_subject(unknown) is unknown


@pytest.fixture(scope="module")
def made():
    return Ball("cpu", count=100, views=1)


BAD_OPTIONS = {
    "occlusion_samples": 0, "light_samples": 3, "offset": np.nan, "denoiser": "blur", "diffuse_weight": "half",
    "surface_depth": "nearest", "solver": "lu", "temporal": -1.0, "seed": -1,
}  # fmt: skip


class TestRefusals:
    def test_no_views_and_other_axes(self, made):
        with pytest.raises(InvalidOptionError, match=r"^views must hold at least one view"):
            made.decompose([])
        with pytest.raises(InvalidOptionError, match=r"^cloud must be in the axes 'rfu'"):
            decompose_by_images(change_axes(made.cloud, "rub"), made.scene, made.views, made.roughness, made.light)

    def test_arrays(self, made):
        with pytest.raises(InvalidArrayError, match=r"^previous must"):
            made.decompose(previous=np.zeros((3, 3), np.float32))
        for roughness in (made.roughness[:5], made.roughness + 1.0):
            with pytest.raises(InvalidArrayError, match=r"^roughness must"):
                decompose_by_images(made.cloud, made.scene, made.views, roughness, made.light)

    @pytest.mark.parametrize(("name", "value"), BAD_OPTIONS.items())
    def test_options(self, name, value):
        """Options of baking are passed on, which refuses them."""
        with pytest.raises(InvalidOptionError, match=f"^{name} must be"):
            ImagePathOptions(**{name: value})
