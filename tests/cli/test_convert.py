"""beam-convert as a user meets it: what it prints, what it writes, how it fails."""

import json
import os
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
from support.drawn_ball import relightable

from beam_warp import __version__, converters
from beam_warp.cli.convert import main
from beam_warp.converters import WriteOptions
from beam_warp.converters.common.importers import IMPORTERS
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence


@pytest.fixture
def person(tmp_path):
    """A sequence of three relightable frames in its own folder, and its first frame as one file."""
    rng = np.random.default_rng(11)
    orientations = rng.normal(size=(9, 4))
    clouds = [
        GaussianCloud(
            positions=rng.normal(size=(9, 3)),
            orientations=orientations / np.linalg.norm(orientations, axis=1, keepdims=True),
            scales=np.full((9, 3), 0.01),
            opacities=np.full(9, 0.5),
            radiance=rng.normal(size=(9, 4, 3)),
            radiance_color_space=DISPLAY_SRGB,
            base_color=rng.uniform(size=(9, 3)),
        )
        for _ in range(3)
    ]
    (tmp_path / "take").mkdir()
    (tmp_path / "out").mkdir()
    converters.write(GaussianSequence.from_clouds(clouds), tmp_path / "take" / "f.ply", WriteOptions(profile="beam"))
    shutil.copy(tmp_path / "take" / "f000000.ply", tmp_path / "person.ply")
    return tmp_path


def run(*arguments, capsys):
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.parametrize(("word", "name"), [("--target", "unity"), ("--for", "aras-p")])
def test_a_file(person, capsys, word, name):
    code, out, err = run(person / "person.ply", person / "out" / "a.ply", word, name, capsys=capsys)
    assert code == 0
    assert out.startswith(f"wrote {person / 'out' / 'a.ply'}: 9 Gaussians, ")
    assert err.splitlines() == [
        "note: materials are left out: --profile beam keeps them in PLY and glTF",
        f"note: in aras-p UnityGaussianSplatting: {IMPORTERS['aras-p'].to_do}",
    ]
    assert converters.read(person / "out" / "a.ply")[0].axes == "ruf"


def test_axes_that_the_format_does_not_mean(person, capsys):
    code, _, err = run(person / "person.ply", person / "out" / "a.spz", "--axes", "rdf", capsys=capsys)
    assert code == 0
    assert "note: SPZ means rub; this file is in rdf and states it, which few readers heed\n" in err
    code, _, err = run(person / "person.ply", person / "out" / "a.spz", "--for", "gsplat-unity", capsys=capsys)
    assert code == 0
    assert "means" not in err


def test_spz_and_gltf(person, capsys):
    out = person / "out"
    code, said, err = run(person / "person.ply", out / "a.spz", "--spz-version", "4", "--sh-degree", 0, capsys=capsys)
    assert (code, (out / "a.spz").read_bytes()[:5]) == (0, b"NGSP\x04")
    assert err == "note: materials are left out: --profile beam keeps them in PLY and glTF\n"
    code, said, err = run(out / "a.spz", out / "a.gltf", capsys=capsys)
    assert code == 0
    assert said.startswith(f"wrote {out / 'a.gltf'} and 1 more beside it: 9 Gaussians, ")
    assert err.startswith("note: axes of SPZ are rub, ")
    code, said, err = run(person / "take", out / "b.glb", "--profile", "beam", capsys=capsys)
    assert (code, err) == (0, "")
    assert said.startswith(f"wrote {out / 'b000000.glb'} … b000002.glb: 3 frames, 9 Gaussians, ")
    assert converters.read(out / "b000001.glb")[0].base_color is not None
    for words, wanted in (
        (("c.spz", "--spz-version", "2"), "--spz-version"),
        (("c.spz", "--profile", "beam"), "--profile"),
    ):
        code, _, err = run(person / "person.ply", out / words[0], *words[1:], capsys=capsys)
        assert code == 2
        assert wanted in err
        assert not (out / "c.spz").exists()


def test_a_sequence_quietly_and_as_json(person, capsys):
    words = (person / "take", person / "out" / "g.ply")
    assert run(*words, "--profile", "beam", "--quiet", capsys=capsys) == (0, "", "")
    assert len(converters.read(person / "out")) == 3
    code, out, _ = run(*words, "--json", capsys=capsys)
    result = json.loads(out)
    assert code == 0
    assert (result["frame_count"], result["gaussian_count"], result["source_axes"]) == (3, 9, "rdf")
    assert len(result["outputs"]) == 3
    assert result["notes"] == ["materials are left out: --profile beam keeps them in PLY and glTF"]


def test_every_option_reaches_the_reader_and_the_writer(person, capsys):
    options = "--source-axes rub --meters-per-unit 0.5 --sh-degree 3 --material-activation linear"
    options += " --activation log --drop-invalid --profile beam --for gsplat-unity --axes rub"
    code, _, _ = run(person / "person.ply", person / "out" / "a.ply", *options.split(), capsys=capsys)
    before, after = (converters.read(path)[0] for path in (person / "person.ply", person / "out" / "a.ply"))
    assert code == 0
    assert (after.axes, after.sh_degree) == ("rub", 3)
    assert np.array_equal(after.positions, 0.5 * before.positions)  # --source-axes outranks the file
    assert np.array_equal(after.base_color, before.base_color)


