"""Previews: which cameras, what a panel shows, and pictures of any size."""

import numpy as np
import pytest
from support.shapes import cloud_of, colored, sphere_points, tiles

from beam_warp.capture.views import CapturedView
from beam_warp.image.panels import BACKGROUND, MARGIN, TITLE_HEIGHT
from beam_warp.raster.gbuffer import rasterize
from beam_warp.reconstruction.preview import (
    AMPLIFICATION,
    FEWEST_ROWS,
    MOST_ROWS,
    opposite_cameras,
    reconstruction_preview,
)
from beam_warp.world.camera import Camera

GRAY = round(255 * BACKGROUND)


def camera(azimuth=0.0, size=40):
    return Camera.orbit((0, 0, 0), 4.0, azimuth, 0.0, width=size + size // 2, height=size, vertical_fov=40.0)


@pytest.fixture(scope="module")
def ball():
    points, spacing = sphere_points(400)
    return colored(cloud_of(tiles(points, points, spacing)), np.full((400, 3), 0.36))


def photograph(ball, where, *, factor=1.0, alpha=True):
    """Return a photograph of the ball, its colours times a factor."""
    buffer = rasterize(ball, where, channels=("radiance",), device="cpu")
    color = buffer.channels["radiance"] * buffer.alpha[..., None] * np.float32(factor)
    covered = np.clip(buffer.alpha, 0.0, 1.0)
    return CapturedView(name="view", camera=where, color=color, alpha=covered if alpha else None)


def panels_of(cloud, views, columns=4, **options):
    """The preview of a cloud beside photographs, cut into its panels, row by row."""
    picture = reconstruction_preview(cloud, views, device="cpu", **options)
    height, width = (picture.shape[0] - MARGIN) // len(views), (picture.shape[1] - MARGIN) // columns
    rows = [picture[row * height :][MARGIN + TITLE_HEIGHT : height] for row in range(len(views))]
    return [[row[:, column * width :][:, MARGIN:width] for column in range(columns)] for row in rows]


def test_cameras_are_far_apart():
    cameras = [camera(azimuth) for azimuth in (0.0, 60.0, 170.0, 240.0)]
    assert opposite_cameras(cameras) == [0, 2]
    assert opposite_cameras(cameras[:1]) == [0]
    assert opposite_cameras([]) == []


def test_a_perfect_render_differs_nowhere(ball):
    views = [photograph(ball, camera(azimuth)) for azimuth in (0.0, 180.0)]
    rows = panels_of(ball, views)
    for shown, render, difference, normals in rows:
        assert np.abs(shown.astype(int) - render).max() <= 1  # divided by alpha and multiplied again: one rounding
        assert difference.max() <= AMPLIFICATION
        assert (shown[0, 0] == GRAY).all()
        assert normals[normals.shape[0] // 2, normals.shape[1] // 2].min() < 160
    front, back = (int(side[side.shape[0] // 2, side.shape[1] // 2, 1]) for *_, side in rows)
    assert abs(front - back) > 230  # the surfaces that are seen face away from each other


def test_differences_are_brightened(ball):
    [(shown, render, difference, _)] = panels_of(ball, [photograph(ball, camera(), factor=1.1)])
    middle = (slice(shown.shape[0] // 2, shown.shape[0] // 2 + 1), shown.shape[1] // 2)
    expected = np.abs(shown[middle].astype(int) - render[middle]) * AMPLIFICATION
    assert (difference[middle] == np.minimum(expected, 255)).all()
    assert difference[middle].min() > 0


def test_without_coverage_only_the_subject_is_compared(ball):
    [(shown, _, difference, _)] = panels_of(ball, [photograph(ball, camera(), alpha=False)])
    assert (shown[0, 0] == 0).all()  # the photograph as it is
    assert (difference[0, 0] == 0).all()


def test_a_mesh_is_one_more_column(ball):
    shading = np.full((40, 60, 3), 77, np.uint8)
    [(*_, mesh)] = panels_of(ball, [photograph(ball, camera())], columns=5, shadings=[shading])
    assert (mesh == 77).all()


@pytest.mark.parametrize("size", [40, 300, 560])
def test_panels_fit_any_size(ball, size):
    [(shown, *_)] = panels_of(ball, [photograph(ball, camera(size=size))])
    assert FEWEST_ROWS <= len(shown) <= max(MOST_ROWS, 2 * FEWEST_ROWS)
