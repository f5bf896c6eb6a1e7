"""Paths that no file can have, outputs that would replace what is read, and what killed programs leave."""

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hostile import corpus
from support.commands import beam
from support.drawn_ball import relightable
from support.leftovers import temporary_of_the_dead

import beam_warp
from beam_warp import converters
from beam_warp.checks import NAME_BYTES, require_path
from beam_warp.cli import convert, validate
from beam_warp.errors import AssetFormatError, InvalidOptionError, OutputError
from beam_warp.image.files import image_size, read_image, write_exr, write_png
from beam_warp.jobs.store import read_frame, write_frame
from beam_warp.mesh.files import read_mesh
from beam_warp.outputs import keep_original, originals_kept, remove_leftovers, replacing, temporary_path
from beam_warp.schema.reader import read_asset
from beam_warp.schema.writer import write_asset
from beam_warp.stage.camera_paths import read_camera_path
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import read_lights

TAKE_A_PATH = (
    beam_warp.read,
    converters.inspect,
    beam_warp.validate,
    beam_warp.Capture.read,
    beam_warp.EnvironmentMap.read,
    beam_warp.Stage.read,
    lambda path: beam_warp.Stage.of([path]),
    lambda path: beam_warp.write(cloud(1), path),
    lambda path: beam_warp.run(cloud(1), beam_warp.EnvironmentMap.constant((1, 1, 1)), path),
    lambda path: write_exr(path, {"Y": np.ones((2, 2))}),
    lambda path: write_png(path, np.ones((2, 2), np.uint8)),
    lambda path: write_asset(cloud(1), path),
    read_asset,
    read_camera_path,
    read_image,
    read_lights,
    read_mesh,
    image_size,
)


def cloud(frames):
    ball = relightable(np.arange(9.0).reshape(3, 3), scales=np.full((3, 3), 0.1), axes="rfu")
    return GaussianSequence.from_clouds([ball] * frames)


@pytest.mark.parametrize("function", TAKE_A_PATH)
@pytest.mark.parametrize("value", [None, b"a.ply", 3, "", "a\0.ply", "a\udc80.ply", "x" * 300 + ".ply"])
def test_what_is_no_path(function, value):
    with pytest.raises(InvalidOptionError, match=r"(path|folder|out) must (be a|have names)"):
        function(value)


