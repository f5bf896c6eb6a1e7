"""Projection matrices: they reproject, whatever their sign and scale, and what is no pinhole is refused."""

import json

import numpy as np
import pytest
from PIL import Image as PillowImage

from beam_warp.capture.capture import Capture
from beam_warp.capture.projections import decompose
from beam_warp.errors import AssetFormatError, MissingFileError
from beam_warp.world.camera import Camera

AROUND = np.linspace(0.0, 300.0, 6)


def rig():
    return [Camera.orbit((0.1, 0.2, 1.0), 4.0, a, 10.0, width=60, height=40, vertical_fov=40.0) for a in AROUND]


def matrix_of(camera, factor=1.0):
    k = np.array([[camera.focal_x, 0, camera.center_x], [0, camera.focal_y, camera.center_y], [0, 0, 1]])
    k[:2] *= factor
    return k @ camera.world_to_camera[:3]


def write(folder, matrices, size=(60, 40), **options):
    (folder / "images").mkdir(exist_ok=True)
    for index, matrix in enumerate(matrices):
        np.savetxt(folder / f"{index:03d}_P.txt", matrix, fmt="%.17g")
        PillowImage.new("RGB", size, (9, 9, 9)).save(folder / f"images/{index:03d}.png")
    if options:
        (folder / "capture.json").write_text(json.dumps(options))


def pixels(matrix, points):
    x = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ matrix.T
    return x[:, :2] / x[:, 2:]


@pytest.mark.parametrize("sign", [3.7, -1e-3])
def test_decomposition_gives_the_camera_back(sign):
    for camera in rig():
        part = decompose(sign * matrix_of(camera))
        np.testing.assert_allclose(part.position, camera.position, atol=1e-12)
        np.testing.assert_allclose(part.rotation, camera.camera_to_world[:3, :3].T, atol=1e-12)
        np.testing.assert_allclose(np.diag(part.intrinsics), (camera.focal_x, camera.focal_y, 1.0), rtol=1e-12)
        assert part.intrinsics[2, 2] == 1.0
        assert part.negated == (sign < 0)


@pytest.mark.parametrize(("scale", "sign"), [(1, 1), (1, -1), (3, -1), (8, 1)])
def test_the_scale_is_found_whatever_the_signs(tmp_path, scale, sign):
    """A sign of -1 is that of every other matrix."""
    write(tmp_path, [matrix_of(camera, scale) * sign**index for index, camera in enumerate(rig())])
    capture = Capture.read(tmp_path)
    assert len(capture.notes) == (scale != 1)
    for record, camera in zip(capture.records, rig(), strict=True):
        found = record.camera
        assert (found.width, found.height) == (60, 40)
        np.testing.assert_allclose(found.camera_to_world, camera.camera_to_world, atol=1e-12)
        assert (found.focal_x, found.center_x, found.center_y) == pytest.approx((camera.focal_x, 30.0, 20.0), rel=1e-12)


def test_the_scale_and_the_pixel_centres_are_stated(tmp_path):
    camera = rig()[0]
    matrix = matrix_of(camera, 2.5)
    matrix[:2] -= 0.5 * matrix[2:]  # the first pixel's centre is (0, 0)
    write(tmp_path, [matrix], scale=2.5, pixel_centers="integer", color_space="linear")
    record = Capture.read(tmp_path).records[0]
    assert (record.camera.center_x, record.camera.center_y) == pytest.approx((30.0, 20.0), rel=1e-12)
    assert record.view().color[0, 0, 0] == np.float32(9) / np.float32(255)


@pytest.mark.parametrize(
    ("pixels_by", "world_by"),
    [(np.eye(3), np.diag([1.0, 1, -1, 1])), (np.array([[1.0, 0, 0], [0, -1, 40], [0, 0, 1]]), np.eye(4))],
    ids=["mirrored world", "rows counted upwards"],
)
def test_mirrors_are_refused(tmp_path, pixels_by, world_by):
    write(tmp_path, [pixels_by @ matrix_of(camera) @ world_by for camera in rig()])
    with pytest.raises(AssetFormatError, match="matrices must be right-handed, got 6 of 6"):
        Capture.read(tmp_path)


