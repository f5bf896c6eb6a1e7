"""COLMAP models: COLMAP's own formulas place the same points on the same pixels, in both forms, and cuts are named."""

import struct

import numpy as np
import pytest
from PIL import Image as PillowImage

from beam_warp.capture import colmap
from beam_warp.capture.capture import Capture
from beam_warp.errors import AssetFormatError
from beam_warp.image.color import srgb_to_linear

CAMERAS = {
    1: ("SIMPLE_PINHOLE", 40, 30, (50.0, 20.5, 14.25)),
    2: ("PINHOLE", 40, 30, (50.0, 55.0, 20.0, 15.0)),
    3: ("SIMPLE_RADIAL", 40, 30, (50.0, 20.0, 15.0, 0.02)),
    4: ("RADIAL", 40, 30, (50.0, 20.0, 15.0, 0.02, -0.01)),
    5: ("OPENCV", 40, 30, (50.0, 52.0, 20.0, 15.0, 0.02, -0.01, 0.003, -0.002)),
    6: ("OPENCV_FISHEYE", 40, 30, (50.0, 52.0, 20.0, 15.0, 0.02, -0.01, 0.003, -0.002)),
    7: ("SIMPLE_RADIAL_FISHEYE", 40, 30, (50.0, 20.0, 15.0, 0.02)),
    8: ("RADIAL_FISHEYE", 40, 30, (50.0, 20.0, 15.0, 0.02, 0.03)),
}
POINTS = [((0.5, -1.25, 3.0), (255, 128, 0), 2), ((1e-3, 7.0, -2.0), (1, 2, 3), 0)]
POINTS_2D = [(1.5, 2.5, -1), (3.0, 4.0, 17)]


def poses():
    """An image of each camera: a unit quaternion, w first, and a translation, rounded to what text keeps exactly."""
    numbers = np.random.default_rng(4).normal(size=(len(CAMERAS), 7))
    drawn = zip(CAMERAS, numbers[:, :4], numbers[:, 4:], strict=True)
    return [(q / np.linalg.norm(q), t, camera, f"cam {camera}/a.png") for camera, q, t in drawn]


def write_text(folder):
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list", *(f"{n} {m} {w} {h} {' '.join(map(repr, p))}" for n, (m, w, h, p) in CAMERAS.items())]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list"]
    for index, (q, t, camera, name) in enumerate(poses()):
        lines.append(f"{index + 1} {' '.join(repr(float(v)) for v in (*q, *t))} {camera} {name}")
        lines.append(" ".join(f"{x} {y} {p}" for x, y, p in POINTS_2D) if index % 2 else "")
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [
        f"{i} {' '.join(map(repr, xyz))} {' '.join(map(str, rgb))} 0.5 {'1 2 ' * track}"
        for i, (xyz, rgb, track) in enumerate(POINTS)
    ]
    (folder / "points3D.txt").write_text("\n".join(["# 3D points", *rows]) + "\n")


def binary_files():
    numbers = {name: number for name, (number, _) in colmap.MODELS.items()}
    cameras = struct.pack("<Q", len(CAMERAS))
    for number, (model, width, height, parameters) in CAMERAS.items():
        cameras += struct.pack(f"<IiQQ{len(parameters)}d", number, numbers[model], width, height, *parameters)
    images = struct.pack("<Q", len(poses()))
    for index, (q, t, camera, name) in enumerate(poses()):
        points = POINTS_2D if index % 2 else []
        images += struct.pack("<I7dI", index + 1, *q, *t, camera) + name.encode() + b"\0"
        images += struct.pack("<Q", len(points)) + b"".join(struct.pack("<ddq", *point) for point in points)
    points = struct.pack("<Q", len(POINTS))
    for index, (xyz, rgb, track) in enumerate(POINTS):
        points += struct.pack("<Q3d3BdQ", index, *xyz, *rgb, 0.5, track) + struct.pack("<II", 1, 2) * track
    return {"cameras.bin": cameras, "images.bin": images, "points3D.bin": points}


def write_binary(folder):
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in binary_files().items():
        (folder / name).write_bytes(content)


def rotation_of(q):
    """Rotate by the quaternion's action on the axes: v + 2 w (u x v) + 2 u x (u x v)."""
    w, u = q[0], q[1:]
    axes = np.eye(3)
    return (axes + 2 * w * np.cross(u, axes) + 2 * np.cross(u, np.cross(u, axes))).T


