"""The runner of stress captures, on reconstructions that are made up: each judgement is met and missed once."""

import json
from functools import partial

import pytest
from support.tracked_balls import tracked_balls

from beam_warp.errors import InvalidArrayError
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.stability.capture_cases import CAPTURE_CASES, TRACED_CASES
from beam_warp.stability.capture_cases.cameras import black_camera, camera_without_files, four_cameras, wrong_exposure
from beam_warp.stability.capture_cases.case import Detection
from beam_warp.stability.capture_cases.studio import StressStudio
from beam_warp.stability.capture_cases.subjects import as_it_is
from beam_warp.stability.captures import TITLES, Reconstructed, cells, run_capture_case
from beam_warp.stability.page import case_table
from beam_warp.stability.suite import run_suite
from beam_warp.world.gaussians import GaussianSequence

pytestmark = pytest.mark.slow  # a stability suite


@pytest.fixture
def studio(tiny_capture, tmp_path):
    return StressStudio(tmp_path, given=tiny_capture, device="cpu")


def tracked(capture, dim_from=None):
    """Grey balls on the truth that follow it; black from some frame on if asked for."""
    levels = [0.0 if dim_from is not None and index >= dim_from else 0.2 for index in range(len(capture.frames))]
    meshes = [read_truth_mesh(capture, frame) for frame in capture.frames]
    return GaussianSequence.from_clouds(tracked_balls(meshes, 3000, 0.012, levels))


def finding(*findings, key_frames=(0,), dim_from=None):
    return lambda capture: Reconstructed(
        sequence=tracked(capture, dim_from), detections=findings, key_frames=key_frames
    )


def run(studio, case, reconstruct):
    return run_capture_case(reconstruct, studio, case)


EXPOSURE, LOST = Detection("camera-exposure", "train_03"), Detection("tracking-lost", frame=1)


class TestJudgement:
    def test_a_sound_capture_reconstructed_is_well(self, studio):
        outcome = run(studio, as_it_is, finding())
        assert outcome.passed
        assert (outcome.frames, outcome.cameras, outcome.device) == (2, 6, "cpu")
        assert outcome.first["psnr"] == pytest.approx(outcome.last["psnr"], abs=1.0)
        assert outcome.drift["gaussians"]["p95_mm"] < 0.01  # they were put where the truth carries them
        # Grey balls turn with nothing: a vertex is off by what the surface turned around it, a part of the motion.
        assert outcome.drift["vertices"]["mean_mm"] < 6.0

    @pytest.mark.parametrize(
        ("case", "found", "faults"),
        [
            (as_it_is, [LOST], ("found where nothing is wrong: tracking-lost in frame 1",)),
            (wrong_exposure, [], ("not detected: camera-exposure of train_03",)),
            (wrong_exposure, [EXPOSURE], ()),
            (wrong_exposure, [EXPOSURE, Detection("camera-exposure", "train_01")], ("train_01 is blamed",)),
            (black_camera, [Detection("black-image", "train_03", 0)], ()),
            (four_cameras, [Detection("few-cameras")], ()),
        ],
    )
    def test_what_is_found_is_judged(self, studio, case, found, faults):
        outcome = run(studio, case, finding(*found))
        assert outcome.faults == faults
        assert outcome.passed == (not faults)
        assert outcome.missed == (() if found else ("camera-exposure of train_03",))

    def test_a_loss_must_be_said(self, studio):
        silent = run(studio, four_cameras, finding(Detection("few-cameras"), dim_from=1))
        assert len(silent.faults) == 1
        assert silent.faults[0].startswith("lost without a word")
        said = finding(Detection("few-cameras"), LOST, key_frames=(0, 1), dim_from=1)
        assert run(studio, four_cameras, said).passed

    def test_frames_that_are_lacking_are_a_fault(self, studio):
        def short(capture):
            return Reconstructed(sequence=GaussianSequence.from_clouds([tracked(capture)[0]]))

        assert run(studio, as_it_is, short).faults == ("2 frames must come out, got 1",)

    def test_refusal_counts_where_it_is_allowed(self, studio):
        def refuse(capture):
            raise InvalidArrayError("images must be there, got none of train_03. Copy them.")

        assert run(studio, camera_without_files, refuse).passed
        outcome = run(studio, wrong_exposure, refuse)
        assert outcome.refused.startswith("images must be there")
        assert not outcome.passed

    def test_a_crash_is_a_fault_and_not_the_end(self, studio):
        def crash(capture):
            raise ZeroDivisionError("by zero")

        assert run(studio, as_it_is, crash).faults == ("ended with ZeroDivisionError: by zero",)


def test_all_cases_of_a_given_capture_run_and_make_a_table(studio):
    too_large = ("8 cameras", "every second frame", "every third frame")
    cases = [case for case in CAPTURE_CASES if case not in TRACED_CASES and case.name not in too_large]
    seen = []
    outcomes = list(run_suite(cases, lambda case: [run(studio, case, finding())], lambda *done: seen.append(done)))
    assert [outcome.case for outcome in outcomes] == [case.name for case in cases]
    assert seen[-1] == (len(cases), len(cases))
    json.dumps([outcome.as_dict() for outcome in outcomes])
    table = case_table(TITLES, CAPTURE_CASES, outcomes, partial(cells, outcomes=outcomes)).splitlines()
    assert len(table) == 2 + len(cases)
    assert all(line.count("|") == table[0].count("|") for line in table)
    assert "not detected: black-image of train_03" in table[3]
