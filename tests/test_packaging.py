"""The wheel installs one top-level name with every package in it, and importing it costs nothing heavy."""

import importlib
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import beam_warp
from beam_warp.cli.main import STEP_MODULES

ROOT = Path(__file__).parent.parent
FOLDERS = {
    "beam_warp": "beam_warp",
    "kernels": "beam_warp/kernels",
    "schema": "beam_warp/schema",
    "converters": "beam_warp/converters",
}


@pytest.fixture(scope="module")
def wheel_names(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "engines", *FOLDERS):
        (source / name).symlink_to(ROOT / name)
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", folder, source],
        check=True,
        capture_output=True,
    )
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.mark.slow
def test_one_top_level_name(wheel_names):
    assert {name.split("/")[0] for name in wheel_names if ".dist-info/" not in name} == {"beam_warp"}


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS)
def test_every_module_is_in_the_wheel(wheel_names, folder):
    for path in (ROOT / folder).rglob("*.py"):
        assert f"{FOLDERS[folder]}/{path.relative_to(ROOT / folder).as_posix()}" in wheel_names


@pytest.mark.slow
def test_licence_and_files_that_are_no_modules_are_in_the_wheel(wheel_names):
    schema = {f"schema/{name}" for name in ("plugInfo.json", "generatedSchema.usda", "schema.usda", "SPEC.md")}
    typing, pages = {"py.typed", "__init__.pyi", "raster/__init__.pyi"}, {"study/page.js", "capture/page.js"}
    web = {f"web/{path.name}" for path in (ROOT / "engines" / "web").glob("*.*s")}
    assert {"web/b4d.js", "web/player.js", "web/player.css"} <= web
    assert {f"beam_warp/{name}" for name in schema | typing | pages | web} <= wheel_names
    assert any(name.endswith("/licenses/LICENSE") for name in wheel_names)


def test_neither_import_nor_records_cost_warp_or_usd():
    records = "from beam_warp import GaussianCloud, Camera, EnvironmentMap, Capture, read, write"
    script = f"import sys, beam_warp\nprint(*sys.modules)\n{records}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    after_import, after_records = (set(line.split()) for line in done.stdout.splitlines())
    assert not after_import & {"warp", "pxr", "scipy", "trimesh", "h5py", "OpenEXR", "skimage"}
    assert not after_records & {"warp", "pxr"}


def test_steps_of_a_take_start_without_what_they_do_not_need():
    """Renderers draw the overview at the end, and the image path is an option.

    Warp's own code stays unloaded: processes are forked from one that has imported these, and CUDA survives no fork.
    OpenUSD is there: loaded later, beside threads, it may wait for the interpreter while the thread that has it waits
    for the loader.
    """
    started = "from warp._src.context import runtime\nassert runtime is None, runtime"
    script = f"import sys, importlib\nfor name in {STEP_MODULES}: importlib.import_module(name)\n{started}\n"
    script += "print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    loaded = set(done.stdout.split())
    assert set(STEP_MODULES) <= loaded
    assert not loaded & {"beam_warp.render", "beam_warp.materials.images", "beam_warp.materials.bake"}
    assert "pxr.Tf" in loaded


FACES = sorted(
    path.parent.relative_to(ROOT).as_posix().replace("/", ".") for path in (ROOT / "beam_warp").rglob("__init__.pyi")
)


@pytest.mark.parametrize("face", FACES)
def test_public_names_resolve_and_are_documented(face):
    module = importlib.import_module(face)
    if face == "beam_warp.interop":
        pytest.importorskip("torch")
    assert module.__all__
    for name in module.__all__:
        assert name in dir(module)
        assert name.isupper() or getattr(module, name).__doc__, name


@pytest.mark.slow
def test_a_type_checker_sees_every_public_name(tmp_path):
    """Each name has a type, read from the same stub that resolves it at run time."""
    lines = [
        line
        for face in FACES
        for name in importlib.import_module(face).__all__
        for line in (f"from {face} import {name}", f"reveal_type({name})")
    ]
    (tmp_path / "names.py").write_text("\n".join(lines))
    command = [sys.executable, "-P", "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, "names.py"]
    said = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False).stdout
    diagnostics = json.loads(said)["generalDiagnostics"]
    assert [d["message"] for d in diagnostics if d["severity"] == "error"] == []
    types = [d["message"] for d in diagnostics if d["severity"] == "information"]
    assert len(types) == len(lines) // 2
    assert not [message for message in types if message.endswith('is "Unknown"')]


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="No beam_warp attribute nonsense"):
        beam_warp.nonsense  # noqa: B018
