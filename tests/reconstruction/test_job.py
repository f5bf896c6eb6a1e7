"""Reconstruction around the optimiser: what is stored, when it is taken again, and that no kill changes a byte."""

import gc
import json
import os
import shutil
import subprocess
import sys
import threading
import time
import weakref
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from support.fake_steps import FakeSteps, write_capture
from support.leftovers import temporary_of_the_dead

from beam_warp import read, validate
from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.corrections import CameraCorrection, RigCorrection, moved_camera
from beam_warp.capture.exposures import CameraExposure, RigExposures
from beam_warp.capture.mask_corrections import MaskCorrections
from beam_warp.capture.mattes import MaskOffset
from beam_warp.errors import InvalidOptionError, MissingFileError, OutputError
from beam_warp.image.files import read_image, write_exr
from beam_warp.jobs.store import read_frame
from beam_warp.plan import steps as plan_steps
from beam_warp.raster.gbuffer import rasterize
from beam_warp.reconstruction import job as job_module
from beam_warp.reconstruction.frames import store as frame_store
from beam_warp.reconstruction.frames.plan import plan_fades, plan_segments
from beam_warp.reconstruction.frames.store import ID_BITS, stored_cloud
from beam_warp.reconstruction.job import ReconstructOptions, reconstruct

FRAMES = (0, 1, 2, 3)
PAIRS = ReconstructOptions(segment_length=2)
BEGINNING = ReconstructOptions(frames=(0, 1))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("captures") / "ball", FRAMES)


@pytest.fixture
def capture(folder):
    return Capture.read(folder)


@pytest.fixture(scope="module")
def followed(folder, tmp_path_factory):
    """All frames in one segment: steps, folder, result, and what was said of the progress."""
    steps, out, said = FakeSteps(), tmp_path_factory.mktemp("runs") / "followed", []
    found = reconstruct(Capture.read(folder), out, steps, progress=lambda *step: said.append(step))
    return steps, out, found, said


@pytest.fixture(scope="module")
def paired(folder, tmp_path_factory):
    """Two segments of two frames: steps, folder, result."""
    steps, out = FakeSteps(), tmp_path_factory.mktemp("runs") / "paired"
    return steps, out, reconstruct(Capture.read(folder), out, steps, PAIRS)


@pytest.fixture
def continued(followed, tmp_path):
    """A folder with all that the run of one segment wrote."""
    return shutil.copytree(followed[1], tmp_path / "out")


def results(out):
    """Every byte that a run promises, by file: all but times and what is remembered of the images."""
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.suffix != ".json" and path.parent.name != "digests"
    }


def require_same_results(one, other):
    first, second = results(one), results(other)
    assert first.keys() == second.keys()
    assert not [name for name in first if first[name] != second[name]]


def drawn(cloud, camera):
    buffer = rasterize(cloud, camera, channels=("radiance",), device="cpu")
    return np.concatenate([buffer.channels["radiance"] * buffer.alpha[..., None], buffer.alpha[..., None]], axis=-1)


def rms(after, before):
    return float(np.sqrt(np.mean(np.square(np.subtract(after, before)))))


