"""A sound asset breaks no rule; for each rule there is one way to break that rule and no other."""

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdValidation, Vt

from beam_warp.schema import MATERIAL_API, PLUGIN_FOLDER, SEQUENCE_API
from beam_warp.schema.layout import to_vt
from beam_warp.schema.report import Report
from beam_warp.schema.validator import ALL_RULES, HOST_VALIDATOR, check_rules, validate, validate_stage
from beam_warp.schema.writer import write_asset
from beam_warp.world.gaussians import GaussianSequence


class Asset:
    """A sound three-frame asset, or one with clips, that a test damages in one place."""

    def __init__(self, folder, sequence, make_cloud):
        self.folder, self.sequence, self.make_cloud = folder, sequence, make_cloud
        self.open(sequence(3))

    def open(self, source, name="asset.usdc"):
        write_asset(source, self.folder / name)
        self.stage = Usd.Stage.Open(str(self.folder / name))
        self.splats = self.stage.GetPrimAtPath("/Asset/Splats")
        self.root = self.stage.GetPrimAtPath("/Asset")

    def open_clips(self):
        self.open(self.sequence(65), "clips.usda")

    def layer(self, name):
        self.held = Sdf.Layer.FindOrOpen(str(self.folder / name))  # edits live as long as somebody holds the layer
        return self.held

    def set(self, name, value):
        self.splats.GetAttribute(name).Set(value)

    def change(self, name, row, value, time=None):
        """Write one element of an array, at one time or at the default."""
        attribute = self.splats.GetAttribute(name)
        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        array = np.array(attribute.Get(code))
        array[row] = value
        attribute.Set(to_vt(str(attribute.GetTypeName()), array), code)

    def rules(self):
        return [finding.rule for finding in check_rules(self.stage).findings]


@pytest.fixture
def asset(tmp_path, sequence, cloud):
    return Asset(tmp_path, sequence, cloud)


def drop_api(asset):
    asset.splats.RemoveAppliedSchema(MATERIAL_API)


def drop_material(asset):
    drop_api(asset)
    for name in asset.splats.GetAuthoredPropertyNames():
        if name.startswith("beam:"):
            asset.splats.RemoveProperty(name)


def both_precisions(asset):
    values = np.asarray(asset.splats.GetAttribute("opacitiesh").Get()).astype(np.float32)
    asset.set("opacities", Vt.FloatArray.FromNumpy(values))


def half_frame(asset):
    for attribute in asset.splats.GetAttributes():
        if attribute.GetNumTimeSamples():
            attribute.Set(attribute.Get(1.0), 1.5)


def other_count(asset):
    clouds = [asset.make_cloud(0, 5, ids=None), asset.make_cloud(1, 6, ids=None)]
    asset.open(GaussianSequence.from_clouds(clouds), "counts.usdc")
    asset.root.GetAttribute("beam:sequence:topology").Set("constant")


def other_ids(asset):
    base = asset.make_cloud()
    asset.open(GaussianSequence.from_clouds([base, base.with_arrays(ids=base.ids[::-1])]), "ids.usdc")
    asset.root.GetAttribute("beam:sequence:topology").Set("constant")


def flipped_quaternions(asset):
    attribute = asset.splats.GetAttribute("orientationsh")
    for time in range(3):
        attribute.Set(attribute.Get(0), time)  # so that only the sign changes
    attribute.Set(Vt.QuathArray.FromNumpy(-np.array(attribute.Get(1.0))), 1.0)


def cut_segment(asset):
    asset.open_clips()
    layer = asset.folder / "clips.000030.usdc"
    del asset.stage
    layer.write_bytes(layer.read_bytes()[:100])
    asset.stage = Usd.Stage.Open(str(asset.folder / "clips.usda"))


def undeclared(asset):
    asset.open_clips()
    prim = asset.layer("clips.manifest.usda").GetPrimAtPath("/Asset/Splats")
    Sdf.AttributeSpec(prim, "beam:metallich", Sdf.ValueTypeNames.HalfArray)


def gap_in_clip(asset):
    asset.open_clips()
    asset.layer("clips.000030.usdc").EraseTimeSample("/Asset/Splats.beam:ambientOcclusionh", 35.0)


def no_low_pass(asset):
    asset.splats.CreateAttribute("beam:rasterLowPass", Sdf.ValueTypeNames.Float).Set(0.0)


def numbered(asset, frames):
    name = "beam:sequence:captureFrames"
    asset.root.CreateAttribute(name, Sdf.ValueTypeNames.IntArray).Set(Vt.IntArray(frames))


