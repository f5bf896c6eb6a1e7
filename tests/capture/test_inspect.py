"""Inspection: every fault that is put into a sound capture is found, by its code, and nothing in a sound one."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.sound_capture import CAMERAS, FLIP, FRAMES, HEIGHT, TARGET, WIDTH, rewrite, rig, save, write_sound

from beam_warp.capture.capture import Capture
from beam_warp.capture.inspect import inspect_capture, require_reconstructable
from beam_warp.capture.rigs import MIN_SPREAD, facing_share, frustum_volume, likely_mistakes, meeting_point, seen_by
from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError
from beam_warp.world.camera import Camera


def found(folder):
    """The findings about a capture by their codes; of several with one code, the first."""
    return {f.code: f for f in reversed(inspect_capture(Capture.read(folder)).findings)}


def ready_cameras(folder, **options):
    """Names of the cameras whose images are fit for reconstruction."""
    records = require_reconstructable(Capture.read(folder), **options).capture.records
    return {record.camera_name for record in records}


def cameras_but(left_out):
    return {f"c{k:02d}" for k in range(CAMERAS) if k != left_out}


def test_a_sound_capture_has_no_findings(tmp_path):
    write_sound(tmp_path)
    report = inspect_capture(Capture.read(tmp_path))
    assert report.findings == ()
    assert report.is_reconstructable
    assert len(report.glimpses) == CAMERAS * FRAMES
    assert json.loads(json.dumps(report.as_dict(), allow_nan=False))["cameras"] == CAMERAS
    low, high = report.volume
    assert (low < TARGET).all()
    assert (high > TARGET).all()
    ready = require_reconstructable(Capture.read(tmp_path))
    assert ready.fallbacks == ()
    assert len(ready.capture.records) == CAMERAS * FRAMES


def test_a_capture_of_the_demo_has_no_findings(data_dir):
    report = inspect_capture(Capture.read(data_dir / "captures" / "walker"), max_images=28)
    assert report.findings == ()
    low, high = report.volume
    mesh = np.load(data_dir / "captures" / "walker" / "truth" / "mesh_0000.npz")["vertices"]
    assert (low < mesh.min(axis=0)).all()
    assert (high > mesh.max(axis=0)).all()


def test_the_buddha_has_no_masks(data_dir):
    report = inspect_capture(Capture.read(data_dir / "photos" / "buddha"), max_images=3)
    assert {finding.code for finding in report.findings} == {"no-coverage", "assumed"}
    assert report.is_reconstructable


def changed(channels, change):
    def edit(pixels):
        pixels[..., channels] = change(pixels[..., channels])

    return edit


COLOR, ALPHA = slice(0, 3), 3
blacken = changed(COLOR, np.zeros_like)
darken = changed(COLOR, lambda color: color // 2)  # of sRGB: 2.3 stops


@pytest.mark.parametrize(
    ("change", "pattern", "code", "severity"),
    [
        (lambda pixels: pixels[..., :3], "*/*", "no-coverage", "warning"),
        (lambda pixels: pixels[..., :3], "c03/*", "some-coverage", "warning"),
        (blacken, "c03/*", "black-image", "warning"),
        (blacken, "*/*", "black-image", "error"),
        (changed(ALPHA, np.zeros_like), "c03/0001.png", "empty-mask", "warning"),
        (changed(ALPHA, np.zeros_like), "*/*", "empty-mask", "error"),
        (changed(ALPHA, lambda _: 255), "c03/*", "full-mask", "warning"),
        (changed(ALPHA, lambda _: 255), "*/*", "full-mask", "error"),
        (changed(ALPHA, lambda alpha: alpha // 255), "c03/*", "mask-range", "error"),
        (changed(ALPHA, lambda alpha: 255 - alpha), "c03/*", "inverted-mask", "warning"),
        (darken, "c03/*", "camera-exposure", "warning"),
        (darken, "c03/0001.png", "frame-exposure", "warning"),
        (darken, "*/0002.png", "frame-exposure", "warning"),
        (lambda pixels: pixels[:20], "c03/*", "image-size", "error"),
    ],
)
def test_faults_of_images(tmp_path, change, pattern, code, severity):
    write_sound(tmp_path, rig(8))
    paths = sorted((tmp_path / "images").glob(pattern))
    for path in paths:
        rewrite(path, change)
    bare = set()
    if severity == "error" and len(paths) == 8 * FRAMES and code != "full-mask":
        bare = {"frame-without-images"}
    findings = found(tmp_path)
    assert findings.keys() == {code} | bare
    assert findings[code].severity == severity
    if pattern.startswith("c03"):
        assert "c03" in findings[code].where
    if severity == "error":
        with pytest.raises(AssetFormatError, match="capture must be fit for reconstruction, got"):
            require_reconstructable(Capture.read(tmp_path))
    else:
        assert require_reconstructable(Capture.read(tmp_path)).fallbacks[0].code == code


def test_hard_light_accuses_no_camera(tmp_path):
    """A pillar in the sun shows four faces in turn, which differ by up to 1.8 stops: no camera is wrong."""
    write_sound(tmp_path, rig(16))
    for number in range(16):
        for path in (tmp_path / f"images/c{number:02d}").iterdir():
            rewrite(path, changed(COLOR, lambda color, stops=0.6 * (number % 4): color * 2.0 ** (-stops / 2.2)))
    assert found(tmp_path) == {}


def test_one_of_three_cameras_is_named(tmp_path):
    write_sound(tmp_path, rig(3))
    for path in (tmp_path / "images/c01").iterdir():
        rewrite(path, darken)
    assert "c01" in found(tmp_path)["camera-exposure"].where


def test_a_black_camera_is_left_out_in_all_its_frames(tmp_path):
    write_sound(tmp_path)
    for path in (tmp_path / "images/c03").iterdir():
        rewrite(path, blacken)
    assert ready_cameras(tmp_path, max_images=CAMERAS) == cameras_but(3)  # one frame is looked at


def test_missing_and_damaged_images_are_left_out(tmp_path):
    write_sound(tmp_path)
    (tmp_path / "images/c01/0001.png").unlink()
    content = (tmp_path / "images/c02/0000.png").read_bytes()
    (tmp_path / "images/c02/0000.png").write_bytes(content[: len(content) // 2])
    (tmp_path / "images/c04/0002.png").write_bytes(b"not an image")
    report = inspect_capture(Capture.read(tmp_path))
    assert {f.code for f in report.findings} == {"missing-image", "damaged-image"}
    assert {f.severity for f in report.findings} == {"warning"}
    assert report.left_out == {"c01_0001", "c02_0000", "c04_0002"}
    assert len(require_reconstructable(Capture.read(tmp_path)).capture.records) == CAMERAS * FRAMES - 3


def test_too_many_missing_images_are_an_error(tmp_path):
    write_sound(tmp_path)
    for path in sorted((tmp_path / "images").glob("*/0001.png"))[1:]:
        path.unlink()
    assert found(tmp_path).keys() == {"missing-image", "frame-without-images"}
    with pytest.raises(MissingFileError, match=r"1 frame of 3 is left with under 2 images at frames 1\. Copy"):
        require_reconstructable(Capture.read(tmp_path))
    for path in (tmp_path / "images").glob("*/*"):
        path.unlink()
    with pytest.raises(MissingFileError, match=r"36 images of 36 are missing .* There are 1 more errors"):
        require_reconstructable(Capture.read(tmp_path))


def change_poses(content, change, only=None):
    for record in content["frames"]:
        if only is None or record["camera"] == only:
            record["transform_matrix"] = change(np.array(record["transform_matrix"])).tolist()


def test_swapped_axes_are_an_error(tmp_path):
    content = write_sound(tmp_path)
    change_poses(content, np.linalg.inv)
    save(tmp_path, content)
    finding = found(tmp_path)["swapped-axes"]
    assert finding.severity == "error"
    assert "world-to-camera poses in OpenGL axes were given" in finding.remedy
    with pytest.raises(AssetFormatError, match="must be fit for reconstruction, got the cameras do not look at"):
        require_reconstructable(Capture.read(tmp_path))


def test_cameras_around_that_look_outwards_have_no_overlap(tmp_path):
    outward = []
    for k in range(CAMERAS):
        angle, height = 2 * np.pi * k / CAMERAS, 0.2 * (k % 3)
        target = (2 * np.cos(angle), 2 * np.sin(angle), height)
        outward.append(Camera.look_at((0.0, 0.0, height), target, width=WIDTH, height=HEIGHT, vertical_fov=20.0))
    write_sound(tmp_path, outward, frames=1)
    assert "no-overlap" in found(tmp_path)


def test_one_stray_camera_is_left_out(tmp_path):
    content = write_sound(tmp_path)
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])  # about its own up: it looks away
    change_poses(content, lambda pose: pose @ turn, only="c05")
    save(tmp_path, content)
    assert found(tmp_path).keys() == {"sees-nothing"}
    assert ready_cameras(tmp_path) == cameras_but(5)


def lose_a_mask(content):
    content["frames"][4]["mask_path"] = "masks/none.png"


def lose_an_image(content):
    content["frames"] = [r for r in content["frames"] if (r["camera"], r["frame"]) != ("c04", 1)]


def turn_up_to_y(content):
    turn = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    change_poses(content, lambda pose: turn @ pose)


def leave_nothing_to_train_from(content):
    for record in content["frames"]:
        record["split"] = "test"


def lens_of_c05(**fields):
    def change(content):
        for record in content["frames"]:
            if record["camera"] == "c05":
                record.update(fields)

    return change


@pytest.mark.parametrize(
    ("change", "codes", "where", "said"),
    [
        (lose_a_mask, ["missing-mask"], "c01_0001", "(c01_0001)"),
        (lose_an_image, ["frame-lacks-cameras"], "frames 1", "frame 1 without c04"),
        (turn_up_to_y, ["up-direction"], "", "up is about +y"),
        (leave_nothing_to_train_from, ["too-few-cameras"], "", "0 cameras to train from"),
        (lens_of_c05(fl_x=1e6, fl_y=1e6), ["singular-intrinsics", "sees-nothing"], "c05", "fields of view"),
        (lens_of_c05(cx=4000.0), ["principal-point", "sees-nothing"], "c05", "outside of the images"),
        (lens_of_c05(fl_y=90.0), ["uneven-pixels"], "c05", "focal lengths along x and y differ"),
    ],
)
def test_faults_of_records(tmp_path, change, codes, where, said):
    content = write_sound(tmp_path)
    change(content)
    save(tmp_path, content)
    report = inspect_capture(Capture.read(tmp_path))
    assert [finding.code for finding in report.findings] == codes
    assert report.findings[0].where == where
    assert said in str(report.findings[0])
    lost = {"missing-mask": {"c01_0001"}, "sees-nothing": {f"c05_{frame:04d}" for frame in range(FRAMES)}}
    assert report.left_out == set().union(*(lost.get(code, set()) for code in codes))


def test_the_same_pose_twice(tmp_path):
    cameras = rig()
    cameras[7] = cameras[2]
    write_sound(tmp_path, cameras)
    assert {code: f.where for code, f in found(tmp_path).items()} == {"duplicate-pose": "c02 = c07"}


def test_gaps_in_the_frames(tmp_path):
    content = write_sound(tmp_path, rig(8), frames=5)
    for numbers, missing in (((0, 2, 4), None), ((0, 1, 4), "2 frames"), ((0, 2, 3), "1 frame "), ((1, 3), None)):
        save(tmp_path, {**content, "frames": [r for r in content["frames"] if r["frame"] in numbers]})
        findings = found(tmp_path)
        assert findings.keys() == ({"missing-frames"} if missing else set())
        assert missing is None or findings["missing-frames"].what.startswith(missing)


@pytest.mark.parametrize(("count", "code"), [(1, "too-few-cameras"), (4, "few-cameras")])
def test_few_cameras(tmp_path, count, code):
    write_sound(tmp_path, rig(12)[:count])
    assert found(tmp_path).keys() == {code}


def test_few_images_are_read_of_a_long_capture(tmp_path):
    write_sound(tmp_path, rig(8), frames=9)
    report = inspect_capture(Capture.read(tmp_path), max_images=24)
    assert sorted({glimpse.record.frame for glimpse in report.glimpses}) == [0, 4, 8]
    assert len(inspect_capture(Capture.read(tmp_path), max_images=5).glimpses) == 5
    with pytest.raises(InvalidOptionError, match="max_images must be an integer"):
        inspect_capture(Capture.read(tmp_path), max_images=0)


def test_axes_meet_at_the_target_despite_strays():
    cameras = rig()
    poses = np.array([camera.camera_to_world for camera in cameras])
    np.testing.assert_allclose(meeting_point(poses), TARGET, atol=1e-9)
    assert facing_share(cameras) == 1.0
    assert likely_mistakes(cameras) == ()
    poses[3, :3, 3] += (5.0, 1.0, -2.0)
    np.testing.assert_allclose(meeting_point(poses), TARGET, atol=1e-2)  # its weight is 1e-3 of the others'
    parallel = np.tile(np.eye(4), (4, 1, 1))
    parallel[:, 0, 3] = range(4)
    assert meeting_point(parallel) is None
    tilt = 2.0 * np.arcsin(np.sqrt(MIN_SPREAD))  # two axes this far apart: the eigenvalue is sin^2 of half of it
    for factor, meets in ((0.9, False), (1.1, True)):
        two = np.tile(np.eye(4), (2, 1, 1))
        half = 0.5 * factor * tilt
        for pose, angle in zip(two, (-half, half), strict=True):
            pose[:3, 2] = (np.sin(angle), 0.0, np.cos(angle))
        assert (meeting_point(two) is not None) == meets


@pytest.mark.parametrize("name", ["walker", "runner"])
def test_mistakes_in_the_poses_of_the_captures_are_told_apart(data_dir, name):
    records = Capture.read(data_dir / "captures" / name).select(split="train", frames=[0])
    cameras = [record.camera for record in records]
    wrongs = {
        "OpenCV poses were given as OpenGL's": lambda q: q @ FLIP,
        "world-to-camera poses in OpenGL axes": lambda q: np.linalg.inv(q @ FLIP) @ FLIP,
        "world-to-camera poses in OpenCV axes": lambda q: np.linalg.inv(q) @ FLIP,
        "world-to-camera poses were given": np.linalg.inv,
    }
    assert likely_mistakes(cameras) == ()
    for told, wrong in wrongs.items():
        turned = [replace(camera, camera_to_world=wrong(camera.camera_to_world)) for camera in cameras]
        assert [mistake[: len(told)] for mistake in likely_mistakes(turned)] == [told]


def test_the_common_volume_is_what_is_seen():
    cameras = rig()
    low, high = frustum_volume(cameras)
    points = np.random.default_rng(0).uniform(TARGET - 3, TARGET + 3, size=(4000, 3))
    counts = np.sum([seen_by(camera, points) for camera in cameras], axis=0)
    inside = ((points >= low) & (points <= high)).all(axis=1)
    assert inside[counts >= 0.75 * CAMERAS].mean() > 0.99
    stray = [*cameras, Camera.look_at((50, 0, 0), (60, 0, 0), width=40, height=30, vertical_fov=20.0)]
    again = frustum_volume(stray)
    np.testing.assert_allclose(again, (low, high), atol=0.1 * float((high - low).max()))
    with pytest.raises(InvalidOptionError, match="cameras must be at least 2"):
        frustum_volume(cameras[:1])
    with pytest.raises(InvalidOptionError, match="cameras must have a volume in common"):
        frustum_volume([cameras[0], stray[-1]])


def test_parallel_cameras_have_a_volume_in_front():
    ends = [((0.1 * k, 0.0, 1.0), (0.1 * k, 5.0, 1.0)) for k in range(4)]
    cameras = [Camera.look_at(eye, target, width=40, height=30, vertical_fov=40.0) for eye, target in ends]
    low, high = frustum_volume(cameras)
    assert high[1] > 0.5
    assert low[1] > 0.0
    assert low[2] < 1.0 < high[2]
