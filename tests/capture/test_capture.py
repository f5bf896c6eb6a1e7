"""Captures: poses and intrinsics come through exactly, images lazily, and every broken file in one line."""

import json

import numpy as np
import pytest
from PIL import Image as PillowImage

from beam_warp.capture.capture import Capture
from beam_warp.capture.undistort import Lens
from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError
from beam_warp.image.files import write_exr

INTRINSICS = {"w": 8, "h": 6, "fl_x": 10.0, "fl_y": 11.0, "cx": 4.0, "cy": 3.0}


def opengl_pose(eye):
    """Pose at ``eye``, looking along +y with z up: right +x, up +z, back -y."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float).T
    pose[:3, 3] = eye
    return pose.tolist()


def write_capture(folder, records, **content):
    (folder / "transforms.json").write_text(json.dumps({**INTRINSICS, "frames": records, **content}))


def record(**changes):
    fields = {"file_path": "images/a/0000.exr", "transform_matrix": opengl_pose((1, -2, 3)), "camera": "a", "frame": 0}
    return {**fields, **changes}


def captured(folder, records, **content):
    write_capture(folder, records, **content)
    return Capture.read(folder)


def photographs(*images):
    """A record of each image, of the cameras a, b, c and so on."""
    return [record(file_path=image, camera=name) for image, name in zip(images, "abcdef", strict=False)]


def test_pose_turns_from_opengl_to_opencv(tmp_path):
    camera = captured(tmp_path, [record()]).records[0].camera
    np.testing.assert_array_equal(camera.position, (1, -2, 3))
    np.testing.assert_array_equal(camera.forward, (0, 1, 0))
    x, y, depth = camera.project([[1.5, 0, 4]])[0]  # half a metre to the right, one up, two ahead
    assert (x, y, depth) == pytest.approx((4 + 10 * 0.25, 3 - 11 * 0.5, 2.0), abs=1e-12)


def test_fields_of_a_performance(tmp_path):
    truth = {"truth": "truth/a_0004.exr", "relit": {"studio": "truth/studio/a_0004.exr"}}
    own = {"fl_x": 20.0, "k1": 0.1, "p2": -0.02}
    (tmp_path / "environment.exr").touch()
    records = [record(split="train"), record(frame=4, time=0.5, split="test", **own, **truth)]
    write_capture(tmp_path, records, fps=24, environment="environment.exr")
    capture = Capture.read(tmp_path / "transforms.json")
    first, second = capture.records
    assert capture.frames == (0, 4)
    assert capture.splits == ("test", "train")
    assert capture.frames_per_second == 24.0
    assert capture.environment_path == tmp_path / "environment.exr"
    assert (first.name, first.camera.focal_x, first.is_distorted, first.truth_path) == ("a_0000", 10.0, False, None)
    assert (second.name, second.time, second.split) == ("a_0004", 0.5, "test")
    assert second.is_distorted
    assert second.undistortion.lens == Lens((0.1, 0, 0, 0, 0, -0.02))
    assert second.undistortion.photograph.focal_x == 20.0
    assert second.camera.focal_x == second.undistortion.pinhole.focal_x
    assert second.truth_path == tmp_path / "truth/a_0004.exr"
    assert second.relit_paths == {"studio": tmp_path / "truth/studio/a_0004.exr"}
    assert capture.select(split="test") == (second,)
    assert capture.select(frames=[0, 1]) == (first,)
    with pytest.raises(MissingFileError, match="truth must be given for a_0000, got none"):
        first.truth()


def test_plain_nerfstudio_file(tmp_path):
    entry = {"file_path": "./images/frame_01.png", "transform_matrix": opengl_pose((0, 0, 0))}
    other = "images/frame_02.png"
    capture = captured(tmp_path, [entry, {**entry, "file_path": other}], test_filenames=[other])
    assert [(r.name, r.split) for r in capture.records] == [
        ("images_frame_01_0000", "train"),
        ("images_frame_02_0000", "test"),
    ]
    assert capture.frames_per_second is None
    assert capture.environment_path is None


def test_images_are_read_when_asked_for(tmp_path):
    capture = captured(tmp_path, [record(), record(frame=1, file_path="images/a/0001.exr")])
    with pytest.raises(MissingFileError):
        capture.records[0].image()
    (tmp_path / "images/a").mkdir(parents=True)
    write_exr(tmp_path / "images/a/0000.exr", {name: np.full((6, 8), 0.5) for name in "RGBA"})
    assert capture.records[0].image().linear_rgba().shape == (6, 8, 4)
    write_exr(tmp_path / "images/a/0001.exr", {name: np.full((6, 9), 0.5) for name in "RGBA"})
    with pytest.raises(AssetFormatError, match=r"image must be 8 x 6 .* got 9 x 6 at .*0001\.exr"):
        capture.records[1].image()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transform_matrix": None}, "transform_matrix must be a 4 x 4 matrix of finite numbers, got nothing"),
        ({"transform_matrix": np.full((4, 4), np.nan).tolist()}, "of finite numbers, got"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "transform_matrix is no camera pose"),
        ({"file_path": 7}, "file_path must be a text, got 7"),
        ({"fl_x": "wide"}, r"fl_x must be a number in \[0.001, 1e\+09\], got 'wide'"),
        ({"cx": float("nan")}, "cx must be a number"),
        ({"w": 7.5}, "w must be an integer, got 7.5"),
        ({"frame": -1}, "frame must be a number"),
        ({"frame": True}, "frame must be a number"),
        ({"camera": "../../evil"}, "camera must be fit for a file name, got '../../evil'"),
        ({"relit": ["x"]}, "relit must be an object of file names"),
        ({"file_path": ".", "camera": None}, "camera must be a text, got"),
        ({"truth": 3}, "truth must be a text"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model must be one of OPENCV, PINHOLE, SIMPLE_PINHOLE"),
        ({"k2": float("nan")}, r"k2 must be a number in \[-1e\+06, 1e\+06\], got nan"),
        (
            {"k1": -20.0},
            "OPENCV has no pinhole at .* k1 must let the lens be inverted .*got -20, .*at 0.1291, at pixel",
        ),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "p1 and p2 must be 0 for OPENCV_FISHEYE"),
        ({"fl_y": None}, "fl_y must be a number in .*, got nothing at"),
        ({"camera": "a"}, r"got a_0000 at .*frames\[1\] and frames\[0\]"),
        ({"color_space": "adobe"}, "color_space must be one of srgb, linear, got 'adobe' at"),
    ],
)
def test_a_broken_record_is_named(tmp_path, changes, message):
    write_capture(tmp_path, [record(), record(**{"camera": "b", **changes})])
    with pytest.raises(AssetFormatError, match=message) as caught:
        Capture.read(tmp_path)
    assert f"{tmp_path / 'transforms.json'}, frames[1]" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"{", "capture must be JSON, got"),
        (b"\xff\xfe", "file must be text in UTF-8, got other bytes"),
        (b"[" * 100_000, "capture must be JSON, got"),
        (b"[]", r"capture must be a JSON object, got \[\]"),
        (b"{}", "frames must be a list of 1 to 4194304 records, got None"),
        (b'{"frames": [3]}', "record must be an object, got 3 at"),
        (b'{"frames": [{}], "test_filenames": 3}', "test_filenames must be a list of texts, got 3"),
    ],
)
def test_a_broken_file_is_one_line(tmp_path, text, message):
    (tmp_path / "transforms.json").write_bytes(text)
    with pytest.raises(AssetFormatError, match=message) as caught:
        Capture.read(tmp_path)
    assert "\n" not in str(caught.value)


def test_missing_files(tmp_path):
    with pytest.raises(MissingFileError, match=r"must be a folder with transforms\.json, a COLMAP model .*, got"):
        Capture.read(tmp_path)
    with pytest.raises(MissingFileError, match="capture must be a folder"):
        Capture.read(tmp_path / "nowhere")
    write_capture(tmp_path, [record()], environment="sky.exr")
    with pytest.raises(MissingFileError, match=r"environment must be a file, got .*sky\.exr"):
        Capture.read(tmp_path)


def test_a_bent_photograph_is_read_undistorted(tmp_path):
    (tmp_path / "images/a").mkdir(parents=True)
    ramp = np.broadcast_to(np.arange(8, dtype=np.float32), (6, 8))
    write_exr(tmp_path / "images/a/0000.exr", {"R": ramp, "G": ramp, "B": ramp, "depth": ramp})
    bent = captured(tmp_path, [record(truth="images/a/0000.exr")], k1=0.1, camera_model="RADIAL").records[0]
    assert bent.mask().all()
    image = bent.image()
    np.testing.assert_array_equal(image.channels["R"], bent.truth().channels["R"])
    # Pincushion: the corners of the photograph, pulled inwards, bound the image, whose focal length has grown.
    assert bent.camera.focal_x > 10.0
    assert bent.camera.focal_y / bent.camera.focal_x == pytest.approx(1.1, rel=1e-12)
    # Along the middle row the photograph shows the tangent t at 4 + 10 t (1 + 0.1 r^2), in a ramp of slope 1.
    x, y = (np.arange(8) + 0.5 - 4.0) / bent.camera.focal_x, -0.5 / bent.camera.focal_y
    expected = 4.0 + 10.0 * x * (1.0 + 0.1 * (x * x + y * y)) - 0.5
    np.testing.assert_allclose(image.channels["depth"][2, 1:-1], expected[1:-1], atol=8 * 2**-23)
    whole = Capture.read(tmp_path, keep=1.0).records[0]
    assert whole.camera.focal_x < bent.camera.focal_x
    with pytest.raises(InvalidOptionError, match="keep must be a number in"):
        Capture.read(tmp_path, keep=2.0)


def write_pair(folder, name, rgb, alpha=None):
    """A PNG of 8 x 6 of one colour; its alpha, if any, is straight."""
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    pixels = np.broadcast_to(np.asarray(rgb, np.uint8), (6, 8, 3))
    if alpha is not None:
        pixels = np.concatenate([pixels, np.broadcast_to(np.asarray(alpha, np.uint8), (6, 8))[..., None]], axis=-1)
    PillowImage.fromarray(np.ascontiguousarray(pixels)).save(folder / name)


def test_a_view_is_linear_and_premultiplied(tmp_path):
    half = np.full((6, 8), 0.5, np.float32)
    (tmp_path / "images").mkdir()
    write_exr(tmp_path / "images/x.exr", {"R": 0.5 * half, "G": half, "B": 4 * half, "A": half})
    write_pair(tmp_path, "images/y.png", (128, 0, 255), alpha=51)
    records = photographs("images/x.exr", "images/y.png", "images/y.png")
    records[2]["color_space"] = "linear"
    x, y, z = (row.view() for row in captured(tmp_path, records).records)
    np.testing.assert_array_equal(x.color[3, 4], (0.25, 0.5, 2.0))
    np.testing.assert_array_equal(x.alpha, half)
    np.testing.assert_allclose(y.color[0, 0], (0.2158605 * 0.2, 0, 0.2), atol=1e-6)  # sRGB 128 is 0.2158605 of white
    np.testing.assert_allclose(z.color[0, 0], (128 / 255 * 0.2, 0, 0.2), atol=1e-7)
    assert (y.name, y.camera.focal_x, y.color.dtype, y.alpha.dtype) == ("b_0000", 10.0, np.float32, np.float32)
    np.testing.assert_allclose(y.alpha, 0.2, atol=1e-7)


def test_masks_named_and_beside(tmp_path):
    mask = np.zeros((6, 8), np.uint8)
    mask[2:, :4] = 255
    mask[0, 0] = 51
    images = ("images/a/0.png", "images/b/0.png", "images/c.png", "images/d.png", "other/e.png", "images/f.png")
    for image in images:
        write_pair(tmp_path, image, (255, 255, 255), alpha=128 if image == images[-1] else None)
    for name in ("masks/a/0.png", "masks/b/0.png.png", "masks/other/e.png", "masks/f.png", "elsewhere.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        PillowImage.fromarray(mask).save(tmp_path / name)
    records = photographs(*images)
    records[2]["mask_path"] = "elsewhere.png"
    views = [row.view() for row in captured(tmp_path, records).records]
    expected = mask.astype(np.float32) / np.float32(255)
    for index in (0, 1, 2, 4):
        np.testing.assert_array_equal(views[index].alpha, expected)
        np.testing.assert_array_equal(views[index].color, np.repeat(expected[..., None], 3, axis=-1))
    assert views[3].alpha is None
    np.testing.assert_array_equal(views[3].color, np.ones((6, 8, 3)))
    np.testing.assert_allclose(views[5].alpha, expected * (128 / 255), atol=1e-7)


def test_a_mask_is_undistorted_with_its_image(tmp_path):
    ramp = np.tile(np.linspace(0.0, 255.0, 8).astype(np.uint8), (6, 1))
    write_pair(tmp_path, "images/a.png", (255, 255, 255))
    write_pair(tmp_path, "images/b.png", (255, 255, 255), alpha=ramp)
    (tmp_path / "masks").mkdir()
    PillowImage.fromarray(ramp).save(tmp_path / "masks/a.png")
    records = photographs("images/a.png", "images/b.png")
    masked, cut = (row.view() for row in captured(tmp_path, records, k1=0.1).records)
    np.testing.assert_array_equal(masked.alpha, cut.alpha)
    np.testing.assert_array_equal(masked.color, cut.color)


def test_views_that_cannot_be_read(tmp_path):
    (tmp_path / "images").mkdir()
    one = np.ones((6, 8), np.float32)
    bad = one.copy()
    bad[2, 3] = np.nan
    write_exr(tmp_path / "images/nan.exr", {"R": bad, "G": one, "B": one, "A": one})
    write_exr(tmp_path / "images/alpha.exr", {"R": one, "G": one, "B": one, "A": 2 * one})
    write_exr(tmp_path / "images/rounded.exr", {"R": one, "G": one, "B": one, "A": one * np.float32(1 + 2**-11)})
    write_pair(tmp_path, "images/good.png", (9, 9, 9))
    PillowImage.fromarray(np.zeros((6, 9), np.uint8)).save(tmp_path / "narrow.png")
    good = "images/good.png"
    records = photographs("images/nan.exr", "images/alpha.exr", good, good, "images/rounded.exr")
    records[2]["mask_path"], records[3]["mask_path"] = "narrow.png", "nowhere.png"
    nan, alpha, narrow, nowhere, rounded = captured(tmp_path, records).records
    with pytest.raises(AssetFormatError, match=r"image must be finite, got NaN or infinity in 1 pixels at .*nan\.exr"):
        nan.view()
    with pytest.raises(AssetFormatError, match=r"alpha must lie in \[0, 1\], got 2 to 2 at .*alpha\.exr"):
        alpha.view()
    with pytest.raises(AssetFormatError, match=r"mask must be 8 x 6 as the capture says, got 9 x 6 at .*narrow\.png"):
        narrow.view()
    with pytest.raises(MissingFileError, match=r"nowhere\.png"):
        nowhere.view()
    assert rounded.view().alpha.max() == 1.0


def test_sparse_points(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {n}\n" for n in "xyz")
    colors = "".join(f"property uchar {n}\n" for n in ("red", "green", "blue"))
    capture = captured(tmp_path, [record()], ply_file_path="points.ply")
    with pytest.raises(MissingFileError):
        capture.points()
    (tmp_path / "points.ply").write_text(f"{header}{colors}end_header\n1 2 3 255 0 128\n0 0 0.5 1 1 1\n")
    points = capture.points()
    np.testing.assert_array_equal(points.positions, [(1, 2, 3), (0, 0, 0.5)])
    np.testing.assert_allclose(points.colors[0], (1.0, 0.0, 0.2158605), atol=1e-6)
    (tmp_path / "points.ply").write_text(f"{header}end_header\n1 2 3\n0 0 0.5\n")
    assert capture.points().colors is None
    (tmp_path / "points.ply").write_text(f"{header}end_header\n1 2 3\n0 nan 0.5\n")
    with pytest.raises(AssetFormatError, match="points must be finite"):
        capture.points()
    assert captured(tmp_path, [record()]).points() is None
