"""Corrections of cameras: what they mean, which records they touch, what is said of them, and their file."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.fake_steps import write_capture

from beam_warp.capture.capture import Capture
from beam_warp.capture.corrections import CameraCorrection, RigCorrection, move_between, moved_camera
from beam_warp.errors import AssetFormatError, InvalidArrayError
from beam_warp.world.camera import Camera

CAMERA = Camera.orbit((0.1, 0.2, 0.3), 2.5, 40.0, 10.0, width=40, height=30, vertical_fov=40.0)


def rig(**changes):
    cameras = (
        CameraCorrection("c0", (0.01, 0.0, 0.0), (0.0, 0.02, 0.0), 0.003, 0.8, 0.1, 30.0),
        CameraCorrection("c1", pixels=0.2, error=0.1, psnr=29.0),
        CameraCorrection("c2", pixels=5.0, error=2.0, psnr=12.0, is_used=False),
    )
    facts = {"is_applied": True, "confidence": 40.0, "kinds": ("turn", "focal"), "world": tuple(np.arange(7.0))}
    return RigCorrection(**{"cameras": cameras, **facts, **changes})


def test_a_point_is_turned_and_shifted_in_the_camera_s_axes(rng):
    move = np.array([0.02, -0.03, 0.01, 0.1, -0.2, 0.05, 0.1, 0.02, -0.01])
    points = rng.uniform(-0.5, 0.5, (20, 3))
    local = (points - CAMERA.position) @ CAMERA.camera_to_world[:3, :3]
    moved = Rotation.from_rotvec(move[:3]).apply(local) + move[3:6]
    focal = CAMERA.focal_x * np.exp(0.1)
    middle = np.array([CAMERA.center_x, CAMERA.center_y]) + CAMERA.focal_x * move[7:9]
    expected = focal * moved[:, :2] / moved[:, 2:] + middle
    np.testing.assert_allclose(moved_camera(CAMERA, move).project(points)[:, :2], expected, atol=1e-9)


def test_moves_are_found_again(rng):
    move = rng.normal(0.0, 0.05, 9)
    np.testing.assert_allclose(move_between(CAMERA, moved_camera(CAMERA, move)), move, atol=1e-12)


def test_only_training_records_of_cameras_in_use_are_corrected(tmp_path):
    capture = Capture.read(write_capture(tmp_path / "ball", (0, 1)))
    first = capture.records[0]
    records = (*capture.records, replace(first, split="test"), replace(first, camera_name="other"))
    found = rig().corrected(records)
    assert {record.camera_name for record in found} == {"c0", "c1", "other"}
    for record in found:
        source = next(r for r in records if (r.name, r.split) == (record.name, record.split))
        is_moved = record.camera_name == "c0" and record.split == "train"
        same = np.array_equal(record.camera.camera_to_world, source.camera.camera_to_world)
        assert same != is_moved or record.camera_name == "c1"
        if is_moved:
            assert record.camera.focal_x == pytest.approx(np.exp(0.003) * source.camera.focal_x)
    kept = rig(is_applied=False).capture(capture).records
    assert [record.camera for record in kept] == [r.camera for r in capture.records if r.camera_name != "c2"]


def test_findings_name_who_was_moved_and_who_is_left_out():
    moved, left_out = rig().findings()
    assert (moved.code, moved.where) == ("camera-poses", "c0")
    assert "at most 0.80, and were moved to agree" in moved.what
    assert (left_out.code, left_out.where) == ("camera-contradicts", "c2")
    assert not RigCorrection(rig().cameras[:2], is_applied=False, confidence=1.0).findings()


def test_files_come_back_and_damage_is_named(tmp_path):
    assert RigCorrection.read(tmp_path) is None
    path = tmp_path / RigCorrection.FILE
    path.write_text(json.dumps(rig().as_dict()))
    assert RigCorrection.read(tmp_path) == rig()
    for content in (
        "[]",
        '{"cameras": 3}',
        '{"cameras": [{"camera": "a", "turn": [1, 2]}]}',
        '{"cameras": [], "x": 1}',
    ):
        path.write_text(content)
        with pytest.raises(AssetFormatError, match=r"corrections of cameras must be as beam reconstruct wrote them"):
            RigCorrection.read(tmp_path)
    with pytest.raises(InvalidArrayError, match="turn must be finite"):
        CameraCorrection("a", turn=(np.nan, 0.0, 0.0))