BREAKERS = {
    "BEAM-STAGE-001": lambda asset: asset.stage.ClearDefaultPrim(),
    "BEAM-STAGE-002": lambda asset: asset.stage.ClearMetadata("metersPerUnit"),
    "BEAM-STAGE-003": lambda asset: asset.stage.ClearMetadata("upAxis"),
    "BEAM-STAGE-004": lambda asset: asset.splats.SetTypeName("Xform"),
    "BEAM-STAGE-005": lambda asset: asset.stage.ClearMetadata("timeCodesPerSecond"),
    "BEAM-STAGE-006": lambda asset: asset.root.GetReferences().AddReference("./nowhere.usdc"),
    "BEAM-GEO-001": lambda asset: asset.splats.RemoveProperty("opacitiesh"),
    "BEAM-GEO-002": both_precisions,
    "BEAM-GEO-003": lambda asset: UsdGeom.Xformable(asset.splats).AddScaleOp().Set((1.0, 2.0, 1.0)),
    "BEAM-GEO-004": lambda asset: asset.splats.RemoveProperty("extent"),
    "BEAM-GEO-010": lambda asset: asset.set("opacitiesh", Vt.HalfArray([0.5])),
    "BEAM-GEO-011": lambda asset: asset.change("positions", 2, np.nan, time=1.0),
    "BEAM-GEO-012": lambda asset: asset.change("orientationsh", 2, [0.0, 0.0, 0.0, 1.1], time=0.0),
    "BEAM-GEO-013": lambda asset: asset.change("scalesh", 2, -3.0),
    "BEAM-GEO-014": lambda asset: asset.change("opacitiesh", 2, 1.5),
    "BEAM-GEO-015": lambda asset: asset.change("extent", 1, 0.0, time=1.0),
    "BEAM-GEO-016": lambda asset: asset.open(GaussianSequence.from_clouds([asset.make_cloud(0, 0)]), "none.usdc"),
    "BEAM-SH-001": lambda asset: asset.splats.RemoveProperty("radiance:sphericalHarmonicsDegree"),
    "BEAM-SH-002": lambda asset: asset.set("radiance:sphericalHarmonicsDegree", 2),
    "BEAM-API-001": drop_material,
    "BEAM-API-002": drop_api,
    "BEAM-MAT-001": lambda asset: asset.splats.RemoveProperty("beam:roughnessh"),
    "BEAM-MAT-002": lambda asset: asset.set("beam:normalSource", "none"),
    "BEAM-MAT-010": lambda asset: asset.change("beam:baseColorh", 2, 1.25),
    "BEAM-MAT-011": lambda asset: asset.change("beam:roughnessh", 2, -0.25),
    "BEAM-MAT-012": lambda asset: asset.change("beam:ambientOcclusionh", 2, 1.25, time=1.0),
    "BEAM-MAT-013": lambda asset: asset.set("beam:metallich", Vt.HalfArray([0, 0, 0, 0, 0, 2])),
    "BEAM-MAT-014": lambda asset: asset.change("beam:normalsh", 2, [0.0, 0.0, 0.5]),
    "BEAM-MAT-015": lambda asset: asset.change("beam:normalConfidenceh", 2, 1.25),
    "BEAM-MAT-016": lambda asset: asset.change("beam:baseColorErrorh", 2, -0.25),
    "BEAM-MAT-017": lambda asset: asset.change("beam:observability", 2, 64),
    "BEAM-COLOR-001": lambda asset: asset.splats.GetAttribute("beam:baseColorh").ClearColorSpace(),
    "BEAM-COLOR-002": lambda asset: asset.set("beam:radianceColorSpace", "acescg"),
    "BEAM-RASTER-001": no_low_pass,
    "BEAM-TOKEN-001": lambda asset: asset.splats.RemoveProperty("beam:brdf"),
    "BEAM-TOKEN-002": lambda asset: asset.set("beam:brdf", "lambert"),
    "BEAM-VERSION-001": lambda asset: asset.set("beam:schemaVersion", "1.x"),
    "BEAM-VERSION-002": lambda asset: asset.set("beam:schemaVersion", "2.0"),
    "BEAM-VERSION-003": lambda asset: asset.set("beam:schemaVersion", "1.9"),
    "BEAM-SEQ-001": lambda asset: asset.root.RemoveAppliedSchema(SEQUENCE_API),
    "BEAM-SEQ-002": lambda asset: asset.root.GetAttribute("beam:sequence:frameCount").Set(7),
    "BEAM-SEQ-003": lambda asset: asset.splats.GetAttribute("beam:ambientOcclusionh").ClearAtTime(1.0),
    "BEAM-SEQ-004": half_frame,
    "BEAM-SEQ-005": other_count,
    "BEAM-SEQ-006": lambda asset: asset.change("beam:ids", 2, 0),
    "BEAM-SEQ-007": other_ids,
    "BEAM-SEQ-008": flipped_quaternions,
    "BEAM-SEQ-009": lambda asset: numbered(asset, [3, 4]),
    "BEAM-CLIP-001": cut_segment,
    "BEAM-CLIP-002": undeclared,
    "BEAM-CLIP-003": gap_in_clip,
}


