"""Targets instead of settings as a user meets them: chosen by a pilot, stated in the report, refused with an offer."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from support.commands import beam
from support.fake_steps import FakeSteps, write_capture
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp import GaussianSequence, write
from beam_warp.image.color import LINEAR_REC709
from beam_warp.image.files import write_exr
from beam_warp.study.table import read_table

RENDER = ("--width", 32, "--device", "cpu", "--json")


@pytest.fixture(autouse=True)
def small_pilots(monkeypatch):
    monkeypatch.setattr("beam_warp.cli.common.targets.PILOT_RAYS", (4, 8))
    monkeypatch.setattr("beam_warp.study.relighting.TRUE_PIXELS", {False: 24, True: 24})
    monkeypatch.setattr("beam_warp.study.relighting.TRUE_PATHS", {False: 32, True: 32})
    monkeypatch.setattr("beam_warp.study.picture.RESOLUTION", 30)


@pytest.fixture
def folder(tmp_path):
    """Gaussians of unknown material, an asset of the same, and a light."""
    points, spacing = sphere_points(300)
    bare = tiles(points, points, spacing)
    known = {"base_color": np.full((300, 3), 0.5), "roughness": np.full(300, 0.5), "ambient_occlusion": np.ones(300)}
    color = {"radiance": np.full((300, 1, 3), 0.4), "radiance_color_space": LINEAR_REC709}
    write(GaussianSequence.from_clouds([cloud_of(bare, **color)]), tmp_path / "ball.ply")
    write(GaussianSequence.from_clouds([cloud_of(bare, **known, normals=points)]), tmp_path / "asset.usda")
    write_exr(tmp_path / "sky.exr", dict.fromkeys("RGB", np.ones((16, 32), np.float32)))
    return tmp_path


def said(capsys):
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "decompose"])
def test_materials(folder, capsys, command):
    out = folder / "out"
    words = (command, folder / "ball.ply", "--environment", folder / "sky.exr", "--out", out, "--device", "cpu")
    assert beam(*words, "--target-error", 9, "--json") == 0
    report = said(capsys)
    target = report["target"]
    assert target["asked"] == {"error": 9.0}
    assert target["chosen"] == {"samples": 4}  # the cheapest there is
    assert report["options"]["materials"]["sample_count"] == 4
    assert target["reached"]["error"] == report["materials"]["mean_base_color_error_where_measured"]
    assert target["met"]
    assert report == json.loads((out / "report.json").read_text())


@pytest.fixture
def captured(tmp_path, monkeypatch):
    """A capture, and the steps that were asked for; fakes do them, each with the same error."""
    asked = []

    def steps_of(modelling, capture, seed, device, environment, **fitting):
        asked.append((modelling.gaussians, modelling.preset, *fitting))
        return FakeSteps(count=60, seed=seed)

    monkeypatch.setattr("beam_warp.cli.reconstruct.steps_of", steps_of)
    return write_capture(tmp_path / "capture", range(2)), asked


def test_reconstruction(captured, tmp_path, capsys):
    capture, asked = captured
    words = ("reconstruct", capture, "--out", tmp_path / "out", "--json")
    assert beam(*words, "--target-error", 0.5) == 0
    target = said(capsys)["target"]
    assert target["chosen"] == {"gaussians": 6250, "preset": "draft"}
    assert target["met"]
    assert asked == [(6250, "draft")] * 2  # the pilot and the job
    asked.clear()
    assert beam(*words, "--target-seconds", 1e6) == 0
    chosen = said(capsys)["target"]["chosen"]
    drafts = [(count, "draft", "reflect_until") for count in (6250, 12_500, 25_000)]
    assert asked[0] == drafts[0]  # compiles
    assert asked[-4:-1] == drafts  # and these cost for each step what a longer one would
    assert asked[-1] == (chosen["gaussians"], chosen["preset"])
    assert beam(*words, "--target-seconds", 1e6, "--gaussians", 80) == 0
    assert said(capsys)["target"]["chosen"]["gaussians"] == 80  # what is stated stays


@pytest.mark.parametrize(("seconds", "is_met"), [(70, True), (60, False)])
def test_pilots_end_when_their_part_of_the_time_is_over(
    captured, tmp_path, monkeypatch, capsys, refused, seconds, is_met
):
    """Each fit takes 10 s: three tell the way of frames, the fourth is the cheapest setting's, whose job takes 20."""
    capture, asked = captured
    monkeypatch.setattr("beam_warp.cli.reconstruct.time", SimpleNamespace(perf_counter=lambda: 10.0 * len(asked)))
    words = ("reconstruct", capture, "--out", tmp_path / "out", "--json", "--target-seconds", seconds)
    if is_met:
        assert beam(*words) == 0
        assert said(capsys)["target"]["chosen"] == {"gaussians": 6250, "preset": "draft"}
        assert len(asked) == 5
    else:
        refused(*words, says="target-seconds must be attainable, got 60: the nearest is 78")
        assert len(asked) == 4


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("decompose ball.ply --preset paper --capture capture --target-error 1", "targets must be left out with the"),
        ("reconstruct capture --target-error 1e-6", "--target-error must be attainable, got 1e-06: the nearest is 0.0"),
        ("reconstruct capture --target-seconds nan", "--target-seconds must be a number in"),
        ("run capture --target-fps 3", "--target-fps must be left out for a capture, got 3"),
    ],
)
def test_mistakes(folder, captured, monkeypatch, refused, words, says):
    monkeypatch.chdir(folder)
    refused(*words.split(), "--out", "out", says=says)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "mode"),
    [
        (("--target-error", 0.9), "deferred"),
        (("--target-fps", 1e-3, "--samples", 1), "deferred"),
        (("--mode", "path", "--target-error", 0.3), "path"),
        (("--target-error", 0.9, "--target-seconds", 1e6, "--environment-shadows", 4), "deferred"),
    ],
)
def test_render(folder, capsys, words, mode):
    lit = (folder / "asset.usda", "--environment", folder / "sky.exr", "--out", folder / "x.png")
    assert beam("render", *lit, *RENDER, *words) == 0
    report = said(capsys)
    assert report["mode"] == report["target"]["chosen"]["mode"] == mode
    assert report["target"]["met"]
    if "--environment-shadows" in words:
        assert report["target"]["chosen"]["environment_shadows"] == 4


@pytest.mark.slow
def test_charts_of_an_asset_on_one_page(folder, capsys):
    out = folder / "chart"
    lit = ("--environment", folder / "sky.exr", "--device", "cpu", "--out", out)
    assert beam("chart", "all", folder / "asset.usda", *lit, "--budget-seconds", 1, "--json") == 0
    charts = said(capsys)["charts"]
    assert [table["measured"] > 0 for table in charts] == [True] * 3
    assert {path.name for path in out.glob("*.html")} == {
        f"{n}.html" for n in ("chart", "render", "delivery", "tracing")
    }
    rows = read_table(out / "delivery.csv").rows
    assert rows[0].errors["relit_error"].value >= 0.0


@pytest.mark.slow
def test_chart_of_a_reconstruction(tiny_capture, tmp_path, capsys):
    words = ("--gaussians", 100, 200, "--schedules", "draft", "--shares", 1, "--device", "cpu", "--json")
    assert beam("chart", "reconstruct", tiny_capture.folder, "--out", tmp_path, "--budget-seconds", 1e6, *words) == 0
    report = said(capsys)
    assert report["measured"] == report["planned"] == 2
    rows = read_table(tmp_path / "reconstruct.csv").rows
    assert 0.0 < rows[-1].errors["color_error"].value < 0.5
