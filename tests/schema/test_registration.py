"""OpenUSD knows the schema after register(), and says so in every way it can."""

import json
import os
import subprocess
import sys

import pytest
from pxr import Usd, UsdGeom, UsdVol

from beam_warp.schema import MATERIAL_API, PLUGIN_FOLDER, SCHEMA_VERSION, SEQUENCE_API, register
from beam_warp.schema.layout import CHANNELS
from beam_warp.schema.validation import generate
from beam_warp.schema.validation.rules import OPTIONAL_TOKENS, TOKENS


@pytest.fixture(autouse=True)
def registered():
    """Else a test that asks for OpenUSD's schemas, run first in its process, would shut ours out."""
    assert register()


@pytest.fixture
def stage():
    assert register()  # again
    return Usd.Stage.CreateInMemory()


@pytest.fixture
def splats(stage):
    return UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Splats").GetPrim()


def run(code, **environment):
    command, environment = [sys.executable, "-c", code], {**os.environ, **environment}
    return subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout


def test_applies_to_particle_fields_only(splats):
    other = UsdGeom.Xform.Define(splats.GetStage(), "/Other").GetPrim()
    assert splats.CanApplyAPI(MATERIAL_API)
    assert not other.CanApplyAPI(MATERIAL_API)
    assert other.CanApplyAPI(SEQUENCE_API)
    assert not splats.CanApplyAPI(SEQUENCE_API)
    assert splats.ApplyAPI(MATERIAL_API)
    assert splats.HasAPI(MATERIAL_API)


def test_fallbacks(splats):
    splats.ApplyAPI(MATERIAL_API)
    assert splats.GetAttribute("beam:schemaVersion").Get() == SCHEMA_VERSION
    assert splats.GetAttribute("beam:normalSource").Get() == "none"
    assert splats.GetAttribute("beam:baseColorh").GetColorSpace() == "lin_rec709_scene"
    assert not splats.GetAttribute("beam:baseColorh").IsCustom()


@pytest.mark.parametrize("name", ["beam:roughness", "beam:roughnessh", "beam:ambientOcclusion", "beam:baseColorh"])
def test_limits(splats, name):
    splats.ApplyAPI(MATERIAL_API)
    limits = splats.GetAttribute(name).GetHardLimits()
    assert (limits.GetMinimum(), limits.GetMaximum()) == (0, 1)


def test_every_array_says_range_and_units():
    definition = Usd.Stage.Open(str(PLUGIN_FOLDER / "schema.usda"))
    for attribute in definition.GetPrimAtPath(f"/{MATERIAL_API}").GetAttributes():
        if attribute.GetTypeName().isArray and attribute.GetName().startswith("beam:"):
            assert "Range:" in attribute.GetDocumentation(), attribute
            assert "Units:" in attribute.GetDocumentation(), attribute


def schema_attributes():
    stage = Usd.Stage.Open(str(PLUGIN_FOLDER / "schema.usda"))
    for api in (MATERIAL_API, SEQUENCE_API):
        for attribute in stage.GetPrimAtPath(f"/{api}").GetAttributes():
            if attribute.GetName().startswith("beam:"):
                yield attribute.GetName(), attribute.GetMetadata("allowedTokens")


def test_the_specification_names_every_attribute_and_token():
    text = (PLUGIN_FOLDER / "SPEC.md").read_text(encoding="utf-8")
    names = {name for name, _ in schema_attributes()}
    for name, tokens in schema_attributes():
        if name.endswith("h") and name[:-1] in names:
            continue  # the half variant of a named array
        assert name in text or name.replace("beam:sequence", "…") in text, name
        assert all(f"`{token}`" in text for token in tokens or ()), name


def test_the_rules_know_the_tokens_of_the_schema():
    allowed = {name: tuple(tokens) for name, tokens in schema_attributes() if tokens}
    del allowed["beam:radianceColorSpace"]  # has a rule of its own
    assert allowed == {**TOKENS, **OPTIONAL_TOKENS}


def test_the_channels_have_the_types_of_the_schema():
    known = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(MATERIAL_API)
    for channel in CHANNELS.values():
        if channel.usd_name.startswith("beam:"):
            types = (channel.type_name, channel.half_type_name)
            for name, type_name in zip(channel.usd_names, types, strict=False):
                assert known.GetAttributeDefinition(name).GetTypeName() == type_name


def test_generated_files_have_not_drifted(tmp_path):
    pytest.importorskip("jinja2")
    generate.generate(tmp_path)
    for name in generate.GENERATED:
        assert (tmp_path / name).read_text() == (PLUGIN_FOLDER / name).read_text(), (
            f"{name} is stale: run python -m beam_warp.schema.validation.generate"
        )


def test_importing_the_package_loads_no_usd():
    assert run("import beam_warp.schema, sys; print('pxr' in sys.modules)").strip() == "False"


def test_late_registration_warns_with_the_remedy():
    code = (
        "import warnings, beam_warp.schema as s\n"
        "from pxr import Usd\n"
        "Usd.SchemaRegistry()\n"
        "with warnings.catch_warnings(record=True) as caught:\n"
        "    warnings.simplefilter('always')\n"
        "    print(s.register()); print(caught[0].message)"
    )
    known, message = run(code, PXR_PLUGINPATH_NAME="").strip().split("\n")
    assert known == "False"
    assert message.startswith("The beam schema must be registered before OpenUSD loads its schemas, got a process")
    assert f"PXR_PLUGINPATH_NAME={PLUGIN_FOLDER}" in message


def test_other_hosts_find_the_schema_by_path():
    known = f"Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('{MATERIAL_API}') is not None"
    assert run(f"from pxr import Usd; print({known})", PXR_PLUGINPATH_NAME=str(PLUGIN_FOLDER)).strip() == "True"


def test_plugin_type_differs_from_its_alias():
    # OpenUSD reports "already is a type named" otherwise.
    text = (PLUGIN_FOLDER / "plugInfo.json").read_text()
    types = json.loads(text[text.index("{") :])["Plugins"][0]["Info"]["Types"]
    assert len(types) == 2
    assert all(name != info["alias"]["UsdSchemaBase"] for name, info in types.items())
