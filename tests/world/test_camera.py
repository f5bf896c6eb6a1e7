"""Cameras: closed-form projections, the inverse of projection, and placement."""

import numpy as np
import pytest

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.world.camera import Camera
from beam_warp.world.framing import bulk

SIZE = {"width": 40, "height": 30, "vertical_fov": 60.0}

DOUBLE_ROUNDING = 1e-12
"""A dozen double-precision operations on numbers of order one to a hundred."""


def test_look_at_puts_right_on_the_right_and_up_on_top():
    camera = Camera.look_at((0, -2, 0), (0, 0, 0), **SIZE)
    x, y, depth = camera.project([[0, 0, 0], [0.1, 0, 0], [0, 0, 0.1]]).T
    np.testing.assert_allclose(x, [20, 20 + camera.focal_x * 0.05, 20], atol=DOUBLE_ROUNDING)
    np.testing.assert_allclose(y, [15, 15, 15 - camera.focal_y * 0.05], atol=DOUBLE_ROUNDING)
    np.testing.assert_allclose(depth, 2.0, atol=DOUBLE_ROUNDING)
    assert camera.focal_y == pytest.approx(15 / np.tan(np.radians(30)))


@pytest.mark.parametrize(
    ("azimuth", "elevation", "eye"),
    [(0, 0, (0, -3, 0)), (90, 0, (3, 0, 0)), (180, 0, (0, 3, 0)), (0, 90, (0, 0, 3)), (0, -90, (0, 0, -3))],
)
def test_orbit_positions_and_poles(azimuth, elevation, eye):
    camera = Camera.orbit((1, 2, 3), 3.0, azimuth, elevation, **SIZE)
    np.testing.assert_allclose(camera.position, np.add(eye, (1, 2, 3)), atol=DOUBLE_ROUNDING)
    np.testing.assert_allclose(camera.forward, -np.divide(eye, 3), atol=DOUBLE_ROUNDING)


def test_directions_invert_project(rng):
    camera = Camera.orbit((0, 0, 1), 4.0, 37.0, 21.0, width=7, height=5, vertical_fov=50.0)
    directions = camera.directions()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=DOUBLE_ROUNDING)
    reach = rng.uniform(0.1, 10.0, (5, 7, 1))
    pixels = camera.project((camera.position + reach * directions).reshape(-1, 3)).reshape(5, 7, 3)
    rows, columns = np.mgrid[:5, :7]
    np.testing.assert_allclose(pixels[..., 0], columns + 0.5, atol=DOUBLE_ROUNDING)
    np.testing.assert_allclose(pixels[..., 1], rows + 0.5, atol=DOUBLE_ROUNDING)


@pytest.mark.parametrize("factor", [1, 3])
def test_samples_of_a_pixel_lie_in_it(rng, factor):
    """A point's place grows with the image, and the samples of a pixel are spread evenly around its centre's ray."""
    camera = Camera(7, 5, 6.0, 5.0, 3.2, 2.4, Camera.orbit((0, 0, 1), 4.0, 37.0, 21.0, **SIZE).camera_to_world)
    fine = camera.supersampled(factor)
    assert (fine.width, fine.height) == (7 * factor, 5 * factor)
    points = rng.uniform(-1.0, 1.0, (20, 3))
    expected = camera.project(points) * (factor, factor, 1.0)
    np.testing.assert_allclose(fine.project(points), expected, atol=20 * DOUBLE_ROUNDING)

    def slopes(one):  # of every ray, on the image plane at depth 1
        local = one.directions() @ one.camera_to_world[:3, :3]
        return local[..., :2] / local[..., 2:]

    blocks = slopes(fine).reshape(5, factor, 7, factor, 2)
    np.testing.assert_allclose(blocks.mean(axis=(1, 3)), slopes(camera), atol=DOUBLE_ROUNDING)


def test_samples_out_of_range_are_refused():
    camera = Camera.orbit((0, 0, 0), 1.0, 0.0, 0.0, **SIZE)
    for factor in (0, -1, 1.5, True):
        with pytest.raises(InvalidOptionError, match="factor must be an integer"):
            camera.supersampled(factor)
    with pytest.raises(InvalidOptionError, match="width must be an integer"):
        camera.supersampled(10_000)


def test_points_behind_are_on_no_pixel():
    pixels = Camera.look_at((0, -2, 0), (0, 0, 0), **SIZE).project([[0, -3, 0], [0, -2, 0]])
    assert np.isnan(pixels[:, :2]).all()
    np.testing.assert_allclose(pixels[:, 2], [-1.0, 0.0], atol=DOUBLE_ROUNDING)


