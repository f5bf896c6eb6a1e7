"""`beam reconstruct`, and `beam run` of a capture: what they write and say, and one clear line for each mistake."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from support.commands import beam
from support.fake_steps import FakeSteps, write_capture
from support.moving_ball import ball_views, rig
from support.sound_capture import rewrite, write_sound

from beam_warp.capture.capture import Capture
from beam_warp.capture.corrections import moved_camera
from beam_warp.cli.reconstruct import Modelling, frames_of, steps_of
from beam_warp.cli.run import capture_at
from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError
from beam_warp.image.files import write_exr
from beam_warp.world.environment import EnvironmentMap


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("captures") / "ball", range(4), levels={2: 0.95})


@pytest.fixture
def asked(monkeypatch):
    """What was asked of the steps; the fake does them."""
    found = []

    def steps_of(modelling, capture, seed, device, environment, **fitting):
        found.append((modelling, seed, device))
        return FakeSteps(count=modelling.gaussians or 60, seed=seed)

    monkeypatch.setattr("beam_warp.cli.reconstruct.steps_of", steps_of)
    monkeypatch.setattr("beam_warp.cli.run.steps_of", steps_of)
    return found


class TestReconstruct:
    def test_all_is_written_and_said(self, folder, asked, tmp_path, capsys):
        out = tmp_path / "out"
        assert beam("reconstruct", folder, "--out", out, "--gaussians", 40, "--seed", 3) == 0
        said = capsys.readouterr()
        assert "gaussians.usda: 4 frames, 2 segments, 40 to 45 Gaussians, " in said.out
        assert "dB, lowest 28.80 dB at frame 1" in said.out
        assert "warning: tracking was lost at frame 2 (too bright)" in said.err
        modelling, seed, _ = asked[0]
        assert (modelling.gaussians, modelling.preset, seed) == (40, None, 3)
        for name in ("gaussians.usda", "report.json", "previews/frame_000003.png", "frames/frame_000003.h5"):
            assert (out / name).is_file()

    def test_json(self, folder, asked, tmp_path, capsys):
        assert beam("reconstruct", folder, "--out", tmp_path / "out", "--frames", "1:3", "--json") == 0
        report = json.loads(capsys.readouterr().out)
        assert [entry["frame"] for entry in report["frames"]] == [1, 2]

    def test_processes_write_the_same_bytes(self, folder, asked, tmp_path, capsys):
        words = ("reconstruct", folder, "--segment-length", 2, "--json")
        found = []
        for workers in (1, 2):
            out = tmp_path / str(workers)
            assert beam(*words, "--out", out, "--workers", workers) == 0
            assert json.loads(capsys.readouterr().out)["segments"] == [0, 2]
            places = (*out.glob("gaussians*"), *out.glob("frames/*"), *out.glob("previews/*"))
            found.append({path.relative_to(out): path.read_bytes() for path in places})
        assert len(found[0]) > 8
        assert found[0] == found[1]
        assert beam("plan", tmp_path / "2", "--html", tmp_path / "page.html") == 0
        said = capsys.readouterr().out
        assert re.search(r"frame +4/4 +0 +0", said)
        assert "all 14 steps are done" in said
        page = (tmp_path / "page.html").read_text()
        assert page.count("<img") == page.count('src="2/previews/') == 4


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("reconstruct {folder} --workers some", "workers must be auto, a number from 1 to 256, gpus, ray or ray://"),
        ("reconstruct {folder} --workers 0", "workers must be auto, a number"),
        ("reconstruct {folder} --workers 0@gpus", "got 0@gpus. Write 4 for four processes, or 3@gpus"),
        ("reconstruct {folder} --workers 3@4", "ray or ray://HOST:PORT, got 3@4"),
        ("reconstruct {folder} --workers gpus --device cpu", "device must be left out with workers gpus, got cpu"),
        ("reconstruct {folder} --workers ray://", "workers must name a cluster as ray://HOST:PORT, got ray://"),
        ("reconstruct {folder} --frames 7:9", "frames must hold some of the capture's 4 from 0 to 3, got 7:9"),
        ("reconstruct {folder} --frames 3", "frames must be A:B or A:B:S, got 3"),
        ("reconstruct {folder} --segment-length -2", "--segment-length must be"),
        (
            "run {folder} --source-axes rdf",
            "--source-axes, --meters-per-unit, --drop-invalid and --persistent must be left out for a capture",
        ),
        (
            "run {folder} --persistent",
            "--source-axes, --meters-per-unit, --drop-invalid and --persistent must be left out for a capture",
        ),
        ("run {folder} --samples 0", "--samples must be"),
        ("run {folder} --fps 0", "--fps must be"),
        ("run {folder} --frames 9:", "frames must hold some"),
        ("run {folder} --environment none.exr", "none.exr"),
        ("run {dark}", "environment must be given, got none for"),
        ("run some.ply", "Gaussians come without their light"),
        ("run some.ply --gaussians 9", "must be left out unless the input is a capture"),
    ],
)
def test_mistakes_cost_no_reconstruction(folder, asked, tmp_path, refused, words, says):
    dark = write_capture(tmp_path / "dark", (0,), environment=False)
    words = words.format(folder=folder, dark=dark)
    refused(*words.split(), "--out", tmp_path / "out", says=says)


@pytest.mark.parametrize(
    ("alpha", "says"),
    [
        (0, "got 24 images are of nothing, by mask or alpha, and left out"),
        (255, "got mask or alpha of 24 images of 24 is white everywhere: background counts as the subject does at c00"),
    ],
)
def test_masks_that_tell_nothing_are_named(tmp_path, refused, alpha, says):
    content = write_sound(tmp_path / "capture", frames=2)
    for entry in content["frames"]:
        rewrite(tmp_path / "capture" / entry["file_path"], lambda pixels: pixels[..., 3].fill(alpha))
    refused("reconstruct", tmp_path / "capture", "--out", tmp_path / "out", says=says)


def test_a_run_from_images_to_an_asset_and_again(folder, asked, tmp_path, capsys):
    words = ("run", folder, "--out", tmp_path / "out", "--samples", 4, "--device", "cpu", "--frames", ":2")
    assert beam(*words) == 0
    said = capsys.readouterr()
    assert "2 frames, 1 segment, 60 Gaussians" in said.out
    assert "asset.usda: 2 frames" in said.out
    assert "exposure of the light +0.00 stops" in said.out
    assert (tmp_path / "out" / "reconstruction" / "gaussians.usda").is_file()
    assert (tmp_path / "out" / "asset.usda").is_file()
    assert beam(*words, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["resumed_frames"] == report["reconstruction"]["resumed_frames"] == 2
    assert report["persistent"]


class TestDetection:
    def test_a_folder_or_its_file(self, folder):
        assert capture_at(folder).frames == (0, 1, 2, 3)
        assert capture_at(folder / "transforms.json").frames == (0, 1, 2, 3)

    def test_numbered_gaussians_are_no_capture(self, tmp_path):
        (tmp_path / "frame_0.ply").touch()
        assert capture_at(tmp_path) is None
        assert capture_at(tmp_path / "frame_0.ply") is None

    def test_a_broken_capture_is_a_capture(self, tmp_path):
        (tmp_path / "frame_0.ply").touch()
        (tmp_path / "transforms.json").write_text("{")
        with pytest.raises(AssetFormatError, match="capture must be JSON"):
            capture_at(tmp_path)

    def test_an_empty_folder(self, tmp_path):
        with pytest.raises(MissingFileError, match="capture must be a folder with"):
            capture_at(tmp_path)


def test_the_words_reach_the_optimiser(folder):
    """What is asked on the command line is what the steps are made of, and goes into the keys of the store."""
    capture = Capture.read(folder)
    steps = steps_of(Modelling(gaussians=123, preset="paper"), capture, seed=7, device="cpu", environment=None)
    asked = json.loads(json.dumps(steps.options()))["fitting"]
    assert (asked["gaussian_count"], asked["seed"]) == (123, 7)
    assert steps.device == "cpu"
    fast = steps_of(Modelling(gaussians=123), capture, 7, "cpu", EnvironmentMap.constant([1.0, 1.0, 1.0]))
    assert steps.options() != fast.options()
    assert steps.options()["environment"] != fast.options()["environment"]


@pytest.mark.parametrize(
    ("words", "frames"),
    [("2:6", (2, 4)), (":3", (0, 2)), ("3:", (4, 6, 8)), ("::2", (0, 4, 8)), (":", (0, 2, 4, 6, 8))],
)
def test_words_for_frames(words, frames):
    assert frames_of(words, (0, 2, 4, 6, 8)) == frames


@pytest.mark.parametrize("words", ["", "3", "a:b", "1:2:0", "1:2:3:4"])
def test_words_for_no_frames(words):
    with pytest.raises(InvalidOptionError, match="frames must be A:B or A:B:S"):
        frames_of(words, (0, 1, 2))


@pytest.mark.slow
def test_the_walker(data_dir, asked, tmp_path, capsys):
    """A real capture goes all the way through: two frames, its own light."""
    walker = data_dir / "captures" / "walker"
    words = ("run", walker, "--out", tmp_path / "out", "--samples", 4, "--device", "cpu", "--frames", "0:2", "--json")
    assert beam(*words) == 0
    report = json.loads(capsys.readouterr().out)["reconstruction"]
    assert report["input"]["cameras"] == 24
    assert np.isfinite(report["mean_psnr"])
    assert len(Capture.read(walker).select(split="train", frames=[0])) == report["input"]["cameras"]


class TestContradictions:
    """Cameras that do not show one subject are named in one line, before hours are spent on them."""

    @staticmethod
    def write(folder, views):
        """Write cut-outs and their cameras as a capture of one frame."""
        folder.mkdir()
        records = []
        for k, view in enumerate(views):
            path = f"{k}.exr"
            write_exr(folder / path, {"RGBA"[i]: view.color[..., i] for i in range(3)} | {"A": view.alpha})
            pose = view.camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
            records.append({"file_path": path, "camera": f"c{k}", "frame": 0, "transform_matrix": pose.tolist()})
        camera = views[0].camera
        content = {"w": camera.width, "h": camera.height, "fl_x": camera.focal_x, "fl_y": camera.focal_y}
        content |= {"cx": camera.center_x, "cy": camera.center_y, "frames": records}
        (folder / "transforms.json").write_text(json.dumps(content))
        return folder

    @pytest.mark.parametrize("case", ["mixed", "contradicting"])
    def test_the_culprits_are_named(self, case, tmp_path, capsys):
        cameras = rig(11, 48)
        views = ball_views(cameras)
        if case == "mixed":  # with a capture of another place, by the same cameras
            others = ball_views(cameras, center=(0.3, 0.3, 0.3))
            views = [others[k] if k in (1, 4, 6, 8) else view for k, view in enumerate(views)]
        else:
            turned = {1: 0.18, 4: -0.18, 6: 0.2, 8: -0.2}
            views = [
                replace(view, camera=moved_camera(view.camera, [turned.get(k, 0.0), *[0.0] * 8]))
                for k, view in enumerate(views)
            ]
        words = ("reconstruct", self.write(tmp_path / case, views), "--out", tmp_path / "out", "--device", "cpu")
        assert beam(*words, "--gaussians", 500, "--preset", "draft", "--quiet") == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert "got 4 of 11 that contradict the others at c1, c4, c6, c8. Check that no two captures are mixed" in line
        kept = {path.relative_to(tmp_path / "out") for path in (tmp_path / "out").rglob("*") if path.is_file()}
        places = {path.parts[0] for path in kept}
        assert places <= {"digests", "masks.json", "plan", "steps"}  # which a second call need not make again
