"""``beam decompose`` as a user meets it: with a capture and without, as text and as JSON, and what it refuses."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.figure_asset import figure_asset

from beam_warp import GaussianSequence, read, write
from beam_warp.cli import decompose as command
from beam_warp.cli.main import main
from beam_warp.image.files import write_exr
from beam_warp.world.environment import EnvironmentMap


@pytest.fixture(scope="module")
def figure(tmp_path_factory):
    """Discs on the demo figure in one frame, as Gaussians of unknown material."""
    cloud = figure_asset(64, 1)[0]
    cloud = cloud.select(np.arange(0, len(cloud), 8)).with_arrays(
        base_color=None, roughness=None, ambient_occlusion=None, normals=None
    )
    path = tmp_path_factory.mktemp("gaussians") / "figure.usda"
    write(GaussianSequence.from_clouds([cloud], metadata={"capture_frames": "0"}), path)
    return path


@pytest.fixture(scope="module")
def small(tiny_capture, tmp_path_factory):
    """The capture with its light on 32 rows: it is prepared in less than a second."""
    folder = tmp_path_factory.mktemp("captures") / "small"
    shutil.copytree(tiny_capture.folder, folder)
    light = EnvironmentMap.read(tiny_capture.environment_path).resized(32, 64).radiance
    path = folder / tiny_capture.environment_path.relative_to(tiny_capture.folder)
    write_exr(path, {name: light[..., index] for index, name in enumerate("RGB")})
    return folder


@pytest.fixture(autouse=True)
def low_overview(monkeypatch):
    full = command.overview_options
    monkeypatch.setattr(command, "overview_options", lambda measuring: replace(full(measuring), height=48))


def beam(*words):
    return main(["decompose", *(str(word) for word in words), "--device", "cpu"])


FEW = ("--samples", 4, "--roughness", 0.5)


def test_with_the_light_of_the_capture(figure, small, tmp_path, capsys):
    out = tmp_path / "out"
    assert beam(figure, "--capture", small, "--out", out, *FEW) == 0
    said = capsys.readouterr()
    assert "asset.usda: 1 frame, 750 Gaussians" in said.out
    assert "exposure of the light +0.00 stops" in said.out
    assert {path.name for path in out.iterdir()} >= {"asset.usda", "report.json", "overview.png"}
    assert read(out / "asset.usda").metadata["capture_frames"] == "0"


def test_json_is_the_report_and_nothing_else(figure, small, tmp_path, capsys):
    out = tmp_path / "out"
    words = (figure, "--capture", small, "--out", out, *FEW, "--json")
    assert beam(*words) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert said.err == ""
    assert report == json.loads((out / "report.json").read_text())
    assert report["options"]["materials"]["sample_count"] == 4
    assert beam(*words) == 0
    assert json.loads(capsys.readouterr().out)["resumed_frames"] == 1


def test_without_images_the_gaussians_own_colour_is_explained(figure, small, tmp_path, capsys):
    light = small / "environment.exr"
    light = light if light.exists() else next(small.glob("environment*"))
    assert beam(figure, "--environment", light, "--out", tmp_path / "out", *FEW, "--quiet") == 0
    said = capsys.readouterr()
    assert said.out == said.err == ""


class TestMistakes:
    @pytest.fixture
    def mistake(self, capsys, tmp_path):
        def check(*words, says):
            out = tmp_path / "out"
            assert beam(*words, "--out", out) == 2
            said = capsys.readouterr()
            assert said.out == ""
            (line,) = said.err.strip().splitlines()
            assert line.startswith("error: ")
            assert says in line
            assert not out.exists()

        return check

    def test_the_paper_works_on_images(self, mistake, figure):
        mistake(figure, "--preset", "paper", says="capture must be given for the preset paper, got none")

    def test_no_light_at_all(self, mistake, figure):
        mistake(figure, says="environment must be given, got none for")

    def test_light_that_is_not_there(self, mistake, figure, small, tmp_path):
        missing = tmp_path / "none.exr"
        mistake(figure, "--capture", small, "--environment", missing, says="must be a readable file, got")

    def test_gaussians_that_are_not_there(self, mistake, small, tmp_path):
        mistake(tmp_path / "none.usda", "--capture", small, says="none.usda")

    def test_a_capture_that_is_not_there(self, mistake, figure, tmp_path):
        mistake(figure, "--capture", tmp_path / "none", says="none")

    def test_a_texture_without_its_mesh(self, mistake, figure, small, tmp_path):
        words = ("--capture", small, "--roughness", tmp_path / "rough.png")
        mistake(figure, *words, says="roughness-mesh must be given with a roughness texture")

    def test_too_few_rays(self, mistake, figure, small):
        mistake(figure, "--capture", small, "--samples", 1, says="sample_count must be")

    def test_an_exposure_out_of_range(self, mistake, figure, small):
        mistake(figure, "--capture", small, *FEW, "--exposure", 99, says="exposure must be")

    def test_frames_that_the_capture_lacks(self, mistake, figure, small, tmp_path):
        other = tmp_path / "other.usda"
        write(GaussianSequence.from_clouds([read(figure)[0]], metadata={"capture_frames": "7"}), other)
        mistake(other, "--capture", small, "--roughness", 0.5, says="got none of frame 7")
