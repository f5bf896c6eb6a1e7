"""How many samples a pixel asks for: closed forms."""

import numpy as np
import pytest
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import (
    DISC_WIDTH,
    LEAST_SAMPLES,
    MOST_IMAGE_SAMPLES,
    MOST_SAMPLES,
    disc_spacing,
    sample_side,
    samples_of_fit,
    samples_of_images,
)
from beam_warp.world.camera import Camera

MIDDLE = np.zeros(3)
CAMERAS = [Camera.orbit((0, 0, 0), 2.5, turn, 10.0, width=64, height=48, vertical_fov=35.0) for turn in (0.0, 120.0)]


def test_two_samples_on_the_distance_of_neighbours():
    """Cameras 2.5 m away: a pixel is 2.5 / focal length wide."""
    pixel = 2.5 / CAMERAS[0].focal_x
    for spacing, side in ((3.0, 1), (2.0001, 1), (1.9, 2), (0.7, 3), (0.01, MOST_SAMPLES)):
        assert sample_side(CAMERAS, MIDDLE, spacing * pixel) == side


def test_cameras_that_look_away_take_one_sample():
    behind = CAMERAS[0].position - CAMERAS[0].forward
    assert sample_side(CAMERAS[:1], behind, 0.1) == 1


def ball_of_discs(spacing):
    """A ball whose neighbours are so many pixels of `CAMERAS` apart."""
    points, _ = sphere_points(400)
    spacing *= 2.5 / CAMERAS[0].focal_x
    ball = cloud_of(tiles(0.2 * points, points, spacing))
    ball = ball.with_arrays(scales=np.full((400, 3), DISC_WIDTH * spacing, np.float32))
    assert disc_spacing(ball) == pytest.approx(spacing)
    return ball


@pytest.mark.parametrize(("antialiased", "side"), [(True, 3), (False, 1)])
def test_only_antialiased_splats_are_sampled_finer_than_pixels(antialiased, side):
    options = RasterOptions(antialiased=antialiased, low_pass=0.1)
    assert samples_of_fit(ball_of_discs(0.7), CAMERAS, options) == side


def test_still_images_have_the_samples_of_the_fit_two_at_least_and_no_more_than_memory_allows():
    options = RasterOptions(antialiased=True, low_pass=0.1)
    for spacing, side in ((3.0, LEAST_SAMPLES), (0.7, 3), (0.1, MOST_SAMPLES)):
        assert samples_of_images(ball_of_discs(spacing), CAMERAS, options) == side
    assert samples_of_images(ball_of_discs(0.1), CAMERAS, RasterOptions()) == LEAST_SAMPLES
    assert samples_of_images(ball_of_discs(0.1), [], options) == LEAST_SAMPLES
    for factor, side in ((25, 4), (26, 3), (34, 3), (35, LEAST_SAMPLES), (200, LEAST_SAMPLES)):  # of 64 x 48 pixels
        large = CAMERAS[0].supersampled(factor)
        found = samples_of_images(ball_of_discs(0.1 / factor), [large], options)
        assert found == side
        assert found == LEAST_SAMPLES or large.width * large.height * found**2 <= MOST_IMAGE_SAMPLES


def test_nothing_to_draw_takes_one_sample():
    points, spacing = sphere_points(10)
    ball, options = cloud_of(tiles(points, points, spacing)), RasterOptions(antialiased=True)
    assert samples_of_fit(ball.select(np.arange(0)), CAMERAS, options) == 1
    assert samples_of_fit(ball, [], options) == 1
