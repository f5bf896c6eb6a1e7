"""A small sound asset, and for each rule one change that breaks this rule and no other."""

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from beam_warp.schema import MATERIAL_API, SEQUENCE_API
from beam_warp.schema.layout import to_vt
from beam_warp.schema.validation.validator import check_rules
from beam_warp.schema.writer import write_asset
from beam_warp.world.gaussians import GaussianSequence


class Asset:
    """A sound three-frame asset, or one with clips, that a test damages in one place."""

    def __init__(self, folder, sequence, make_cloud):
        self.folder, self.sequence, self.make_cloud = folder, sequence, make_cloud
        self.open(sequence(3))

    def open(self, source, name="asset.usdc", **options):
        write_asset(source, self.folder / name, **options)
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

    def prepare(self, rule):
        PREPARED.get(rule, lambda asset: None)(self)

    def rules(self):
        return [finding.rule for finding in check_rules(self.stage).findings]


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


def counts_that_change(asset):
    clouds = [asset.make_cloud(0, 5, ids=None), asset.make_cloud(1, 6, ids=None)]
    asset.open(GaussianSequence.from_clouds(clouds), "counts.usdc")


def ids_that_change(asset):
    base = asset.make_cloud()
    asset.open(GaussianSequence.from_clouds([base, base.with_arrays(ids=base.ids[::-1])]), "ids.usdc")


def constant_topology(asset):
    asset.root.GetAttribute("beam:sequence:topology").Set("constant")


def one_rotation(asset):
    constant_topology(asset)
    attribute = asset.splats.GetAttribute("orientationsh")
    for time in range(3):
        attribute.Set(attribute.Get(0), time)


def negated_quaternions(asset):
    attribute = asset.splats.GetAttribute("orientationsh")
    attribute.Set(Vt.QuathArray.FromNumpy(-np.array(attribute.Get(1.0))), 1.0)


def cut_segment(asset):
    layer = asset.folder / "clips.000030.usdc"
    del asset.stage
    layer.write_bytes(layer.read_bytes()[:100])
    asset.stage = Usd.Stage.Open(str(asset.folder / "clips.usda"))


def undeclared(asset):
    prim = asset.layer("clips.manifest.usda").GetPrimAtPath("/Asset/Splats")
    Sdf.AttributeSpec(prim, "beam:metallich", Sdf.ValueTypeNames.HalfArray)


def gap_in_clip(asset):
    asset.layer("clips.000030.usdc").EraseTimeSample("/Asset/Splats.beam:ambientOcclusionh", 35.0)


def scaled(asset, *factors):
    UsdGeom.Xformable(asset.splats).MakeMatrixXform().Set(Gf.Matrix4d().SetScale(Gf.Vec3d(*factors)))


def metallic(asset, *values):
    attribute = asset.splats.CreateAttribute("beam:metallich", Sdf.ValueTypeNames.HalfArray)
    attribute.Set(Vt.HalfArray(values))


def low_pass(asset, variance):
    asset.splats.CreateAttribute("beam:rasterLowPass", Sdf.ValueTypeNames.Float).Set(variance)


def numbered(asset, frames):
    name = "beam:sequence:captureFrames"
    asset.root.CreateAttribute(name, Sdf.ValueTypeNames.IntArray).Set(Vt.IntArray(frames))


PREPARED = {
    "BEAM-GEO-003": lambda asset: scaled(asset, 2.0, 2.0, 2.0),
    "BEAM-MAT-013": lambda asset: metallic(asset, 0, 0, 0, 0, 0, 1),
    "BEAM-RASTER-001": lambda asset: low_pass(asset, 0.3),
    "BEAM-SEQ-005": counts_that_change,
    "BEAM-SEQ-007": ids_that_change,
    "BEAM-SEQ-008": one_rotation,
    "BEAM-SEQ-009": lambda asset: numbered(asset, [3, 4, 5]),
    "BEAM-SEQ-010": lambda asset: asset.open(asset.sequence(3), "keyed.usdc", bounds={}),
    "BEAM-CLIP-001": lambda asset: asset.open_clips(),
    "BEAM-CLIP-002": lambda asset: asset.open_clips(),
    "BEAM-CLIP-003": lambda asset: asset.open_clips(),
}
"""What a sound asset needs beside, so that there is something that a rule can be about."""

