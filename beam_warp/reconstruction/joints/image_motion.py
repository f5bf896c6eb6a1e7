"""Motion of a subject from one frame to the next, in pixels of its cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from beam_warp.world.camera import Camera


def motion_in_pixels(
    before: NDArray[np.floating], after: NDArray[np.floating], cameras: Sequence[Camera]
) -> NDArray[np.float64]:
    """Return how far each point moves in the image where it moves farthest [pixel]; 0 before no camera.

    Args:
        before: Points [m], ``(N, 3)``.
        after: The same points [m], ``(N, 3)``.
        cameras: Cameras that look at the points; points beside the image count too, points behind the camera do not.
    """
    farthest = np.zeros(len(before))
    for camera in cameras:
        rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        pair = [points.astype(np.float64) @ rotation.T + shift for points in (before, after)]
        visible = (pair[0][:, 2] > 0.0) & (pair[1][:, 2] > 0.0)
        places = [points[visible, :2] / points[visible, 2:] * (camera.focal_x, camera.focal_y) for points in pair]
        farthest[visible] = np.maximum(farthest[visible], np.linalg.norm(places[1] - places[0], axis=1))
    return farthest