@pytest.mark.parametrize(
    ("pixels_by", "message"),
    [
        ([[1, 0, 0], [2, 0, 0], [0, 0, 1]], "matrix must not be singular, got singular values .*000_P.txt"),
        ([[1, 0, 0], [0, 1, 0], [0, 0, 0]], "matrix must be finite with three rows that are not 0"),
        (
            [[1, 0.02, -0.4], [0, 1, 0], [0, 0, 1]],
            "matrix must have no skew, got .*, which moves pixels by up to 0.4, at .*000_P.txt",
        ),
    ],
)
def test_what_is_no_pinhole_is_refused(tmp_path, pixels_by, message):
    write(tmp_path, [pixels_by @ matrix_of(rig()[0])])
    with pytest.raises(AssetFormatError, match=message):
        Capture.read(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("000_P.txt", "a b c d e f g h i j k l", r"matrix must be 3 rows of 4 finite numbers, got .*000_P\.txt"),
        ("000_P.txt", "nan " * 12, r"matrix must be 3 rows of 4 finite numbers, got .*000_P\.txt"),
        ("000_P.txt", "1 " * 13, r"matrix must be 3 rows of 4 finite numbers, got .*000_P\.txt"),
        ("capture.json", "{", "options must be JSON"),
        ("capture.json", '{"scael": 2}', "options must be a JSON object of scale, pixel_centers, color_space"),
        ("capture.json", '{"scale": 0}', r"scale must be a number in \[0.001, 1000\], got 0"),
        ("capture.json", '{"pixel_centers": 3}', "pixel_centers must be half or integer"),
        ("capture.json", '{"color_space": "x"}', "color_space must be one of srgb, linear"),
    ],
)
def test_damaged_files_are_named(tmp_path, name, text, message):
    write(tmp_path, [matrix_of(rig()[0])])
    (tmp_path / name).write_text(text)
    with pytest.raises(AssetFormatError, match=message):
        Capture.read(tmp_path)


def test_a_scale_that_cannot_be_told_must_be_stated(tmp_path):
    write(tmp_path, [matrix_of(rig()[0], 20.0)])
    with pytest.raises(AssetFormatError, match="scale must be stated where principal points are not near the middle"):
        Capture.read(tmp_path)
    write(tmp_path, [matrix_of(rig()[0], 20.0)], scale=20)
    assert Capture.read(tmp_path).records[0].camera.center_x == pytest.approx(30.0, rel=1e-12)


def test_matrices_without_images(tmp_path):
    write(tmp_path, [matrix_of(camera) for camera in rig()])
    for index in range(1, 6):
        (tmp_path / f"images/{index:03d}.png").unlink()
    capture = Capture.read(tmp_path)
    assert [record.camera_name for record in capture.records] == ["000"]
    assert capture.notes == ("5 of 6 matrices have no image and are left out",)
    (tmp_path / "images/000.png").unlink()
    with pytest.raises(MissingFileError, match=r"images must lie in .*, got none for 6 matrices"):
        Capture.read(tmp_path)


def test_the_buddha(data_dir):
    folder = data_dir / "photos" / "buddha"
    capture = Capture.read(folder)
    assert len(capture.records) == 9
    assert len(capture.notes) == 2
    rng = np.random.default_rng(0)
    for record in capture.records:
        camera = record.camera
        assert (camera.width, camera.height) == (1368, 770)
        matrix = np.loadtxt(folder / f"{record.camera_name}_P.txt")
        depth = rng.uniform(1.0, 4.0, size=(100, 1))
        rays = camera.directions()[rng.integers(0, 770, 100), rng.integers(0, 1368, 100)]
        points = camera.position + depth * rays
        # A pixel of the halved photograph is two of the matrix' grid; its skew, below 1e-6 px, is left out.
        np.testing.assert_allclose(camera.project(points)[:, :2], 0.5 * pixels(matrix, points), atol=1e-6)
    view = capture.records[0].view()
    assert view.color.shape == (770, 1368, 3)
    assert view.alpha is None
