"""`beam inspect` as a user meets it: its answer, its exit codes, its pictures, and a page whose script runs."""

import json
import re
import subprocess

import numpy as np
import pytest
import trimesh
from PIL import Image as PillowImage
from support.commands import beam
from support.sound_capture import CAMERAS, FLIP, FRAMES, rewrite, save, write_sound


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound") / "dancer <1>"
    folder.mkdir()
    content = write_sound(folder)
    content["ply_file_path"] = "points.ply"
    points = trimesh.PointCloud([[0.3, -0.2, 0.9], [9, 9, 9]], colors=[[255, 0, 0], [0, 255, 0]])
    points.export(folder / "points.ply")
    save(folder, content)
    return folder


@pytest.fixture(scope="module")
def pages(sound, tmp_path_factory):
    """What is written of it."""
    out = tmp_path_factory.mktemp("pages") / "made" / "here"
    assert beam("inspect", sound, "--out", out, "--quiet") == 0
    return out


def test_the_picture_of_a_sound_capture(pages):
    assert {path.name for path in pages.iterdir()} == {"capture.png", "capture.html"}
    with PillowImage.open(pages / "capture.png") as picture:
        assert picture.width == 1200
        pixels = np.asarray(picture.convert("RGB"))
    for color in ((0, 114, 178), (46, 139, 87)):  # frustums of trained cameras, the common volume
        assert (pixels == color).all(axis=-1).any()


def test_words_json_and_quiet(sound, capsys):
    assert beam("inspect", sound) == 0
    assert "ready (12 cameras, 3 frames, 36 images (36 train); 36 looked at)" in capsys.readouterr().out
    assert beam("inspect", sound, "--json", "--max-images", CAMERAS) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["cameras"], report["frames"], report["images_read"]) == (CAMERAS, FRAMES, CAMERAS)
    assert report["findings"] == []
    assert report["is_reconstructable"] is True
    assert beam("inspect", sound, "--quiet") == 0
    assert capsys.readouterr().out == ""


def test_an_error_is_exit_code_1(tmp_path, capsys):
    content = write_sound(tmp_path)
    for record in content["frames"]:
        record["transform_matrix"] = (np.array(record["transform_matrix"]) @ FLIP).tolist()
    save(tmp_path, content)
    assert beam("inspect", tmp_path, "--out", tmp_path / "out") == 1
    said = capsys.readouterr().out
    assert "error: the cameras do not look at a common place, and would with their axes changed. Probably" in said
    assert "cannot be reconstructed: " in said
    assert (tmp_path / "out" / "capture.png").is_file()


def test_left_out_cameras_are_drawn_so(tmp_path):
    write_sound(tmp_path)
    for path in (tmp_path / "images/c03").iterdir():
        rewrite(path, lambda pixels: np.zeros_like(pixels[..., :3]))
    assert beam("inspect", tmp_path, "--out", tmp_path, "--quiet") == 0
    text = (tmp_path / "capture.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'id="data">(.*?)</script>', text).group(1))
    assert {camera["name"]: camera["kind"] for camera in data["cameras"]}["c03"] == "left out"


def test_what_cannot_be_read_or_written(tmp_path, refused):
    refused("inspect", tmp_path / "nowhere", says="capture must be a folder with transforms.json, a COLMAP model")
    (tmp_path / "file").touch()
    write_sound(tmp_path)
    refused("inspect", tmp_path, "--out", tmp_path / "file", says="out must be a folder")


def test_the_page_needs_nothing_and_its_script_runs(pages, tmp_path):
    text = (pages / "capture.html").read_text(encoding="utf-8")
    start = text.index("<body>")
    assert "dancer &lt;1&gt;" in text[start:]
    assert set(re.findall(r'(?:src|href)="(.{10})', text[start:])) == {"data:image"}
    script = text[text.rindex("<script>") + 8 : text.rindex("</script>")]
    data = re.search(r'id="data">(.*?)</script>', text).group(1)
    assert len(json.loads(data)["points"]) == 1  # the other one is far off
    try:
        subprocess.run(["node", "--version"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("node is not installed")
    (tmp_path / "data.json").write_text(data, encoding="utf-8")
    (tmp_path / "check.js").write_text(
        "const text = require('fs').readFileSync(process.argv[2], 'utf8');\n"
        "const calls = [];\n"
        "const figure = { dataset: { camera: 'c02' }, addEventListener: (event, act) => act() };\n"
        "const document = { getElementById: () => ({ textContent: text }), querySelectorAll: () => [figure] };\n"
        "const Plotly = { newPlot: (at, traces) => calls.push(traces), restyle: (at, change) => calls.push(change) };\n"
        + script.replace('"use strict";', "")
        + "\nconst named = (name) => calls[0].find((trace) => trace.name === name);\n"
        "const names = calls[0].map((trace) => trace.name ?? '');\n"
        "const counts = { faces: named('images').i.length, lines: named('trained from').x.length };\n"
        "console.log(JSON.stringify({ names, ...counts, pointed: calls[1].x[0].length }));\n",
        encoding="utf-8",
    )
    run = subprocess.run(
        ["node", tmp_path / "check.js", tmp_path / "data.json"], check=True, capture_output=True, text=True
    )
    said = json.loads(run.stdout)
    assert said["names"] == ["points", "what most see", "trained from", "", "images", "pointed at"]
    assert said["lines"] == CAMERAS * said["pointed"]
    assert said["faces"] > 0
    assert said["faces"] % 2 == 0
