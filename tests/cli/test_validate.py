"""beam-validate: exit codes, what it prints, and that a caller's mistake is one line."""

import json
import runpy

import numpy as np
import pytest
from pxr import Sdf
from support.drawn_ball import relightable
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp.cli import validate
from beam_warp.cli.validate import main
from beam_warp.schema.writer import write_asset
from beam_warp.world.gaussians import GaussianSequence


@pytest.fixture
def trusted_files():
    """Files are tried before they are opened, as they are for users: some here are cut short."""


@pytest.fixture
def asset(tmp_path):
    write_asset(GaussianSequence.from_clouds([relightable([[0.0, 0.0, 0.0]])]), tmp_path / "a.usdc")
    return tmp_path / "a.usdc"


@pytest.fixture
def damaged(asset):
    layer = Sdf.Layer.FindOrOpen(str(asset))
    layer.GetAttributeAtPath("/Asset/Splats.beam:brdf").default = "lambert"
    layer.Save()
    return asset


def test_valid(asset, capsys):
    assert main([str(asset)]) == 0
    assert capsys.readouterr().out == f"{asset}: valid (1 frame, 1 Gaussian; 0 errors, 0 warnings)\n"


def test_the_folder_of_an_asset_is_that_asset(asset, capsys):
    whole = asset.parent / "run" / "asset.usda"
    whole.parent.mkdir()
    write_asset(GaussianSequence.from_clouds([relightable([[0.0, 0.0, 0.0]])]), whole)
    assert main([str(whole.parent)]) == 0
    assert capsys.readouterr().out.startswith(f"{whole}: valid")


def test_not_valid(damaged, capsys):
    assert main([str(damaged)]) == 1
    finding, verdict = capsys.readouterr().out.splitlines()
    assert finding == (
        "error   BEAM-TOKEN-002  /Asset/Splats.beam:brdf: beam:brdf must be one of ggx-metallic-roughness, "
        "got 'lambert'. Choose one."
    )
    assert verdict == f"{damaged}: not valid (1 frame, 1 Gaussian; 1 error, 0 warnings)"


def test_json_and_quiet(damaged, capsys):
    assert main([str(damaged), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["valid"] is False
    assert [finding["rule"] for finding in report["findings"]] == ["BEAM-TOKEN-002"]
    assert main([str(damaged), "--quiet"]) == 1
    assert capsys.readouterr().out == ""


def test_fix_mends_once_and_says_what(asset, capsys):
    layer = Sdf.Layer.FindOrOpen(str(asset))
    prim = layer.GetPrimAtPath("/Asset/Splats")
    prim.RemoveProperty(prim.attributes["beam:brdf"])
    layer.Save()
    assert main([str(asset), "--fix"]) == 0
    mended, verdict = capsys.readouterr().out.splitlines()
    assert mended.startswith("mended  BEAM-TOKEN-001  /Asset/Splats.beam:brdf: beam:brdf must be authored, got none.")
    assert verdict == f"{asset}: valid (1 frame, 1 Gaussian; 0 errors, 0 warnings; 1 mended)"
    assert main([str(asset), "--fix"]) == 0
    assert capsys.readouterr().out == f"{asset}: valid (1 frame, 1 Gaussian; 0 errors, 0 warnings)\n"


def test_fix_leaves_what_only_the_producer_knows(damaged, capsys):
    before = damaged.read_bytes()
    assert main([str(damaged), "--fix"]) == 1
    assert "BEAM-TOKEN-002" in capsys.readouterr().out
    assert damaged.read_bytes() == before


def test_sarif(damaged, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([str(damaged), "--quiet", "--sarif", "report.sarif"]) == 1
    log = json.loads((tmp_path / "report.sarif").read_text())
    (run,) = log["runs"]
    (result,) = run["results"]
    assert (result["ruleId"], result["level"]) == ("BEAM-TOKEN-002", "error")
    assert run["tool"]["driver"]["rules"][result["ruleIndex"]]["id"] == "BEAM-TOKEN-002"
    assert result["locations"][0]["physicalLocation"]["artifactLocation"]["uri"] == "a.usdc"
    assert main([str(damaged), "--sarif", "a.usdc"]) == 2
    assert damaged.read_bytes().startswith(b"PXR-USDC")


def test_physical(tmp_path, capsys):
    """A ball whose occlusion is stored wrong, in a report that is machine-readable in both forms."""
    points, spacing = sphere_points(100)
    fields = {"normals": points, "base_color": np.full((100, 3), 0.5), "roughness": np.full(100, 0.5)}
    cloud = cloud_of(tiles(points, points, spacing), **fields, ambient_occlusion=np.full(100, 0.5), axes="rub")
    write_asset(GaussianSequence.from_clouds([cloud]), tmp_path / "ball.usdc")
    arguments = [str(tmp_path / "ball.usdc"), "--physical", "--device", "cpu"]
    assert main(arguments) == 1
    out = capsys.readouterr().out
    assert "holds   BEAM-PHYS-001  at most 0.5" in out
    assert "broken  BEAM-PHYS-002  100.0% of 100 off (up to 13.5%)" in out
    assert "error   BEAM-PHYS-002  /.beam:ambientOcclusion: Ambient occlusion is that of a fresh trace" in out
    assert main([*arguments, "--json", "--sarif", str(tmp_path / "ball.sarif")]) == 1
    report = json.loads(capsys.readouterr().out)
    assert [finding["rule"] for finding in report["findings"]] == ["BEAM-PHYS-002"]
    assert {each["rule"]: each["passed"] for each in report["physical"]}["BEAM-PHYS-003"] is True
    (run,) = json.loads((tmp_path / "ball.sarif").read_text())["runs"]
    assert [result["ruleId"] for result in run["results"]] == ["BEAM-PHYS-002"]


def test_physics_is_asked_of_valid_assets_only(damaged, capsys):
    assert main([str(damaged), "--physical"]) == 2
    assert "must be given a valid asset, got one that breaks BEAM-TOKEN-002" in capsys.readouterr().err


def test_unreadable(tmp_path, asset, capsys):
    asset.write_bytes(asset.read_bytes()[:-10])
    assert main([str(asset)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {asset} must hold ")
    assert error.count("\n") == 1
    assert main([str(tmp_path / "none.usda")]) == 2
    assert "must be a readable file, got No such file or directory" in capsys.readouterr().err


def test_rules_are_listed(capsys):
    assert main(["--rules"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 40
    assert lines == sorted(lines)
    assert main(["--rules", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)) == len(lines)


def test_help_and_version(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--help"])
    assert stopped.value.code == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Example: beam-validate dancer.usda --fix" in said
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("beam-validate 0.")
    assert main([]) == 2
    assert "asset must be given, got none" in capsys.readouterr().err


def test_as_a_program(asset, monkeypatch):
    monkeypatch.setattr("sys.argv", ["validate.py", str(asset)])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(validate.__file__, run_name="__main__")
    assert stopped.value.code == 0
