"""What the asset itself says how to mend is mended, once; all else stays as it is, to the byte."""

import numpy as np
import pytest
from pxr import Sdf, Usd, Vt
from support.broken_assets import BREAKERS, drop_material

from beam_warp.errors import OutputError
from beam_warp.schema.authoring import kernel_extent
from beam_warp.schema.layout import to_vt
from beam_warp.schema.reader import read_asset
from beam_warp.schema.validation.mending import mend, mend_stage
from beam_warp.schema.validation.mends import CLIPPED_REACH, MENDS
from beam_warp.schema.validation.report import Report
from beam_warp.schema.validation.validator import check_rules
from beam_warp.world.gaussians import GaussianSequence

ABOVE_ONE = 1.0 + CLIPPED_REACH
"""The next larger half."""


def longer(asset, name, surplus):
    attribute = asset.splats.GetAttribute(name)
    array = np.asarray(attribute.Get())
    attribute.Set(to_vt(str(attribute.GetTypeName()), np.concatenate([array, array[:surplus]])))


def base_color_only(asset):
    cloud = asset.make_cloud(degree=None)
    asset.open(GaussianSequence.from_clouds([cloud]), "plain.usdc")
    asset.splats.RemoveProperty("colorSpace:name")
    asset.splats.RemoveProperty("beam:radianceColorSpace")


MENDED = {
    **{rule: BREAKERS[rule] for rule in MENDS},
    "BEAM-GEO-010": lambda asset: longer(asset, "opacitiesh", 1),
    "BEAM-SH-002": lambda asset: longer(asset, "radiance:sphericalHarmonicsCoefficientsh", 2),
    "BEAM-GEO-014": lambda asset: asset.change("opacitiesh", 2, ABOVE_ONE),
    "BEAM-MAT-010": lambda asset: asset.change("beam:baseColorh", 2, ABOVE_ONE),
    "BEAM-MAT-011": lambda asset: asset.change("beam:roughnessh", 2, -(2.0**-24)),
    "BEAM-MAT-012": lambda asset: asset.change("beam:ambientOcclusionh", 2, ABOVE_ONE, time=1.0),
    "BEAM-MAT-013": lambda asset: asset.set("beam:metallich", Vt.HalfArray([0, 0, 0, 0, 0, ABOVE_ONE])),
    "BEAM-MAT-015": lambda asset: asset.change("beam:normalConfidenceh", 2, ABOVE_ONE),
    "BEAM-COLOR-002": lambda asset: asset.splats.RemoveProperty("beam:radianceColorSpace"),
    "BEAM-VERSION-001": lambda asset: asset.splats.RemoveProperty("beam:schemaVersion"),
}
"""One change that breaks a rule within reach of its mend."""

LEFT = {rule: change for rule, change in BREAKERS.items() if MENDED.get(rule) is not change}
"""One change that breaks a rule so that only the producer can tell what is meant."""


@pytest.mark.parametrize("rule", MENDED)
def test_what_is_mended_breaks_no_rule_and_is_not_mended_again(asset, rule):
    asset.prepare(rule)
    MENDED[rule](asset)
    assert set(asset.rules()) == {rule}
    report = mend_stage(asset.stage)
    assert {finding.rule for finding in report.mended} == {rule}
    assert report.findings == ()
    assert mend_stage(asset.stage).mended == ()


def test_the_primvar_of_a_mended_array_is_mended_with_it(asset):
    asset.change("beam:baseColorh", 2, ABOVE_ONE)
    mend_stage(asset.stage)
    shown = np.asarray(asset.splats.GetAttribute("primvars:baseColor").Get())
    assert np.array_equal(shown, np.asarray(asset.splats.GetAttribute("beam:baseColorh").Get()))
    assert shown.max() <= 1.0