def test_the_input_is_never_written_over(person, capsys):
    before = (person / "person.ply").read_bytes()
    spelled = person / "out" / ".." / "person.ply"
    code, _, err = run(person / "person.ply", spelled, capsys=capsys)
    assert code == 2
    assert err.startswith("error: output must be another file than those that are read, got ")
    assert (person / "person.ply").read_bytes() == before
    code, _, err = run(person / "take", person / "take" / "f.ply", capsys=capsys)
    assert code == 2
    assert "f000000.ply. Rename it." in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("gone.ply out/a.ply", "error: input must be an existing file or folder, got "),
        ("person.ply person.ply/a.ply", "error: output folder must be a folder, got "),
        ("person.ply out/a.obj", "error: file name must end in one of .ply, "),
        ("person.ply out/a.ksplat", "error: output's name must end in one of"),
        ("person.ply out", "error: file name must end in one of .ply, "),
        ("out out/a.ply", "error: folder out must hold asset.usda, meta.json or numbered files"),
        ("person.ply out/a.ply --sh-degree 4", "error: --sh-degree must be "),
        ("person.ply out/a.ply --source-axes xyz", "error: --source-axes must be "),
        ("person.ply out/a.ply --for maya", "error: --for must be one of supersplat, "),
        ("person.ply out/a.ply --axes up", "error: --axes must be three letters"),
        ("person.ply out/new/a.ply --profile beam --sh-degree 5", "error: --sh-degree must be "),
        ("person.ply out/a.ply --meters-per-unit -1", "error: --meters-per-unit must be "),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(person, capsys, monkeypatch, words, message):
    monkeypatch.chdir(person)
    started = time.perf_counter()
    code, out, err = run(*words.split(), capsys=capsys)
    assert time.perf_counter() - started < 2.0
    assert (code, out) == (2, "")
    assert err.startswith(message)
    assert err.count("\n") == 1
    assert not list((person / "out").iterdir())


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_closed_folder(person, capsys):
    (person / "out").chmod(0o500)
    code, _, err = run(person / "person.ply", person / "out" / "a.ply", capsys=capsys)
    assert code == 2
    assert err.startswith("error: output folder must be writable, got ")


def test_inspect(person, capsys):
    code, out, _ = run("inspect", person / "person.ply", capsys=capsys)
    assert code == 0
    assert "producer    beam-warp (beam_schema 1.3)\n" in out
    assert "materials   base_color\n" in out
    code, out, _ = run("inspect", person / "take", "--json", capsys=capsys)
    assert json.loads(out)["frame_count"] == 3


def test_version_and_help(capsys):
    assert run("--version", capsys=capsys) == (0, f"beam-convert {__version__}\n", "")
    for arguments in (["--help"], ["inspect", "--help"]):
        with pytest.raises(SystemExit) as stopped:
            main(arguments)
        assert stopped.value.code == 0
        assert "Example: beam-convert " in capsys.readouterr().out
    with pytest.raises(SystemExit) as stopped:
        main(["one.ply"])
    assert stopped.value.code == 2


def test_ply_to_ply_costs_neither_warp_nor_usd(person):
    script = (
        "import sys\n"
        "from beam_warp.cli.convert import main\n"
        "code = main(['person.ply', 'out/a.ply', '--target', 'unreal']) or main(['inspect', 'person.ply'])\n"
        "heavy = {'warp', 'pxr', 'OpenEXR', 'scipy', 'trimesh', 'h5py'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else code)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=person, capture_output=True, text=True, timeout=30)
    assert done.returncode == 0, done.stderr


def test_a_take_with_keys(tmp_path, capsys):
    """What moves evenly has two time samples, and every frame is read back within the bounds."""
    still = relightable(np.random.default_rng(0).normal(size=(30, 3)), ids=np.arange(30))
    moved = [still.with_arrays(positions=still.positions + np.array([0.02 * frame, 0.0, 0.0])) for frame in range(10)]
    converters.write(GaussianSequence.from_clouds(moved), tmp_path / "take.usdc")
    code, out, err = run(tmp_path / "take.usdc", tmp_path / "keyed.usdc", "--keyed", capsys=capsys)
    assert (code, err) == (0, "")
    assert "10 frames" in out
    assert (tmp_path / "keyed.usdc").stat().st_size < (tmp_path / "take.usdc").stat().st_size
    found, every = (converters.read(tmp_path / name) for name in ("keyed.usdc", "take.usdc"))
    for cloud, wanted in zip(found, every, strict=True):
        np.testing.assert_allclose(cloud.positions, wanted.positions, atol=1e-6)  # a rounding of single precision
    unknown = GaussianSequence.from_clouds([cloud.with_arrays(ids=None) for cloud in moved])
    converters.write(unknown, tmp_path / "unknown.usdc")
    code, _, err = run(tmp_path / "unknown.usdc", tmp_path / "no.usdc", "--keyed", capsys=capsys)
    assert (code, err.count("\n")) == (2, 1)
    assert "must go with a constant topology, got perFrame" in err
