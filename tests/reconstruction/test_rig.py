"""Refinement of a rig: its gauge, what counts as chance, and cameras found again that were moved."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from support.moving_ball import ball_views
from support.moving_ball import rig as cameras_around

from beam_warp.capture.corrections import RigCorrection, move_between, moved_camera
from beam_warp.errors import AssetFormatError
from beam_warp.reconstruction import rig
from beam_warp.reconstruction.alignment import Evidence, flow_of
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.initial import initial_gaussians
from beam_warp.reconstruction.labels import agreement_of
from beam_warp.reconstruction.rig import LEAST_DISTORTION, distortion_of, in_gauge, pixels_of, refine_rig, wrong_kinds

POSE = ("turn", "shift")


@pytest.fixture
def points(rng):
    return rng.uniform(-0.4, 0.4, (200, 3))


def shaken(rng, cameras, pixels):
    """Cameras that are each turned, so that the middle of the image moves by about as many pixels."""
    turns = pixels / cameras[0].focal_x * rng.normal(size=(len(cameras), 3))
    return [moved_camera(camera, [*turn, *[0.0] * 6]) for camera, turn in zip(cameras, turns, strict=True)]


def moves_of(cameras, others):
    return np.array([[*move_between(*pair), 0.0, 0.0] for pair in zip(cameras, others, strict=True)])


def apart(cameras, moves, points):
    return np.array([pixels_of(*pair, points) for pair in zip(cameras, moves, strict=True)])


@pytest.mark.parametrize("kinds", [POSE, (*POSE, "focal")])
def test_motions_of_the_world_and_a_zoom_of_all_cameras_are_no_correction(points, kinds):
    cameras = cameras_around(8)
    world = np.eye(4)
    world[:3, :3] = Rotation.from_rotvec([1e-3, -2e-3, 1.5e-3]).as_matrix()
    world[:3, 3] = [2e-3, 1e-3, -1e-3]
    zoom = 1.01 if "focal" in kinds else 1.0
    moved = []
    for camera in cameras:
        pose = world @ camera.camera_to_world
        pose[:3, 3] *= 1.002
        lengths = {name: zoom * getattr(camera, name) for name in ("focal_x", "focal_y")}
        moved.append(replace(camera, camera_to_world=pose, **lengths))
    before = moves_of(cameras, moved)
    after, undone = in_gauge(cameras, before, points, kinds)
    assert apart(cameras, before, points).min() > 0.03
    assert apart(cameras, after, points).max() < 2e-3  # of second order
    assert np.abs(undone).max() > 1e-3


def test_a_rig_s_own_corrections_stay(points):
    """What one camera does alone is no motion of the world but for its share in the mean."""
    cameras = cameras_around(12)
    moves = np.zeros((12, 11))
    moves[0, 0] = 0.01
    kept = apart(cameras, in_gauge(cameras, moves, points, ["turn"])[0], points)
    assert kept[0] > 0.7 * pixels_of(cameras[0], moves[0], points)
    assert kept[1:].max() < 0.3 * kept[0]


def test_turns_alone_have_no_shift_to_undo_the_world_with(rng, points):
    cameras = cameras_around(12)
    moves = np.zeros((12, 11))
    moves[:, :3] = 0.01 * rng.normal(size=(12, 3))
    found, _ = in_gauge(cameras, moves, points, ["turn"])
    np.testing.assert_array_equal(found[:, 3:], 0.0)


def says(rng, points, truth, noise):
    """What photographs would say that see the points well: exact flows, errors of 24 fields."""
    result = []
    for camera, move in zip(cameras_around(len(truth)), truth, strict=True):
        fields = np.array_split(flow_of(camera, points), 24, axis=2)
        informations, scores = [], []
        for field in fields:
            flat = field.reshape(11, -1)
            informations.append(flat @ flat.T)
            scores.append(flat @ (flat.T @ move + noise * rng.normal(size=flat.shape[1])))
        result.append(Evidence(np.array(informations), np.array(scores)))
    return result


def test_chance_is_no_kind_and_what_is_wrong_is_named(rng, points):
    none = np.zeros((12, 11))
    assert wrong_kinds(says(rng, points, none, 0.3)) == ()
    for column, size, kind in ((0, 0.01, "turn"), (6, 0.01, "focal")):
        truth = none.copy()
        truth[:, column] = size * rng.normal(size=12)
        assert wrong_kinds(says(rng, points, truth, 0.1))[-1] == kind
    both = none.copy()
    both[:, 0], both[:, 6] = 0.01 * rng.normal(size=(2, 12))
    assert wrong_kinds(says(rng, points, both, 0.1), ["turn"]) == ("turn", "focal")
    np.testing.assert_array_equal(says(rng, points, both, 0.1)[0].solved([])[0], 0.0)
    one = none.copy()
    one[3, 1] = 0.02
    assert wrong_kinds(says(rng, points, one, 0.1)) == ("turn",)


def test_lenses_that_nobody_states_are_told_by_their_size(rng, points):
    cameras, truth = cameras_around(12), np.zeros((12, 11))
    assert distortion_of(cameras, says(rng, points, truth, 0.1), points) == 0.0
    truth[:, 9] = np.where(np.arange(12) % 2, 0.2, -0.2)
    size = np.sqrt(np.mean(np.square(apart(cameras, truth, points))))
    assert distortion_of(cameras, says(rng, points, truth, 0.1), points) == pytest.approx(size, rel=0.2)
    little = 0.4 * LEAST_DISTORTION / size * truth
    assert distortion_of(cameras, says(rng, points, little, 1e-3), points) == 0.0  # sure, and nothing to speak of
    said = RigCorrection((), is_applied=False, confidence=1.0, distortion=0.3)
    assert [finding.code for finding in said.findings()] == ["lens-distortion"]
    assert RigCorrection.from_dict(said.as_dict()) == said


def test_a_camera_that_is_met_much_worse_is_left_out(device, monkeypatch):
    """One of eight cameras looks a third of the ball aside; the others are refined without it."""
    monkeypatch.setattr(rig, "LEVELS", (rig.Level(1, 1.0, 3, 1, 1),))
    views = ball_views(cameras_around(8, 40))
    turned = moved_camera(views[3].camera, [0.0, 0.12, *[0.0] * 7])
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


def exchanged(views, order):
    """The photographs under each other's names: camera k has that of ``order[k]``."""
    return [replace(views[photograph], camera=view.camera) for view, photograph in zip(views, order, strict=True)]


