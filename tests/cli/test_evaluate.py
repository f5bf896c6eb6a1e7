"""`beam evaluate`: table, JSON, picture and images of a small asset, and what it refuses."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from support.figure_asset import figure_asset

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.cli.main import main
from beam_warp.image.files import read_image


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The asset as `beam run` leaves it."""
    place = tmp_path_factory.mktemp("asset")
    converters.write(figure_asset(), place / "asset.usda")
    return place


@pytest.fixture(scope="module")
def truth(relit_capture, tmp_path_factory):
    """One of the capture's two test cameras."""
    truth = tmp_path_factory.mktemp("truth") / "relit"
    shutil.copytree(relit_capture.folder, truth)
    content = json.loads((truth / "transforms.json").read_text())
    content["frames"] = [record for record in content["frames"] if record["camera"] != "test_01"]
    (truth / "transforms.json").write_text(json.dumps(content))
    return truth


def run(*words):
    return main(["evaluate", *map(str, words), "--device", "cpu"])


def test_everything_that_is_written(folder, truth, tmp_path, capsys):
    """One run with all outputs; its table, report, picture and images tell of the same scores."""
    out, renders = tmp_path / "out", tmp_path / "renders"
    sharp = ("--antialiased", "--low-pass", "0.1")  # wide filters blur 48 pixels until coverage is not the truth's
    assert run(folder, "--truth", truth, *sharp, "--out", out, "--renders", renders) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    report = json.loads((out / "evaluation.json").read_text())
    mean = report["mean"]
    for title, scores in (
        ("ambient occlusion", mean["ambient_occlusion"]),
        ("base colour", mean["base_color"]),
        ("base colour, scaled", mean["base_color_scaled"]),
        ("novel view", mean["novel_view"]),
        ("sunset, deferred", mean["relit"]["deferred"]["sunset"]),
        ("stage, deferred", mean["relit"]["deferred"]["stage"]),
    ):
        (row,) = [line for line in printed.out.splitlines() if f" {title} " in line]
        assert f"{scores['psnr']:.2f}" in row
        assert f"{scores['ssim']:.3f}" in row
    assert " ".join(f"{value:.3f}" for value in report["base_color_scale"]) in printed.out
    assert f"{report['temporal']['surface']['ours']['mean']:.4f}" in printed.out
    sheet = np.asarray(Image.open(out / "evaluation.png"))
    assert sheet.dtype == np.uint8
    assert sheet.shape[2] == 3
    names = [record.name for record in Capture.read(truth).select(split="test")]
    assert sorted(path.stem for path in renders.glob("*.exr")) == sorted(names)
    layers = read_image(renders / f"{names[0]}.exr").channels
    assert set(layers) == {
        "A", "R", "G", "B", "ambient_occlusion", "roughness", "depth", "base_color.R", "base_color.G", "base_color.B",
        "normal.X", "normal.Y", "normal.Z",
    }  # fmt: skip
    for light in ("sunset", "stage"):
        assert (renders / f"deferred_{light}" / f"{names[0]}.exr").is_file()


def test_json_and_quiet_of_a_ply_and_its_frames(truth, tmp_path, capsys):
    """One frame of the asset as PLY: which one of the capture it shows is said, and so is what is left out."""
    (path,) = converters.write(
        figure_asset(frame_count=1), tmp_path / "figure.ply", converters.WriteOptions(profile="beam")
    )
    quick = (path, "--truth", truth, "--relight", "none", "--samples", "1")
    assert run(*quick, "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    words = (*quick, "--json")
    assert run(*words, "--capture-frames", "0") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["conditions"]["frames"] == [0]
    assert found["conditions"]["samples_per_pixel"] == 1
    assert "the asset does not show frames whose truth is known: 1" in found["asset_notes"]
    assert run(*words, "--capture-frames", "7") == 2
    assert "asset must show a frame whose truth is known" in capsys.readouterr().err
    assert run(*words, "--antialiased", "--low-pass", "0.1") == 0
    conditions = json.loads(capsys.readouterr().out)["conditions"]
    assert (conditions["antialiased"], conditions["low_pass"]) == (True, 0.1)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--relight", "magic"), "relight must be one of deferred"),
        (("--samples", "0"), "samples must be an integer in [1, 64], got 0"),
        (("--out", f"{__file__}/out"), "out must be a folder"),
        (("--low-pass", "-1"), "low-pass must be a number in"),
        (("--split", "train"), "truth must be a capture whose train views have exact channels"),
    ],
)
def test_what_is_refused(folder, truth, refused, words, said):
    refused("evaluate", folder, "--truth", truth, *words, "--device", "cpu", says=said)
