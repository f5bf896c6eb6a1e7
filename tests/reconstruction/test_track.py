"""Tracking: a turning ball is followed and keeps its ids, lost ones are found out, tracks come back bit by bit."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from support.moving_ball import ball_cloud, ball_views, rig
from support.threads import require_same_on_any_threads

from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.reconstruction import far_motion, joint_tracking
from beam_warp.reconstruction.fit import FitOptions, fit_gaussians
from beam_warp.reconstruction.joint_tracking import JointOptions, JointPose, JointTracker, hanging_together
from beam_warp.reconstruction.joints import registration
from beam_warp.reconstruction.targets import TargetSet
from beam_warp.reconstruction.track import (
    GAUSSIANS_PER_JOINT,
    JOINT_LIMITS,
    NOISE_PSNR,
    SMALLEST_COSINE,
    TrackOptions,
    advance_track,
    begin_track,
    outward_normals,
)

CAMERAS = rig()

PIXEL = 2.5 / CAMERAS[0].focal_x
"""Width of a pixel at the ball [m]."""


def track_options(levels, iterations, normal_iterations):
    refinement = replace(TrackOptions().refinement, normal_iterations=normal_iterations, samples=1)
    joints = JointOptions(levels=levels, iterations=iterations)
    return TrackOptions(joint_count=40, joints=joints, refinement=refinement)


OPTIONS = track_options((4, 2, 1), (16, 16, 24), 30)

FEWER = track_options((4, 2, 1), (8, 8, 12), 15)
"""Steps enough to find out that a motion is not found."""

BRIEF = track_options((2, 1), (3, 3), 4)


@cache
def key_track(device):
    """A ball of 400 Gaussians, well fitted."""
    options = FitOptions(gaussian_count=400, color_iterations=0, normal_iterations=60, refine_every=0, samples=1)
    views = ball_views(CAMERAS)
    cloud = fit_gaussians(views, ball_cloud(400), options, device=device).cloud
    return begin_track(cloud, views, OPTIONS, device=device)


def turned(degrees):
    return Rotation.from_rotvec(np.radians(degrees) * np.array([0.3, 0.2, 0.93]))


def rough_track(device, count=60, views=None, options=BRIEF):
    """Gaussians that were not fitted at all."""
    views = ball_views(CAMERAS[:3]) if views is None else views
    return begin_track(ball_cloud(count), views, options, device=device)


class TestASoundMotion:
    def test_a_turning_ball_is_followed_to_less_than_a_pixel(self, device):
        """Two frames of 2 pixels and 5 degrees each: every Gaussian where the motion takes it, under its id."""
        key = track = key_track(device)
        for frame in (1, 2):
            center, turn = frame * np.array([0.06, 0.03, 0.02]), turned(5.0 * frame)
            track, report = advance_track(track, ball_views(CAMERAS, center, turn), OPTIONS, device=device)
            error = track.cloud.positions - (turn.apply(key.cloud.positions) + center)
            assert report["lost"] == ""
            assert np.sqrt((error**2).sum(axis=1).mean()) < PIXEL
            assert report["psnr"] > key.baseline[0] - 3.0
            assert report["torn"] == 0.0
            np.testing.assert_array_equal(track.cloud.ids, key.cloud.ids)
            # Joints are carried on: the rest of the motion is theirs, too.
            error = track.joints - (turn.apply(key.key_joints) + center)
            assert np.sqrt((error**2).sum(axis=1).mean()) < PIXEL
        np.testing.assert_array_equal(track.key_joints, key.key_joints)
        np.testing.assert_array_equal(track.baseline, key.baseline)

    @pytest.mark.slow
    def test_what_stands_still_stays(self, device):
        key = key_track(device)
        track, report = advance_track(key, ball_views(CAMERAS), OPTIONS, device=device)
        assert report["lost"] == ""
        assert np.median(np.linalg.norm(track.cloud.positions - key.cloud.positions, axis=1)) < 0.25 * PIXEL

    @pytest.mark.slow
    def test_other_cameras_than_in_the_key_frame(self, device):
        """Fewer, of another size, elsewhere."""
        views = ball_views(rig(5, 56, vertical_fov=30.0), (0.03, 0.0, 0.0))
        track, report = advance_track(key_track(device), views, OPTIONS, device=device)
        assert report["lost"] == ""
        assert len(track.cloud) == 400


class TestLost:
    """Each of the three reasons, and what causes it."""

    def test_scrambled_photographs(self, device):
        rng, views = np.random.default_rng(0), ball_views(CAMERAS)
        colors = [rng.permutation(view.color.reshape(-1, 3)).reshape(view.color.shape) for view in views]
        views = [replace(view, color=color) for view, color in zip(views, colors, strict=True)]
        _, report = advance_track(key_track(device), views, FEWER, device=device)
        assert report["lost"].startswith("PSNR fell from")

    def test_a_jump_beyond_reach(self, device):
        """Nearly a diameter, silhouettes not asked: some is not covered, and views are named in which."""
        options = replace(FEWER, reach=np.inf)
        _, report = advance_track(key_track(device), ball_views(CAMERAS, (0.0, 0.0, 0.9)), options, device=device)
        assert "of the subject are not covered in view" in report["lost"]

    def test_nothing_is_lost_where_everything_is_allowed(self, device):
        options = replace(BRIEF, largest_drop=1000.0, largest_gap=1.0, largest_tear=1.0)
        views = ball_views(CAMERAS[:3], (0.0, 0.0, 0.9))
        _, report = advance_track(rough_track(device), views, options, device=device)
        assert report["lost"] == ""


class TestCaptures:
    def test_same_bits_for_every_number_of_threads(self, device, monkeypatch):
        views = ball_views(rig(2, 48))

        def run():
            track, _ = advance_track(rough_track(device, 1100, views), views, BRIEF, device=device)
            return track.arrays().values()

        require_same_on_any_threads(monkeypatch, run)

    @pytest.mark.parametrize("count", [1, 2, 30])
    def test_fewer_gaussians_than_joints(self, device, count):
        track, report = advance_track(rough_track(device, count), ball_views(CAMERAS[:3]), BRIEF, device=device)
        assert len(track.cloud) == len(track.joints) == count
        assert np.isfinite([report[name] for name in ("psnr", "gap", "torn")]).all()

    @pytest.mark.parametrize("size", [1, 3])
    def test_images_that_cannot_be_reduced_so_far(self, device, size):
        """Levels stop at a pixel."""
        views = ball_views(rig(1, size))
        options = replace(BRIEF, joints=JointOptions(levels=(4, 1), iterations=(2, 2)))
        track, _ = advance_track(rough_track(device, views=views), views, options, device=device)
        assert len(track.cloud) == 60

    @pytest.mark.parametrize("degree", [0, 3])
    def test_the_radiance_has_the_degree_of_the_key_frame(self, device, degree):
        """Without alpha nothing is known to be uncovered."""
        cloud = ball_cloud(60).with_arrays(radiance=np.zeros((60, (degree + 1) ** 2, 3)))
        views = ball_views(CAMERAS[:2], with_alpha=False)
        track, report = advance_track(begin_track(cloud, views, BRIEF, device=device), views, BRIEF, device=device)
        assert report["gap"] == 0.0
        assert track.cloud.radiance.shape == cloud.radiance.shape


class TestNormals:
    def test_discs_face_to_their_side(self):
        cloud = ball_cloud(50)
        expected = cloud.positions / np.linalg.norm(cloud.positions, axis=1, keepdims=True)
        np.testing.assert_allclose(outward_normals(cloud, expected + 0.3), expected, atol=1e-6)
        np.testing.assert_allclose(outward_normals(cloud, -2.0 * expected), -expected, atol=1e-6)

    def test_balls_and_needles_and_what_nobody_sees_face_nowhere(self):
        scales = [[0.1, 0.1, 0.08], [0.1, 0.1, 0.1], [0.1, 0.09, 0.05]]
        cloud = ball_cloud(3)
        assert not outward_normals(cloud.with_arrays(scales=scales), cloud.positions).any()
        assert not outward_normals(cloud, np.zeros((3, 3))).any()

    def test_a_key_frame_is_turned_towards_its_cameras(self, device):
        """Whichever way local z points: outside is where it is seen from."""
        track = key_track(device)
        faces = track.normals().any(axis=1)
        outward = track.cloud.positions[faces] / np.linalg.norm(track.cloud.positions[faces], axis=1, keepdims=True)
        assert faces.mean() > 0.5
        assert ((track.normals()[faces] * outward).sum(axis=1) > 0.0).mean() > 0.95


def test_a_pose_stays_what_it_was_when_the_next_is_found(device):
    track, views = rough_track(device), ball_views(CAMERAS[:2], (0.05, 0.0, 0.0))
    target = resolve_device(device)
    raster = BRIEF.refinement.raster
    tracker = JointTracker(track.cloud, track.anchors, track.graph, track.joints, BRIEF.joints, raster, target)
    start = {"there": JointPose(track.turns, track.joints)}
    pose, _ = tracker.find(views, start, 1, 0)
    carried = tracker.carried(track.cloud)
    kept = pose.positions.copy(), carried.positions.copy()
    tracker.find(ball_views(CAMERAS[:2], (-0.05, 0.0, 0.0)), start, 1, 0)
    tracker.carried(track.cloud)
    np.testing.assert_array_equal(pose.positions, kept[0])
    np.testing.assert_array_equal(carried.positions, kept[1])


class TestCoarseLevels:
    def test_few_gaussians_find_what_all_find(self, device, monkeypatch):
        """Half a Gaussian for a pixel: about half of them are drawn, or fewer, and the ball is found as well."""
        key, turn, center = key_track(device), turned(5.0), np.array([0.06, 0.03, 0.02])
        drawn = []

        def spied(views, count, *rest):
            drawn.append(count)
            return TargetSet(views, count, *rest)

        monkeypatch.setattr(joint_tracking, "TargetSet", spied)
        options = JointOptions(levels=(4, 2), iterations=(16, 24))
        errors = []
        for per_pixel in (0.5, np.inf):
            monkeypatch.setattr(joint_tracking, "GAUSSIANS_PER_PIXEL", per_pixel)
            raster, target = OPTIONS.refinement.raster, resolve_device(device)
            tracker = JointTracker(key.cloud, key.anchors, key.graph, key.joints, options, raster, target)
            start = {"there": JointPose(key.turns, key.joints)}
            pose, _ = tracker.find(ball_views(CAMERAS, center, turn), start, 1, 0)
            errors.append(pose.positions - (turn.apply(key.key_joints) + center))
        few, every = (np.sqrt((error**2).sum(axis=1).mean()) for error in errors)
        assert drawn[2:] == [400, 400]
        assert drawn[0] < drawn[1] < 240
        assert every < PIXEL
        assert few < PIXEL

    @pytest.mark.parametrize("size", [2, 7, 100])
    def test_what_merges_hangs_on_one_joint_and_lies_together(self, device, size):
        track = key_track(device)
        labels = hanging_together(track.cloud, track.anchors, size, resolve_device(device))
        joints = track.anchors.joints[:, 0]
        counts = np.bincount(labels)
        assert counts.min() >= 1
        assert counts.max() <= size
        pairs = set(zip(labels, joints, strict=True))
        assert len(pairs) == len(counts) == sum(-(-held // size) for held in np.bincount(joints))
        near = cKDTree(track.cloud.positions).query(track.cloud.positions, 2)[0][:, 1].mean()
        spread = [np.ptp(track.cloud.positions[labels == label], axis=0).max() for label in range(len(counts))]
        assert np.mean(spread) < 3.0 * near * np.sqrt(size)


class TestRefusals:
    def test_nothing_to_track(self, device):
        views = ball_views(CAMERAS[:2])
        with pytest.raises(InvalidArrayError, match="got 0 views and 60 Gaussians"):
            begin_track(ball_cloud(60), [], BRIEF, device=device)
        with pytest.raises(InvalidArrayError, match="got 2 views and 0 Gaussians"):
            begin_track(ball_cloud(60).select(np.zeros(0, int)), views, BRIEF, device=device)
        with pytest.raises(InvalidArrayError, match="got 0 views and 60 Gaussians"):
            advance_track(rough_track(device), [], BRIEF, device=device)

    def test_a_cloud_without_light(self, device):
        views = ball_views(CAMERAS[:2])
        for changes in ({"radiance_color_space": DISPLAY_SRGB}, {"radiance": None, "radiance_color_space": None}):
            with pytest.raises(InvalidArrayError, match="cloud must have radiance in lin_rec709_scene"):
                begin_track(ball_cloud(9).with_arrays(**changes), views, BRIEF, device=device)

    @pytest.mark.parametrize(
        ("changes", "match"),
        [
            ({"joint_count": 0}, "joint_count must be"),
            ({"reach": np.nan}, "reach must be"),
            ({"largest_drop": -1.0}, "largest_drop must be"),
            ({"largest_gap": np.nan}, "largest_gap must be"),
            ({"largest_tear": -0.1}, "largest_tear must be"),
            ({"levels": (1,)}, "levels and iterations must be as many"),
            ({"levels": (), "iterations": ()}, "levels and iterations must be as many"),
            ({"levels": (4, 0, 1), "iterations": (1, 1, 1)}, "levels must be an integer"),
            ({"levels": (4, 2, 1), "iterations": (1, -1, 1)}, "iterations must be an integer"),
            ({"rigidity": -1.0}, "rigidity must be a number"),
            ({"rotation_rate": np.nan}, "rotation_rate must be a number"),
            ({"position_rate": -1.0}, "position_rate must be a number"),
            ({"final_rate": 1.5}, "final_rate must be a number"),
            ({"blend": "cubic"}, "blend must be one of linear, dual"),
        ],
    )
    def test_options(self, changes, match):
        options = TrackOptions if changes.keys() <= vars(OPTIONS).keys() else JointOptions
        with pytest.raises(InvalidOptionError, match=match):
            options(**changes)


def test_the_tracking_page_states_the_defaults():
    page = Path(__file__).parents[2] / "docs" / "tracking.md"
    text = " ".join(page.read_text(encoding="utf-8").split())
    options, joints = TrackOptions(), JointOptions()
    fewest, most = JOINT_LIMITS
    for phrase in (
        f"one joint for every {GAUSSIANS_PER_JOINT} Gaussians, but at least {fewest} and at most {most:,}",
        f"whose normals have a cosine below {SMALLEST_COSINE} are not neighbours",
        "reduced {}, {}, {} and {} times, in {} steps".format(*joints.levels, sum(joints.iterations)),
        f"more than {100 * far_motion.ASTRAY:g} % of the joints would start more than {options.reach:g} pixels",
        f"{far_motion.MOST_NODES} Gaussians",
        f"{far_motion.MOST_NODES * far_motion.POINTS_PER_NODE:,} points",
        "In {} rounds σ shrinks from {:g} to {:g} distances".format(registration.ROUNDS, *registration.WIDTHS),
        f"τ is {registration.GIVE:g} of them, ν = {registration.FACING:g}, c = {registration.STRAY:g}",
        f"λ = {joints.rigidity:g} divided by the square of the reduction",
        f"are fitted in {options.refinement.normal_iterations} steps",
        f"more than {options.largest_drop:g} dB below that of the key frame, which counts as at most {NOISE_PSNR:g} dB",
        f"more than {100 * options.largest_gap:g} % of the subject is not covered",
        f"More than {100 * options.largest_tear:g} % of the joints are torn",
    ):
        assert phrase in text, phrase