def test_labels_that_were_swapped_are_told_where_silhouettes_are_alike(device, monkeypatch):
    """Photographs of a ball from two sides under each other's names: both are left out."""
    monkeypatch.setattr(rig, "LEVELS", (rig.Level(1, 1.0, 3, 1, 1),))
    views, options = ball_views(cameras_around(8, 40)), FitOptions.of_preset("draft", gaussian_count=500)
    found = refine_rig([f"c{k}" for k in range(8)], exchanged(views, [0, 4, 2, 3, 1, 5, 6, 7]), options, device=device)
    assert found is not None
    assert [camera.camera for camera in found.cameras if not camera.is_used] == ["c1", "c4"]


def test_a_rig_whose_cameras_contradict_each_other_is_told(device, monkeypatch):
    """All labels in another order: what the photographs show of a ball has nothing in common."""
    monkeypatch.setattr(rig, "LEVELS", (rig.Level(1, 1.0, 3, 1, 1),))
    views, options = ball_views(cameras_around(8, 40)), FitOptions.of_preset("draft", gaussian_count=500)
    names = [f"c{k}" for k in range(8)]
    sound, shuffled = (
        refine_rig(names, exchanged(views, order), options, device=device)
        for order in (range(8), [3, 6, 1, 7, 2, 4, 0, 5])
    )
    assert sound is not None
    assert sound.findings() == []
    assert shuffled is not None
    assert shuffled.findings()[0].code == "photographs-unlike"
    assert RigCorrection.from_dict(shuffled.as_dict()) == shuffled


def test_black_gloss_has_nothing_in_common_and_is_not_blamed(device, monkeypatch):
    """Each camera sees a lamp elsewhere on a black ball: no photograph explains another, but a fit meets them all."""
    monkeypatch.setattr(rig, "LEVELS", (rig.Level(1, 1.0, 3, 1, 1),))
    views, options = ball_views(cameras_around(8, 40)), FitOptions.of_preset("draft", gaussian_count=500)
    rng, glossy = np.random.default_rng(0), []
    for view in views:
        y, x = np.indices(view.alpha.shape) - rng.uniform(14.0, 25.0, 2)[:, None, None]
        shine = 0.01 + 0.2 * np.exp(-0.125 * (x**2 + y**2))
        glossy.append(replace(view, color=np.repeat((shine * view.alpha)[..., None], 3, axis=2).astype(np.float32)))
    surface = initial_gaussians(glossy, 500, device=device)
    assert np.median(agreement_of(glossy, surface, device=device).explained) < rig.UNEXPLAINED
    found = refine_rig([f"c{k}" for k in range(8)], glossy, options, device=device)
    assert found is not None
    assert found.findings() == []


def test_where_all_sides_are_alike_nothing_tells_labels(device):
    """An even ball has no wrong labels; a painted one shows them."""
    views = ball_views(cameras_around(12, 40))
    wrong = exchanged(views, [0, 6, 2, 3, 4, 5, 1, 7, 8, 9, 10, 11])
    surface = initial_gaussians(views, 500, device=device)
    sound, told = (agreement_of(some, surface, device=device) for some in (views, wrong))
    assert sound.explained.min() > 0.9
    assert not sound.swapped.any()
    assert np.flatnonzero(told.swapped).tolist() == [1, 6]
    even = [replace(view, color=np.repeat(view.alpha[..., None], 3, axis=2)) for view in wrong]
    blank = agreement_of(even, surface, device=device)
    assert (blank.explained == 1.0).all()
    assert not blank.swapped.any()