def test_world_to_camera_is_the_inverse():
    camera = Camera.orbit((1, 2, 3), 2.0, 200.0, -40.0, **SIZE)
    np.testing.assert_allclose(camera.world_to_camera @ camera.camera_to_world, np.eye(4), atol=DOUBLE_ROUNDING)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "width", "height"), [(33, 20, 64, 64), (190, -60, 200, 50), (0, 90, 50, 200)]
)
def test_frame_cloud_fills_the_image_to_its_margin(rng, azimuth, elevation, width, height):
    points = rng.uniform(-1, 1, (2000, 3)) * (0.3, 0.5, 0.9) + (5, -3, 1)
    camera = Camera.frame_cloud(points, azimuth=azimuth, elevation=elevation, width=width, height=height, margin=1.25)
    x, y, _ = camera.project(points).T
    used = max(np.abs(x / width * 2 - 1).max(), np.abs(y / height * 2 - 1).max())
    assert used == pytest.approx(1 / 1.25, abs=1e-9)


def test_frame_cloud_ignores_strays_but_keeps_thin_parts(rng):
    body = rng.uniform(-1, 1, (3000, 3)) * (0.3, 0.3, 0.8)
    finger = np.array([[0.42, 0.0, 0.0]])
    strays = rng.normal(0, 300.0, (15, 3))
    everything = np.concatenate([body, finger, strays])
    kept = bulk(everything)
    assert np.abs(kept).max() <= 1.2
    assert (kept == finger).all(axis=1).any()
    faint = np.concatenate([body, rng.normal(0, 300.0, (3000, 3))])
    assert np.abs(bulk(faint, np.repeat([1.0, 1e-3], 3000))).max() <= 1.2


def test_frame_cloud_of_one_point_and_of_invisible_points():
    assert np.isfinite(Camera.frame_cloud([[1, 2, 3]], width=8, height=8).camera_to_world).all()
    camera = Camera.frame_cloud([[0, 0, 0], [1, 0, 0]], [0, 0], width=8, height=8)
    np.testing.assert_allclose(camera.project([[0.5, 0, 0]])[0, :2], 4.0, atol=1e-9)


def test_errors_name_the_contract():
    def camera(**changes):
        fields = {"width": 4, "height": 4, "focal_x": 4, "focal_y": 4, "center_x": 2, "center_y": 2}
        return Camera(**{**fields, "camera_to_world": np.eye(4), **changes})

    with pytest.raises(InvalidOptionError, match=r"width must be an integer in \[1, 65536\], got 0"):
        camera(width=0)
    with pytest.raises(InvalidOptionError, match="width x height must be at most 268435456, got 65536 x 65536"):
        camera(width=65536, height=65536)
    with pytest.raises(InvalidOptionError, match="focal_y must be a number"):
        camera(focal_y=float("nan"))
    with pytest.raises(InvalidArrayError, match=r"must hold a rotation, got .* determinant -1"):
        camera(camera_to_world=np.diag([1, 1, -1, 1]))
    with pytest.raises(InvalidArrayError, match="Take out scale"):
        camera(camera_to_world=np.diag([2, 2, 2, 1]))
    with pytest.raises(InvalidArrayError, match="camera_to_world must be finite"):
        camera(camera_to_world=np.full((4, 4), np.nan))
    with pytest.raises(InvalidArrayError, match="row 0 0 0 1"):
        camera(camera_to_world=np.ones((4, 4)))
    with pytest.raises(InvalidOptionError, match="target must differ from eye"):
        Camera.look_at((1, 2, 3), (1, 2, 3), **SIZE)
    with pytest.raises(InvalidOptionError, match="up must not be parallel"):
        Camera.look_at((0, 0, 1), (0, 0, 0), **SIZE)
    with pytest.raises(InvalidOptionError, match="vertical_fov must be a number"):
        Camera.look_at((0, 1, 1), (0, 0, 0), width=4, height=4, vertical_fov=180.0)
    with pytest.raises(InvalidOptionError, match="elevation must be a number"):
        Camera.orbit((0, 0, 0), 1.0, 0.0, 91.0, **SIZE)
    with pytest.raises(InvalidArrayError, match="positions must hold at least one point"):
        Camera.frame_cloud(np.zeros((0, 3)), width=4, height=4)
