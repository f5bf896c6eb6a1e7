"""What `beam stability` reconstructs with: reports understood, and two cases through the real steps."""

import json

import numpy as np
import pytest
from support.fake_steps import FakeSteps

from beam_warp.stability.capture_cases.cameras import wrong_exposure
from beam_warp.stability.capture_cases.case import Detection, in_words
from beam_warp.stability.capture_cases.studio import StressStudio
from beam_warp.stability.capture_cases.subjects import object_appears
from beam_warp.stability.captures import run_capture_case
from beam_warp.stability.reconstruct import StressEffort, detections_in, done_in, reconstructing

pytestmark = pytest.mark.slow  # a stability suite

CAMERAS = ("train_0", "train_1", "train_2")

SMALL = StressEffort(
    size=64, camera_count=6, frame_count=2, samples=4, gaussian_count=500, fit=(20, 10), levels=(5, 5, 5), refinement=5
)


def finding(code, what="", where=""):
    return {"severity": "warning", "code": code, "what": what, "where": where, "remedy": ""}


def report_of(frames, *, findings=(), cameras=3):
    entries = [{"frame": number, "lost": lost, "findings": list(said)} for number, (lost, said) in enumerate(frames)]
    return {"input": {"cameras": cameras}, "findings": list(findings), "frames": entries}


class TestReports:
    def test_findings_of_the_capture_and_of_frames(self):
        off = finding("camera-exposure", "a view is off", "train_1_0000")
        found = detections_in(
            report_of([("", [off]), ("", [])], findings=[finding("black-image", "1 image", "train_2_0000")]), CAMERAS
        )
        assert found == (Detection("black-image", "train_2"), Detection("camera-exposure", "train_1", 0))

    def test_a_view_that_shows_a_loss_is_not_to_blame(self):
        lost = finding("new-surface", "tracking is lost: 9 % of the subject are not covered in train_1_0001")
        report = report_of([("", []), ("9 % of ...", [lost])])
        assert detections_in(report, CAMERAS) == (Detection("new-surface", frame=1),)
        assert done_in(report, CAMERAS) == ("new key frame at 1",)

    def test_a_loss_without_a_finding_is_one(self):
        assert detections_in(report_of([("", []), ("dark", [])]), CAMERAS) == (Detection("tracking-lost", frame=1),)

    def test_what_was_done(self):
        report = report_of(
            [("", [finding("camera-exposure", where="train_0_0000")]), ("", [finding("few-cameras")])],
            findings=[finding("frame-lacks-cameras")],
            cameras=2,
        )
        assert done_in(report, CAMERAS) == (
            "1 of 3 cameras left out",
            "exposure matched",
            "reconstructed from the cameras that there are",
            "told",
        )
        assert done_in(report_of([("", [])], findings=[finding("camera-exposure")]), CAMERAS) == ()  # used as it is

    def test_detections_in_words_are_summed_up(self):
        found = [Detection("a", "x", 1), Detection("a", "x", 0), Detection("b"), Detection("b", frame=2)]
        assert in_words(found) == ("a of x in frame 0, 1", "b in frame 2")
        assert in_words([]) == ()


def test_changed_images_reach_the_steps(tiny_capture, tmp_path):
    """Records that change their images as they are read are read so by the reconstruction as well."""

    class Looking(FakeSteps):
        def begin(self, views, progress):
            seen.append([float(view.color.sum()) for view in views])
            return super().begin(views, progress)

    studio = StressStudio(tmp_path, given=tiny_capture, device="cpu")
    first = []
    for capture in (studio.brief(), wrong_exposure.build(studio).capture):
        seen = []
        reconstructing(Looking(), tmp_path)(capture)
        first.append(seen[0])
    sound, wrong = np.array(first)
    np.testing.assert_allclose(wrong / sound, [1.0, 1.0, 1.0, 2.0, 1.0, 1.0], rtol=1e-6)
    assert list(tmp_path.iterdir()) == []  # nothing is left behind


@pytest.mark.slow
class TestRealSteps:
    def test_an_exposure_is_detected_and_undone(self, tiny_capture, tmp_path):
        studio = StressStudio(tmp_path, given=tiny_capture, device="cpu")
        outcome = run_capture_case(reconstructing(SMALL.steps("cpu"), tmp_path), studio, wrong_exposure)
        assert outcome.passed, outcome.faults
        assert "camera-exposure of train_03 in frame 0, 1" in outcome.detected
        assert "exposure matched" in outcome.done
        assert (outcome.size, outcome.gaussians) == ((64, 64), 500)
        json.dumps(outcome.as_dict())

    def test_an_object_that_appears_begins_a_segment(self, tmp_path):
        studio = SMALL.studio(tmp_path, "cpu")
        outcome = run_capture_case(reconstructing(SMALL.steps("cpu"), tmp_path), studio, object_appears)
        assert outcome.passed, outcome.faults
        assert "new-surface in frame 1" in outcome.detected
        assert outcome.key_frames == (0, 1)
        assert "new key frame at 1" in outcome.done
