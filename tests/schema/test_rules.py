"""A sound asset breaks no rule; for each rule there is one way to break that rule and no other."""

import numpy as np
import pytest
from pxr import Usd, UsdValidation
from support.broken_assets import BREAKERS, drop_material, low_pass, numbered

from beam_warp.schema import PLUGIN_FOLDER
from beam_warp.schema.validation.report import Report
from beam_warp.schema.validation.validator import ALL_RULES, HOST_PLUGIN, check_rules, validate, validate_stage
from beam_warp.schema.writer import write_asset


def test_every_rule_has_a_breaker_and_a_text():
    assert sorted(BREAKERS) == [rule.id for rule in ALL_RULES]
    for rule in ALL_RULES:
        assert rule.text.endswith("."), rule.id
        assert "\n" not in rule.text, rule.id


@pytest.mark.parametrize("rule", BREAKERS)
def test_breaking_one_rule_breaks_no_other(asset, rule):
    asset.prepare(rule)
    assert asset.rules() == []
    BREAKERS[rule](asset)
    assert set(asset.rules()) == {rule}


@pytest.mark.parametrize(("name", "frames"), [("a.usda", 1), ("a.usdc", 3), ("a.usda", 65), ("a.usdz", 65)])
def test_our_output_is_clean_for_us_and_for_every_validator_of_usd(tmp_path, sequence, name, frames):
    write_asset(sequence(frames), tmp_path / name)
    report = validate_stage(Usd.Stage.Open(str(tmp_path / name)))
    assert report.findings == ()
    assert (report.frames, report.gaussians, report.is_valid) == (frames, 6, True)


@pytest.mark.parametrize("variance", [-0.1, np.nan, np.inf])
def test_a_low_pass_must_be_positive_and_finite(asset, variance):
    low_pass(asset, variance)
    assert asset.rules() == ["BEAM-RASTER-001"]


def test_capture_frames_must_not_be_negative(asset):
    numbered(asset, [3, -4, 5])
    (finding,) = check_rules(asset.stage).findings
    assert finding.rule == "BEAM-SEQ-009"
    assert finding.message == "captureFrames must not be negative, got -4. Number the frames from 0."


def test_a_rate_of_zero_is_told_from_none(asset):
    asset.stage.SetTimeCodesPerSecond(0.0)
    zero, other = check_rules(asset.stage).findings
    assert zero.message == "timeCodesPerSecond must be authored and positive, got 0. Author the frame rate."
    assert (zero.rule, zero.attribute) == ("BEAM-STAGE-005", "timeCodesPerSecond")
    assert (other.rule, other.prim) == ("BEAM-SEQ-002", "/Asset")  # nor is it that of the sequence


def test_a_reversed_range_is_told_from_none(asset):
    asset.stage.SetStartTimeCode(5.0)
    reversed_range = check_rules(asset.stage).findings[0]
    assert "must be authored in order, got 5 and 2." in reversed_range.message
    asset.stage.ClearMetadata("startTimeCode")
    asset.stage.ClearMetadata("endTimeCode")
    (missing,) = check_rules(asset.stage).findings
    assert "must be authored in order, got none." in missing.message


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


def host_errors(stage, *arguments):
    """What OpenUSD itself finds by the suite of our plug-in: names of errors and paths of prims."""
    suite = UsdValidation.ValidationRegistry().GetOrLoadValidatorSuiteByName(f"{HOST_PLUGIN}:AssetRules")
    errors = UsdValidation.ValidationContext([suite]).Validate(stage, *arguments)
    return {(error.GetName(), str(next(iter(error.GetSites())).GetPrim().GetPath())) for error in errors}


def test_other_hosts_find_a_validator_for_each_rule():
    known = UsdValidation.ValidationRegistry().GetValidatorMetadataForKeyword("BeamValidators")
    docs = {data.name.removeprefix(f"{HOST_PLUGIN}:"): data.doc for data in known if not data.isSuite}
    assert docs == {rule.id: rule.text for rule in ALL_RULES}
    assert (PLUGIN_FOLDER / "validation" / "host_validator.py").is_file()


@pytest.mark.parametrize("rule", BREAKERS)
def test_other_hosts_find_what_we_find(asset, rule):
    asset.prepare(rule)
    BREAKERS[rule](asset)
    assert host_errors(asset.stage) == {(found.rule, found.prim) for found in check_rules(asset.stage).findings}


def test_other_hosts_can_check_one_frame(asset):
    asset.change("beam:ambientOcclusionh", 4, 2.0, time=1.0)
    frames = (UsdValidation.ValidationTimeRange(Usd.TimeCode(float(frame))) for frame in range(3))
    assert [len(host_errors(asset.stage, frame)) for frame in frames] == [0, 1, 0]


def test_a_broken_clip_is_a_finding_and_no_crash(asset):
    asset.open_clips()
    BREAKERS["BEAM-CLIP-001"](asset)
    asset.stage = None
    rules = {finding.rule for finding in validate(asset.folder / "clips.usda").findings}
    assert "BEAM-CLIP-001" in rules


def test_an_asset_without_our_schema_is_only_warned_about(asset):
    drop_material(asset)
    report = check_rules(asset.stage)
    assert report.is_valid
    assert [(finding.severity, finding.time, finding.frames) for finding in report.findings] == [("warning", None, 0)]
