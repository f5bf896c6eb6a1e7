"""What the camera sees of the environment: the right part of it, turned the right way, without flicker."""

import numpy as np
import pytest

from beam_warp.render.backdrops import Backdrop
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap, texel_directions


def camera(target, side=9, fov=10.0, up=(0.0, 0.0, 1.0)):
    eye = (0.5, -3.0, 2.0)
    return Camera.look_at(eye, np.add(eye, target), up=up, width=side, height=side, vertical_fov=fov)


@pytest.fixture
def smooth():
    """Radiance that is linear in the direction: 2 + d."""
    return EnvironmentMap((2.0 + texel_directions(128, 256)).astype(np.float32))


@pytest.mark.parametrize("target", [(1, 0, 0), (0, 1, 0), (-1, 0.01, 0), (-1, -0.01, 0.2), (0.3, -0.5, -0.8)])
@pytest.mark.parametrize("rotation", [0.0, 33.0, -90.0, 400.0])
def test_it_shows_what_is_in_that_direction(smooth, target, rotation):
    view = camera(target)
    cosine, sine = np.cos(np.radians(rotation)), np.sin(np.radians(rotation))
    x, y, z = np.moveaxis(view.directions(), -1, 0)
    turned = np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1)
    # Between texels of pi / 128 a sine is off its chord by (pi / 128)^2 / 8 in each of two axes.
    np.testing.assert_allclose(Backdrop(smooth).seen(view, rotation), 2.0 + turned, atol=2 * (np.pi / 128) ** 2 / 8)


def test_rotation_by_whole_texels_is_that_of_the_map(rng):
    light = EnvironmentMap(rng.uniform(0.0, 9.0, (16, 32, 3)).astype(np.float32))
    view = camera((0.2, 0.9, 0.1), fov=60.0)
    turned = Backdrop(light.rotated(45.0)).seen(view)
    np.testing.assert_allclose(Backdrop(light).seen(view, 45.0), turned, rtol=1e-5)  # of float32, and angles of float64


def test_what_stays_is_looked_at_once(smooth):
    backdrop = Backdrop(smooth)
    first = backdrop.seen(camera((1, 0, 0)), 10.0)
    assert backdrop.seen(camera((1, 0, 0)), 10.0) is first
    assert not np.array_equal(backdrop.seen(camera((1, 0, 0)), 11.0), first)
    assert not np.array_equal(backdrop.seen(camera((1, 0, 0.1)), 10.0), first)


def test_poles_are_whole(smooth):
    seen = Backdrop(smooth).seen(camera((0, 0, 1), up=(0, 1, 0), fov=2.0))
    # The corner of the image is 1.42 degrees from the pole, beyond the half texel in which the map stays as it is.
    np.testing.assert_allclose(seen, np.broadcast_to([2.0, 2.0, 3.0], seen.shape), atol=np.sin(np.radians(1.42)))


def test_a_sun_smaller_than_a_pixel_keeps_its_light_while_it_moves():
    radiance = np.zeros((512, 1024, 3), np.float32)
    radiance[255, 511] = 1000.0
    backdrop = Backdrop(EnvironmentMap(radiance))
    view = camera((1, 0, 0), side=16, fov=60.0)
    sums = [backdrop.seen(view, rotation)[..., 0].sum() for rotation in np.linspace(-2.0, 2.0, 21)]
    solid_angle = backdrop._environment.solid_angles()[255, 0]
    pixel = (1.0 / view.focal_x) ** 2
    # Bilinear weights sum to 1 over pixels of a texel's size; 44 rows stand for the 43.5 that pixels are high and wide.
    np.testing.assert_allclose(sums, 1000.0 * solid_angle / pixel, rtol=(44 / 43.5) ** 2 - 1.0)
