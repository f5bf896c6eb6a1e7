"""Refinement of a rig: its gauge, what counts as chance, and cameras found again that were moved."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from support.moving_ball import ball_views
from support.moving_ball import rig as cameras_around
from support.shapes import aligned

from beam_warp.capture.corrections import moved_camera
from beam_warp.kernels.reconstruction.image_halves import launch_keep_half
from beam_warp.reconstruction import rig
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.rig import in_gauge, judged, pixels_between, refine_rig, units_of

CENTER = np.zeros(3)


@pytest.fixture
def points(rng):
    return rng.uniform(-0.4, 0.4, (200, 3))


def shaken(rng, cameras, pixels):
    """Cameras that are each moved by about as many pixels, in turn and shift."""
    sizes = pixels * np.array([1.0, 1.0, 0.3, 0.5, 0.5, 0.3, 0.0])
    return [moved_camera(camera, rng.normal(size=7) * sizes * units_of(camera, CENTER)) for camera in cameras]


def test_motions_of_the_world_and_a_zoom_of_all_cameras_are_no_correction(points):
    cameras = cameras_around(8)
    world = np.eye(4)
    world[:3, :3] = Rotation.from_rotvec([1e-3, -2e-3, 1.5e-3]).as_matrix()
    world[:3, 3] = [2e-3, 1e-3, -1e-3]
    moved = []
    for camera in cameras:
        pose = world @ camera.camera_to_world
        pose[:3, 3] *= 1.002
        moved.append(
            replace(camera, camera_to_world=pose, focal_x=1.01 * camera.focal_x, focal_y=1.01 * camera.focal_y)
        )
    before = [pixels_between(*pair, points) for pair in zip(cameras, moved, strict=True)]
    after = [pixels_between(*pair, points) for pair in zip(cameras, in_gauge(cameras, moved, CENTER), strict=True)]
    assert min(before) > 0.03
    assert max(after) < 1e-3  # of second order


def test_a_rig_s_own_corrections_stay(rng, points):
    """What one camera does alone is no motion of the world but for its share in the mean."""
    cameras = cameras_around(12)
    moved = [moved_camera(cameras[0], [0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), *cameras[1:]]
    found = in_gauge(cameras, moved, CENTER)
    kept = [pixels_between(*pair, points) for pair in zip(cameras, found, strict=True)]
    assert kept[0] > 0.7 * pixels_between(cameras[0], moved[0], points)
    assert max(kept[1:]) < 0.3 * kept[0]


def outcome(cameras, ends, points, psnr=None):
    names = [f"c{k}" for k in range(len(cameras))]
    return judged(
        names,
        cameras,
        ends,
        aligned(np.tile(points, (20, 1)), 0.9, 0.1),
        np.full(len(cameras), 30.0) if psnr is None else psnr,
    )


def test_chance_moves_nothing(rng, points):
    cameras = cameras_around(12)
    found = outcome(cameras, [shaken(rng, cameras, 0.5) for _ in range(2)], points)
    assert not found.is_applied
    assert found.confidence < 2.0
    for correction, camera in zip(found.cameras, cameras, strict=True):
        np.testing.assert_array_equal(correction.applied(camera).camera_to_world, camera.camera_to_world)


def test_what_both_halves_say_is_applied_and_the_rest_shrunk(rng, points):
    cameras = cameras_around(12)
    truth = in_gauge(cameras, shaken(rng, cameras, 1.0), CENTER)
    found = outcome(cameras, [shaken(rng, truth, 0.1) for _ in range(2)], points)
    assert found.is_applied
    assert found.confidence > 20.0
    left = [
        pixels_between(correction.applied(camera), exact, points)
        for correction, camera, exact in zip(found.cameras, cameras, truth, strict=True)
    ]
    assert np.mean(left) < 2.5 * found.error < 0.3
    assert found.pixels == pytest.approx(np.mean([c.pixels**2 for c in found.cameras]) ** 0.5)


def test_less_than_the_method_s_own_error_moves_nothing(rng, points):
    cameras = cameras_around(12)
    agreed = shaken(rng, cameras, 0.05)
    assert not outcome(cameras, [agreed, agreed], points).is_applied


def test_a_camera_that_is_met_much_worse_is_left_out(device, monkeypatch):
    """One of eight cameras looks a third of the ball aside; the others are refined without it."""
    monkeypatch.setattr(rig, "LEVELS", (rig.Level(1, 1.0, 2, 3, 0.05, 0.02),))
    views = ball_views(cameras_around(8, 40))
    turned = moved_camera(views[3].camera, [0.0, 0.12, 0.0, 0.0, 0.0, 0.0, 0.0])
    views[3] = replace(views[3], camera=turned)
    names, options = [f"c{k}" for k in range(8)], FitOptions.of_preset("draft", gaussian_count=500)
    found = refine_rig(names, views, options, device=device)
    assert found is not None
    assert [camera.camera for camera in found.cameras if not camera.is_used] == ["c3"]
    assert len(found.cameras) == 8
    assert found.findings()[-1].code == "camera-contradicts"
    monkeypatch.setattr(rig, "FEWEST_CAMERAS", 8)
    too_few = refine_rig(names, views, options, device=device)
    assert too_few is not None
    assert not too_few.is_applied
    assert [camera.camera for camera in too_few.cameras if not camera.is_used] == ["c3"]


def test_halves_share_no_pixel(device):
    kept = []
    for half in range(2):
        gradients = wp.full((50 * 30, 3), 1.0, dtype=float, device=device)
        launch_keep_half(50, 8, half, gradients, device)
        kept.append(gradients.numpy().reshape(30, 50, 3))
    np.testing.assert_array_equal(kept[0] + kept[1], 1.0)
    assert kept[0][0, 0].all()
    assert not kept[0][7, 8].any()
    assert kept[0][8, 8].all()


def errors(given, found, truth, points):
    """How far cameras are from the truth, as far as the gauge lets them: as given, and as found."""
    exact = in_gauge(given, truth, points.mean(axis=0))
    after = [correction.applied(camera) for correction, camera in zip(found.cameras, given, strict=True)]
    return [
        np.mean([pixels_between(*pair, points) for pair in zip(cameras, exact, strict=True)])
        for cameras in (given, after)
    ]


def test_moved_cameras_of_a_ball_come_nearer_with_the_same_bits(device, monkeypatch, points):
    monkeypatch.setattr(rig, "LEVELS", (rig.Level(1, 1.0, 8, 2, 0.15, 0.02),))
    monkeypatch.setattr(rig, "FIELD", 8)
    views = ball_views(cameras_around(8, 40))
    truth = [view.camera for view in views]
    given = shaken(np.random.default_rng(1), truth, 0.8)
    moved = [replace(view, camera=camera) for view, camera in zip(views, given, strict=True)]
    names, options = [f"c{k}" for k in range(8)], FitOptions.of_preset("draft", gaussian_count=500)
    found = refine_rig(names, moved, options, device=device)
    assert found is not None
    assert found.is_applied
    before, after = errors(given, found, truth, points)
    assert after < 0.85 * before  # broad waves on a ball say little, and are looked at eight times
    assert refine_rig(names, moved, options, device=device) == found


@pytest.mark.slow
def test_cameras_of_a_capture_are_found_again(device, walker_views, rng):
    """A painted figure: of a third of a pixel and a millimetre, more than a third is gone."""
    truth = [view.camera for view in walker_views]
    center = np.array([0.0, 0.0, 1.0])
    turn = 0.3 / truth[0].focal_x
    given = [moved_camera(camera, [*rng.normal(0.0, turn, 3), *rng.normal(0.0, 1e-3, 3), 0.0]) for camera in truth]
    moved = [replace(view, camera=camera) for view, camera in zip(walker_views, given, strict=True)]
    names = [f"c{k}" for k in range(len(truth))]
    found = refine_rig(names, moved, FitOptions.of_preset("draft", gaussian_count=8_000), device=device)
    assert found is not None
    assert found.is_applied
    before, after = errors(given, found, truth, center + rng.uniform(-0.3, 0.3, (200, 3)))
    assert after < 2.0 / 3.0 * before


def test_a_sound_rig_stays_to_the_bit_after_one_half(device, monkeypatch):
    monkeypatch.setattr(rig, "LEVELS", (rig.Level(1, 1.0, 2, 3, 0.02, 0.01),))
    monkeypatch.setattr(rig, "judged", None)  # is asked of two halves only
    views = ball_views(cameras_around(6, 40))
    found = refine_rig([f"c{k}" for k in range(6)], views, FitOptions.of_preset("draft"), device=device)
    assert found is not None
    assert not found.is_applied
    assert 0.0 < found.pixels < rig.OWN_ERROR
    for correction, view in zip(found.cameras, views, strict=True):
        np.testing.assert_array_equal(correction.applied(view.camera).camera_to_world, view.camera.camera_to_world)


def test_too_few_cameras_or_no_masks_say_nothing():
    views = ball_views(cameras_around(6))
    names = [f"c{k}" for k in range(6)]
    assert refine_rig(names[:5], views[:5], FitOptions(), device="cpu") is None
    assert refine_rig(names, [replace(views[0], alpha=None), *views[1:]], FitOptions(), device="cpu") is None