def test_every_rule_has_a_breaker_and_a_text():
    assert sorted(BREAKERS) == [rule.id for rule in ALL_RULES]
    for rule in ALL_RULES:
        assert rule.text.endswith("."), rule.id
        assert "\n" not in rule.text, rule.id


@pytest.mark.parametrize("rule", BREAKERS)
def test_breaking_one_rule_breaks_no_other(asset, rule):
    BREAKERS[rule](asset)
    assert set(asset.rules()) == {rule}


@pytest.mark.parametrize(("name", "frames"), [("a.usda", 1), ("a.usdc", 3), ("a.usda", 65), ("a.usdz", 65)])
def test_our_output_is_clean_for_us_and_for_every_validator_of_usd(tmp_path, sequence, name, frames):
    write_asset(sequence(frames), tmp_path / name)
    report = validate_stage(Usd.Stage.Open(str(tmp_path / name)))
    assert report.findings == ()
    assert (report.frames, report.gaussians, report.is_valid) == (frames, 6, True)


@pytest.mark.parametrize("low_pass", [-0.1, np.nan, np.inf])
def test_a_low_pass_must_be_positive_and_finite(asset, low_pass):
    no_low_pass(asset)
    asset.set("beam:rasterLowPass", low_pass)
    assert asset.rules() == ["BEAM-RASTER-001"]
    asset.set("beam:rasterLowPass", 0.1)
    assert asset.rules() == []


def test_capture_frames_must_not_be_negative(asset):
    numbered(asset, [3, -4, 5])
    (finding,) = check_rules(asset.stage).findings
    assert finding.rule == "BEAM-SEQ-009"
    assert finding.message == "captureFrames must not be negative, got -4. Number the frames from 0."
    numbered(asset, [3, 4, 5])
    assert asset.rules() == []


def test_a_rate_of_zero_is_none(asset):
    asset.stage.SetTimeCodesPerSecond(0.0)
    assert asset.rules() == ["BEAM-STAGE-005", "BEAM-SEQ-002"]  # nor is it that of the sequence


def test_another_color_space_is_named(asset):
    asset.splats.GetAttribute("beam:baseColorh").SetColorSpace("srgb_rec709_scene")
    (finding,) = check_rules(asset.stage).findings
    assert finding.rule == "BEAM-COLOR-001"
    assert finding.message == "colorSpace must be lin_rec709_scene, got srgb_rec709_scene. Author it."


def test_what_version_1_1_added_is_checked(asset):
    asset.change("beam:observability", 2, 63)  # grazing is a known flag
    assert asset.rules() == []
    asset.change("beam:roughnessErrorh", 2, -0.25)
    assert asset.rules() == ["BEAM-MAT-016"]


def test_the_validators_of_usd_run_beside_ours(asset):
    asset.stage.ClearMetadata("upAxis")
    rules = {finding.rule for finding in validate_stage(asset.stage).findings}
    assert "BEAM-STAGE-003" in rules
    assert "USD-MissingUpAxisMetadata" in rules


def test_a_finding_says_where_and_how_often(asset):
    for time in (1.0, 2.0):
        asset.change("beam:ambientOcclusionh", 4, 2.0, time=time)
    (finding,) = check_rules(asset.stage).findings
    assert (finding.prim, finding.attribute) == ("/Asset/Splats", "beam:ambientOcclusionh")
    assert (finding.time, finding.frames, finding.severity) == (1.0, 2, "error")
    assert finding.message == "values must lie in [0, 1], got 2 at element 4. Clip or rescale them."


def test_reports_survive_json(asset):
    asset.change("opacitiesh", 2, 1.5)
    report = check_rules(asset.stage)
    assert Report.from_dict(report.as_dict()) == report


def test_validation_from_a_file_equals_that_of_the_stage(asset):
    asset.change("opacitiesh", 2, 1.5)
    asset.stage.GetRootLayer().Save()
    path = asset.folder / "asset.usdc"
    assert validate(path).findings == validate_stage(asset.stage).findings


def test_other_hosts_run_our_rules_through_usd(asset):
    asset.change("opacitiesh", 2, 1.5)
    registry = UsdValidation.ValidationRegistry()
    names = [data.name for data in registry.GetValidatorMetadataForKeyword("BeamValidators")]
    assert names == [HOST_VALIDATOR]
    context = UsdValidation.ValidationContext(registry.GetOrLoadValidatorsByName(names))
    (error,) = context.Validate(asset.stage)
    assert error.GetName() == "BEAM-GEO-014"
    assert str(next(iter(error.GetSites())).GetPrim().GetPath()) == "/Asset/Splats"
    assert (PLUGIN_FOLDER / "host_validator.py").is_file()


def test_an_asset_without_our_schema_is_only_warned_about(asset):
    drop_material(asset)
    report = check_rules(asset.stage)
    assert report.is_valid
    assert [(finding.severity, finding.time, finding.frames) for finding in report.findings] == [("warning", None, 0)]
