"""A start without masks: depths joined as planes are, discs where the surface is, a view that was not used."""

import numpy as np
import pytest
from support.textured_scene import FLOOR, RADIUS, SHELL, arc_cameras, known_view

from beam_warp.capture.capture import Capture
from beam_warp.image.color import LUMINANCE, linear_to_srgb
from beam_warp.jobs.listeners import no_progress
from beam_warp.raster.gbuffer import rasterize
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.steps import PLENTY, FitAndTrack
from beam_warp.reconstruction.unmasked import ELSEWHERE_OPACITY, FAR_TIE, LEAST_TIE, joined_depth, unmasked_gaussians

COUNT = 3000
GAP = 5


@pytest.fixture(scope="module")
def scene():
    return [known_view(f"v{i}", camera) for i, camera in enumerate(arc_cameras(5))]


class TestJoinedDepth:
    def test_a_plane_goes_on_as_a_plane(self):
        # The inverse depth of a plane is linear in the image, so that it is harmonic. The tie to what is far moves the
        # middle of a gap of n pixels by at most n² / 8 of the tie.
        x, y = np.meshgrid(np.arange(12.0), np.arange(9.0))
        depth = 1.0 / (0.2 + 0.03 * x + 0.02 * y)
        hidden = depth.copy()
        hidden[2 : 2 + GAP, 3:9] = 0.0
        np.testing.assert_allclose(
            joined_depth(hidden, np.full((9, 12, 3), 0.5), 100.0), depth, rtol=GAP**2 * FAR_TIE / 8.0
        )

    def test_a_step_of_color_is_a_step_of_depth(self):
        depth, colors = np.zeros((8, 16)), np.zeros((8, 16, 3))
        depth[:, 0], depth[:, -1], colors[:, 8:] = 1.0, 4.0, 0.5
        joined = joined_depth(depth, colors, 100.0)
        # In a row of 15 ties, the weak one takes nearly all of the difference: its share of their resistances. Seven
        # ties to what is far, as weak as it, draw a little.
        weak = 1.0 / (np.exp(-0.5 / 0.04) + 1e-3)
        least = 0.75 * weak / (weak + 14.0)
        np.testing.assert_allclose(1.0 / joined[:, 7] - 1.0 / joined[:, 8], least, rtol=5e-2)

    def test_known_depths_stay_and_none_is_too_far(self):
        depth = np.zeros((4, 4))
        depth[1, 2] = 7.0
        np.testing.assert_allclose(joined_depth(depth, np.zeros((4, 4, 3)), 5.0), 5.0)

    def test_far_from_the_surface_is_the_backdrop(self):
        """Inverse depths in a row of one colour come nearer to the farthest by one factor a pixel."""
        depth = np.zeros((3, 400))
        depth[:, 0] = 2.0
        off = 1.0 / joined_depth(depth, np.full((3, 400, 3), 0.5), 50.0)[1] - 1.0 / 50.0
        tie = FAR_TIE / (1.0 + LEAST_TIE)
        factor = 1.0 + 0.5 * tie - np.sqrt(tie + 0.25 * tie**2)
        np.testing.assert_allclose(off[:200], (0.5 - 0.02) * factor ** np.arange(200), rtol=1e-4)


def test_discs_lie_on_the_surface(scene):
    cloud = unmasked_gaussians([known.view for known in scene[:4]], COUNT)
    assert cloud is not None
    assert len(cloud) == COUNT
    sure = cloud.opacities > ELSEWHERE_OPACITY + 0.01
    assert 0.5 * COUNT <= sure.sum() < COUNT
    away = np.linalg.norm(cloud.positions, axis=1)
    off = np.minimum(np.minimum(np.abs(away - RADIUS), np.abs(cloud.positions[:, 2] - FLOOR)), np.abs(away - SHELL))
    assert np.median(off[sure]) < 0.03  # a pixel of the images is 0.034 wide at the ball
    ball = sure & (away < RADIUS + 0.1) & (cloud.positions[:, 2] > FLOOR + 0.2)
    assert ball.sum() > 100
    outward = (cloud.normals[ball] * cloud.positions[ball]).sum(axis=1) / away[ball]
    assert np.median(outward) > np.cos(np.radians(25.0))


