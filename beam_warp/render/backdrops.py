"""The environment as the camera sees it behind the subject."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beam_warp.world.camera import Camera
from beam_warp.world.environment import MIN_HEIGHT, EnvironmentMap


class Backdrop:
    """One environment behind any number of images; what they share is made ready once."""

    def __init__(self, environment: EnvironmentMap) -> None:
        """Take the environment; `seen` turns it."""
        self._environment = environment
        self._reduced = environment
        self._held: tuple[tuple[object, ...], NDArray[np.float32]] | None = None

    def seen(self, camera: Camera, rotation: float = 0.0) -> NDArray[np.float32]:
        """Return the radiance behind every pixel.

        Between texel centres radiance is interpolated, so that a small map shows no squares; where texels are smaller
        than pixels it is averaged to about a pixel first, so that a sun of one texel is as bright in the next frame.

        Args:
            camera: Camera that sees the environment.
            rotation: Turn of the environment about z, counter-clockwise from above [degree].

        Returns:
            Scene-linear Rec.709, ``(H, W, 3)`` float32.
        """
        lens = (camera.width, camera.height, camera.focal_x, camera.focal_y, camera.center_x, camera.center_y)
        key = (*lens, camera.camera_to_world.tobytes(), rotation)
        if self._held is None or self._held[0] != key:
            self._held = (key, self._look(camera, rotation))
        return self._held[1]

    def _look(self, camera: Camera, rotation: float) -> NDArray[np.float32]:
        """Look at the environment."""
        pixel = 1.0 / max(camera.focal_x, camera.focal_y)  # radians, in the middle of the image
        rows = max(MIN_HEIGHT, int(np.ceil(np.pi / pixel)))
        if rows >= self._environment.height:
            self._reduced = self._environment
        elif rows != self._reduced.height:
            self._reduced = self._environment.resized(rows, 2 * rows)
        height, width = self._reduced.height, self._reduced.width
        d = camera.directions()
        u = 0.5 - (np.arctan2(d[..., 1], d[..., 0]) - np.radians(rotation)) / (2.0 * np.pi)
        v = np.arccos(np.clip(d[..., 2], -1.0, 1.0)) / np.pi
        x, y = u * width - 0.5, np.clip(v * height - 0.5, 0.0, height - 1.0)
        left, top = np.floor(x), np.floor(y)
        right_share, lower_share = (x - left)[..., None], (y - top)[..., None]
        columns = [(left.astype(np.int64) + step) % width for step in (0, 1)]
        rows_of = [np.minimum(top.astype(np.int64) + step, height - 1) for step in (0, 1)]
        upper, lower = (
            self._reduced.radiance[row, columns[0]] * (1.0 - right_share)
            + self._reduced.radiance[row, columns[1]] * right_share
            for row in rows_of
        )
        return (upper * (1.0 - lower_share) + lower * lower_share).astype(np.float32)
