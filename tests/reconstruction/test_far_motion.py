"""Motion farther than a limb is wide: silhouettes find a turned arm, and the pose most like the views is taken."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.moving_ball import RADIUS, ball_views, rig
from support.two_limbs import ARM, BODY, arm_at, distance, limb_cloud, limb_views, surface, turn_of

from beam_warp.reconstruction.far_motion import Silhouette, squares_outside
from beam_warp.reconstruction.fit import FitOptions, fit_gaussians
from beam_warp.reconstruction.joint_tracking import JointOptions
from beam_warp.reconstruction.joints.graph import JointGraph
from beam_warp.reconstruction.joints.registration import WIDTHS, register
from beam_warp.reconstruction.track import SMALLEST_COSINE, TrackOptions, advance_track, begin_track

TURN = 75.0
"""Degrees by which the arm swings: its end moves by five of its widths."""

CAMERAS = rig(8, 48)

OPTIONS = TrackOptions(
    joint_count=250,
    joints=JointOptions(levels=(4, 2, 1), iterations=(16, 16, 24)),
    refinement=replace(TrackOptions().refinement, normal_iterations=20, samples=1),
)


def rms(errors):
    return np.sqrt((errors.reshape(len(errors), -1) ** 2).sum(axis=1).mean())


class TestRegistration:
    def test_a_limb_that_swings_is_found_without_texture(self):
        """Points end on the surface, to the last width of shares; the arm's as far along it as before."""
        rest, normals, is_arm = surface(0.06, -0.5 * TURN)
        graph = JointGraph.build(rest, normals=normals, smallest_cosine=SMALLEST_COSINE)
        still = np.tile(np.eye(3), (len(rest), 1, 1)), rest
        rotations, places = register(graph, rest, normals, *surface(0.03, 0.5 * TURN)[:2], still)
        away = np.minimum(distance(places, *BODY), distance(places, arm_at(ARM[0], 0.5 * TURN), ARM[1]))
        assert rms(away) < WIDTHS[1] * graph.spacing
        assert rms(places[is_arm] - arm_at(rest[is_arm], TURN)) < ARM[1]
        along = (ARM[0][1] - ARM[0][0]) / np.linalg.norm(ARM[0][1] - ARM[0][0])
        before, after = (turn_of(part * TURN).apply(along) for part in (-0.5, 0.5))
        assert np.degrees(np.arccos(Rotation.from_matrix(rotations[is_arm]).mean().apply(before) @ after)) < 0.1 * TURN

    def test_a_rigid_motion_keeps_the_shape(self):
        """Everything goes together, by more than the body is wide."""
        rest, normals, _ = surface(0.07)
        turn, shift = Rotation.from_rotvec([0.0, 0.0, 0.3]), np.array([0.4, 0.2, -0.1])
        graph = JointGraph.build(rest, normals=normals, smallest_cosine=SMALLEST_COSINE)
        moved = turn.apply(rest) + shift, turn.apply(normals)
        _, places = register(graph, rest, normals, *moved, (np.tile(np.eye(3), (len(rest), 1, 1)), rest))
        assert rms(places - moved[0]) < 0.5 * graph.spacing


class TestSilhouettes:
    @pytest.mark.parametrize("size", [1, 4])
    def test_points_beside_a_ball_are_as_far_outside_as_they_were_moved(self, size):
        cameras = rig(6, 40)
        rim = RADIUS * np.stack([np.zeros(200), *(f(np.linspace(0, 2 * np.pi, 200)) for f in (np.cos, np.sin))], axis=1)
        pixel = 2.5 / cameras[0].focal_x
        silhouettes = [Silhouette.of(view, size) for view in ball_views(cameras)]
        assert squares_outside(rim, silhouettes) <= 1.0
        found = squares_outside(rim + np.array([0.0, 0.3, 0.0]), silhouettes)
        assert found * size == pytest.approx(0.3 / pixel, abs=1.5 * size)

    def test_views_that_show_no_mask_tell_nothing(self):
        views = [*ball_views(rig(1, 16), with_alpha=False), *ball_views(rig(1, 16), (9.0, 9.0, 9.0))]
        assert [Silhouette.of(view, 2) for view in views] == [None, None]
        assert squares_outside(np.zeros((5, 3)), []) == 0.0

    def test_images_smaller_than_a_square(self):
        (view,) = ball_views(rig(1, 3))
        found = Silhouette.of(view, 8)
        assert found.away.shape == (1, 1)
        assert squares_outside(np.zeros((5, 3)), [found]) == 0.0


@cache
def key_track():
    """The figure with its arm back, and which Gaussians are the arm's."""
    cloud, is_arm = limb_cloud(0.045, -0.5 * TURN)
    views = limb_views(CAMERAS, -0.5 * TURN)
    fitting = FitOptions(gaussian_count=len(cloud), color_iterations=0, normal_iterations=30, refine_every=0, samples=1)
    return begin_track(fit_gaussians(views, cloud, fitting, device="cpu").cloud, views, OPTIONS, device="cpu"), is_arm


class TestTracking:
    def test_an_arm_that_swings_far_is_followed(self):
        """The end of an arm 5 pixels wide moves by 23: photographs reduced 4 times alone lose it, and that is said."""
        (track, is_arm), views = key_track(), limb_views(CAMERAS, 0.5 * TURN)
        found, report = advance_track(track, views, OPTIONS, device="cpu")
        goal = np.where(is_arm[:, None], arm_at(track.cloud.positions, TURN), track.cloud.positions)
        assert (report["start"], report["lost"]) == ("silhouettes", "")
        assert rms(found.cloud.positions[is_arm] - goal[is_arm]) < ARM[1]
        assert rms(found.cloud.positions[~is_arm] - goal[~is_arm]) < ARM[1]
        found, report = advance_track(track, views, replace(OPTIONS, reach=np.inf), device="cpu")
        assert report["start"] == "continued"
        assert "PSNR fell" in report["lost"]
        assert rms(found.cloud.positions[is_arm] - goal[is_arm]) > 3.0 * ARM[1]

    def test_what_stops_is_not_carried_on(self):
        track, _ = key_track()
        moving = replace(track, previous_joints=track.joints - np.float32([0.0, 0.5, 0.0]))
        _, report = advance_track(moving, limb_views(CAMERAS, -0.5 * TURN), OPTIONS, device="cpu")
        assert (report["start"], report["lost"]) == ("ended", "")