def test_the_longest_names(tmp_path):
    name = "ü" * 125 + ".ply"
    assert require_path("path", tmp_path / name) == tmp_path / name
    assert len(os.fsencode(temporary_path(tmp_path / name).name)) <= NAME_BYTES
    converters.write(cloud(1), tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


COMMANDS = {
    "run": ("run", "{in}", "--environment", "{env}", "--out", "{out}"),
    "run of a light": ("run", "a.ply", "--environment", "{in}", "--out", "o"),
    "reconstruct": ("reconstruct", "{in}", "--out", "{out}"),
    "decompose": ("decompose", "{in}", "--environment", "{env}", "--out", "{out}"),
    "render": ("render", "{in}", "--environment", "{env}", "--out", "{out}.png"),
    "render with lamps": ("render", "a.ply", "--lights", "{in}", "--out", "o.png"),
    "channel": ("channel", "{in}", "roughness", "--out", "{out}.png"),
    "view": ("view", "a.ply", "--environment", "{in}"),
    "evaluate": ("evaluate", "{in}", "--truth", "t", "--out", "{out}", "--renders", "r"),
    "mesh": ("mesh", "{in}", "--out", "{out}"),
    "demo": ("demo", "--out", "{out}"),
    "stability": ("stability", "--out", "{out}.md"),
    "chart": ("chart", "tracing", "{in}", "--out", "{out}"),
    "inspect": ("inspect", "{in}", "--out", "{out}"),
    "convert": ("{in}", "{out}.ply"),
    "look": ("inspect", "{in}"),
    "validate": ("{in}", "--sarif", "{out}.sarif"),
}


def run(name, words):
    """Run a command in this process; returns the exit code."""
    program = {"convert": convert.main, "look": convert.main, "validate": validate.main}.get(name)
    return beam(*words) if program is None else program([str(word) for word in words])


@pytest.mark.parametrize("part", ["in", "out"])
@pytest.mark.parametrize("name", COMMANDS)
def test_names_are_checked_before_any_work(name, part, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if not any(f"{{{part}}}" in word for word in COMMANDS[name]):
        pytest.skip("takes none")
    for spoiled in ("x" * 300, "a\udc80"):
        named = {"in": "a.ply", "out": "o", "env": "env.exr", part: spoiled}
        assert run(name, [word.format(**named) for word in COMMANDS[name]]) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith("error: ")
        assert "must have names of at most" in printed.err or "must be a name in UTF-8" in printed.err
        assert printed.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", COMMANDS)
def test_folders_that_cannot_be_searched(name, tmp_path, monkeypatch, capsys):
    """Whoever runs the tests may search any folder, so that the system's answer is made up."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "closed").mkdir()
    stat = Path.stat

    def closed(path, **options):
        if path.parts[-2:-1] == ("closed",):
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, **options)

    monkeypatch.setattr(Path, "stat", closed)
    words = [word.format(**{"in": "closed/a.ply", "out": "closed/o", "env": "env.exr"}) for word in COMMANDS[name]]
    assert run(name, words) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("error: ")
    assert "must be within reach, got closed/" in printed.err
    assert printed.err.count("\n") == 1


def plain(folder):
    """Files that convert reads and other files beside them, by what is read and what would be replaced."""
    converters.write(cloud(1), folder / "asset.usda")
    converters.write(cloud(2), folder / "walk" / "walk.ply")
    converters.write(cloud(1), folder / "a.gltf")
    (folder / "b.gltf").write_text((folder / "a.gltf").read_text().replace("a.bin", "b.bin"))
    shutil.copy(folder / "a.bin", folder / "b.bin")
    os.link(folder / "a.gltf", folder / "linked.gltf")


OVERWRITES = [
    ("asset.usda", "asset.usda"),
    ("asset.usda", "asset.static.usdc"),
    (".", "asset.static.usdc"),
    ("asset.static.usdc", "asset.usda"),
    ("walk", "walk/walk.ply"),
    ("walk", "walk/other.ply"),
    ("b.gltf", "b.gltf"),
    ("a.gltf", "linked.gltf"),
    ("shifted.gltf", "b.gltf"),
]


@pytest.mark.parametrize(("source", "output"), OVERWRITES)
def test_a_conversion_replaces_nothing_that_it_reads(source, output, tmp_path, capsys, trusted_files):
    plain(tmp_path)
    if source == "shifted.gltf":  # its side file is that of another name
        (tmp_path / "b.gltf").rename(tmp_path / source)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert convert.main([str(tmp_path / source), str(tmp_path / output)]) == 2
    assert re.match("error: output must be (in )?another (file|folder) than", capsys.readouterr().err)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_results_do_not_replace_their_input(tmp_path, capsys, trusted_files):
    converters.write(cloud(1), tmp_path / "asset.usda")
    light = corpus.exr(tmp_path)
    os.link(light, tmp_path / "overview.png")
    stage = tmp_path / "stage.json"
    stage.write_text('{"beam-stage": 1, "assets": ["asset.usda"], "environment": "a.exr"}')
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for words in (
        ("run", tmp_path / "asset.usda", "--environment", light, "--out", tmp_path),
        ("run", tmp_path, "--environment", light, "--out", tmp_path),
        ("run", tmp_path / "asset.static.usdc", "--environment", light, "--out", tmp_path),
        ("decompose", tmp_path / "x.ply", "--environment", light, "--out", tmp_path),
        ("render", stage, "--out", light),
        ("render", stage, "--out", tmp_path / "asset.usda"),
    ):
        assert beam(*words) == 2
        assert capsys.readouterr().err.startswith("error: ")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_originals_are_kept_while_a_command_runs(tmp_path):
    original, link = tmp_path / "a", tmp_path / "b"
    original.write_text("1")
    link.symlink_to(original)
    with originals_kept():
        keep_original(original, tmp_path / "none")
        for path in (original, link, tmp_path / ".." / tmp_path.name / "a"):
            with pytest.raises(InvalidOptionError, match="another file than those that are read"), replacing(path):
                pass
        with replacing(tmp_path / "none") as temporary:
            temporary.write_text("2")
    with replacing(original) as temporary:
        temporary.write_text("3")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "3", "b": "3", "none": "2"}


def test_leftovers_of_the_dead_are_removed(tmp_path):
    dead, folder = temporary_of_the_dead(tmp_path / "frame_000000.h5"), temporary_of_the_dead(tmp_path / "asset.usda")
    dead.touch()
    folder.mkdir()
    (folder / "x.usdc").touch()
    number = dead.name.split(".")[-4].split("-")[0]
    kept = [
        temporary_path(tmp_path / "a.h5"),
        tmp_path / f".a.h5.{number}-00000000.abcdef01.tmp",
        tmp_path / ".x.1.tmp",
    ]
    for path in kept:
        path.touch()
    assert remove_leftovers(tmp_path, tmp_path / "none") == ["removed 2 unfinished files that a stopped call had left"]
    assert remove_leftovers(tmp_path) == []
    assert sorted(tmp_path.iterdir()) == sorted(kept)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps no numbers of processes that have ended")
def test_the_dead_whom_nobody_asks_about_are_dead(tmp_path):
    """The first process of a container may never ask how its adopted children ended: their numbers stay taken."""
    ended = subprocess.Popen([sys.executable, "-c", ""], stdout=subprocess.PIPE)
    assert ended.stdout.read() == b""
    path = temporary_path(tmp_path / "a.h5")
    path = path.with_name(path.name.replace(f".{os.getpid()}-", f".{ended.pid}-"))
    path.touch()
    for _ in range(100):  # its pipe closes before it has quite ended
        if remove_leftovers(tmp_path):
            break
        time.sleep(0.05)
    assert not path.exists()
    ended.wait()


def test_layers_of_a_longer_asset_are_removed(tmp_path):
    """Nobody else's files go, whatever they are called."""
    moving = GaussianSequence.from_clouds(
        [relightable(np.full((1, 3), float(frame)), axes="rfu", scales=np.ones((1, 3))) for frame in range(65)]
    )
    (tmp_path / "a.000090.usdc").touch()
    assert len(write_asset(moving, tmp_path / "a.usda")) == 6
    write_asset(cloud(1), tmp_path / "a.usda")
    assert {path.name for path in tmp_path.iterdir()} == {"a.000090.usdc", "a.static.usdc", "a.usda"}


def test_zeros_in_a_stored_frame_are_found(tmp_path):
    path = tmp_path / "frame_000000.h5"
    write_frame(path, {"colors": np.linspace(1, 2, 3000)})
    content = path.read_bytes()
    start = content.index(np.linspace(1, 2, 3000).tobytes())
    path.write_bytes(content[: start + 800] + bytes(400) + content[start + 1200 :])
    with pytest.raises(AssetFormatError, match=r"damaged file at .*frame_000000\.h5 \(another checksum of colors\)"):
        read_frame(path)


def test_a_full_disk_is_one_error(tmp_path, monkeypatch):
    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OutputError, match=r"a \(No space left on device\)"), replacing(tmp_path / "a") as temporary:
        temporary.write_text("1")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="locales as glibc has them")
@pytest.mark.parametrize("locale", [{"LC_ALL": "C"}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}])
def test_a_name_beyond_ascii_in_a_plain_locale(tmp_path, locale):
    source = corpus.ply(tmp_path)
    code = "import sys; sys.argv[0] = 'beam'; from beam_warp.cli import entry; sys.exit(entry.beam_convert())"
    command = [sys.executable, "-c", code, str(source), str(tmp_path / "ü.usda")]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **locale}, check=False)
    if done.returncode:
        assert done.stderr.startswith("error: output must be a name in UTF-8, got")
        assert done.stderr.count("\n") == 1
    else:
        assert len(converters.read(tmp_path / "ü.usda")[0]) == 3
