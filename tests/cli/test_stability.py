"""``beam stability``: tables, page, JSON of several devices side by side, exit codes; on a few small cases."""

import dataclasses
import json

import pytest

from beam_warp.cli.main import main
from beam_warp.stability import analytic_occlusion
from beam_warp.stability import capture_cases as stress_captures
from beam_warp.stability import material_cases as stress_materials
from beam_warp.stability import page as stability_page
from beam_warp.stability import relighting_cases as stress_relighting
from beam_warp.stability import tracing as stability
from beam_warp.stability import tracing_cases as stress_cases
from beam_warp.stability.capture_cases.cameras import black_camera

NAMES = ("one Gaussian", "broken rows", "2 million Gaussians")
TRACING_CASES = {case.name: case for case in stress_cases.CASES}


@pytest.fixture(autouse=True)
def few_cases(monkeypatch):
    monkeypatch.setattr(stress_cases, "CASES", [TRACING_CASES[name] for name in NAMES])
    disc = next(shape for shape in analytic_occlusion.SHAPES if shape.name == "coaxial disc")
    assert stability_page.CAPTURE_CASES  # imported before: tables name all of them
    monkeypatch.setattr(stress_captures, "CAPTURE_CASES", [])
    monkeypatch.setattr(stress_materials, "MATERIAL_CASES", [])
    monkeypatch.setattr(stress_relighting, "RELIGHTING_CASES", [])
    monkeypatch.setattr(analytic_occlusion, "SHAPES", (dataclasses.replace(disc, spacing=0.2),))


def run(*words):
    return main(["stability", "--device", "cpu", *map(str, words)])


def run_beside(page, capsys, *words, before="", code=0, **changes):
    """Run for JSON, let a GPU have found the same but for some changes, and run again beside it on a page."""
    if before:
        page.write_text(before, encoding="utf-8")
    assert run(*words, "--json") == code
    record = json.loads(capsys.readouterr().out)
    rows = [row for part in record.values() if isinstance(part, list) for row in part]
    for row in rows:
        row["device"] = "Some GPU"
    rows[0].update(changes)
    gpu = page.with_name("gpu.json")
    gpu.write_text(json.dumps(record), encoding="utf-8")
    assert run(*words, "--out", page, "--beside", gpu) == code
    return record, capsys.readouterr(), page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_tables_and_a_page_of_two_devices(tmp_path, capsys):
    fault = "3 rays differ by more than rounding explains"
    record, said, page = run_beside(tmp_path / "page.md", capsys, faults=[fault])
    assert record["passed"]
    assert [(row["case"], row["hierarchy"]) for row in record["cases"]] == [
        (name, hierarchy) for name in NAMES[:2] for hierarchy in stability.HIERARCHIES
    ]
    assert "stress cases on cpu" in said.out
    assert "10 with a zero quaternion" in said.out
    assert "coaxial disc" in said.out
    assert "2 million" not in said.out
    assert said.err == ""
    assert "| error, cpu | error, Some GPU | verdict |" in page
    row = next(line for line in page.splitlines() if line.startswith("| broken rows |"))
    assert "60 not finite, 10 with a negative scale, 10 with a zero quaternion | left out |" in row
    assert row.endswith("| ok |")
    assert f"| Some GPU, {stability.HIERARCHIES[0]}: {fault} |" in page
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gpu.json", "page.md"]


def test_quietly_a_page_keeps_what_was_not_run(tmp_path, capsys):
    page = tmp_path / "page.md"
    parts = ("Captures on which reconstructions fail", "Materials", "Relighting")
    after = "\n".join(f"## {part}\n\nkept, {part}\n" for part in parts)
    page.write_text(f"# Stability\n\nrays of before\n\n{after}", encoding="utf-8")
    assert run("--only", "tracing", "--out", page, "--quiet") == 0
    assert capsys.readouterr().out == ""
    text = page.read_text(encoding="utf-8")
    assert "| broken rows |" in text
    assert "rays of before" not in text
    assert text.endswith(f"| ok |\n\n{after}")


def test_a_fault_is_told_and_exits_with_one(monkeypatch, capsys):
    case = TRACING_CASES["one Gaussian"]
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


