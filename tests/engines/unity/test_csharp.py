"""All C# of the package compiles against stubs of Unity's API; what a package needs around it is there."""

import json
import re
from importlib.util import module_from_spec, spec_from_file_location

import numpy as np
import pytest
from engines.unity.csharp import HERE, PACKAGE, ROOT, compiled, needs_compiler

from beam_warp.world.environment import EnvironmentMap

SOURCES = sorted(PACKAGE.rglob("*.cs"))
STUBS = sorted((HERE / "stubs").glob("*.cs"))


@needs_compiler
@pytest.mark.parametrize(
    "defines",
    [
        "BEAM_HDRP,BEAM_URP,BEAM_TIMELINE",
        *[pytest.param(each, marks=pytest.mark.slow) for each in ("BEAM_HDRP", "BEAM_URP", "NONE")],
    ],
)
def test_the_package_compiles_with_and_without_optional_packages(tmp_path, defines):
    said = compiled([*STUBS, *SOURCES], tmp_path / "package.dll", "-target:library", f"-define:{defines}")
    assert not said, said


def test_the_parser_needs_no_engine():
    for source in (PACKAGE / "Runtime" / "Delivery").glob("*.cs"):
        assert "UnityEngine" not in source.read_text(encoding="utf-8"), source


def script(name):
    """Import a script of engines/unity."""
    spec = spec_from_file_location(name, ROOT / "engines" / "unity" / f"{name}.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_file_has_its_identity():
    """``python engines/unity/metas.py`` writes them; without them Unity ignores a file of a package from git."""
    metas = script("metas").metas()
    assert {path: path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.meta")} == metas
    assert len({re.search(r"guid: (\w{32})\n", text)[1] for text in metas.values()}) == len(metas)


@pytest.mark.slow
def test_the_table_of_albedo_is_that_of_the_renderer():
    """``python engines/unity/prefilter.py`` writes it."""
    prefilter = script("prefilter")
    found = np.frombuffer(prefilter.ALBEDO.read_bytes(), "<f4")
    np.testing.assert_allclose(found, np.frombuffer(prefilter.albedo_bytes(), "<f4"), atol=1e-6)


@pytest.mark.slow
def test_an_environment_is_written_as_the_package_reads_it():
    content = script("prefilter").prefiltered_bytes(EnvironmentMap.constant((1.0, 2.0, 3.0), height=16))
    rows = np.frombuffer(content, "<i4", 14).astype(int)
    assert len(content) == 4 * 14 + 12 * (2 * rows * rows).sum()
    texels = np.frombuffer(content, "<f4", offset=56).reshape(-1, 3)
    count = 2 * rows[-1] ** 2
    np.testing.assert_allclose(texels[:-count], np.tile([1.0, 2.0, 3.0], (len(texels) - count, 1)), rtol=1e-4)
    np.testing.assert_allclose(texels[-count:], np.pi * np.tile([1.0, 2.0, 3.0], (count, 1)), rtol=1e-3)


def test_assemblies_define_what_sources_ask_for():
    runtime = json.loads((PACKAGE / "Runtime" / "Beam.Relightable.asmdef").read_text(encoding="utf-8"))
    defined = {each["define"] for each in runtime["versionDefines"]}
    asked = {name for path in SOURCES for name in re.findall(r"#if (\w+)", path.read_text(encoding="utf-8"))}
    assert asked == defined == {"BEAM_HDRP", "BEAM_URP", "BEAM_TIMELINE"}


def test_shaders_name_entries_that_are_there():
    resources = PACKAGE / "Runtime" / "Resources" / "Beam"
    passes = 0
    for path in [*resources.glob("*.shader"), *resources.glob("*.compute")]:
        parts = path.read_text(encoding="utf-8").split("HLSLPROGRAM")
        for part in parts[1:] or parts:
            passes += 1
            (included,) = re.findall(r'#include "(.*)"', part)
            text = (resources / included).resolve().read_text(encoding="utf-8")
            entries = re.findall(r"#pragma (?:vertex|fragment|kernel) (\w+)", part)
            assert entries
            assert all(re.search(rf"\b{entry}\(", text) for entry in entries), (path.name, entries)
    assert passes == 11
