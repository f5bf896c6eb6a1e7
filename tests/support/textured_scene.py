"""Photographs without masks whose depth is known: a ball on a floor within a shell, all with a texture of noise."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from beam_warp.capture.views import CapturedView
from beam_warp.image.color import srgb_to_linear
from beam_warp.image.metrics import block_means
from beam_warp.world.camera import Camera

RADIUS = 0.5
FLOOR = -0.5
SHELL = 5.0
SUPERSAMPLES = 3
GRAIN = 12.0
"""Lattice points of the noise on a metre."""


@dataclass(frozen=True, eq=False)
class KnownView:
    """A photograph, and what its pixels' middles see."""

    view: CapturedView
    depth: np.ndarray
    normals: np.ndarray
    is_ball: np.ndarray


def arc_cameras(count, *, size=(72, 48), distance=2.0, step=15.0):
    """Cameras side by side on an arc that look down at the ball."""
    return [
        Camera.orbit((0.0, 0.0, 0.0), distance, step * i, 35.0, width=size[0], height=size[1], vertical_fov=45.0)
        for i in range(count)
    ]


def known_view(name, camera, *, exposure=1.0):
    """Photograph the scene."""
    fine = camera.supersampled(SUPERSAMPLES)
    display = _display_colors(camera.position + fine.directions() * _hits(fine)[0][..., None])
    light = srgb_to_linear(display)
    color = np.stack([block_means(light[..., k], SUPERSAMPLES) for k in range(3)], axis=-1)
    rays = camera.directions()
    distance, is_ball = _hits(camera)
    places = camera.position + rays * distance[..., None]
    normals = np.where(is_ball[..., None], places / RADIUS, np.array([0.0, 0.0, 1.0]))
    view = CapturedView(name=name, camera=camera, color=(exposure * color).astype(np.float32))
    return KnownView(view, distance * (rays @ camera.forward), normals, is_ball)


def _hits(camera):
    """Distances along unit rays, and whether each is the ball's."""
    rays, origin = camera.directions(), camera.position
    along = -rays @ origin
    square = RADIUS**2 - (origin @ origin - along**2)
    ball = np.where(square > 0.0, along - np.sqrt(np.maximum(square, 0.0)), np.inf)
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 2] < 0.0, (FLOOR - origin[2]) / rays[..., 2], np.inf)
    shell = along + np.sqrt(SHELL**2 - (origin @ origin - along**2))
    return np.minimum(np.minimum(ball, floor), shell), ball < np.minimum(floor, shell)


def _display_colors(points):
    """Noise between lattice points of a cube of random colours that repeats."""
    lattice = np.random.default_rng(7).uniform(0.1, 0.9, (24, 24, 24, 3))
    where = np.moveaxis(points, -1, 0) * GRAIN
    return np.stack([map_coordinates(lattice[..., k], where, order=1, mode="grid-wrap") for k in range(3)], axis=-1)
