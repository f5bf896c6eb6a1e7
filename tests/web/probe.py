"""A tripod that tells how a viewer takes a file: what is up, which hand the axes follow, and what turns with them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0

BALLS = {
    "red": ((0.9, 0.0, 0.0), (0.95, 0.05, 0.05)),
    "blue": ((0.0, 0.6, 0.0), (0.1, 0.1, 0.95)),
    "green": ((0.0, 0.0, 0.75), (0.05, 0.85, 0.1)),
    "yellow": ((-0.5, -0.3, 0.35), (0.95, 0.9, 0.05)),
}
"""Place [m], right, forward, up; and colour, display-referred. Arms lead to the first three: red points to the right,
blue forward, green up, and each has a length of its own. Yellow, the marker, is on no axis."""

MOOD_RING = (0.35, -0.4, -0.2)
"""Place of a fifth ball [m], whose colour depends on the direction that it is seen from."""

BALL_SIGMAS = (0.04, 0.05, 0.06)
"""Standard deviations of a ball along its axes [m]."""

BALL_TURN = Rotation.from_euler("xyz", (20.0, 40.0, 70.0), degrees=True)
"""Orientation of a ball, so that none is round or upright on the screen, which hides what a viewer turns."""

OPACITY = 0.98
SIDE, FIELD_OF_VIEW = 320, 45.0
EYE, TARGET = np.array([0.9, -2.1, 1.3]), np.array([0.1, 0.1, 0.25])
BACKGROUND = 0x20 / 255.0

_C1 = np.sqrt(3.0 / (4.0 * np.pi))


def camera() -> Camera:
    """Return the camera of every picture, from which no ball hides another."""
    return Camera.look_at(EYE, TARGET, width=SIDE, height=SIDE, vertical_fov=FIELD_OF_VIEW)


def tripod() -> GaussianCloud:
    """Return the probe: x right, y forward, z up; harmonics of the first degree.

    An arm is one long pale Gaussian: a viewer that takes rotations or scales otherwise points it elsewhere.
    """
    arms = [np.array(place) for name, (place, _) in BALLS.items() if name != "yellow"]
    places = [place for place, _ in BALLS.values()]
    count = len(places) + 1 + len(arms)
    colors = np.full((count, 3), 0.7)
    colors[: len(places)] = [color for _, color in BALLS.values()]
    colors[len(places)] = 0.5
    radiance = np.zeros((count, 4, 3))
    radiance[:, 0] = (colors - 0.5) / SH_C0
    for channel, (coefficient, sign) in enumerate([(3, 1.0), (1, 1.0), (2, -1.0)]):  # Y = -C1 x, -C1 y, C1 z
        radiance[len(places), coefficient, channel] = sign * 0.4 / _C1
    turns = [Rotation.align_vectors([arm], [[1.0, 0.0, 0.0]])[0] for arm in arms]
    return GaussianCloud(
        positions=np.array([*places, MOOD_RING, *(0.5 * arm for arm in arms)]),
        orientations=Rotation.concatenate([*[BALL_TURN] * (count - len(arms)), *turns]).as_quat(),
        scales=np.array(
            [BALL_SIGMAS] * (count - len(arms)) + [[0.22 * np.linalg.norm(arm), 0.012, 0.006] for arm in arms]
        ),
        opacities=np.full(count, OPACITY),
        radiance=radiance,
        radiance_color_space=DISPLAY_SRGB,
        axes="rfu",
    )


def color_error(picture: NDArray[np.uint8], *, harmonics: bool) -> float:
    """Return how far the middle of the fifth ball is from its colour in a picture, the largest of three channels.

    Seen in direction d, the ball has the colour 0.5 - 0.4 d; without harmonics, as in a .splat, it is grey.
    """
    column, row = camera().project([MOOD_RING])[0, :2].astype(int)
    direction = np.subtract(MOOD_RING, EYE)
    color = 0.5 - 0.4 * harmonics * direction / np.linalg.norm(direction)
    wanted = OPACITY * color + (1.0 - OPACITY) * BACKGROUND
    return float(np.abs(picture[row, column] / 255.0 - wanted).max())


def shifts(picture: NDArray[np.uint8]) -> dict[str, float]:
    """Return how far the middle of each ball is from where the camera projects it [pixel]; NaN where it is missing."""
    found = blobs(picture)
    return {name: float(np.linalg.norm(found[name] - place)) for name, place in pixels().items()}


def pixels() -> dict[str, NDArray[np.float64]]:
    """Return where the picture must have the middle of each ball [pixel]."""
    return {name: camera().project([place])[0, :2] for name, (place, _) in BALLS.items()}


def blobs(picture: NDArray[np.uint8]) -> dict[str, NDArray[np.float64]]:
    """Return the centroid of each ball in a picture [pixel]; NaN for a ball that is not there.

    A pixel belongs to the ball whose hue it has within some 25 degrees; it weighs as much as it is saturated.

    Args:
        picture: Display-referred colour, ``(height, width, 3)``.
    """
    chroma = _chroma(picture.astype(np.float64) / 255.0)
    saturation = np.linalg.norm(chroma, axis=2)
    rows, columns = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    found = {}
    for name, (_, color) in BALLS.items():
        hue = _chroma(np.array(color))
        alike = chroma @ (hue / np.linalg.norm(hue)) > 0.9 * saturation
        weight = np.where(alike & (saturation > 0.3), saturation, 0.0)
        total = weight.sum()
        found[name] = np.array([(weight * each).sum() / total if total else np.nan for each in (columns, rows)])
    return found


def _chroma(color: NDArray[np.float64]) -> NDArray[np.float64]:
    return color - color.mean(axis=-1, keepdims=True)