BREAKERS = {
    "BEAM-STAGE-001": lambda asset: asset.stage.ClearDefaultPrim(),
    "BEAM-STAGE-002": lambda asset: asset.stage.ClearMetadata("metersPerUnit"),
    "BEAM-STAGE-003": lambda asset: asset.stage.ClearMetadata("upAxis"),
    "BEAM-STAGE-004": lambda asset: asset.splats.SetTypeName("Xform"),
    "BEAM-STAGE-005": lambda asset: asset.stage.ClearMetadata("timeCodesPerSecond"),
    "BEAM-STAGE-006": lambda asset: asset.root.GetReferences().AddReference("./nowhere.usdc"),
    "BEAM-GEO-001": lambda asset: asset.splats.RemoveProperty("opacitiesh"),
    "BEAM-GEO-002": both_precisions,
    "BEAM-GEO-003": lambda asset: scaled(asset, 1.0, 2.0, 1.0),
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
    "BEAM-MAT-013": lambda asset: metallic(asset, 0, 0, 0, 0, 0, 2),
    "BEAM-MAT-014": lambda asset: asset.change("beam:normalsh", 2, [0.0, 0.0, 0.5]),
    "BEAM-MAT-015": lambda asset: asset.change("beam:normalConfidenceh", 2, 1.25),
    "BEAM-MAT-016": lambda asset: asset.change("beam:baseColorErrorh", 2, -0.25),
    "BEAM-MAT-017": lambda asset: asset.change("beam:observability", 2, 64),
    "BEAM-COLOR-001": lambda asset: asset.splats.GetAttribute("beam:baseColorh").ClearColorSpace(),
    "BEAM-COLOR-002": lambda asset: asset.set("beam:radianceColorSpace", "acescg"),
    "BEAM-RASTER-001": lambda asset: low_pass(asset, 0.0),
    "BEAM-TOKEN-001": lambda asset: asset.splats.RemoveProperty("beam:brdf"),
    "BEAM-TOKEN-002": lambda asset: asset.set("beam:brdf", "lambert"),
    "BEAM-VERSION-001": lambda asset: asset.set("beam:schemaVersion", "1.x"),
    "BEAM-VERSION-002": lambda asset: asset.set("beam:schemaVersion", "2.0"),
    "BEAM-VERSION-003": lambda asset: asset.set("beam:schemaVersion", "1.9"),
    "BEAM-SEQ-001": lambda asset: asset.root.RemoveAppliedSchema(SEQUENCE_API),
    "BEAM-SEQ-002": lambda asset: asset.root.GetAttribute("beam:sequence:frameCount").Set(7),
    "BEAM-SEQ-003": lambda asset: asset.splats.GetAttribute("beam:ambientOcclusionh").ClearAtTime(1.0),
    "BEAM-SEQ-004": half_frame,
    "BEAM-SEQ-005": constant_topology,
    "BEAM-SEQ-006": lambda asset: asset.change("beam:ids", 2, 0),
    "BEAM-SEQ-007": constant_topology,
    "BEAM-SEQ-008": negated_quaternions,
    "BEAM-SEQ-009": lambda asset: numbered(asset, [3, 4]),
    "BEAM-SEQ-010": lambda asset: asset.splats.GetAttribute("beam:ambientOcclusionh").ClearAtTime(2.0),
    "BEAM-CLIP-001": cut_segment,
    "BEAM-CLIP-002": undeclared,
    "BEAM-CLIP-003": gap_in_clip,
}
"""The one change that breaks a rule."""
