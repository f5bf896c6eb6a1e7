"""The material that an asset binds, the primvars that it reads, and the variant whose radiance is the base colour."""

import numpy as np
import pytest
from pxr import Sdr, Usd, UsdGeom, UsdShade

from beam_warp.errors import BeamError
from beam_warp.schema.layout import CHANNELS
from beam_warp.schema.reader import read_asset
from beam_warp.schema.validation.validator import validate_stage
from beam_warp.schema.writer import write_asset
from beam_warp.world.gaussians import GaussianSequence

SH_C0 = 0.5 / np.sqrt(np.pi)

HARMONICS = "radiance:sphericalHarmonicsCoefficients"


@pytest.fixture
def written(tmp_path):
    """A function that writes a sequence and returns its stage."""

    stages = []  # a prim does not keep its stage alive

    def write(source, name="a.usda", **options):
        write_asset(source, tmp_path / name, **options)
        stages.append(Usd.Stage.Open(str(tmp_path / name)))
        return stages[-1]

    return write


def splats(stage):
    return stage.GetPrimAtPath("/Asset/Splats")


def material(stage):
    return UsdShade.MaterialBindingAPI(splats(stage)).ComputeBoundMaterial()[0]


def read_by(shader):
    """The identifier of a surface shader, and the primvar that each of its inputs reads."""
    found = {}
    for entry in shader.GetInputs():
        source = UsdShade.Shader(entry.GetConnectedSources()[0][0].source.GetPrim())
        key = source.GetInput("varname") or source.GetInput("geomprop")
        found[entry.GetBaseName()] = (source.GetIdAttr().Get(), key.Get())
    return shader.GetIdAttr().Get(), found


def test_openpbr_reads_base_colour_and_roughness_and_the_preview_surface_occlusion_too(sequence, written):
    bound = material(written(sequence(1)))
    assert read_by(bound.ComputeSurfaceSource("mtlx")[0]) == (
        "ND_open_pbr_surface_surfaceshader",
        {
            "base_color": ("ND_geompropvalue_color3", "baseColor"),
            "specular_roughness": ("ND_geompropvalue_float", "roughness"),
        },
    )
    assert read_by(bound.ComputeSurfaceSource()[0]) == (
        "UsdPreviewSurface",
        {
            "diffuseColor": ("UsdPrimvarReader_float3", "baseColor"),
            "roughness": ("UsdPrimvarReader_float", "roughness"),
            "occlusion": ("UsdPrimvarReader_float", "ambientOcclusion"),
        },
    )
    assert bound.GetPrim().GetAttribute("config:mtlx:version").Get() == "1.39"


def test_every_node_of_the_preview_has_the_inputs_and_outputs_that_openusd_defines(sequence, written):
    registry = Sdr.Registry()
    for prim in material(written(sequence(1))).GetPrim().GetChildren():
        shader = UsdShade.Shader(prim)
        node = registry.GetShaderNodeByIdentifier(shader.GetIdAttr().Get())
        if node is None:
            assert shader.GetIdAttr().Get().startswith("ND_")  # usd-core knows no MaterialX
            continue
        assert {entry.GetBaseName() for entry in shader.GetInputs()} <= set(node.GetShaderInputNames())
        assert {entry.GetBaseName() for entry in shader.GetOutputs()} <= set(node.GetShaderOutputNames())


@pytest.mark.parametrize(("frames", "full_float"), [(1, False), (3, True), (65, False)])
def test_primvars_are_the_attributes_at_every_frame(sequence, written, frames, full_float):
    prim = splats(written(sequence(frames), full_float=full_float))
    for channel in CHANNELS.values():
        if not channel.primvar:
            continue
        attribute = prim.GetAttribute(channel.usd_names[0 if full_float else 1])
        primvar = UsdGeom.Primvar(prim.GetAttribute(channel.primvar))
        assert primvar.GetInterpolation() == UsdGeom.Tokens.vertex
        assert primvar.GetTypeName() == attribute.GetTypeName()
        assert primvar.GetAttr().GetColorSpace() == attribute.GetColorSpace()
        assert primvar.GetTimeSamples() == attribute.GetTimeSamples()
        for time in (0, frames - 1):
            assert np.array_equal(np.asarray(primvar.Get(time)), np.asarray(attribute.Get(time)))