def test_two_captures_in_one_are_refused(device, monkeypatch):
    monkeypatch.setattr(rig, "LEVELS", (rig.Level(1, 1.0, 3, 1, 1),))
    one, other = (ball_views(cameras_around(8, 40), center=(0.0, 0.0, z)) for z in (0.0, 0.45))
    mixed = [(one, other)[k % 2][k] for k in range(8)]
    options = FitOptions.of_preset("draft", gaussian_count=500)
    with pytest.raises(AssetFormatError, match="photographs must show one subject"):
        refine_rig([f"c{k}" for k in range(8)], mixed, options, device=device)


def test_moved_cameras_of_a_ball_come_nearer_with_the_same_bits(device, monkeypatch, points):
    monkeypatch.setattr(rig, "LEVELS", (rig.Level(1, 1.0, 6, 3, 3),))
    views = ball_views(cameras_around(8, 40))
    truth = [view.camera for view in views]
    given = shaken(np.random.default_rng(1), truth, 0.8)
    moved = [replace(view, camera=camera) for view, camera in zip(views, given, strict=True)]
    names, options = [f"c{k}" for k in range(8)], FitOptions.of_preset("draft", gaussian_count=500)
    found = refine_rig(names, moved, options, device=device)
    assert found is not None
    assert found.is_applied
    assert found.kinds[0] == "turn"
    after = [correction.applied(camera) for correction, camera in zip(found.cameras, given, strict=True)]
    left, before = (
        np.mean(apart(truth, in_gauge(truth, moves_of(truth, cameras), points, POSE)[0], points))
        for cameras in (after, given)
    )
    assert left < 0.5 * before
    assert refine_rig(names, moved, options, device=device) == found


def test_a_sound_rig_stays_to_the_bit_after_one_look(device, monkeypatch):
    monkeypatch.setattr(rig, "LEVELS", (rig.Level(1, 1.0, 4, 1, 1),))
    monkeypatch.setattr(rig.RigFitter, "_move", None)
    views = ball_views(cameras_around(8, 40))
    found = refine_rig([f"c{k}" for k in range(8)], views, FitOptions.of_preset("draft"), device=device)
    assert found is not None
    assert not found.is_applied
    assert 0.0 < found.pixels < 2.0 * found.error
    for correction, view in zip(found.cameras, views, strict=True):
        np.testing.assert_array_equal(correction.applied(view.camera).camera_to_world, view.camera.camera_to_world)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.5, 1.0])
def test_cameras_of_a_capture_are_found_again(device, walker_views, size, rng):
    """A painted figure: of a third of a pixel and a millimetre, or half of it, more than half is gone."""
    truth = [view.camera for view in walker_views]
    turn = 0.3 * size / truth[0].focal_x
    given = [
        moved_camera(camera, [*rng.normal(0.0, turn, 3), *rng.normal(0.0, 1e-3 * size, 3), *[0.0] * 3])
        for camera in truth
    ]
    moved = [replace(view, camera=camera) for view, camera in zip(walker_views, given, strict=True)]
    names = [f"c{k}" for k in range(len(truth))]
    found = refine_rig(names, moved, FitOptions.of_preset("draft", gaussian_count=8_000), device=device)
    assert found is not None
    assert found.is_applied
    points = np.array([0.0, 0.0, 1.0]) + rng.uniform(-0.3, 0.3, (200, 3))
    after = [correction.applied(camera) for correction, camera in zip(found.cameras, given, strict=True)]
    left, before = (
        np.mean(apart(truth, in_gauge(truth, moves_of(truth, cameras), points, POSE)[0], points))
        for cameras in (after, given)
    )
    assert left < 0.5 * before


def test_too_few_cameras_or_no_masks_say_nothing():
    views = ball_views(cameras_around(8))
    names = [f"c{k}" for k in range(8)]
    assert refine_rig(names[:7], views[:7], FitOptions(), device="cpu") is None
    assert refine_rig(names, [replace(views[0], alpha=None), *views[1:]], FitOptions(), device="cpu") is None


def test_noise_asks_nothing_of_a_short_fit(device, rng):
    """A key frame would heed this noise; steps that look for cameras are too few to learn it."""
    clean = ball_views(cameras_around(8, size=96))
    noise = [0.1 * np.sqrt(view.color) * rng.normal(size=view.color.shape) for view in clean]
    views = [replace(view, color=np.float32(view.color + by)) for view, by in zip(clean, noise, strict=True)]
    options, cameras = FitOptions(gaussian_count=20_000), [view.camera for view in views]
    fitter = rig.RigFitter(views, cameras, rig.Level(1, 1.0, 3, 1, 1), options, wp.get_device(device))
    assert (fitter.dropout, fitter.total_variation) == ((0.0, 0.0), 0.0)
    asked = rig.Fitter(views, fitter.parameters.cloud(), options, wp.get_device(device))
    assert asked.dropout[1] > 0.0
    assert asked.total_variation > 0.0