@pytest.mark.parametrize("rule", sorted(LEFT.keys() - {"BEAM-CLIP-001"}))
def test_what_only_the_producer_knows_is_left(asset, rule):
    asset.prepare(rule)
    LEFT[rule](asset)
    assert set(asset.rules()) == {rule}  # opens all layers
    before = {layer: layer.ExportToString() for layer in asset.stage.GetUsedLayers()}
    assert mend_stage(asset.stage).mended == ()
    assert set(asset.rules()) == {rule}
    assert {layer: layer.ExportToString() for layer in asset.stage.GetUsedLayers()} == before


@pytest.mark.parametrize("name", ["a.usda", "clips.usda", "clips.usdz"])
def test_a_file_is_mended_in_place(tmp_path, asset, name):
    """Unnormalised quaternions, in clips too, and bounds that are not there."""
    source = asset.sequence(65 if "clips" in name else 3)
    asset.open(source, name.replace("usdz", "usda"))
    times = [1.0, 40.0] if "clips" in name else [1.0]
    layers = []
    for time in times:
        (spec, _), *_ = asset.splats.GetAttribute("orientationsh").GetPropertyStackWithLayerOffsets(time)
        array = np.array(asset.splats.GetAttribute("orientationsh").Get(time))
        array[3] *= 0.75
        spec.layer.SetTimeSample(spec.path, time, Vt.QuathArray.FromNumpy(array))
        layers.append(spec.layer)
    for layer in layers:
        layer.Save()
    path = tmp_path / name
    if name.endswith("usdz"):
        names = sorted(file.name for file in tmp_path.glob(f"{path.stem}.*"))
        package = Sdf.ZipFileWriter.CreateNew(str(path))
        for each in sorted(names, key=lambda each: each != f"{path.stem}.usda"):
            package.AddFile(str(tmp_path / each), each)
        package.Save()
    files = {file: file.read_bytes() for file in tmp_path.iterdir()}
    del asset.stage, asset.splats, asset.root
    report = mend(path)
    assert [(found.rule, found.frames) for found in report.mended] == [("BEAM-GEO-012", len(times))]
    assert report.is_valid
    assert {*files} == {*tmp_path.iterdir()}
    changed = {file.name for file in files if file.read_bytes() != files[file]}
    expected = {"clips.usda": {"clips.000000.usdc", "clips.000030.usdc"}, "a.usda": {"a.frames.usdc"}}
    assert changed == expected.get(name, {name})
    for frame in map(int, times):
        written, found = source[frame], read_asset(path)[frame]
        cosines = np.abs(np.einsum("nk,nk->n", found.orientations, written.orientations))
        np.testing.assert_allclose(cosines, 1.0, atol=2.0**-10)  # rounding to half, and either sign
        assert np.array_equal(found.positions, written.positions)
    once = {file: file.read_bytes() for file in tmp_path.iterdir()}
    assert mend(path).mended == ()
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == once


def test_bounds_of_clips_are_written_where_the_prim_is_defined(asset):
    asset.open_clips()
    layers = [Sdf.Layer.FindOrOpen(str(path)) for path in asset.folder.glob("clips.*")]
    for prim in filter(None, (layer.GetPrimAtPath("/Asset/Splats") for layer in layers)):
        if "extent" in prim.attributes:
            prim.RemoveProperty(prim.attributes["extent"])
    assert asset.rules() == ["BEAM-GEO-004"]
    assert mend_stage(asset.stage).findings == ()
    cloud = asset.sequence(65)[40]
    wanted = kernel_extent(cloud.positions, cloud.orientations, cloud.scales)
    reach = 3.0 * np.linalg.norm(cloud.scales, axis=1).max()
    np.testing.assert_allclose(asset.splats.GetAttribute("extent").Get(40.0), wanted, atol=2.0**-9 * reach)


@pytest.mark.parametrize(("length", "is_mended"), [(0.49, False), (0.51, True), (1.99, True), (2.01, False)])
def test_only_lengths_in_reach_are_normalised(asset, length, is_mended):
    asset.change("beam:normalsh", 2, [0.0, 0.0, length])
    assert bool(mend_stage(asset.stage).mended) is is_mended


