"""Views: what is refused, and cameras that follow their images through crops and reductions."""

import numpy as np
import pytest

from beam_warp.capture.mattes import Uncut
from beam_warp.capture.views import CapturedView
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.world.camera import Camera

CAMERA = Camera(7, 5, 6.0, 5.0, 3.2, 2.4, np.eye(4))


def view() -> CapturedView:
    rng = np.random.default_rng(0)
    color, alpha, doubt = (rng.random((5, 7, *more), np.float32) for more in ((3,), (), ()))
    uncut = Uncut(*rng.random((2, 5, 7, 3), np.float32))
    return CapturedView(name="a", camera=CAMERA, color=color, alpha=alpha, doubt=doubt, uncut=uncut)


def test_a_point_of_a_crop_is_the_same_pixel():
    given = view()
    part = given.cropped(2, 1, 4, 3)
    point = np.array([[0.1, 0.2, 1.5]])
    np.testing.assert_allclose(part.camera.project(point)[0, :2], given.camera.project(point)[0, :2] - (2, 1))
    np.testing.assert_array_equal(part.color, given.color[1:4, 2:6])
    np.testing.assert_array_equal(part.alpha, given.alpha[1:4, 2:6])
    np.testing.assert_array_equal(part.doubt, given.doubt[1:4, 2:6])
    np.testing.assert_array_equal(part.uncut.scene, given.uncut.scene[1:4, 2:6])


def test_a_reduction_is_the_mean_of_its_pixels_and_its_camera_sees_them():
    given = view()
    half = given.reduced(2)
    assert (half.camera.width, half.camera.height) == (3, 2)
    np.testing.assert_allclose(half.color[1, 2], given.color[2:4, 4:6].mean(axis=(0, 1)), rtol=1e-6)
    np.testing.assert_allclose(half.alpha[0, 1], given.alpha[0:2, 2:4].mean(), rtol=1e-6)
    np.testing.assert_allclose(half.doubt[0, 1], given.doubt[0:2, 2:4].mean(), rtol=1e-6)
    np.testing.assert_allclose(half.uncut.behind[1, 2], given.uncut.behind[2:4, 4:6].mean(axis=(0, 1)), rtol=1e-6)
    point = np.array([[0.3, -0.2, 2.0]])
    np.testing.assert_allclose(half.camera.project(point)[0, :2], given.camera.project(point)[0, :2] / 2.0)
    assert view().reduced(1).camera.width == 7


def test_gains_are_those_of_light_and_not_of_coverage():
    given, gains = view(), np.float32([2.0, 1.0, 0.5])
    found = given.brightened(gains)
    for one, other in (
        (found.color, given.color),
        *zip(vars(found.uncut).values(), vars(given.uncut).values(), strict=True),
    ):
        np.testing.assert_array_equal(one, other * gains)
    np.testing.assert_array_equal(found.alpha, given.alpha)


@pytest.mark.parametrize("place", [(0, 0, 8, 5), (-1, 0, 3, 3), (0, 0, 0, 2), (5, 3, 2, 3)])
def test_a_crop_outside_is_refused(place):
    with pytest.raises(InvalidArrayError, match="crop must lie in 7 x 5 pixels"):
        view().cropped(*place)


def test_what_is_wrong_is_refused():
    with pytest.raises(InvalidArrayError, match="color must"):
        CapturedView(name="a", camera=CAMERA, color=np.zeros((5, 6, 3)))
    with pytest.raises(InvalidArrayError, match="color"):
        CapturedView(name="a", camera=CAMERA, color=np.full((5, 7, 3), np.nan))
    with pytest.raises(InvalidArrayError, match="alpha"):
        CapturedView(name="a", camera=CAMERA, color=np.zeros((5, 7, 3)), alpha=np.full((5, 7), 1.5))
    with pytest.raises(InvalidArrayError, match="doubt"):
        CapturedView(name="a", camera=CAMERA, color=np.zeros((5, 7, 3)), doubt=np.full((5, 7), np.nan))
    with pytest.raises(InvalidArrayError, match="factor must leave a pixel"):
        view().reduced(6)
    with pytest.raises(InvalidOptionError, match="factor"):
        view().reduced(0)