class TestSegments:
    def test_plan(self):
        assert plan_fades(((0, 1), (2, 3, 4), (5,)), 2) == pytest.approx({2: 2 / 3, 3: 1 / 3, 5: 1 / 2})
        assert not plan_fades(((0, 1), (2, 3)), 0)
        assert plan_segments((3, 4, 6, 9, 10), 2) == ((3, 4), (6, 9), (10,))
        assert plan_segments((3, 4, 6), 3) == plan_segments((3, 4, 6), 0) == ((3, 4, 6),)

    def test_one_segment_keeps_identities(self, followed):
        steps, _, found, _ = followed
        assert steps.calls == ["begin", "advance", "advance", "advance"]
        assert found.sequence.topology == "constant"
        assert found.sequence.frames_per_second == 12.0
        assert [entry["kind"] for entry in found.report["frames"]] == ["key", "tracked", "tracked", "tracked"]
        assert found.report["segments"] == [0]
        moved = [np.abs(found.sequence[i].positions - found.sequence[0].positions).max() for i in FRAMES]
        assert moved == sorted(moved)
        assert moved[1] > 0.0

    def test_segments_share_no_identity(self, paired):
        steps, _, found = paired
        assert steps.calls == ["begin", "advance", *["advance"] * 2, "begin", "advance"]  # of them, 2 and 3 go on
        assert found.sequence.topology == "perFrame"
        assert found.report["segments"] == [0, 2]
        ids = [cloud.ids for cloud in found.sequence]
        assert np.array_equal(ids[0], ids[1])
        assert np.array_equal(ids[2], ids[3])
        assert np.array_equal(ids[2], np.concatenate([ids[0] + (2 << ID_BITS), ids[0]]))  # and the faded ones

    def test_seams_are_faded(self, capture, paired, tmp_path):
        """Colours and places of a key frame are others than those before; what is seen of it comes by equal steps."""
        cut = reconstruct(capture, tmp_path / "cut", FakeSteps(), replace(PAIRS, seam_frames=0)).sequence
        seen = {}
        for name, sequence in {"cut": cut, "faded": paired[2].sequence}.items():
            cameras = [record.camera for record in capture.records if record.frame == 0]
            seen[name] = [[drawn(cloud, camera) for camera in cameras] for cloud in sequence]
        flicker = {name: [rms(after, before) for before, after in pairwise(frames)] for name, frames in seen.items()}
        assert flicker["cut"][1] > 10.0 * flicker["cut"][0]  # a seam that is seen
        assert max(flicker["faded"]) < 0.5 * max(flicker["cut"])
        coverage = [np.mean([image[..., 3] for image in views]) for views in seen["faded"]]
        assert np.ptp(coverage) < 0.02 * coverage[0]

    def test_a_segment_that_is_lost_beyond_its_end_is_cut(self, tmp_path):
        levels = {2: 0.95}
        capture = Capture.read(write_capture(tmp_path / "capture", FRAMES, levels=levels))
        found = reconstruct(capture, tmp_path / "out", FakeSteps(), PAIRS)
        assert [len(cloud) for cloud in found.sequence] == [60, 60, 65, 65]
        assert [entry["gaussians"] for entry in found.report["frames"]] == [60, 60, 65, 65]
        assert not any(entry["lost"] for entry in found.report["frames"])

    def test_a_lost_frame_is_a_key_frame_and_said_so(self, tmp_path):
        capture = Capture.read(write_capture(tmp_path / "capture", FRAMES, levels={2: 0.95}))
        steps, said = FakeSteps(), []
        found = reconstruct(capture, tmp_path / "out", steps, progress=lambda *step: said.append(step))
        assert steps.calls == ["begin", "advance", "advance", "begin", "advance"]
        assert found.report["segments"] == [0, 2]
        assert [entry["segment"] for entry in found.report["frames"]] == [0, 0, 2, 2]
        assert found.report["frames"][2]["lost"] == "too bright"
        assert found.report["frames"][2]["kind"] == "key"
        assert found.sequence.topology == "perFrame"
        assert np.array_equal(found.sequence[1].ids, np.arange(60))
        assert np.array_equal(found.sequence[3].ids, np.arange(65) + (2 << ID_BITS))
        assert np.array_equal(read(found.asset)[3].ids, found.sequence[3].ids)
        (warning,) = [text for text in found.report["warnings"] if "lost" in text]
        assert "at frame 2 (too bright)" in warning
        assert any("frame 2: lost (too bright), fitted anew" in step[3] for step in said if len(step) > 3)

    def test_frames_of_a_range_keep_their_numbers(self, capture, tmp_path):
        """The asset states them, and how its Gaussians were drawn."""
        stated = {"raster_antialiased": "true", "raster_low_pass": "0.3", "capture_frames": "1 3"}
        found = reconstruct(capture, tmp_path / "out", FakeSteps(), ReconstructOptions(frames=(1, 3)))
        assert found.sequence.metadata.items() >= stated.items()
        assert read(found.asset).metadata.items() >= stated.items()
        stored = sorted(path.stem for path in (tmp_path / "out" / "frames").glob("*.h5"))
        assert stored == ["frame_000001", "frame_000003"]
        assert [entry["frame"] for entry in found.report["frames"]] == [1, 3]


