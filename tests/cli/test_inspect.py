"""`beam inspect` as a user meets it: its answer, its exit codes, its pictures, and a page whose script runs."""

import json
import re
import subprocess

import numpy as np
import pytest
import trimesh
from PIL import Image as PillowImage
from support.commands import beam
from support.sound_capture import CAMERAS, FLIP, FRAMES, TARGET, rewrite, rig, save, write_sound

from beam_warp.capture.corrections import CameraCorrection, RigCorrection


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


def corrections(**changes):
    """Corrections of a camera that is turned, one that is left out, and sound ones."""
    cameras = [CameraCorrection(f"c{k:02d}", pixels=0.01, error=0.02, place_error=4e-3) for k in range(CAMERAS)]
    cameras[2] = CameraCorrection("c02", turn=(0.0, 0.01, 0.0), pixels=0.41, error=0.02, place_error=4e-3)
    cameras[5] = CameraCorrection("c05", is_used=False)
    return RigCorrection(tuple(cameras), **{"is_applied": True, "confidence": 9.0, "kinds": ("turn",), **changes})


def test_what_a_reconstruction_found_wrong_with_cameras_is_said_and_drawn(sound, tmp_path, capsys):
    (tmp_path / "reconstruction").mkdir()
    (tmp_path / "reconstruction" / RigCorrection.FILE).write_text(json.dumps(corrections().as_dict()))
    assert beam("inspect", sound, "--cameras", tmp_path, "--out", tmp_path) == 0
    said = capsys.readouterr().out
    assert "cameras contradict each other by 0.12 ± 0.02 pixels, at most 0.41, and were moved to agree (c02)" in said
    assert "; cameras moved by 0.12 ± 0.02 pixels (turn); images tell places to ± 3.8 mm)" in said
    text = (tmp_path / "capture.html").read_text(encoding="utf-8")
    assert "<span>c02</span><span>0.41 ± 0.02 px</span>" in text
    assert "<span>c05</span><span>contradicts</span>" in text
    data = json.loads(re.search(r'id="data">(.*?)</script>', text).group(1))
    assert ["moved by" in camera["text"] for camera in data["cameras"]] == [k != 5 for k in range(CAMERAS)]
    with PillowImage.open(tmp_path / "capture.png") as picture:
        assert (np.asarray(picture.convert("RGB")) == (255, 212, 0)).all(axis=-1).any()  # the arrow
    sound_rig = json.dumps(corrections(is_applied=False).as_dict())
    (tmp_path / RigCorrection.FILE).write_text(sound_rig)
    assert beam("inspect", sound, "--cameras", tmp_path, "--json") == 0
    assert json.loads(capsys.readouterr().out)["corrections"] == json.loads(sound_rig)


def test_the_arrow_of_a_correction_points_where_the_subject_went():
    camera = rig()[2]
    way = corrections().ways({"c02": camera}, TARGET)["c02"]  # turned down by 0.01: what is ahead comes to the right
    np.testing.assert_allclose(way, [0.01 * camera.focal_x, 0.0], atol=1e-3)


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
    refused("inspect", tmp_path, "--cameras", tmp_path, says="cameras must be the folder of a reconstruction with")
    (tmp_path / RigCorrection.FILE).write_text("{}")
    refused("inspect", tmp_path, "--cameras", tmp_path, says="corrections of cameras must be as beam reconstruct")


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
