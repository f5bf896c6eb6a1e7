"""Exposures of cameras: which records they touch, what a view is then, what is said of them, and their file."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t
from support.fake_steps import write_capture

from beam_warp.capture.capture import Capture
from beam_warp.capture.exposures import CameraExposure, RigExposures, scale_errors
from beam_warp.errors import AssetFormatError

FOUND = RigExposures(
    (
        CameraExposure("c0", 0.2, (0.03, -0.01, -0.02), (1.25, 1.0, 0.8)),
        CameraExposure("c1", -0.1, (0.0, 0.01, -0.01), (0.9, 0.9, 0.9)),
        CameraExposure("c2"),
    ),
    exposure_error=0.03,
    balance_error=0.004,
    exposure_undone=True,
    balance_undone=True,
)


def test_views_of_training_records_are_without_the_gains(tmp_path):
    capture = Capture.read(write_capture(tmp_path / "ball", (0,)))
    records = (*capture.records, replace(capture.records[0], split="test"))
    corrected = FOUND.corrected(records)
    for before, after in zip(records, corrected, strict=True):
        gains = {"c0": (1.25, 1.0, 0.8), "c1": (0.9, 0.9, 0.9), "c2": (1.0, 1.0, 1.0)}[before.camera_name]
        gains = gains if before.split == "train" else (1.0, 1.0, 1.0)
        np.testing.assert_allclose(after.view().color * gains, before.view().color, rtol=1e-6)
        np.testing.assert_array_equal(after.view().alpha, before.view().alpha)
    assert corrected[2] is records[2]
    assert corrected[3] is records[3]


def test_vignetting_is_undone_off_the_axis_alone(tmp_path):
    record = Capture.read(write_capture(tmp_path / "ball", (0,))).records[0]
    camera, found = record.camera, RigExposures((), falloff=4.0, falloff_error=0.5, falloff_undone=True)
    x = (np.arange(camera.width) + 0.5 - camera.center_x) / camera.focal_x
    y = (np.arange(camera.height) + 0.5 - camera.center_y) / camera.focal_y
    lens = (1.0 + x**2 + y[:, None] ** 2)[..., None] ** -2.0  # the fourth power of the cosine
    view = found.put_right(record).view()
    np.testing.assert_allclose(view.color * lens, record.view().color, rtol=1e-5)
    np.testing.assert_array_equal(view.alpha, record.view().alpha)
    assert "by the cosine's power of 4.0 ± 0.5, 22 % at 20°" in found.findings()[0].what
    assert replace(found, falloff_undone=False).put_right(record) is record


def test_findings_say_how_much_and_who_most():
    exposure, balance = FOUND.findings()
    assert (exposure.code, exposure.where) == ("camera-exposure", "c0")
    assert "differ by 0.13 ± 0.03 stops, at most +0.20" in exposure.what
    assert (balance.code, balance.where) == ("camera-white-balance", "c0")
    assert "differ by 1.3 ± 0.4 %, at most 3.0 %" in balance.what
    assert replace(FOUND, exposure_undone=False, balance_undone=False).findings() == []


def test_files_come_back_and_damage_is_named(tmp_path):
    assert RigExposures.read(tmp_path) is None
    path = tmp_path / RigExposures.FILE
    path.write_text(json.dumps({"key": "k", **FOUND.as_dict()}))
    assert RigExposures.read(tmp_path) == FOUND
    older = {name: value for name, value in FOUND.as_dict().items() if not name.startswith("falloff")}
    path.write_text(json.dumps({"key": "k", **older}))
    assert RigExposures.read(tmp_path) == FOUND
    wrong_gain = FOUND.as_dict() | {"cameras": [{"camera": "a", "gains": [0.0, 1.0, 1.0]}]}
    for content in ("[]", '{"cameras": 3}', '{"cameras": []}', json.dumps(wrong_gain)):
        path.write_text(content)
        with pytest.raises(AssetFormatError, match="exposures of cameras must be as beam reconstruct wrote them"):
            RigExposures.read(tmp_path)


def test_the_scale_s_error_is_that_of_a_light_measured_by_one_more_camera(rng):
    """Errors over stated ones are those of Student's distribution, with as many degrees as V cameras have."""
    count, cameras = 4000, 8
    logs = 0.1 * rng.normal(size=(count, cameras + 1, 3))
    gains = np.exp(logs[:, :cameras] - logs[:, :cameras].mean(axis=1, keepdims=True))
    off = logs[:, cameras] - logs[:, :cameras].mean(axis=1)
    z = np.abs(off / np.array([scale_errors(rig) for rig in gains]))
    for sigma in (1.0, 2.0):
        part = 2.0 * t(cameras - 1).cdf(sigma) - 1.0
        assert abs((z < sigma).mean() - part) < 4.0 * np.sqrt(part * (1.0 - part) / z.size)
    assert scale_errors(np.ones((5, 3))) == scale_errors(gains[0, :1]) == (0.0, 0.0, 0.0)
