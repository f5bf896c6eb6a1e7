"""``beam stability``: tables, page, JSON of several devices side by side, exit codes; on a few small cases."""

import dataclasses
import json

import pytest
import tyro
from tyro.conf import FlagCreatePairsOff

from beam_warp.cli.console import run_command
from beam_warp.cli.stability import Stability
from beam_warp.cli.stability import stability as run_stability
from beam_warp.stability import analytic_occlusion
from beam_warp.stability import capture_cases as stress_captures
from beam_warp.stability import material_cases as stress_materials
from beam_warp.stability import page as stability_page
from beam_warp.stability import relighting_cases as stress_relighting
from beam_warp.stability import tracing as stability
from beam_warp.stability import tracing_cases as stress_cases
from beam_warp.stability.capture_cases.cameras import black_camera

NAMES = ("one Gaussian", "broken rows", "2 million Gaussians")


@pytest.fixture(autouse=True)
def few_cases(monkeypatch):
    monkeypatch.setattr(stress_cases, "CASES", [stress_cases.case_of(name) for name in NAMES])
    disc = next(shape for shape in analytic_occlusion.SHAPES if shape.name == "coaxial disc")
    assert stability_page.CAPTURE_CASES  # imported before: tables name all of them
    monkeypatch.setattr(stress_captures, "CAPTURE_CASES", [])
    monkeypatch.setattr(stress_materials, "MATERIAL_CASES", [])
    monkeypatch.setattr(stress_relighting, "RELIGHTING_CASES", [])
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
    assert "| Some GPU, fast: 3 rays differ by more than rounding explains |" in page


def test_a_fault_is_told_and_exits_with_one(monkeypatch, capsys):
    case = stress_cases.case_of("one Gaussian")
    broken = dataclasses.replace(case, build=lambda: dataclasses.replace(case.build(), expected={"traced": 2}))
    monkeypatch.setattr(stress_cases, "CASES", [broken])
    assert run("--quiet") == 1
    assert "failed: one Gaussian on cpu, quality: traced must be 2, got 1" in capsys.readouterr().err


@pytest.fixture
def one_capture(monkeypatch, tiny_capture):
    """A case that is run for real, of as few steps as there can be, on a capture that is there."""
    from beam_warp.stability import reconstruct
    from beam_warp.stability.capture_cases.studio import StressStudio

    class Effort(reconstruct.StressEffort):
        def studio(self, folder, device):
            return StressStudio(folder, given=tiny_capture, device=device)

    effort = Effort(size=64, camera_count=6, gaussian_count=300, fit=(4, 2), levels=(1, 1, 1), refinement=1)
    monkeypatch.setattr(reconstruct, "QUICK", effort)
    monkeypatch.setattr(stress_captures, "CAPTURE_CASES", [black_camera])