@pytest.mark.slow
def test_captures_alone_of_two_devices(one_capture, tmp_path, capsys):
    before = "# Stability\n\nrays\n\n## Captures on which reconstructions fail\n\nwhat was before\n"
    words, fault = ("--only", "reconstruction"), "not detected: black-image of train_03"
    _, said, text = run_beside(tmp_path / "page.md", capsys, *words, before=before, faults=[fault])
    assert "stress captures on cpu" in said.out
    assert "black-image of" in said.out
    assert "coaxial disc" not in said.out
    assert text.startswith("# Stability\n\nrays\n\n## Captures")  # what was not run stays
    assert "what was before" not in text
    # told: six cameras are few, too few to find out whether one of them is wrong
    assert "black-image of train_03, cameras-kept | 1 of 6 cameras left out, told |" in text
    assert text.index("cpu: 6 cameras of 64 x 64 pixels") < text.index("Some GPU: 6 cameras of 64 x 64 pixels")
    assert f"| {fault} |" in text


@pytest.mark.slow
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


def test_materials_alone_of_two_devices(one_light, tmp_path, capsys):
    before = "# Stability\n\nrays\n\n## Captures on which reconstructions fail\n\nkept\n"
    words, fault = ("--only", "materials"), "must be refused, and was not"
    _, said, text = run_beside(tmp_path / "page.md", capsys, *words, before=before, faults=[fault])
    assert "materials on cpu" in said.out
    assert "coaxial disc" not in said.out
    assert text.startswith(f"{before}\n## Materials\n")
    assert "refused: environment must shed light" in text
    assert text.index("cpu: 42 Gaussians") < text.index("Some GPU: 42 Gaussians")
    assert f"| {fault} |" in text


def test_materials_at_fault_exit_with_one(one_light, monkeypatch, capsys):
    broken = dataclasses.replace(
        one_light, build=lambda studio: dataclasses.replace(one_light.build(studio), refused=False)
    )
    monkeypatch.setattr(stress_materials, "MATERIAL_CASES", [broken])
    assert run("--only", "materials", "--quiet") == 1
    assert "failed: black environment on cpu: refused: environment must shed light" in capsys.readouterr().err


@pytest.fixture
def leaking_front(monkeypatch):
    """Two Gaussians: paths hold what is asked, the deferred renderer does not."""
    cases = stability_page.RELIGHTING_CASES
    case = next(case for case in cases if case.name == "a leaking front before a dark inside")
    monkeypatch.setattr(stress_relighting, "RELIGHTING_CASES", [case])
    return case


def test_relighting_alone_of_two_devices(leaking_front, tmp_path, capsys):
    before, words = "# Stability\n\nrays\n\n## Materials\n\nkept\n", ("--only", "relighting")
    record, said, text = run_beside(tmp_path / "page.md", capsys, *words, before=before, code=1)
    assert [row["renderer"] for row in record["relighting"]] == ["deferred", "path"]
    assert "relighting on cpu" in said.out
    assert "coaxial disc" not in said.out
    failed = "failed: a leaking front before a dark inside on cpu, deferred: radiance, of the front's own"
    assert said.err.startswith(failed)
    assert said.err.count("\n") == 1
    assert text.startswith(f"{before}\n## Relighting\n")
    by_paths = next(line for line in text.splitlines() if "| path |" in line)
    assert by_paths.startswith("| a leaking front before a dark inside |")
    assert by_paths.endswith("| ok |")
    assert text.index("cpu: images of") < text.index("Some GPU: images of")


def test_large_relighting_is_run_on_request(leaking_front, monkeypatch, capsys):
    large = dataclasses.replace(leaking_front, large=True)
    monkeypatch.setattr(stress_relighting, "RELIGHTING_CASES", [large])
    assert run("--only", "relighting", "--json") == 0
    assert json.loads(capsys.readouterr().out)["relighting"] == []
    assert run("--only", "relighting", "--large", "--quiet") == 1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("--out none/page.md", "out must be in a folder that exists"),
        ("--device cuda:99", "device must be one of cpu"),
        ("--beside other.json", "beside must be what beam stability --json printed, got other.json"),
        ("--beside none.json", "beside must be a file, got"),
    ],
)
def test_mistakes(tmp_path, monkeypatch, refused, words, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other.json").write_text('{"cases": [{}]}', encoding="utf-8")
    refused("stability", *words.split(), says=says)
