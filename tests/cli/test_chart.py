"""`beam chart` as a user meets it: a small study end to end, drawing again, and one line for every mistake."""

import json

import numpy as np
import pytest
from support.commands import beam

from beam_warp import GaussianSequence, write
from beam_warp.image.files import write_exr
from beam_warp.study import tracing
from beam_warp.study.materials import MaterialsSubject
from beam_warp.study.table import read_table
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.shapes import still_life

QUICK = (
    *("--device", "cpu", "--points", 8, "--reference-rays", 64, "--repeats", 1, "--rays", 4, 8),
    *("--samplers", "owen", "--densities", "product", "--offsets", "auto", "0.01"),
)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr("beam_warp.study.picture.RESOLUTION", 30)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "still.ply"
    write(GaussianSequence.from_clouds([still_life(400)]), path)
    return path


def test_measure_then_draw_again(scene, tmp_path, capsys):
    out = tmp_path / "made" / "here"
    write_exr(tmp_path / "sky.exr", dict.fromkeys("RGB", np.ones((16, 32), np.float32)))
    words = (scene, "--environment", tmp_path / "sky.exr", "--out", out)
    assert beam("chart", "tracing", *words, *QUICK, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["measured"] == report["planned"]
    assert report["skipped"] == []
    assert report["frontier"]["occlusion_error"][0]["rays"] == 4
    assert "still.ply" in report["title"]
    assert report["notes"]["Light"] == "sky.exr"
    names = {"tracing.csv", "tracing.png", "tracing.html", "tracing.references.npz"}
    assert {path.name for path in out.iterdir()} == names

    # A table that was cut short draws as well
    text = (out / "tracing.csv").read_text(encoding="utf-8")
    short = tmp_path / "short.csv"
    short.write_text(text[: len(text) * 3 // 4], encoding="utf-8")
    again = tmp_path / "again"
    assert beam("chart", "tracing", "--from-csv", short, "--out", again) == 0
    said = capsys.readouterr().out
    assert f"{len(read_table(short).rows)} of {report['planned']} planned settings measured" in said
    assert {path.name for path in again.iterdir()} == {"tracing.png", "tracing.html"}


def test_quiet_and_budget(scene, tmp_path, capsys):
    words = ("chart", "tracing", scene, "--out", tmp_path, *QUICK, "--budget-seconds", 0)
    assert beam(*words, "--quiet") == 0
    said = capsys.readouterr()
    assert said.out == said.err == ""
    assert len(read_table(tmp_path / "tracing.csv").rows) == 1
    assert beam(*words) == 0  # one more: the budget is for each call
    said = capsys.readouterr()
    assert "2 of" in said.out
    assert "skipped for the budget" in said.err


def test_stop_keeps_what_was_measured(scene, tmp_path, capsys, monkeypatch):
    measure, measured = tracing._Bench.measure, []

    def stop_later(self, settings):
        if len(measured) == 2:
            raise KeyboardInterrupt
        measured.append(settings)
        return measure(self, settings)

    monkeypatch.setattr(tracing._Bench, "measure", stop_later)
    assert beam("chart", "tracing", scene, "--out", tmp_path, *QUICK) == 130
    assert "tracing.partial.csv: call again to continue" in capsys.readouterr().err
    assert len(read_table(tmp_path / "tracing.partial.csv").rows) == 2


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("tracing none.ply", "input must be an existing file or folder, got none.ply"),
        ("tracing none.xyz", "file name must end in one of"),
        ("tracing --environment none.exr", "none.exr"),
        ("tracing --from-csv none.csv", "table must be a readable file, got none.csv"),
        ("tracing scene.ply --from-csv none.csv", "from-csv must be given without a scene"),
        ("tracing --samplers sobol", "samplers must be one of owen, stratified, iid, got 'sobol'"),
        ("tracing --offsets 3x", "offsets must be auto, metres"),
        ("tracing --rays 1", "rays must be an integer in [4, 65536], got 1"),
        ("tracing --budget-seconds nan", "budget-seconds must be a number"),
        ("materials asset.usda", "capture must be given with an asset, got asset.usda alone"),
        ("materials --capture none", "capture must be a folder"),
        ("materials --capture none --from-csv none.csv", "from-csv must be given without an asset, a capture"),
        ("materials --samplers sobol", "samplers must be one of owen, stratified, iid, got 'sobol'"),
        ("materials --offsets 3t", "offsets must be auto or metres"),
        ("materials --budget-seconds nan", "budget-seconds must be a number"),
        ("materials --device cuda:99", "device must be one of"),
    ],
)
def test_mistakes(words, says, tmp_path, refused):
    refused("chart", *words.split(), "--out", tmp_path / "out", says=says)


def test_frame_device_and_folder_mistakes(scene, tmp_path, refused):
    (tmp_path / "file").write_text("in the way")
    for words, says in (
        (("--frame", 3, "--out", tmp_path / "out"), "frame must be an integer in [0, 0], got 3"),
        (("--device", "cuda:99", "--out", tmp_path / "out"), "device must be one of"),
        ((*QUICK, "--out", tmp_path / "file"), "out must be a folder"),
    ):
        refused("chart", "tracing", scene, *words, says=says)


MATERIALS = (
    *("--device", "cpu", "--rays", 4, "--samplers", "owen", "--densities", "product", "--ratios", "ratio"),
    *("--offsets", "auto", "0.02", "--bounces", "one", "--weights", "albedo_scaling", "--fits", "robust"),
    *("--observed", "difference", "--denoisers", "none", "--budget-seconds", 1e6),  # none is skipped, however slow
)


@pytest.mark.slow
def test_materials_of_a_capture_with_its_true_surface(tiny_capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("beam_warp.study.materials.GAUSSIANS", {False: 500})
    words = ("--capture", tiny_capture.folder, "--out", tmp_path, "--budget-seconds", 3600)
    assert beam("chart", "materials", *words, *MATERIALS, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["measured"] == report["planned"] == 3  # auto and 0.02 m directly, 0.02 m by images
    assert set(report["frontier"]) == {"occlusion_error", "color_error"}
    assert {path.name for path in tmp_path.iterdir()} == {"materials.csv", "materials.png", "materials.html"}
    again = tmp_path / "again"
    words = ("--from-csv", tmp_path / "materials.csv", "--out", again)
    assert beam("chart", "materials", *words) == 0
    assert "3 of 3 planned settings measured" in capsys.readouterr().out


def test_materials_of_an_asset(tiny_capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("beam_warp.study.materials.GAUSSIANS", {False: 300})
    light = EnvironmentMap.read(tiny_capture.environment_path)
    cloud = MaterialsSubject.on_true_surface(tiny_capture, light, 0, "tiny", "cpu").cloud
    (tmp_path / "figure").mkdir()
    write(GaussianSequence.from_clouds([cloud]), tmp_path / "figure" / "asset.usda")
    words = (tmp_path / "figure" / "asset.usda", "--capture", tiny_capture.folder, "--out", tmp_path / "chart")
    assert beam("chart", "materials", *words, *MATERIALS, "--budget-seconds", 0, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["measured"] == 1
    assert report["title"].startswith("Error against time of materials: figure, 300 Gaussians")