def test_exposures_and_white_balances_are_matched(device):
    """Without light and masks, gains are found at the surface that photographs agree on; sound ones stay."""
    views = [known_view(f"v{i}", camera).view for i, camera in enumerate(arc_cameras(6, step=12.0))]
    names = [view.name for view in views]
    stops = np.array([0.9, -0.8, 0.4, 0.2, -0.3, 0.6])
    warmth = np.array([0.2, -0.2, 0.3, -0.3, 0.1, 0.0])
    logs = np.log(2.0) * stops[:, None] + warmth[:, None] * [1.0, 0.0, -1.0]
    logs -= logs.mean(axis=0)
    steps = FitAndTrack(device=device)
    off = [view.brightened(np.exp(log)) for view, log in zip(views, logs, strict=True)]
    found = steps.find_exposures(names, off, no_progress)
    assert found.exposure_undone
    assert found.balance_undone
    assert not found.falloff_undone
    np.testing.assert_allclose(np.log([camera.gains for camera in found.cameras]), logs, atol=0.02)
    sound = steps.find_exposures(names, views, no_progress)
    assert all(camera.gains == (1.0, 1.0, 1.0) for camera in sound.cameras)
    assert steps.find_exposures(names[:5], off[:5], no_progress) is None


def test_a_view_that_was_not_used(scene, device):
    held, used = scene[2], [known.view for i, known in enumerate(scene) if i != 2]
    many = {"gaussian_count": 4000, "color_iterations": 60, "normal_iterations": 100}
    asked = {name: value * PLENTY // len(used) for name, value in many.items()}
    fitting = FitOptions(samples=1, refine_every=60, **asked)
    track, report = FitAndTrack(fitting=fitting, device=device).begin(used, no_progress)
    assert report["iterations"] == 160
    drawn = rasterize(track.cloud, held.view.camera, channels=("radiance",), options=fitting.raster, device=device)
    color = np.clip(drawn.channels["radiance"] * drawn.alpha[..., None], 0.0, 1.0)
    off = linear_to_srgb(color) - linear_to_srgb(np.clip(held.view.color, 0.0, 1.0))
    psnr = -10.0 * np.log10((off[held.is_ball] ** 2).mean())
    assert psnr > 26.0  # the noise itself, grey against its lattice's 0.1 to 0.9, would be 13
    assert np.median(np.abs(drawn.median_depth - held.depth)[held.is_ball]) < 0.034  # a pixel's width
    assert report["gaussians"] >= len(track.cloud)


@pytest.mark.slow
def test_a_photograph_of_a_statue_that_was_not_used(data_dir, device):
    """The statue fills the middle of the photograph; exposures differ, so that brightness is correlated."""
    views = [record.view().reduced(6) for record in Capture.read(data_dir / "photos" / "buddha").records]
    held = views.pop(3)
    fitting = FitOptions.of_preset("draft", gaussian_count=18_000)
    track, _ = FitAndTrack(fitting=fitting, device=device).begin(views, no_progress)
    drawn = rasterize(track.cloud, held.camera, channels=("radiance",), options=fitting.raster, device=device)
    rows, columns = held.camera.height // 3, held.camera.width // 3
    middle = np.s_[rows:-rows, columns:-columns]
    assert drawn.alpha[middle].mean() > 0.9  # nothing but the statue is there; other seeds cover 0.94 to 0.99 of it
    seen = (drawn.channels["radiance"] * drawn.alpha[..., None])[middle] @ LUMINANCE
    # Some 50 curls are in the middle: those of another place would correlate by 0 within 2 / sqrt(50).
    assert np.corrcoef(seen.ravel(), (held.color[middle] @ LUMINANCE).ravel())[0, 1] > 2.0 / np.sqrt(50.0)
