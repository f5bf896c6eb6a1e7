"""Contents that once ended in a traceback or in gigabytes, each refused in one line or read soon."""

import json
import resource
import time

import pytest
from hostile import corpus
from support.commands import beam

import beam_warp
from beam_warp.capture.inspect import inspect_capture


def changed(path, /, *steps, **fields):
    """Change fields of a JSON file, in the object that steps lead to."""
    content = json.loads(path.read_text())
    place = content
    for step in steps:
        place = place[step]
    place |= fields
    path.write_text(json.dumps(content))
    return path


def tiny_lens(folder):
    return changed(corpus.nerfstudio(folder), k1=1e-320, camera_model="OPENCV_FISHEYE").parent


def lone_surrogate(folder):
    return changed(corpus.nerfstudio(folder), "frames", 0, file_path="a\ud800.png").parent


def far_pose(folder):
    pose = [*corpus.POSE[:2], [0.0, 0.0, 1.0, 1e300], corpus.POSE[3]]
    return changed(corpus.nerfstudio(folder), "frames", 0, transform_matrix=pose).parent


def color_space(folder):
    return changed(corpus.projection_options(folder), color_space={}).parent


def home_of_nobody(folder):
    return changed(corpus.nerfstudio(folder), "frames", 0, file_path="~nosuchuser/x.png").parent


@pytest.mark.parametrize("make", [tiny_lens, lone_surrogate, far_pose, color_space, home_of_nobody])
def test_captures(make, tmp_path, capsys):
    code = beam("inspect", make(tmp_path))
    printed = capsys.readouterr()
    assert code in (0, 1, 2)
    assert "Traceback" not in printed.err
    if code == 2:
        assert printed.err.startswith("error: ")
        assert printed.err.count("\n") == 1


@pytest.mark.parametrize(
    ("steps", "fields"),
    [((), {"duration": 1e9}), (("assets", 0), {"path": "~nosuchuser/x.ply"}), ((), {"environment": "\ud800.exr"})],
)
def test_stages(tmp_path, capsys, steps, fields):
    stage = changed(corpus.stage(tmp_path), *steps, **fields)
    assert beam("render", stage, "--out", tmp_path / "o.png", "--device", "cpu") == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    assert not (tmp_path / "o.png").exists()


def test_a_user_who_is_not_there(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert beam("inspect", "~nosuchuser/x") == 2
    assert capsys.readouterr().err.startswith("error: capture must be a folder with")


@pytest.mark.slow
def test_thousands_of_records_of_one_pose(tmp_path):
    """Comparing all of them with all took 5.6 GB and 89 s."""
    path = corpus.nerfstudio(tmp_path)
    record = json.loads(path.read_text())["frames"][0]
    frames = [{**record, "camera": f"c{number}", "frame": number % 2} for number in range(4000)]
    changed(path, frames=frames, train_filenames=["a.png"])
    begun, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    report = inspect_capture(beam_warp.Capture.read(tmp_path), max_images=4)
    assert report.findings
    assert time.process_time() - begun < 20.0
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) * 1024 < 256 * 2**20 + 2 * path.stat().st_size