@pytest.mark.parametrize("frames", [1, 4])
def test_primvars_take_no_space(tmp_path, sequence, frames):
    count = 4000
    write_asset(sequence(frames, count, degree=0, ids=None), tmp_path / "a.usdc")  # ids would be compressed
    moving = 12 + 8 + 2  # positions, orientations, occlusion
    fixed = 6 + 2 + 6 + 6 + 2 + 6 + 2 + 2 + 6 + 1 + 2
    arrays = count * (fixed + moving * frames)
    overhead = 8_000  # names, tokens and tables, whatever the number of Gaussians; roughness alone has 8,000 bytes
    assert arrays < (tmp_path / "a.usdc").stat().st_size < arrays + overhead


def test_a_renderer_without_primvars_of_gaussians_gets_the_means(cloud, written):
    two = cloud(count=2, base_color=[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], roughness=[0.25, 0.75], opacities=[0.75, 0.25])
    stage = written(GaussianSequence.from_clouds([two]))
    assert np.allclose(
        stage.GetAttributeAtPath("/Asset/Material/Preview_diffuseColor.inputs:fallback").Get(), [0.75, 0, 0.25]
    )
    assert stage.GetAttributeAtPath("/Asset/Material/OpenPBR_specular_roughness.inputs:default").Get() == 0.5


def test_splats_without_base_colour_have_no_material(sequence, written):
    stage = written(sequence(1, relightable=False))
    assert not stage.GetPrimAtPath("/Asset/Material")
    assert not material(stage)


@pytest.mark.parametrize(
    ("name", "frames", "varying"),
    [("a.usda", 1, ""), ("a.usdz", 2, "base_color"), ("a.usda", 65, "radiance"), ("a.usdz", 65, "base_color")],
)
def test_albedo_is_base_colour_and_captured_is_the_asset_without_variants(
    tmp_path, cloud, written, name, frames, varying
):
    rng = np.random.default_rng(1)
    changes = {"base_color": (6, 3), "radiance": (6, 4, 3)}
    clouds = [cloud(i, **{varying: rng.random(changes[varying])} if varying else {}) for i in range(frames)]
    source = GaussianSequence.from_clouds(clouds)
    plain = splats(written(source, f"plain{name}"))
    stage = written(source, name, lighting_variants=True)
    variants = stage.GetPrimAtPath("/Asset").GetVariantSet("lighting")
    assert variants.GetVariantSelection() == "captured"
    assert validate_stage(stage).findings == ()
    for time in (0, frames - 1):
        assert np.array_equal(*(prim.GetAttribute(f"{HARMONICS}h").Get(time) for prim in (plain, splats(stage))))

    variants.SetVariantSelection("albedo")
    prim = splats(stage)
    assert validate_stage(stage).findings == ()
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 0
    assert prim.GetAttribute("colorSpace:name").Get() == "lin_rec709_scene"
    for time in (0, frames - 1):
        shown = 0.5 + SH_C0 * np.asarray(prim.GetAttribute(f"{HARMONICS}h").Get(time)).astype(np.float64)
        # A coefficient is at most 0.5 / SH_C0 = 1.78 and half rounds it by at most 2^-11.
        assert np.abs(shown - clouds[time].base_color).max() <= SH_C0 * 2.0**-11
        assert np.array_equal(prim.GetAttribute("positions").Get(time), clouds[time].positions)


def test_albedo_is_no_captured_radiance(tmp_path, sequence):
    write_asset(sequence(1), tmp_path / "a.usda", lighting_variants=True)
    text = (tmp_path / "a.usda").read_text().replace('lighting = "captured"', 'lighting = "albedo"')
    (tmp_path / "b.usda").write_text(text)
    assert read_asset(tmp_path / "a.usda", trusted=True)[0].radiance is not None
    assert read_asset(tmp_path / "b.usda", trusted=True)[0].radiance is None


@pytest.mark.parametrize(
    ("name", "relightable", "message"),
    [
        (
            "a.usdc",
            True,
            r"path must end in .usda or .usdz for lighting variants, got 'a.usdc'. Choose another suffix.",
        ),
        ("a.usda", False, r"base_color must be given, got none\. Decompose the asset first\."),
    ],
)
def test_variants_that_cannot_be(tmp_path, sequence, name, relightable, message):
    with pytest.raises(BeamError, match=message):
        write_asset(sequence(1, relightable=relightable), tmp_path / name, lighting_variants=True)
    assert not list(tmp_path.iterdir())
