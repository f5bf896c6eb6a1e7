"""``beam decompose`` as a user meets it: with a capture and without, as text and as JSON, and what it refuses."""

import json
import shutil
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
from support.figure_asset import figure_asset

from beam_warp import GaussianSequence, read, write
from beam_warp.capture.capture import Capture
from beam_warp.cli import decompose as command
from beam_warp.cli.decompose import Decompose, Measuring
from beam_warp.cli.main import main
from beam_warp.decomposition.options import OverviewOptions, RunOptions
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

OPTIONS = {
    "sequence": None,
    "out": None,
    "capture": "--capture {folder}/other",
    "preset": None,
    "seed": "--seed 5",
    "device": None,
    "quiet": None,
    "json": None,
    "environment": "--environment {folder}/dim.exr",
    "relight": "--relight {folder}/dim.exr",
    "orbit": "--orbit 30 10",
    "rotate": "--rotate 40",
    "exposure": "--exposure 1.5",
    "turn_light": "--no-turn-light",
    "roughness": "--roughness 0.25",
    "roughness_mesh": "--roughness {folder}/rough.png --roughness-mesh {folder}/mesh.obj",
    "samples": "--samples 128",
    "offset": "--offset 0.01",
    "bounce": "--no-bounce",
}
"""Words that set each option to another value; None where it names input, output or the path, or only what is printed.
"""

DIRECT_ONLY = ("--samples 128", "--samples 64", "--offset 0.01", "--offset auto", "--no-bounce")
"""Words that the image path has no use for, whether or not they are the direct path's defaults."""


def test_with_the_light_of_the_capture_and_again(figure, small, tmp_path, capsys):
    """Words for people first; then JSON, which is the report and nothing else, of what is kept."""
    out = tmp_path / "out"
    words = (figure, "--capture", small, "--out", out, *FEW)
    assert beam(*words) == 0
    said = capsys.readouterr()
    assert "asset.usda: 1 frame, 750 Gaussians" in said.out
    assert "exposure of the light +0.00 stops" in said.out
    assert {path.name for path in out.iterdir()} >= {"asset.usda", "report.json", "overview.png"}
    assert read(out / "asset.usda").metadata["capture_frames"] == "0"
    assert beam(*words, "--json") == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert said.err == ""
    assert report == json.loads((out / "report.json").read_text())
    assert report["options"]["materials"]["sample_count"] == 4
    assert 4.0 <= report["economy"]["light_rays_per_gaussian"] <= 16.0
    assert report["resumed_frames"] == 1


def test_without_images_the_gaussians_own_colour_is_explained(figure, small, tmp_path, capsys):
    assert beam(figure, "--environment", *small.glob("environment*"), "--out", tmp_path / "out", *FEW, "--quiet") == 0
    said = capsys.readouterr()
    assert said.out == said.err == ""


@dataclass
class Asked(Exception):
    """What a command asks of the job, which is not done."""

    environment: EnvironmentMap
    options: RunOptions
    capture: Capture
    overview: OverviewOptions

    def stated(self):
        """All that a result depends on, as the report states it, and the input."""
        view, light = self.overview, self.overview.second_light
        shown = None if light is None else light.environment.radiance.tobytes()
        return (
            self.environment.radiance.tobytes(),
            json.dumps(self.options.as_dict(), sort_keys=True),
            self.capture.folder,
            (view.azimuth, view.elevation, shown),
        )


@pytest.fixture
def asked(figure, small, tmp_path, monkeypatch):
    """Return what the job is asked by some words."""

    def refuse(sequence, environment, out, options, *, capture, overview, progress):
        raise Asked(environment, options, capture, overview)

    light = EnvironmentMap.read(next(small.glob("environment*"))).scaled(0.5).radiance
    write_exr(tmp_path / "dim.exr", {name: light[..., index] for index, name in enumerate("RGB")})
    shutil.copytree(small, tmp_path / "other")
    for name in ("rough.png", "mesh.obj"):
        (tmp_path / name).write_bytes(b"")  # the job reads them, and is not run
    monkeypatch.setattr("beam_warp.decomposition.job.run", refuse)

    def ask(preset, words):
        base = () if words.startswith("--capture") else ("--capture", small)
        with pytest.raises(Asked) as caught:
            beam(figure, *base, "--out", tmp_path / "out", "--preset", preset, *words.format(folder=tmp_path).split())
        return caught.value.stated()

    return ask


def test_all_options_are_in_the_table():
    assert {field.name for kind in (Decompose, Measuring) for field in fields(kind)} - {"measuring"} == set(OPTIONS)


@pytest.mark.parametrize("preset", ["direct", "paper"])
def test_each_option_is_used_or_refused(asked, preset):
    """No word is dropped in silence: what it asks for reaches the job and its report, or is an error."""
    plain = asked(preset, "")
    for name, words in OPTIONS.items():
        if words is not None and not (preset == "paper" and words in DIRECT_ONLY):
            assert asked(preset, words) != plain, name


@pytest.mark.parametrize("words", DIRECT_ONLY)
def test_the_image_path_refuses_what_it_does_not_have(figure, small, tmp_path, refused, words):
    says = "materials (sample_count, offset, bounce and so on) must be left out on the image path"
    base = ("decompose", figure, "--capture", small, "--out", tmp_path / "out", "--preset", "paper", "--device", "cpu")
    refused(*base, *words.split(), says=says)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("{figure} --preset paper", "capture must be given for the preset paper, got none"),
        ("{figure}", "environment must be given, got none for"),
        ("{figure} --capture {small} --environment none.exr", "must be a readable file, got"),
        ("none.usda --capture {small}", "none.usda"),
        ("{figure} --capture none", "none"),
        ("{figure} --capture {small} --roughness rough.png", "roughness-mesh must be given with a roughness texture"),
        ("{figure} --capture {small} --samples 1", "--samples must be"),
        ("{figure} --capture {small} --samples 4 --exposure 99", "exposure must be"),
        ("{other} --capture {small} --roughness 0.5", "got none of frame 7"),
    ],
)
def test_mistakes(figure, small, tmp_path, monkeypatch, refused, words, says):
    monkeypatch.chdir(tmp_path)
    other = tmp_path / "other.usda"
    if "{other}" in words:
        write(GaussianSequence.from_clouds([read(figure)[0]], metadata={"capture_frames": "7"}), other)
    words = words.format(figure=figure, small=small, other=other)
    refused("decompose", *words.split(), "--out", "out", "--device", "cpu", says=says)