def colmap_project(model, parameters, local):
    """COLMAP's img_from_cam of each model, from its camera models' header."""
    u, v = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    values = list(parameters)
    fx = values.pop(0)
    fy = values.pop(0) if model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE") else fx
    cx, cy, *extra = values
    if model.endswith("FISHEYE"):
        radius = np.hypot(u, v)
        theta = np.arctan(radius)
        powers = sum(k * theta ** (2 * i) for i, k in enumerate(extra, 1))
        u, v = u * theta * (1 + powers) / radius, v * theta * (1 + powers) / radius
    elif extra:
        k1, k2, p1, p2 = (*extra, 0.0, 0.0, 0.0)[:4]
        r2 = u * u + v * v
        radial = k1 * r2 + k2 * r2 * r2
        du = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
        dv = v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
        u, v = u + du, v + dv
    return np.stack([fx * u + cx, fy * v + cy], axis=-1)


@pytest.mark.parametrize("place", ["", "sparse/0"])
def test_points_fall_where_colmap_puts_them(tmp_path, place):
    write_text(tmp_path / place)
    capture = Capture.read(tmp_path)
    assert [r.camera_name for r in capture.records] == [f"cam {n}_a" for n in CAMERAS]
    local = np.random.default_rng(1).uniform((-0.3, -0.2, 1.0), (0.3, 0.2, 3.0), size=(50, 3))
    for record, (q, t, number, _) in zip(capture.records, poses(), strict=True):
        model, _, _, parameters = CAMERAS[number]
        expected = colmap_project(model, parameters, local)
        world = (local - t) @ rotation_of(q)  # x_camera = R x_world + t
        pinhole = record.camera.project(world)
        np.testing.assert_allclose(pinhole[:, 2], local[:, 2], atol=1e-12)
        if record.undistortion is None:
            found = pinhole[:, :2]
        else:  # the pinhole's pixel, carried back through the lens to the photograph
            way = record.undistortion
            found = way.photograph.to_pixels(way.lens.distort(way.pinhole.to_tangents(pinhole[:, :2])))
        np.testing.assert_allclose(found, expected, atol=1e-9, err_msg=model)  # px: rounding of 50-odd px, a few steps


def test_binary_is_text(tmp_path):
    write_text(tmp_path / "t")
    write_binary(tmp_path / "b")
    text, binary = Capture.read(tmp_path / "t"), Capture.read(tmp_path / "b")
    for one, other in zip(text.records, binary.records, strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.camera.camera_to_world, other.camera.camera_to_world)
        assert one.undistortion == other.undistortion
        assert (one.camera.focal_x, one.camera.center_y) == (other.camera.focal_x, other.camera.center_y)
    for capture in (text, binary):
        points = capture.points()
        np.testing.assert_array_equal(points.positions, [xyz for xyz, _, _ in POINTS])
        np.testing.assert_allclose(points.colors, srgb_to_linear(np.array([rgb for _, rgb, _ in POINTS]) / 255.0), 1e-6)


def test_images_and_masks_are_found(tmp_path):
    write_binary(tmp_path / "sparse" / "0")
    for folder in ("images/cam 1", "masks/cam 1"):
        (tmp_path / folder).mkdir(parents=True)
    PillowImage.new("RGB", (40, 30), (255, 0, 0)).save(tmp_path / "images/cam 1/a.png")
    mask = PillowImage.new("L", (40, 30), 0)
    mask.paste(255, (10, 5, 20, 25))
    mask.save(tmp_path / "masks/cam 1/a.png.png")
    view = Capture.read(tmp_path).records[0].view()
    assert view.alpha.sum() == 200
    np.testing.assert_array_equal(view.color[10, 12], (1, 0, 0))


@pytest.fixture
def two_cameras(monkeypatch):
    """Fewer rows, for tests of every cut."""
    for number in set(CAMERAS) - {1, 5}:
        monkeypatch.delitem(CAMERAS, number)


@pytest.mark.usefixtures("two_cameras")
def test_every_cut_of_a_binary_file_is_one_error(tmp_path):
    write_binary(tmp_path)
    for name, content in binary_files().items():
        for length in range(len(content)):
            (tmp_path / name).write_bytes(content[:length])
            with pytest.raises(AssetFormatError, match=f"model must hold what it counts, got .* at .*{name}"):
                Capture.read(tmp_path).points()
        (tmp_path / name).write_bytes(content + b"\0")
        with pytest.raises(AssetFormatError, match="model must hold what it counts"):
            Capture.read(tmp_path).points()
        (tmp_path / name).write_bytes(content)
    assert len(Capture.read(tmp_path).records) == len(CAMERAS)


