"""Findings about a frame: each is met and missed once, with tracking made up."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from beam_warp.jobs.listeners import no_progress
from beam_warp.reconstruction import steps
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.initial import initial_gaussians
from beam_warp.reconstruction.steps import DOUBTFUL_TEAR, MOST_UNPAIRED, STRUCTURE_REACH, FitAndTrack

STEPS = FitAndTrack(fitting=FitOptions(gaussian_count=200, color_iterations=1, normal_iterations=0), device="cpu")


@pytest.fixture(scope="module")
def views(tiny_capture):
    return [record.view() for record in tiny_capture.select(split="train", frames=[0])]


@pytest.fixture(scope="module")
def cloud(views):
    return initial_gaussians(views, 200, device="cpu")


@pytest.fixture
def advanced(monkeypatch, views, cloud):
    """A function that returns the report of a frame of which tracking makes what it is called with."""

    def report_of(before=0.0, after=0.0, gap=0.0, lost="", start="continued", torn=0.0):
        joints, baseline = cloud.positions[:3], np.array([30.0, 0.01])
        track = SimpleNamespace(cloud=cloud, joints=joints, previous_joints=joints - before, baseline=baseline)
        track.normals = lambda: np.zeros((len(cloud), 3))
        following = SimpleNamespace(cloud=cloud, joints=joints + after)
        report = {"psnr": 30.0, "gap": gap, "torn": torn, "start": start, "lost": lost}
        monkeypatch.setattr(steps, "advance_track", lambda *args, **kwargs: (following, report))
        return STEPS.advance(track, views, no_progress)[1]

    return report_of


class TestTrackedFrames:
    def test_nothing_is_said_of_a_sound_one(self, advanced):
        report = advanced()
        assert report["findings"] == []
        assert report["motion"] == {"median": 0.0, "largest": 0.0}
        assert report["surprise"] == 0.0
        assert report["exposure_spread"] < 0.3

    def test_motion_that_goes_on_is_no_surprise(self, advanced):
        step = np.float32([0.0, 0.0, 1.0])  # a metre a frame: a third of the image
        report = advanced(before=step, after=step)
        assert report["motion"]["median"] > 15.0
        assert report["surprise"] < 1e-3  # rounding of positions to float32, of some metres
        assert report["findings"] == []

    def test_motion_beyond_the_reach_of_tracking_is_said(self, advanced):
        """Reach: some pixels of the most reduced images."""
        reach = STRUCTURE_REACH * max(STEPS.tracking.joints.levels)
        step = np.float32([0.0, 0.0, 0.1])
        pixels = advanced(after=step)["surprise"]
        for part, codes in ((0.9, []), (1.1, ["fast-motion"])):
            report = advanced(after=step * (reach * part / pixels))
            assert [finding["code"] for finding in report["findings"]] == codes
        for lost, codes in (("", []), ("so", ["fast-motion", "tracking-lost"])):
            report = advanced(after=step * (2.0 * reach / pixels), start="silhouettes", lost=lost)
            assert [finding["code"] for finding in report["findings"]] == codes

    def test_a_few_torn_joints_are_said_unless_the_frame_is_lost(self, advanced):
        for torn, lost, codes in (
            (0.9 * DOUBTFUL_TEAR, "", []),
            (1.1 * DOUBTFUL_TEAR, "", ["doubtful-motion"]),
            (np.nan, "", ["doubtful-motion"]),
            (0.5, "so", ["tracking-lost"]),
        ):
            report = advanced(torn=torn, lost=lost)
            assert [finding["code"] for finding in report["findings"]] == codes

    def test_a_loss_is_of_new_surface_or_of_track(self, advanced):
        """The key frame's gap was 0.01, and 0.03 more may be."""
        for gap, code in ((0.039, "tracking-lost"), (0.041, "new-surface"), (np.nan, "new-surface")):
            report = advanced(gap=gap, lost="so")
            assert [(f["code"], f["what"]) for f in report["findings"]] == [(code, "tracking is lost: so")]


@pytest.fixture(scope="module")
def sound(views):
    """The key frame of sound views: its track and its report."""
    return STEPS.begin(views, no_progress)


class TestKeyFrames:
    def test_cameras_too_few_for_the_surface_are_said(self, views, sound):
        _, report = sound
        assert report["findings"] == []
        assert report["unpaired"] <= MOST_UNPAIRED
        _, report = STEPS.begin(views[::3], no_progress)  # two, on opposite sides
        assert [finding["code"] for finding in report["findings"]] == ["few-cameras"]
        assert report["unpaired"] > 0.9

    def test_a_fit_with_a_matched_view_is_nearer_to_the_sound_one(self, monkeypatch, views, sound):
        wrong = list(views)
        wrong[2] = replace(wrong[2], color=wrong[2].color * np.float32(2.0))
        mended, report = STEPS.begin(wrong, no_progress)
        assert [(f["code"], f["where"]) for f in report["findings"]] == [("camera-exposure", views[2].name)]
        monkeypatch.setattr(steps, "matched", lambda views, gains: list(views))
        naive, _ = STEPS.begin(wrong, no_progress)
        true = sound[0].cloud.radiance
        apart, naively = (np.abs(track.cloud.radiance - true)[:, 0].mean() for track in (mended, naive))
        assert apart < naively
