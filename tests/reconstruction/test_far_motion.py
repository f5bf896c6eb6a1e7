"""Motion farther than a limb is wide: silhouettes find a turned arm, and the pose most like the views is taken."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.moving_ball import RADIUS, ball_views, rig
from support.two_limbs import arm_at, limb_cloud, limb_views, surface, turn_of

from beam_warp.reconstruction.far_motion import pixels_outside
from beam_warp.reconstruction.fit import FitOptions, fit_gaussians
from beam_warp.reconstruction.joint_tracking import JointOptions
from beam_warp.reconstruction.joints.graph import JointGraph
from beam_warp.reconstruction.joints.registration import register
from beam_warp.reconstruction.track import SMALLEST_COSINE, TrackOptions, advance_track, begin_track

TURN = 75.0
"""Degrees by which the arm swings: its end moves by five of its widths."""

CAMERAS = rig(8, 48)

OPTIONS = TrackOptions(
    joint_count=250,
    joints=JointOptions(levels=(4, 2, 1), iterations=(16, 16, 24)),
    refinement=replace(TrackOptions().refinement, normal_iterations=20, samples=1),
)


class TestRegistration:
    def test_a_limb_that_swings_is_found_without_texture(self):
        """Along the surface nothing holds a point of a round limb but its neighbours: to a spacing, in the mean."""
        spacing = 0.05
        rest, normals, is_arm = surface(spacing, -0.5 * TURN)
        goal = np.where(is_arm[:, None], arm_at(rest, TURN), rest)
        graph = JointGraph.build(rest, normals=normals, smallest_cosine=SMALLEST_COSINE)
        still = np.tile(np.eye(3), (len(rest), 1, 1)), rest
        rotations, places = register(graph, rest, normals, *surface(0.5 * spacing, 0.5 * TURN)[:2], still)
        error = np.linalg.norm(places - goal, axis=1)
        assert np.sqrt((error**2).mean()) < spacing
        turned = Rotation.from_matrix(rotations[is_arm]).mean().inv() * turn_of(TURN)
        assert np.degrees(turned.magnitude()) < 0.2 * TURN

    def test_a_rigid_motion_keeps_the_shape(self):
        """Everything goes together, by more than the body is wide."""
        rest, normals, _ = surface(0.07)
        turn, shift = Rotation.from_rotvec([0.0, 0.0, 0.3]), np.array([0.4, 0.2, -0.1])
        graph = JointGraph.build(rest, normals=normals, smallest_cosine=SMALLEST_COSINE)
        moved = turn.apply(rest) + shift, turn.apply(normals)
        _, places = register(graph, rest, normals, *moved, (np.tile(np.eye(3), (len(rest), 1, 1)), rest))
        assert np.sqrt(((places - moved[0]) ** 2).sum(axis=1).mean()) < 0.5 * graph.spacing


class TestSilhouettes:
    @pytest.mark.parametrize("size", [1, 4])
    def test_points_beside_a_ball_are_as_far_outside_as_they_were_moved(self, size):
        cameras = rig(6, 40)
        rim = RADIUS * np.stack([np.zeros(200), *(f(np.linspace(0, 2 * np.pi, 200)) for f in (np.cos, np.sin))], axis=1)
        views, pixel = ball_views(cameras), 2.5 / cameras[0].focal_x
        assert pixels_outside(rim, views, size) <= 1.0
        found = pixels_outside(rim + np.array([0.0, 0.3, 0.0]), views, size)
        assert found * size == pytest.approx(0.3 / pixel, abs=1.5 * size)

    def test_views_without_masks_tell_nothing(self):
        views = [*ball_views(rig(2, 16), with_alpha=False), *ball_views(rig(2, 16), (9.0, 9.0, 9.0))]
        assert pixels_outside(np.full((5, 3), 0.6), views, 2) == 0.0


class TestTracking:
    @pytest.fixture(scope="class")
    def key(self):
        """The figure with its arm back, and which Gaussians are the arm's."""
        cloud, is_arm = limb_cloud(0.045)
        turn = turn_of(-0.5 * TURN)
        arm = cloud.positions.copy(), cloud.orientations.copy()
        arm[0][is_arm] = arm_at(arm[0][is_arm], -0.5 * TURN)
        arm[1][is_arm] = (turn * Rotation.from_quat(arm[1][is_arm])).as_quat()
        cloud = cloud.with_arrays(positions=arm[0], orientations=arm[1])
        views = limb_views(CAMERAS, -0.5 * TURN)
        fitting = FitOptions(
            gaussian_count=len(cloud), color_iterations=0, normal_iterations=30, refine_every=0, samples=1
        )
        return begin_track(
            fit_gaussians(views, cloud, fitting, device="cpu").cloud, views, OPTIONS, device="cpu"
        ), is_arm

    def test_an_arm_that_swings_far_is_followed(self, key):
        """Its end moves by 22 pixels, where it is 5 wide: photographs reduced 4 times pull it nowhere."""
        track, is_arm = key
        found, report = advance_track(track, limb_views(CAMERAS, 0.5 * TURN), OPTIONS, device="cpu")
        goal = np.where(is_arm[:, None], arm_at(track.cloud.positions, TURN), track.cloud.positions)
        error = np.linalg.norm(found.cloud.positions - goal, axis=1)
        assert report["start"] == "silhouettes"
        assert report["lost"] == ""
        assert np.sqrt((error[is_arm] ** 2).mean()) < 0.07
        assert np.sqrt((error[~is_arm] ** 2).mean()) < 0.03

    def test_what_stops_is_not_carried_on(self, key):
        track, _ = key
        moving = replace(track, previous_joints=track.joints - np.float32([0.0, 0.5, 0.0]))
        _, report = advance_track(moving, limb_views(CAMERAS, -0.5 * TURN), OPTIONS, device="cpu")
        assert report["start"] == "ended"
        assert report["lost"] == ""