class TestOutputs:
    def test_all_is_written_and_valid(self, paired):
        _, out, found = paired
        assert validate(found.asset).is_valid
        back = read(found.asset)
        assert len(back) == 4
        np.testing.assert_allclose(back[3].opacities, found.sequence[3].opacities, atol=2.0**-11)  # written in half
        report = json.loads((out / "report.json").read_text())
        assert report["mean_psnr"] == pytest.approx((30.0 + 28.8) / 2)
        assert report["lowest_psnr"]["psnr"] == pytest.approx(28.8)
        assert report["input"]["cameras"] == 3
        assert report["frames"][0]["iterations"] == 7
        assert report["frames"][0]["loss"] == [1.0, None]
        assert all(entry["seconds"] > 0.0 for entry in report["frames"])
        assert [entry["gaussians"] for entry in report["frames"]] == [len(cloud) for cloud in found.sequence]
        assert [entry["fading_gaussians"] for entry in report["frames"]] == [0, 0, 60, 60]
        for frame in FRAMES:
            assert read_image(out / "previews" / f"frame_{frame:06d}.png").width > 300
        assert not [path for path in out.rglob("*") if path.name.startswith(".")]

    def test_drift_is_said(self, followed):
        warnings = followed[2].report["warnings"]
        assert next(text for text in warnings if "dB" in text).startswith("frame 3 is 3.6 dB below its key frame")

    def test_progress_ends_full(self, followed):
        said = followed[3]
        assert [step[1:3] for step in said if step[0] == "frames"] == [(done, 4) for done in range(5)]
        assert ("fit", 1, 1, "frame 0, 30.00 dB, 60 Gaussians") in said
        assert ("track", 1, 1, "frame 1, 29.00 dB") in said

    def test_what_the_track_shares_with_the_cloud_is_stored_once(self, paired):
        frames = paired[1] / "frames"
        first, third = (set(read_frame(frames / f"frame_{n:06d}.h5")) for n in (0, 2))
        assert {name for name in first if name.startswith("track_")} == {"track_velocity", "track_age"}
        assert third - first == {"track_ids"}  # local in the track, unique in the cloud
        cloud = stored_cloud(frames / "frame_000002.h5")
        assert cloud.ids.min() == 2 << ID_BITS

    def test_images_of_two_frames_at_most(self, capture, tmp_path, monkeypatch):
        """The frame that is worked on, and the one that is read ahead."""
        alive, most = weakref.WeakSet(), []
        original = CaptureRecord.view

        def counted(record):
            view = original(record)
            alive.add(view)
            most.append(len(alive))
            return view

        monkeypatch.setattr(CaptureRecord, "view", counted)
        reconstruct(capture, tmp_path / "out", FakeSteps())
        # Once to inspect the capture, once for all that is done with a frame.
        assert len(most) == 2 * 3 * len(FRAMES)
        gc.collect()
        assert max(most) <= 2 * 3
        assert not alive


def before_each_write(monkeypatch, act):
    """Have a run call ``act`` ahead of each of its writes: Gaussians, preview, their receipts, and the report."""

    def watched(function):
        def write(*arguments, **options):
            act()
            return function(*arguments, **options)

        return write

    for module, name in (
        *((frame_store, "write_frame"), (job_module, "write_png")),
        *((plan_steps, "write_record"), (job_module, "write_report")),
    ):
        monkeypatch.setattr(module, name, watched(getattr(module, name)))


