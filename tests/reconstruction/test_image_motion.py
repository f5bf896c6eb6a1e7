"""Motion in the images: closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from beam_warp.reconstruction.joints.image_motion import motion_in_pixels
from beam_warp.world.camera import Camera

FRONT = Camera(100, 80, focal_x=50.0, focal_y=60.0, center_x=50.0, center_y=40.0, camera_to_world=np.eye(4))


def test_a_step_sideways_is_focal_length_times_step_over_depth():
    before, after = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0]]), np.array([[0.1, 0.0, 2.0], [0.0, 0.2, 4.0]])
    np.testing.assert_allclose(motion_in_pixels(before, after, [FRONT]), [50.0 * 0.1 / 2.0, 60.0 * 0.2 / 4.0])


def test_the_view_that_shows_most_counts():
    """A step along one camera's axis is seen from the side only."""
    pose = np.eye(4)
    pose[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]  # looks along +x
    pose[0, 3], pose[2, 3] = -5.0, 5.0
    side = replace(FRONT, camera_to_world=pose)
    before, after = np.array([[0.0, 0.0, 5.0]]), np.array([[0.0, 0.0, 6.0]])
    np.testing.assert_allclose(motion_in_pixels(before, after, [FRONT]), [0.0], atol=1e-12)
    np.testing.assert_allclose(motion_in_pixels(before, after, [FRONT, side]), [50.0 / 5.0])


@pytest.mark.parametrize("depth", [-1.0, 0.0])
def test_what_is_behind_a_camera_is_not_seen(depth):
    points = np.array([[0.0, 0.0, depth]])
    assert motion_in_pixels(points, points + np.array([1.0, 0.0, 0.0]), [FRONT]) == [0.0]
    assert motion_in_pixels(points, points, []) == [0.0]
