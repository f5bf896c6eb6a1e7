"""beam-validate: exit codes, what it prints, and that a caller's mistake is one line."""

import json
import runpy

import pytest
from pxr import Sdf
from support.drawn_ball import relightable

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
    for flag, text in (("--help", "beam-validate dancer.usda"), ("--version", "beam-validate 0.")):
        with pytest.raises(SystemExit) as stopped:
            main([flag])
        assert stopped.value.code == 0
        assert text in capsys.readouterr().out
    with pytest.raises(SystemExit) as stopped:
        main([])
    assert stopped.value.code == 2
    assert "asset must be given, got none" in capsys.readouterr().err


def test_as_a_program(asset, monkeypatch):
    monkeypatch.setattr("sys.argv", ["validate.py", str(asset)])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(validate.__file__, run_name="__main__")
    assert stopped.value.code == 0