def test_huge_counts_ask_for_no_memory(tmp_path):
    write_binary(tmp_path)
    for name, content in binary_files().items():
        for count in (2**32, 2**63, 2**64 - 1):
            (tmp_path / name).write_bytes(struct.pack("<Q", count) + content[8:])
            with pytest.raises(AssetFormatError, match="model must hold what it counts"):
                Capture.read(tmp_path).points()
        (tmp_path / name).write_bytes(content)


@pytest.mark.usefixtures("two_cameras")
@pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "points3D.txt"])
def test_cuts_of_text_are_named_or_lose_nothing_they_have(tmp_path, name):
    """Text has no counts: a cut between rows cannot be seen; one within a row is an error unless it still reads."""
    write_text(tmp_path)
    content = (tmp_path / name).read_text()
    messages = []
    for length in range(len(content)):
        (tmp_path / name).write_text(content[:length])
        try:
            capture = Capture.read(tmp_path)
            points = capture.points()
        except AssetFormatError as error:
            messages.append(str(error))
        else:
            assert len(capture.records) <= len(CAMERAS)
            assert len(points.positions) <= len(POINTS)
    assert messages
    assert all(str(tmp_path) in message and "\n" not in message for message in messages)


@pytest.mark.parametrize(
    ("name", "line", "message"),
    [
        ("cameras.txt", "1 FULL_OPENCV 4 3 1 1 1 1", "camera model must be one of SIMPLE_PINHOLE.* got FULL_OPENCV"),
        ("cameras.txt", "1 PINHOLE 4 3 1 1 1", "PINHOLE must have the parameters fx fy cx cy, got 3 numbers"),
        ("cameras.txt", "1 PINHOLE 4 3 0 1 2 1.5", r"fx of a camera must be a number in \[0.001, 1e\+09\], got 0"),
        ("cameras.txt", "1 PINHOLE 0 3 1 1 2 1.5", r"size of a camera must be in \[1, 65536\] px, got 0 x 3"),
        ("cameras.txt", "1 PINHOLE wide 3 1 1 2 1.5", "line must have a whole number as word 3, got 'wide'"),
        ("cameras.txt", "1 RADIAL 4 3 1 2 1.5 -20 0", "RADIAL has no pinhole at .*line 1: k1 must let the lens"),
        ("images.txt", "1 1 0 0 0 0 0 0 9 a.png\n", "camera of an image must be one of cameras, got 9"),
        ("images.txt", "1 2 0 0 0 0 0 0 1 a.png\n", r"pose must be a unit quaternion .*, got \|q\| = 2 "),
        ("images.txt", "1 1 0 0 0 0 0 0 1 ../a.png\n", r"image name must be a path below images, got '\.\./a\.png'"),
        ("images.txt", "1 1 0 0 0 0 0 0 1\n", "image must have a name, got none at .*line 1"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n1 2\n", "points of an image must be triples, got 2 words"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 0 1 a.jpg\n", "image names must differ without"),
        ("images.txt", "# none\n", "images must be at least one, got none"),
        ("points3D.txt", "1 0 0 0 256 0 0 0.5", r"colour must be three bytes, got \[256, 0, 0\]"),
        ("points3D.txt", "1 0 inf 0 25 0 0 0.5", "points must be finite"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, name, line, message):
    write_text(tmp_path)
    (tmp_path / name).write_text(line)
    with pytest.raises(AssetFormatError, match=message):
        Capture.read(tmp_path).points()


def test_a_number_of_no_model_is_refused(tmp_path):
    write_binary(tmp_path)
    content = bytearray((tmp_path / "cameras.bin").read_bytes())
    for number, shown in ((6, "FULL_OPENCV"), (7, "FOV"), (99, "number 99"), (-1, "number -1")):
        content[12:16] = struct.pack("<i", number)
        (tmp_path / "cameras.bin").write_bytes(content)
        with pytest.raises(AssetFormatError, match=f"camera model must be one of .*, got {shown} at"):
            Capture.read(tmp_path)