def test_captures_alone(one_capture, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text(
        "# Stability\n\nrays\n\n## Captures on which reconstructions fail\n\nwhat was before\n", encoding="utf-8"
    )
    assert run("--only", "reconstruction", "--out", page) == 0
    out, _ = capsys.readouterr()
    assert "stress captures on cpu" in out
    assert "black-image of" in out
    assert "coaxial disc" not in out
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# Stability\n\nrays\n\n## Captures")  # what was not run stays
    assert "what was before" not in text
    row = next(line for line in text.splitlines() if line.startswith("| black camera |"))
    assert "black-image of train_03 | 1 of 6 cameras left out, told |" in row  # told: six cameras are few
    assert row.endswith("| ok |")


def test_tracing_alone_keeps_captures(one_capture, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text(
        "# Stability\n\nrays of before\n\n## Captures on which reconstructions fail\n\nkept\n", encoding="utf-8"
    )
    assert run("--only", "tracing", "--out", page, "--quiet") == 0
    text = page.read_text(encoding="utf-8")
    assert "| broken rows |" in text
    assert "rays of before" not in text
    assert text.endswith("\n## Captures on which reconstructions fail\n\nkept\n")


def test_captures_of_another_device_stand_below(one_capture, tmp_path, capsys):
    assert run("--only", "reconstruction", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    record["captures"][0] |= {"device": "Some GPU", "faults": ["not detected: black-image of train_03"]}
    (tmp_path / "gpu.json").write_text(json.dumps(record), encoding="utf-8")
    page = tmp_path / "page.md"
    assert run("--only", "reconstruction", "--beside", tmp_path / "gpu.json", "--out", page, "--quiet") == 0
    text = page.read_text(encoding="utf-8")
    assert text.index("cpu: 6 cameras of 64 x 64 pixels") < text.index("Some GPU: 6 cameras of 64 x 64 pixels")
    assert "| not detected: black-image of train_03 |" in text


def test_a_capture_at_fault_exits_with_one(one_capture, monkeypatch, capsys):
    from beam_warp.stability.capture_cases.case import CaptureStress, Detection

    broken = dataclasses.replace(
        black_camera,
        build=lambda at: CaptureStress(capture=at.brief(), required=(Detection("black-image", "train_03"),)),
    )
    monkeypatch.setattr(stress_captures, "CAPTURE_CASES", [broken])
    assert run("--only", "reconstruction", "--quiet") == 1
    assert "failed: black camera on cpu: not detected: black-image of train_03" in capsys.readouterr().err


@pytest.fixture
def one_light(monkeypatch):
    """A case that is refused before it is measured, so that it takes no time."""
    case = next(case for case in stability_page.MATERIAL_CASES if case.name == "black environment")
    studio = stress_materials.MaterialStudio("cpu", camera_count=2, size=8, samples=1, subdivisions=1)
    monkeypatch.setattr(stress_materials, "MaterialStudio", lambda device: studio)
    monkeypatch.setattr(stress_materials, "MATERIAL_CASES", [case])
    return case


def test_materials_alone(one_light, tmp_path, capsys):
    page = tmp_path / "page.md"
    captures = "## Captures on which reconstructions fail\n\nkept\n"
    page.write_text(f"# Stability\n\nrays\n\n{captures}", encoding="utf-8")
    assert run("--only", "materials", "--out", page) == 0
    out, _ = capsys.readouterr()
    assert "materials on cpu" in out
    assert "coaxial disc" not in out
    text = page.read_text(encoding="utf-8")
    assert text.startswith(f"# Stability\n\nrays\n\n{captures}\n## Materials\n")
    row = next(line for line in text.splitlines() if line.startswith("| black environment |"))
    assert "refused: environment must shed light" in row
    assert row.endswith("| ok |")


def test_other_parts_keep_materials(one_light, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("# Stability\n\nrays of before\n\n## Materials\n\nkept\n", encoding="utf-8")
    assert run("--only", "tracing", "--out", page, "--quiet") == 0
    text = page.read_text(encoding="utf-8")
    assert "rays of before" not in text
    assert text.endswith("| ok |\n\n## Materials\n\nkept\n")


def test_materials_of_another_device_stand_below(one_light, tmp_path, capsys):
    assert run("--only", "materials", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    record["materials"][0] |= {"device": "Some GPU", "faults": ["must be refused, and was not"]}
    (tmp_path / "gpu.json").write_text(json.dumps(record), encoding="utf-8")
    page = tmp_path / "page.md"
    assert run("--only", "materials", "--beside", tmp_path / "gpu.json", "--out", page, "--quiet") == 0
    text = page.read_text(encoding="utf-8")
    assert text.index("cpu: 42 Gaussians") < text.index("Some GPU: 42 Gaussians")
    assert "| must be refused, and was not |" in text


def test_materials_at_fault_exit_with_one(one_light, monkeypatch, capsys):
    def build(studio):
        return dataclasses.replace(one_light.build(studio), refused=False)

    monkeypatch.setattr(stress_materials, "MATERIAL_CASES", [dataclasses.replace(one_light, build=build)])
    assert run("--only", "materials", "--quiet") == 1
    assert "failed: black environment on cpu: refused: environment must shed light" in capsys.readouterr().err


@pytest.fixture
def leaking_front(monkeypatch):
    """Two Gaussians: paths hold what is asked, the deferred renderer does not."""
    cases = stability_page.RELIGHTING_CASES
    case = next(case for case in cases if case.name == "a leaking front before a dark inside")
    monkeypatch.setattr(stress_relighting, "RELIGHTING_CASES", [case])
    return case


def test_relighting_alone(leaking_front, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("# Stability\n\nrays\n\n## Materials\n\nkept\n", encoding="utf-8")
    assert run("--only", "relighting", "--out", page) == 1
    out, err = capsys.readouterr()
    assert "relighting on cpu" in out
    assert "coaxial disc" not in out
    assert err.startswith("failed: a leaking front before a dark inside on cpu, deferred: radiance, of the front's own")
    assert err.count("\n") == 1
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# Stability\n\nrays\n\n## Materials\n\nkept\n\n## Relighting\n")
    assert "1 of 2 hold." in text
    by_paths = next(line for line in text.splitlines() if "| path |" in line)
    assert by_paths.startswith("| a leaking front before a dark inside |")
    assert by_paths.endswith("| ok |")


def test_other_parts_keep_relighting(tmp_path, capsys):
    page = tmp_path / "page.md"
    after = "## Materials\n\nkept\n\n## Relighting\n\nkept too\n"
    page.write_text(f"# Stability\n\nrays of before\n\n{after}", encoding="utf-8")
    assert run("--only", "tracing", "--out", page, "--quiet") == 0
    text = page.read_text(encoding="utf-8")
    assert "rays of before" not in text
    assert text.endswith(f"\n\n{after}")


def test_relighting_of_another_device_stands_below(leaking_front, tmp_path, capsys):
    assert run("--only", "relighting", "--json") == 1
    record = json.loads(capsys.readouterr().out)
    assert [row["renderer"] for row in record["relighting"]] == ["deferred", "path"]
    for row in record["relighting"]:
        row["device"] = "Some GPU"
    (tmp_path / "gpu.json").write_text(json.dumps(record), encoding="utf-8")
    page = tmp_path / "page.md"
    assert run("--only", "relighting", "--beside", tmp_path / "gpu.json", "--out", page, "--quiet") == 1
    text = page.read_text(encoding="utf-8")
    assert text.index("cpu: images of") < text.index("Some GPU: images of")


def test_large_relighting_is_run_on_request(leaking_front, monkeypatch, capsys):
    large = dataclasses.replace(leaking_front, large=True)
    monkeypatch.setattr(stress_relighting, "RELIGHTING_CASES", [large])
    assert run("--only", "relighting", "--json") == 0
    assert json.loads(capsys.readouterr().out)["relighting"] == []
    assert run("--only", "relighting", "--large", "--quiet") == 1


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