def leave_half_written(out):
    """Leave what a kill within a frame's and within the asset's writer leaves."""
    temporary_of_the_dead(out / "frames" / "frame_000001.h5").write_bytes(b"half")
    folder = temporary_of_the_dead(out / "gaussians.usda")
    folder.mkdir()
    (folder / "half.usdc").write_bytes(b"half")


class TestResuming:
    def test_a_kill_at_any_write_changes_no_byte(self, capture, tmp_path, monkeypatch):
        """A kill before a write leaves what the writes before it made; the last leaves a whole run."""
        options = ReconstructOptions(segment_length=2, frames=(0, 1, 2))
        left, one_at_a_time = [], threading.Lock()  # writes of two threads may meet

        def keep_what_a_kill_leaves():
            unfinished = shutil.ignore_patterns("*.tmp")  # of the thread that reads ahead; others are left below
            with one_at_a_time:
                left.append(shutil.copytree(tmp_path / "whole", tmp_path / f"killed_{len(left)}", ignore=unfinished))

        with monkeypatch.context() as patch:
            before_each_write(patch, keep_what_a_kill_leaves)
            reconstruct(capture, tmp_path / "whole", FakeSteps(), options)
        keep_what_a_kill_leaves()
        # three receipts of mends, four writes of each frame, two of a seam, the receipt of the asset, the report, and
        # nothing that is killed
        assert len(left) == 3 + 4 * 3 + 2 + 1 + 1 + 1
        for done, out in enumerate(left):
            leave_half_written(out)
            steps = FakeSteps()
            found = reconstruct(capture, out, steps, options)
            kept = found.report["resumed_frames"] + (done >= 3 + 4 * 2 + 2)  # the seam is made before its frame
            assert len(steps.calls) == 3 + 1 - kept
            require_same_results(tmp_path / "whole", out)

    def test_an_interrupt_changes_no_byte_either(self, followed, capture, tmp_path, monkeypatch):
        """An interrupt, unlike a kill, ends the threads and unwinds the writers: here before the second preview."""
        writes = []

        def interrupt():
            writes.append("begun")
            if len(writes) == 10:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            before_each_write(patch, interrupt)
            with pytest.raises(KeyboardInterrupt):
                reconstruct(capture, tmp_path / "out", FakeSteps())
        assert reconstruct(capture, tmp_path / "out", FakeSteps()).report["resumed_frames"] == 2
        require_same_results(followed[1], tmp_path / "out")

    @pytest.mark.slow
    def test_sigkill(self, folder, capture, tmp_path):
        """A process killed while it works."""
        script = (
            "from beam_warp.capture.capture import Capture\n"
            "from beam_warp.reconstruction.job import reconstruct\n"
            "from support.fake_steps import StuckSteps\n"
            f"reconstruct(Capture.read({str(folder)!r}), {str(tmp_path / 'out')!r}, StuckSteps())\n"
        )
        paths = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]))
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", script], stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": paths}
        )
        try:
            assert process.stdout.readline() == b"working\n"
        finally:
            process.kill()
            process.wait()
            process.stdout.close()
        assert not (tmp_path / "out" / "gaussians.usda").exists()
        leave_half_written(tmp_path / "out")
        found = reconstruct(capture, tmp_path / "out", FakeSteps())
        assert found.report["resumed_frames"] == 1
        reconstruct(capture, tmp_path / "whole", FakeSteps())
        require_same_results(tmp_path / "whole", tmp_path / "out")

    @pytest.mark.parametrize(
        ("name", "kept", "calls"),
        [("frames/frame_000001.h5", 400, ["advance"]), ("previews/frame_000002.png", None, [])],
    )
    def test_what_is_damaged_or_missing_is_made_again(self, followed, continued, capture, name, kept, calls):
        whole = (continued / name).read_bytes()
        (continued / name).unlink()
        if kept:
            (continued / name).write_bytes(whole[:kept])
        steps = FakeSteps()
        reconstruct(capture, continued, steps)
        assert steps.calls == calls
        require_same_results(followed[1], continued)


