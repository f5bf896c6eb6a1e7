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
from beam_warp.reconstruction.unmasked import ELSEWHERE_OPACITY, joined_depth, unmasked_gaussians

COUNT = 3000


@pytest.fixture(scope="module")
def scene():
    return [known_view(f"v{i}", camera) for i, camera in enumerate(arc_cameras(5))]


class TestJoinedDepth:
    def test_a_plane_goes_on_as_a_plane(self):
        # The inverse depth of a plane is linear in the image, so that it is harmonic.
        x, y = np.meshgrid(np.arange(12.0), np.arange(9.0))
        depth = 1.0 / (0.2 + 0.03 * x + 0.02 * y)
        hidden = depth.copy()
        hidden[2:7, 3:9] = 0.0
        np.testing.assert_allclose(joined_depth(hidden, np.full((9, 12, 3), 0.5), 100.0), depth, rtol=1e-9)

    def test_a_step_of_color_is_a_step_of_depth(self):
        depth, colors = np.zeros((8, 16)), np.zeros((8, 16, 3))
        depth[:, 0], depth[:, -1], colors[:, 8:] = 1.0, 4.0, 0.5
        joined = joined_depth(depth, colors, 100.0)
        # In a row of 15 ties, the weak one takes nearly all of the difference: its share of their resistances.
        weak = 1.0 / (np.exp(-0.5 / 0.04) + 1e-3)
        least = 0.75 * weak / (weak + 14.0)
        np.testing.assert_allclose(1.0 / joined[:, 7] - 1.0 / joined[:, 8], least, rtol=1e-2)

    def test_known_depths_stay_and_none_is_too_far(self):
        depth = np.zeros((4, 4))
        depth[1, 2] = 7.0
        np.testing.assert_allclose(joined_depth(depth, np.zeros((4, 4, 3)), 5.0), 5.0)


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


def test_a_view_that_was_not_used(scene, device):
    held, used = scene[2], [known.view for i, known in enumerate(scene) if i != 2]
    many = {"gaussian_count": 3000, "color_iterations": 40, "normal_iterations": 80}
    asked = {name: value * PLENTY // len(used) for name, value in many.items()}
    fitting = FitOptions(samples=1, refine_every=60, **asked)
    track, report = FitAndTrack(fitting=fitting, device=device).begin(used, no_progress)
    assert report["iterations"] == 120
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
