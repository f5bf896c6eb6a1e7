"""A capture as one plan, from cameras to materials: the same bytes by one process and by several."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from support.fake_steps import FakeSteps, write_capture

from beam_warp import RunOptions, converters, validate
from beam_warp.capture.capture import Capture
from beam_warp.decomposition.frames import ReconstructedFrames
from beam_warp.decomposition.job import OverviewOptions, run_capture
from beam_warp.decomposition.work import MaterialWork
from beam_warp.demo.from_images import FromImagesOptions, demo_steps
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.plan.crew import crew_of
from beam_warp.plan.processes import Processes
from beam_warp.plan.standing import look
from beam_warp.plan.workers import in_process
from beam_warp.reconstruction.job import ReconstructionWork, ReconstructOptions
from beam_warp.world.environment import EnvironmentMap

OPTIONS = RunOptions(materials=MaterialOptions(sample_count=8), device="cpu")


def take(capture, out, steps, length, crew=in_process, options=OPTIONS):
    out.mkdir()
    frames = ReconstructionWork.prepare(
        capture, out / "reconstruction", steps, ReconstructOptions(segment_length=length)
    )
    light = EnvironmentMap.read(capture.environment_path).resized(8, 16)
    work = MaterialWork(out, ReconstructedFrames(frames, None), light, options)
    return run_capture(frames, work, OverviewOptions(height=48), time.perf_counter(), crew)


def results(out):
    """Every byte that a run promises: all but times."""
    files = (
        path for path in out.rglob("*") if path.is_file() and path.suffix != ".json" and path.parent.name != "plan"
    )
    return {path.relative_to(out): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return Capture.read(write_capture(tmp_path_factory.mktemp("captures") / "ball", (2, 3, 4, 5)))


@pytest.mark.parametrize(("length", "topology"), [(2, "perFrame"), pytest.param(0, "constant", marks=pytest.mark.slow)])
def test_processes_write_the_same_bytes(ball, tmp_path, length, topology):
    one = take(ball, tmp_path / "one", FakeSteps(), length)
    two = take(ball, tmp_path / "two", FakeSteps(), length, crew_of("2", "cpu"))
    assert two.result.sequence.topology == topology
    assert validate(two.result.asset).is_valid
    assert results(tmp_path / "one") == results(tmp_path / "two")
    assert one.result.report["materials"] == two.result.report["materials"]
    assert one.result.report["workers"] != two.result.report["workers"]
    assert look(tmp_path / "two").stages["materials"].done == 4


def test_processes_share_roughness(ball, tmp_path):
    """While one tracks, the other one measures what frames say of roughness; a step adds all up, to the same bytes."""
    options = RunOptions(materials=MaterialOptions(sample_count=8), roughness="estimate", device="cpu")
    one = take(ball, tmp_path / "one", FakeSteps(), 0, options=options)
    two = take(ball, tmp_path / "two", FakeSteps(seconds=3.0), 0, crew_of("2", "cpu"), options)
    assert results(tmp_path / "one") == results(tmp_path / "two")
    assert one.result.report["roughness"] == two.result.report["roughness"]
    receipts = look(tmp_path / "two").receipts
    tracking, measuring = ({receipts[f"{it}-{frame:06d}"].worker for frame in (3, 4)} for it in ("frame", "profile"))
    assert tracking.isdisjoint(measuring)
    assert receipts["profile-000003"].ended < receipts["frame-000005"].ended
    assert look(tmp_path / "two").stages["profile"].total == 4
    assert look(tmp_path / "two").stages["roughness"].total == 1


def test_frames_that_roughness_is_found_from_are_looked_at_once(ball, tmp_path, monkeypatch):
    """All frames of so short a take are: what their views show is kept until they are measured."""
    looked = []

    def counted(*arguments, **options):
        looked.append(len(arguments[0]))
        return view_evidence(*arguments, **options)

    monkeypatch.setattr("beam_warp.decomposition.seen.view_evidence", counted)
    options = RunOptions(materials=MaterialOptions(sample_count=8), roughness="estimate", device="cpu")
    found = take(ball, tmp_path / "take", FakeSteps(), 0, options=options)
    assert found.result.sequence.topology == "constant"
    assert len(looked) == 4


@pytest.mark.slow
@pytest.mark.parametrize(("length", "lost"), [(16, False), (0, False), (0, True)])
def test_processes_write_the_same_clips(tmp_path, length, lost):
    """Both assets of a take that is long enough to have clips, which are steps; these find whether it is persistent."""
    dim = {frame: 0.2 + 0.002 * frame for frame in range(64)}
    capture = Capture.read(write_capture(tmp_path / "capture", range(64), levels=dim | ({40: 0.95} if lost else {})))
    take(capture, tmp_path / "one", FakeSteps(), length)
    two = take(capture, tmp_path / "two", FakeSteps(), length, crew_of("2", "cpu"))
    assert two.result.sequence.topology == ("constant" if length == 0 and not lost else "perFrame")
    assert validate(two.result.asset).is_valid
    assert look(tmp_path / "two").stages["asset-clip"].done == look(tmp_path / "two").stages["gaussians-clip"].done == 3
    assert results(tmp_path / "one") == results(tmp_path / "two")
    for name, found in (("asset", two.result.sequence), ("reconstruction/gaussians", two.reconstruction.sequence)):
        serial = tmp_path / Path(name).name
        converters.write(found, serial.with_suffix(".usda"))
        for clip in tmp_path.glob(f"{serial.name}.*"):
            assert clip.read_bytes() == (tmp_path / "two" / f"{name}{clip.name.removeprefix(serial.name)}").read_bytes()
    assert (tmp_path / "two" / "asset.000030.usdc").samefile(tmp_path / "two" / "clips" / "asset.000030.usdc")


def test_materials_do_not_wait_for_other_segments(ball, tmp_path):
    take(ball, tmp_path / "out", FakeSteps(), 2)
    receipts = look(tmp_path / "out").receipts
    assert receipts["materials-000003"].ended < receipts["frame-000004"].ended


def test_tracking_that_is_lost_in_one_segment(tmp_path):
    """What looked as if it could be persistent is then decomposed frame by frame."""
    capture = Capture.read(write_capture(tmp_path / "capture", (0, 1, 2), levels={1: 0.95}))
    lost = take(capture, tmp_path / "lost", FakeSteps(), 0, options=OPTIONS)
    assert lost.result.sequence.topology == "perFrame"
    assert [len(cloud) for cloud in lost.result.sequence] == [60, 65, 65]
    assert lost.reconstruction.report["segments"] == [0, 1]


@pytest.mark.slow
@pytest.mark.parametrize("length", [1, 0])
def test_a_real_capture_whose_workers_are_killed(tiny_capture, tmp_path, length):
    """The true steps, small: two processes, each killed once, write what one process writes."""
    small = FromImagesOptions(gaussian_count=400, color_iterations=6, normal_iterations=6, joint_iterations=6)
    options = RunOptions(materials=MaterialOptions(sample_count=8), roughness="estimate", device="cpu")
    steps = demo_steps(small, device="cpu", seed=0)
    killed = []

    def crew(plan, kind, progress):
        workers = crew_of("2", "cpu")(plan, kind, progress)
        assert isinstance(workers, Processes)

        def kill():
            for member in list(workers._members):
                while member.task is None:
                    time.sleep(0.05)
                time.sleep(1.0)
                os.kill(member.process.pid, signal.SIGKILL)
                killed.append(member.process.pid)

        threading.Thread(target=kill, daemon=True).start()
        return workers

    take(tiny_capture, tmp_path / "one", steps, length, options=options)
    take(tiny_capture, tmp_path / "two", steps, length, crew, options)
    assert killed
    assert results(tmp_path / "one") == results(tmp_path / "two")