class TestStaleness:
    """Nothing that was made from something else is taken, and nothing is made twice from the same."""

    def test_other_options_start_over(self, continued, capture):
        for steps in (FakeSteps(seed=1), FakeSteps(count=50)):
            assert reconstruct(capture, continued, steps, BEGINNING).report["resumed_frames"] == 0

    def test_other_segments_keep_what_they_may(self, continued, capture):
        steps = FakeSteps()
        reconstruct(capture, continued, steps, PAIRS)
        # 0 and 1 are as they were and go on in 2 and 3; 2 is a key frame now, and 3 follows it.
        assert steps.calls == ["advance", "advance", "begin", "advance"]

    def test_an_image_that_changes_costs_its_frame_and_those_after_it(self, tmp_path):
        folder = write_capture(tmp_path / "capture", (0, 1, 2))
        capture = Capture.read(folder)
        reconstruct(capture, tmp_path / "out", FakeSteps())
        changed = folder / "images" / "c1" / "0001.exr"
        image = read_image(changed)
        before = changed.stat()
        write_exr(changed, {**image.channels, "G": image.channels["G"] * np.float32(3.0)})
        os.utime(changed, ns=(before.st_atime_ns, before.st_mtime_ns))  # whatever its time says
        steps = FakeSteps()
        found = reconstruct(capture, tmp_path / "out", steps)
        assert steps.calls == ["advance", "advance"]
        reconstruct(capture, tmp_path / "fresh", FakeSteps())
        require_same_results(tmp_path / "fresh", tmp_path / "out")
        assert found.report["resumed_frames"] == 1

    @pytest.mark.parametrize(("focal_length", "resumed"), [(24.0, 2), (24.5, 0)])
    def test_a_moved_capture_is_the_same_unless_a_camera_changed(self, continued, tmp_path, focal_length, resumed):
        folder = write_capture(tmp_path / "moved", FRAMES)
        content = json.loads((folder / "transforms.json").read_text())
        (folder / "transforms.json").write_text(json.dumps({**content, "fl_x": focal_length}))
        found = reconstruct(Capture.read(folder), continued, FakeSteps(), BEGINNING)
        assert found.report["resumed_frames"] == resumed

    def test_settled_images_are_read_once_for_their_digest(self, tmp_path, monkeypatch):
        folder = write_capture(tmp_path / "capture", (0, 1))
        capture = Capture.read(folder)
        later = time.time() + 100.0
        monkeypatch.setattr("beam_warp.digests.time.time", lambda: later)
        reconstruct(capture, tmp_path / "out", FakeSteps())
        opened = []
        original = Path.open
        monkeypatch.setattr(Path, "open", lambda path, *a, **k: (opened.append(path), original(path, *a, **k))[1])
        assert reconstruct(capture, tmp_path / "out", FakeSteps()).report["resumed_frames"] == 2
        assert not [path for path in opened if path.suffix == ".exr"]


class TestMistakes:
    def test_missing_images_are_said_before_anything_is_made(self, tmp_path):
        folder = write_capture(tmp_path / "capture", (0, 1))
        (folder / "images" / "c0" / "0001.exr").unlink()
        (folder / "images" / "c2" / "0001.exr").unlink()
        with pytest.raises(MissingFileError, match="1 frame of 2 is left with under 2 images at frames 1"):
            reconstruct(Capture.read(folder), tmp_path / "out", FakeSteps())
        assert not (tmp_path / "out").exists()

    def test_one_missing_image_is_done_without(self, tmp_path):
        folder = write_capture(tmp_path / "capture", (0, 1))
        (folder / "images" / "c0" / "0001.exr").unlink()
        found = reconstruct(Capture.read(folder), tmp_path / "out", FakeSteps())
        assert len(found.sequence) == 2
        assert any("missing" in text for text in found.report["warnings"])

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            ({"frames": (2, 7)}, "frames must be some of the capture's 4 from 0 to 3, got 7"),
            ({"frames": ()}, "frames must be some of the capture's 4 from 0 to 3, got none"),
            ({"frames": (2, 1)}, "frames must be ascending"),
            ({"segment_length": -1}, "segment_length must be"),
        ],
    )
    def test_options(self, capture, tmp_path, options, says):
        with pytest.raises(InvalidOptionError, match=says):
            reconstruct(capture, tmp_path / "out", FakeSteps(), ReconstructOptions(**options))
        assert not (tmp_path / "out").exists()

    def test_a_folder_that_cannot_be_made(self, capture, tmp_path):
        (tmp_path / "file").write_bytes(b"")
        with pytest.raises(OutputError, match="output folder must be a folder"):
            reconstruct(capture, tmp_path / "file" / "out", FakeSteps())


