"""The wheel installs one top-level name with every package in it, and importing it costs nothing heavy."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import beam_warp

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
    for name in ("pyproject.toml", "README.md", "LICENSE", *FOLDERS):
        (source / name).symlink_to(ROOT / name)
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", folder, source],
        check=True,
        capture_output=True,
    )
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_one_top_level_name(wheel_names):
    assert {name.split("/")[0] for name in wheel_names if ".dist-info/" not in name} == {"beam_warp"}


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_module_is_in_the_wheel(wheel_names, folder):
    for path in (ROOT / folder).rglob("*.py"):
        assert f"{FOLDERS[folder]}/{path.relative_to(ROOT / folder).as_posix()}" in wheel_names


def test_schema_files_and_type_marker_are_in_the_wheel(wheel_names):
    for name in (
        "schema/plugInfo.json",
        "schema/generatedSchema.usda",
        "schema/schema.usda",
        "schema/SPEC.md",
        "py.typed",
        "study/page.js",
        "capture/page.js",
    ):
        assert f"beam_warp/{name}" in wheel_names


def test_licence_is_in_the_wheel(wheel_names):
    assert any(name.endswith("/licenses/LICENSE") for name in wheel_names)


def modules_after(code):
    script = f"{code}\nimport sys\nprint(*sys.modules)"
    return set(
        subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout.split()
    )


def test_import_costs_neither_warp_nor_usd_nor_scipy():
    assert not modules_after("import beam_warp") & {"warp", "pxr", "scipy", "trimesh", "h5py", "OpenEXR", "skimage"}


def test_records_need_no_warp():
    code = "from beam_warp import GaussianCloud, Camera, EnvironmentMap, Capture, change_axes, read, write"
    assert not modules_after(code) & {"warp", "pxr"}


@pytest.mark.parametrize("name", [n for n in beam_warp.__all__ if n != "__version__"])
def test_every_public_name_resolves_and_is_documented(name):
    assert getattr(beam_warp, name).__doc__
    assert name in dir(beam_warp)


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="module 'beam_warp' has no attribute 'nonsense'"):
        beam_warp.nonsense  # noqa: B018
