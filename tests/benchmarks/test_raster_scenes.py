"""The raster benchmark's scenes are what they say, and its peer is given the same splats and camera."""

import importlib.util

import numpy as np
import pytest
from gsplat_peer import GsplatPeer, GsplatUnavailableError, arguments
from raster_scenes import BUMP, bumpy_sphere, cube, figure
from tracing_scenes import FLATNESS

from beam_warp.world.quaternions import rotation_matrices

pytestmark = pytest.mark.slow  # a benchmark's own tests


def sphere(rng, count):
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_normals_and_area_are_those_of_the_surface(rng):
    directions = sphere(rng, 400)
    surface = bumpy_sphere(directions)
    np.testing.assert_allclose((surface.points * directions).sum(axis=1), np.linalg.norm(surface.points, axis=1))
    across = np.cross(directions, sphere(rng, 400))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(directions, across)
    step, tangents = 1e-5, []
    for offset in (across, along):  # central differences: rounding 1e-16 / step, truncation step^2 times 9^3 BUMP
        ends = [bumpy_sphere(np.cos(step) * directions + sign * np.sin(step) * offset).points for sign in (1, -1)]
        tangents.append((ends[0] - ends[1]) / (2.0 * step))
    crossed = np.cross(*tangents)
    np.testing.assert_allclose(crossed, surface.densities[:, None] * surface.normals, atol=1e-7)


def test_the_figure_covers_a_quarter_of_the_image_with_flat_discs():
    scene = figure(3000, 192, 108)
    cloud = scene.cloud
    assert len(cloud) == 3000
    assert (scene.camera.width, scene.camera.height) == (192, 108)
    np.testing.assert_allclose(rotation_matrices(cloud.orientations)[:, :, 2], cloud.normals, atol=1e-6)
    assert np.median(cloud.scales[:, 2] / cloud.scales[:, 0]) == pytest.approx(FLATNESS, rel=0.05)
    # Evenly over the surface: each side of it has half of its area, to 4 standard deviations and what bumps move.
    assert np.abs((cloud.positions > 0).mean(axis=0) - 0.5).max() < 4 * 0.5 / np.sqrt(3000) + 0.01
    # The silhouette of a sphere of the largest radius bounds what is covered, that of the smallest is covered.
    focal, distance = scene.camera.focal_y, np.linalg.norm(scene.camera.position)
    low, high = (np.pi * focal**2 * r**2 / (distance**2 - r**2) / (192 * 108) for r in (1 - BUMP, 1 + BUMP))
    assert low < 0.26 < high
    pixels = scene.camera.project(cloud.positions)
    assert ((pixels[:, :2] > 0) & (pixels[:, :2] < (192, 108))).all()


def test_the_cube_fills_the_image():
    scene = cube(2000, 160, 90)
    corners = np.array([[0, 0], [160, 0], [0, 90], [160, 90]])
    for x, y in corners:
        tangent = (np.array([x, y]) - (80, 45)) / scene.camera.focal_x
        assert (np.abs(tangent) * (np.linalg.norm(scene.camera.position) - 0.5) < 0.5).all()


@pytest.mark.parametrize("make", [figure, cube])
def test_scenes_belong_to_their_seed(make):
    first, again, other = make(500, 64, 36), make(500, 64, 36), make(500, 64, 36, seed=1)
    for name, array in first.cloud.arrays().items():
        np.testing.assert_array_equal(array, again.cloud.arrays()[name])
    assert not np.array_equal(first.cloud.positions, other.cloud.positions)
    values = first.values()
    assert values.shape == (500, 11)
    assert values.dtype == np.float32
    assert first.cloud.opacities.max() <= 0.98
    assert first.cloud.is_relightable


def test_the_peer_is_given_the_same_splats_and_camera():
    scene = figure(200, 192, 108)
    given = arguments(scene.cloud, scene.camera, scene.values())
    homogeneous = np.concatenate([given["means"], np.ones((200, 1))], axis=1)
    seen = homogeneous @ given["viewmats"][0].astype(np.float64).T
    pixels = seen[:, :3] @ given["Ks"][0].astype(np.float64).T
    expected = scene.camera.project(scene.cloud.positions)
    # World to camera in float32: 6e-8 of 4 m, seen at 171 pixels a metre and less.
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], expected[:, :2], atol=1e-3)
    np.testing.assert_allclose(pixels[:, 2], expected[:, 2], atol=1e-5)
    w, x, y, z = given["quats"].T.astype(np.float64)  # the third column of the matrix of a quaternion
    third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    np.testing.assert_allclose(third, scene.cloud.normals, atol=1e-6)
    assert all(array.dtype == np.float32 and array.flags.c_contiguous for array in given.values())


def test_what_is_missing_is_said():
    if importlib.util.find_spec("torch") is not None and importlib.util.find_spec("gsplat") is not None:
        pytest.skip("torch and gsplat are here")
    scene = figure(10, 16, 9)
    with pytest.raises(GsplatUnavailableError, match="torch and gsplat must be importable"):
        GsplatPeer(scene.cloud, scene.camera, scene.values())