class TestCameras:
    """What is found about the rig holds for every frame, is kept beside the result, and is not sought twice."""

    RIG = RigCorrection(
        (
            CameraCorrection("c0", shift=(0.0, 0.01, 0.0), pixels=0.6, error=0.1),
            CameraCorrection("c1"),
            CameraCorrection("c2", is_used=False),
        ),
        is_applied=True,
        confidence=30.0,
    )

    @pytest.fixture
    def steps(self):
        steps = FakeSteps()
        steps.rig = self.RIG
        return steps

    def test_frames_are_fitted_with_corrected_cameras(self, capture, steps, tmp_path):
        found = reconstruct(capture, tmp_path / "out", steps, BEGINNING)
        stated = {record.camera_name: record.camera for record in capture.select(frames={0})}
        assert steps.refined == [("c0", "c1", "c2")]
        assert len(steps.cameras) == 2
        np.testing.assert_allclose(steps.cameras[0].position, stated["c0"].position - 0.01 * down_of(stated["c0"]))
        np.testing.assert_array_equal(steps.cameras[1].position, stated["c1"].position)
        used = found.capture.select(frames={0})
        assert [record.camera_name for record in used] == ["c0", "c1"]
        np.testing.assert_array_equal(used[0].camera.position, steps.cameras[0].position)
        assert found.report["cameras"] == self.RIG.as_dict()
        assert {finding["code"] for finding in found.report["findings"]} >= {"camera-poses", "camera-contradicts"}
        assert RigCorrection.read(tmp_path / "out") == self.RIG

    def test_a_continued_job_does_not_seek_again(self, capture, steps, tmp_path):
        reconstruct(capture, tmp_path / "out", steps, BEGINNING)
        again = FakeSteps()
        found = reconstruct(capture, tmp_path / "out", again, BEGINNING)
        assert (again.refined, again.calls) == ([], [])
        assert found.report["cameras"] == self.RIG.as_dict()

    def test_cameras_are_kept_if_asked_for(self, capture, steps, tmp_path):
        reconstruct(capture, tmp_path / "out", steps, BEGINNING)
        kept = replace(BEGINNING, cameras="keep")
        found = reconstruct(capture, tmp_path / "out", steps, kept)
        assert steps.refined == [("c0", "c1", "c2")]
        assert found.capture is capture
        assert found.report["cameras"] is None
        assert RigCorrection.read(tmp_path / "out") is None
        with pytest.raises(InvalidOptionError, match="cameras must be one of refine, keep, got 'move'"):
            ReconstructOptions(cameras="move")

    def test_a_rig_that_moves_is_taken_as_it_is(self, capture, steps, tmp_path):
        moved = [
            replace(record, camera=moved_camera(record.camera, [0.0] * 5 + [0.1, *[0.0] * 3]))
            if record.frame
            else record
            for record in capture.records
        ]
        reconstruct(Capture(**{**vars(capture), "records": tuple(moved)}), tmp_path / "out", steps, BEGINNING)
        assert steps.refined == []


