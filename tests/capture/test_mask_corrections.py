"""Corrections of masks: the records they make, what is said of them, and their file."""

import json

import numpy as np
import pytest
from support.fake_steps import write_capture

from beam_warp.capture.capture import Capture
from beam_warp.capture.cutouts import taken_in
from beam_warp.capture.mask_corrections import MaskCorrections
from beam_warp.capture.mattes import MaskOffset
from beam_warp.errors import AssetFormatError

FOUND = MaskCorrections({"c1": MaskOffset(-1.0, 0.1), "c2": MaskOffset(0.8, 0.1)})


def test_records_are_read_with_moved_masks(tmp_path):
    capture = Capture.read(write_capture(tmp_path / "ball", (0, 1)))
    for record, given in zip(FOUND.capture(capture).records, capture.records, strict=True):
        view, stated = record.view(), given.view()
        expected = taken_in(stated, {"c0": 0.0, "c1": -1.0, "c2": 0.8}[record.camera_name])
        np.testing.assert_array_equal(view.alpha, expected.alpha)
        np.testing.assert_array_equal(view.color, expected.color)
        assert (view.alpha.sum() > stated.alpha.sum()) == (record.camera_name == "c1")
    assert MaskCorrections().capture(capture) is capture


def test_the_finding_names_the_cameras():
    (finding,) = FOUND.findings()
    assert (finding.code, finding.where) == ("mask-offset", "c1 -1.0 ± 0.1, c2 +0.8 ± 0.1")
    assert not MaskCorrections().findings()


def test_files_come_back_and_damage_is_named(tmp_path):
    assert MaskCorrections.read(tmp_path) is None
    path = tmp_path / MaskCorrections.FILE
    path.write_text(json.dumps({"key": "k", **FOUND.as_dict()}))
    assert MaskCorrections.read(tmp_path) == FOUND
    for content in ("[]", '{"cameras": 3}', '{"cameras": {"a": {"pixels": 1e9, "error": 0}}}', '{"cameras": {"a": 1}}'):
        path.write_text(content)
        with pytest.raises(AssetFormatError, match="corrections of masks must be as beam reconstruct wrote them"):
            MaskCorrections.read(tmp_path)
