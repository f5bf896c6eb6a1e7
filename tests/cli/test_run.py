"""`beam` as a user meets it: a run end to end, and one clear line for everything that can be wrong with the input."""

import json

import numpy as np
import pytest
from pxr import Usd
from support.commands import beam
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp import GaussianSequence, read, write
from beam_warp.cli.convert import main as convert
from beam_warp.cli.run import capture_at
from beam_warp.cli.validate import main as validate
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.files import write_exr
from beam_warp.stage.files import source_files


@pytest.fixture
def ball(tmp_path):
    points, spacing = sphere_points(300)
    cloud = cloud_of(
        tiles(points, points, spacing), radiance=np.full((300, 1, 3), 0.4), radiance_color_space=DISPLAY_SRGB
    )
    write(GaussianSequence.from_clouds([cloud]), tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


def environment(path, radiance):
    write_exr(path, {name: radiance[..., index] for index, name in enumerate("RGB")})
    return path


@pytest.fixture
def sky(tmp_path):
    return environment(tmp_path / "sky.exr", np.ones((16, 32, 3), np.float32))


def test_run_then_render_then_validate(ball, sky, tmp_path, capsys):
    out = tmp_path / "out"
    words = ("run", ball, "--environment", sky, "--out", out, "--samples", 8, "--device", "cpu")
    assert beam(*words, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["input"]["gaussians"] == 300
    assert report["materials"]["flags"]["FILLED"] < 30
    for name in ("asset.usda", "report.json", "overview.png"):
        assert (out / name).is_file()
    assert beam(*words, "--workers", 2) == 0  # what is there is kept, whoever looks; the words are the same
    said = capsys.readouterr()
    assert "asset.usda: 1 frame, 300 Gaussians" in said.out
    assert f"fitted by {report['exposure_stops']:+.2f} stops, as captured colour has no scale of its own" in said.out
    assert "overview.png" in said.out
    assert "note: axes" in said.err or "note" not in said.err
    shown = tmp_path / "shown.png"
    plain = ("--width", 32, "--environment-shadows", 0, "--bounces", 0, "--quiet")
    assert beam("render", out, "--environment", sky, "--out", shown, *plain) == 0  # the folder is the asset
    assert shown.is_file()
    assert source_files(out) == source_files(out / "asset.usda")
    assert convert(["inspect", str(out)]) == 0
    assert "USD (.usda)" in capsys.readouterr().out
    assert convert([str(out), str(tmp_path / "new" / "ball.splat"), "--quiet"]) == 0
    assert capture_at(out) is None
    assert validate([str(out / "asset.usda"), "--quiet"]) == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("none.ply --environment sky.exr", "input must be an existing file or folder, got"),
        ("text.ply --environment sky.exr", "text.ply"),
        ("ball.ply --environment none.exr", "must be a readable file, got"),
        ("ball.ply --environment square.exr", "twice as wide as high"),
        ("ball.ply --environment sky.exr --roughness r.png", "roughness-mesh must be given"),
        ("ball.ply --environment sky.exr --samples 0", "--samples must be"),
        ("ball.ply --environment sky.exr --fps 0", "--fps must be"),
        ("ball.ply --environment sky.exr --roughness 7", "--roughness must be a number in [0, 1], got 7.0"),
        ("ball.ply --environment sky.exr --roughness r.png --roughness-mesh m.obj", "must be files, got r.png"),
        ("ball.ply --environment sky.exr --error-scale 2", "error-scale must be left out without keyed, got 2"),
        ("ball.ply --environment sky.exr --offset nan", "--offset must be a number in"),
        ("ball.ply --environment sky.exr --exposure 99", "--exposure must be a number in"),
        ("ball.ply --environment sky.exr --seed -5", "--seed must be an integer in"),
        ("ball.ply --environment sky.exr --orbit 0 nan", "elevation must be a number in"),
        ("ball.ply --environment sky.exr --orbit inf 0", "azimuth must be a number in"),
        ("ball.ply --environment sky.exr --out text.ply/out", "output folder must be a folder, got"),
    ],
)
def test_mistakes(ball, sky, tmp_path, monkeypatch, refused, words, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.ply").write_text("hello")
    environment(tmp_path / "square.exr", np.ones((32, 32, 3), np.float32))
    refused("run", "--out", "out", *words.split(), says=says)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_environment_with_a_bad_texel(ball, tmp_path, refused, value):
    radiance = np.ones((32, 64, 3), np.float32)
    radiance[3, 5, 1] = value
    path = environment(tmp_path / "bad.exr", radiance)
    says = "at row 3, column 5 (1 texels in all)"
    refused("run", ball, "--environment", path, "--out", tmp_path / "out", says=says)


def test_a_take_with_keys(sky, tmp_path, refused):
    """What is known to be the same Gaussians may be keyed; without that word nothing is begun."""
    points, spacing = sphere_points(100)
    radiance = {"radiance": np.full((100, 1, 3), 0.4), "radiance_color_space": DISPLAY_SRGB}
    ball = cloud_of(tiles(points, points, spacing), **radiance)
    moved = [ball.with_arrays(positions=ball.positions + 0.1 * frame) for frame in range(4)]
    write(GaussianSequence.from_clouds(moved), tmp_path / "take.usdc")
    words = ("run", tmp_path / "take.usdc", "--environment", sky, "--samples", 4, "--device", "cpu", "--keyed")
    refused(*words, "--out", tmp_path / "no", says="must go with frames that have the same Gaussians")
    assert beam(*words, "--persistent", "--error-scale", 2, "--out", tmp_path / "out", "--quiet") == 0
    stage = Usd.Stage.Open(str(tmp_path / "out" / "asset.usda"))
    samples = stage.GetPrimAtPath("/Asset/Splats").GetAttribute("positions").GetNumTimeSamples()
    assert (samples, len(read(tmp_path / "out" / "asset.usda"))) == (2, 4)


def test_version(capsys):
    assert beam("--version") == 0
    assert capsys.readouterr().out.startswith("beam 0.")


@pytest.mark.parametrize("name", ["asset.usda", "report.json", "overview.png"])
def test_results_appear_together_or_not_at_all(ball, sky, tmp_path, monkeypatch, refused, name):
    """One of them cannot be written: nothing is begun."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out" / name).mkdir(parents=True)
    words = ("ball.ply", "--environment", "sky.exr", "--out", "out", "--device", "cpu")
    refused("run", *words, says="output must be a file, got the folder")