def test_an_array_is_mended_as_a_whole_or_not_at_all(asset):
    asset.change("beam:normalsh", 2, [0.0, 0.0, 0.75])
    asset.change("beam:normalsh", 3, [0.0, 0.0, 0.0])
    before = np.array(asset.splats.GetAttribute("beam:normalsh").Get())
    assert mend_stage(asset.stage).mended == ()
    assert np.array_equal(asset.splats.GetAttribute("beam:normalsh").Get(), before)


def test_coefficients_of_another_degree_are_no_surplus(asset):
    """Four coefficients each under degree 0: the array and the degree contradict each other."""
    asset.set("radiance:sphericalHarmonicsDegree", 0)
    assert mend_stage(asset.stage).mended == ()


def test_one_mend_uncovers_another(asset):
    """Without the schema nobody asks for its tokens; once it is applied, they are stated."""
    BREAKERS["BEAM-API-002"](asset)
    for name in ("beam:brdf", "beam:schemaVersion", "beam:aoMeaning"):
        asset.splats.RemoveProperty(name)
    report = mend_stage(asset.stage)
    assert {found.rule for found in report.mended} == {"BEAM-API-002", "BEAM-TOKEN-001", "BEAM-VERSION-001"}
    assert report.findings == ()


def test_splats_of_others_are_not_made_relightable(asset):
    drop_material(asset)
    assert mend_stage(asset.stage).mended == ()


def test_the_stand_in_for_viewers_has_a_known_color_space(asset):
    base_color_only(asset)
    assert asset.rules() == ["BEAM-COLOR-002"]
    assert mend_stage(asset.stage).findings == ()
    asset.splats.RemoveProperty("beam:radianceColorSpace")
    asset.set("beam:radianceMeaning", "captured")
    assert mend_stage(asset.stage).mended == ()


def test_layers_outside_the_folder_are_not_changed(tmp_path, asset):
    (tmp_path / "shot").mkdir()
    asset.set("beam:brdf", "ggx-metallic-roughness")
    asset.splats.RemoveProperty("beam:brdf")
    asset.stage.GetRootLayer().Save()
    shot = Usd.Stage.CreateNew(str(tmp_path / "shot" / "shot.usda"))
    shot.GetRootLayer().subLayerPaths.append("../asset.usdc")
    root = asset.stage.GetRootLayer()
    shot.SetDefaultPrim(shot.GetPrimAtPath("/Asset"))
    for key in ("metersPerUnit", "upAxis", "startTimeCode", "endTimeCode", "timeCodesPerSecond"):
        shot.GetRootLayer().pseudoRoot.SetInfo(key, root.pseudoRoot.GetInfo(key))
    shot.GetRootLayer().Save()
    before = (tmp_path / "asset.usdc").read_bytes()
    report = mend(tmp_path / "shot" / "shot.usda")
    assert report.mended == ()
    assert [found.rule for found in report.findings] == ["BEAM-TOKEN-001"]
    assert (tmp_path / "asset.usdc").read_bytes() == before


def test_nothing_is_left_behind_where_nothing_can_be_written(tmp_path, asset, monkeypatch):
    asset.splats.RemoveProperty("beam:brdf")
    asset.stage.GetRootLayer().Save()
    files = {file: file.read_bytes() for file in tmp_path.iterdir()}

    def refuse(*_):
        raise OutputError("the disk is full")

    monkeypatch.setattr("beam_warp.schema.validation.mending.publish", refuse)
    with pytest.raises(OutputError, match="the disk is full"):
        mend(tmp_path / "asset.usdc")
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == files


def test_reports_with_mends_survive_json(asset):
    asset.splats.RemoveProperty("beam:brdf")
    report = mend_stage(asset.stage)
    assert Report.from_dict(report.as_dict()) == report
    assert check_rules(asset.stage).mended == ()
