"""Reports: what made a result, and that a changed algorithm never continues old frames."""

from support.changed_code import changed_code
from support.fake_steps import FakeSteps, write_capture

from beam_warp.capture.capture import Capture
from beam_warp.digests import code_digest
from beam_warp.jobs.report import versions
from beam_warp.reconstruction.job import reconstruct


def test_versions_state_the_code():
    assert versions()["code"] == code_digest()
    with changed_code():
        assert versions()["code"] == "another algorithm"
    assert versions()["code"] != "another algorithm"


def test_reconstruction_continues_with_the_same_code_only(tmp_path):
    capture = Capture.read(write_capture(tmp_path / "capture", [0, 1]))
    reconstruct(capture, tmp_path / "out", FakeSteps())
    with changed_code():
        assert reconstruct(capture, tmp_path / "out", FakeSteps()).report["resumed_frames"] == 0
        assert reconstruct(capture, tmp_path / "out", FakeSteps()).report["resumed_frames"] == 2
