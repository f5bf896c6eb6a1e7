"""``beam stability``: tables, page, JSON of several devices side by side, exit codes; on a few small cases."""

import dataclasses
import json

import pytest
import tyro
from tyro.conf import FlagCreatePairsOff

from beam_warp import analytic_occlusion, stability, stress_cases
from beam_warp.cli.console import run_command
from beam_warp.cli.stability import Stability
from beam_warp.cli.stability import stability as run_stability

NAMES = ("one Gaussian", "broken rows", "2 million Gaussians")


@pytest.fixture(autouse=True)
def few_cases(monkeypatch):
    monkeypatch.setattr(stress_cases, "CASES", [stress_cases.case_of(name) for name in NAMES])
    disc = next(shape for shape in analytic_occlusion.SHAPES if shape.name == "coaxial disc")
    monkeypatch.setattr(analytic_occlusion, "SHAPES", (dataclasses.replace(disc, spacing=0.2),))


def run(*words):
    args = tyro.cli(Stability, args=["--device", "cpu", *map(str, words)], config=(FlagCreatePairsOff,))
    return run_command(lambda: run_stability(args))


def test_tables(capsys):
    assert run() == 0
    out, err = capsys.readouterr()
    assert "stress cases on cpu" in out
    assert "10 with a zero quaternion" in out
    assert "coaxial disc" in out
    assert "2 million" not in out
    assert err == ""


def test_page(tmp_path, capsys):
    assert run("--out", tmp_path / "page.md", "--quiet") == 0
    assert capsys.readouterr().out == ""
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "| error, cpu | verdict |" in page
    row = next(line for line in page.splitlines() if line.startswith("| broken rows |"))
    assert "60 not finite, 10 with a negative scale, 10 with a zero quaternion | left out |" in row
    assert row.endswith("| ok |")
    assert [path.name for path in tmp_path.iterdir()] == ["page.md"]


def test_json_of_another_device_stands_beside(tmp_path, capsys):
    assert run("--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["passed"]
    assert [(row["case"], row["hierarchy"]) for row in record["cases"]] == [
        (name, hierarchy) for name in NAMES[:2] for hierarchy in stability.HIERARCHIES
    ]
    for row in (*record["cases"], *record["occlusion"]):
        row["device"] = "Some GPU"
    record["cases"][1]["faults"] = ["3 rays differ by more than rounding explains"]
    (tmp_path / "gpu.json").write_text(json.dumps(record), encoding="utf-8")
    assert run("--out", tmp_path / "page.md", "--beside", tmp_path / "gpu.json", "--quiet") == 0
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "| error, cpu | error, Some GPU | verdict |" in page
    assert "| Some GPU, wide, fast: 3 rays differ by more than rounding explains |" in page


def test_a_fault_is_told_and_exits_with_one(monkeypatch, capsys):
    case = stress_cases.case_of("one Gaussian")
    broken = dataclasses.replace(case, build=lambda: dataclasses.replace(case.build(), expected={"traced": 2}))
    monkeypatch.setattr(stress_cases, "CASES", [broken])
    assert run("--quiet") == 1
    assert "failed: one Gaussian on cpu, wide: traced must be 2, got 1" in capsys.readouterr().err


def test_results_that_are_none_are_refused(tmp_path, capsys):
    (tmp_path / "other.json").write_text('{"cases": [{}]}', encoding="utf-8")
    assert run("--beside", tmp_path / "other.json") == 2
    assert "beside must be what beam stability --json printed, got other.json" in capsys.readouterr().err
    assert run("--beside", tmp_path / "none.json") == 2
    assert "beside must be a file, got" in capsys.readouterr().err


def test_a_folder_that_is_not_there_is_refused(tmp_path, capsys):
    assert run("--out", tmp_path / "none" / "page.md") == 2
    assert "out must be in a folder that exists" in capsys.readouterr().err


def test_a_device_that_is_not_there_is_refused(capsys):
    args = tyro.cli(Stability, args=["--device", "cuda:99"], config=(FlagCreatePairsOff,))
    assert run_command(lambda: run_stability(args)) == 2
    assert "device must be one of cpu" in capsys.readouterr().err
