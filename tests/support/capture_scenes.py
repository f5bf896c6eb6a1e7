"""Views of a ball whose masks are known exactly: what tests of reconstruction's first steps start from."""

from functools import cache

import numpy as np
from support.shapes import sphere_points

from beam_warp.capture.views import CapturedView
from beam_warp.image.metrics import block_means
from beam_warp.world.camera import Camera

SUPERSAMPLES = 4
"""Along each side of a pixel: coverage is a box filter's to a quarter of a row, so that edges are right to 1/8."""

EDGE_ERROR = 0.25
"""Pixels that the place of half coverage, linear between centres, is off the edge: at 45 degrees, where coverage is
least linear in the distance, 0.1, of the samples 0.125, of the circle's curvature less than the rest."""


def cameras_around(count, *, distance=2.0, size=64, fov=40.0, center=(0.0, 0.0, 0.0)):
    """Cameras evenly around a point that look at it."""
    middle = np.asarray(center, float)
    lens = {"width": size, "height": size, "vertical_fov": fov}
    directions, _ = sphere_points(count)
    ups = ((0.0, 0.0, 1.0) if abs(d[2]) < 0.9 else (1.0, 0.0, 0.0) for d in directions)
    return [Camera.look_at(middle + distance * d, middle, up=up, **lens) for d, up in zip(directions, ups, strict=True)]


def ball_view(name, camera, *, radius=0.5, center=(0.0, 0.0, 0.0), color=(0.6, 0.3, 0.1)):
    """One view of a ball of one colour: its rays pass the centre at no more than the radius."""
    to_center = np.asarray(center, float) - camera.position
    along = camera.supersampled(SUPERSAMPLES).directions() @ to_center
    hit = (along > 0.0) & ((to_center**2).sum() - along**2 <= radius**2)
    alpha = block_means(hit.astype(np.float32), SUPERSAMPLES)
    return CapturedView(name=name, camera=camera, color=alpha[..., None] * np.float32(color), alpha=alpha)


@cache
def ball_views(count, **options):
    """Views of a ball of radius 0.5 around the origin."""
    return tuple(ball_view(f"view_{i}", camera) for i, camera in enumerate(cameras_around(count, **options)))