class TestExposures:
    """Gains that are found hold for every frame, are kept beside the result, and are not sought twice."""

    FOUND = RigExposures(
        (CameraExposure("c0", 1.0, gains=(2.0, 2.0, 2.0)), CameraExposure("c1"), CameraExposure("c2")),
        exposure_undone=True,
    )

    def test_frames_are_fitted_to_corrected_colours(self, capture, tmp_path):
        steps = FakeSteps()
        steps.exposures = self.FOUND
        found = reconstruct(capture, tmp_path / "out", steps, BEGINNING)
        for before, after in zip(capture.select(frames={1}), found.capture.select(frames={1}), strict=True):
            factor = 2.0 if before.camera_name == "c0" else 1.0
            np.testing.assert_array_equal(factor * after.view().color, before.view().color)
        assert found.report["exposures"] == self.FOUND.as_dict()
        assert "camera-exposure" in {finding["code"] for finding in found.report["findings"]}
        assert RigExposures.read(tmp_path / "out") == self.FOUND
        again = FakeSteps()  # would find nothing
        assert reconstruct(capture, tmp_path / "out", again, BEGINNING).report["exposures"] == self.FOUND.as_dict()
        assert again.calls == []
        kept = reconstruct(capture, tmp_path / "out", steps, replace(BEGINNING, exposures="keep"))
        assert kept.capture is capture
        assert RigExposures.read(tmp_path / "out") is None

    def test_what_shared_points_say_outranks_the_brightness_of_images(self, tmp_path):
        """A camera that sees a face in the sun is bright; the points that it shares say that its exposure is right."""
        folder = write_capture(tmp_path / "ball", FRAMES[:1])
        (bright,) = (record for record in Capture.read(folder).records if record.camera_name == "c1")
        view = bright.view()
        colors = 5.0 * np.moveaxis(view.color, -1, 0) * view.alpha
        write_exr(folder / "images/c1/0000.exr", dict(zip("RGBA", [*colors, view.alpha], strict=True)))

        def codes(exposures):
            steps = FakeSteps()
            steps.exposures = exposures
            found = reconstruct(Capture.read(folder), tmp_path / f"out_{exposures is None}", steps)
            return {finding["code"] for finding in found.report["findings"]}

        assert "camera-exposure" in codes(None)
        assert "camera-exposure" not in codes(RigExposures(tuple(map(CameraExposure, ("c0", "c1", "c2")))))


def down_of(camera):
    return camera.camera_to_world[:3, 1]


class TestMasks:
    """What is found about masks holds for every frame, is kept beside the result, and is not sought twice."""

    FOUND = MaskCorrections({"c1": MaskOffset(-0.7, 0.1)})

    def test_frames_are_fitted_to_moved_masks(self, capture, tmp_path):
        steps, again = FakeSteps(), FakeSteps()
        steps.masks = self.FOUND
        found = reconstruct(capture, tmp_path / "out", steps, BEGINNING)
        assert steps.mended == [("c0", "c1", "c2")]
        assert found.report["masks"] == self.FOUND.as_dict()["cameras"]
        assert "mask-offset" in {finding["code"] for finding in found.report["findings"]}
        excess = {record.camera_name: record.mask_excess for record in found.capture.records}
        assert excess == {"c0": 0.0, "c1": -0.7, "c2": 0.0}
        assert MaskCorrections.read(tmp_path / "out") == self.FOUND
        assert reconstruct(capture, tmp_path / "out", again, BEGINNING).report["masks"] == found.report["masks"]
        assert (again.mended, again.calls) == ([], [])

    def test_masks_are_kept_if_asked_for(self, capture, tmp_path):
        steps = FakeSteps()
        steps.masks = self.FOUND
        reconstruct(capture, tmp_path / "out", steps, BEGINNING)
        found = reconstruct(capture, tmp_path / "out", steps, replace(BEGINNING, masks="keep"))
        assert len(steps.mended) == 1
        assert found.capture is capture
        assert MaskCorrections.read(tmp_path / "out") is None
