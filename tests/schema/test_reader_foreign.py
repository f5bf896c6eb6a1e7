"""Assets of other makers, written by hand here: other units, axes, places, precisions, and faults."""

import re

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol, Vt
from reference.harmonics import sh_color
from scipy.spatial.transform import Rotation

from beam_warp.errors import AssetFormatError, MissingFileError, SchemaVersionError
from beam_warp.schema.layout import to_vt
from beam_warp.schema.reader import read_asset
from beam_warp.schema.writer import write_asset

TURN = Rotation.from_euler("xyz", [30, -50, 110], degrees=True)


def author(path, *, up="Z", meters=0.01, prim_path="/World/Scan/Points", **values):
    """Write a splat prim with attributes by name, where ``__`` stands for the namespace separator."""
    stage = Usd.Stage.CreateNew(str(path))
    if up:
        UsdGeom.SetStageUpAxis(stage, up)
    if meters:
        UsdGeom.SetStageMetersPerUnit(stage, meters)
    UsdGeom.Xform.Define(stage, Sdf.Path(prim_path).GetParentPath())
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, prim_path).GetPrim()
    for name, value in values.items():
        attribute = prim.GetAttribute(name.replace("__", ":"))
        attribute.Set(to_vt(str(attribute.GetTypeName()), value) if isinstance(value, np.ndarray) else value)
    return stage


def saved(stage, **options):
    """Save a stage and read it as an asset."""
    stage.Save()
    return read_asset(stage.GetRootLayer().realPath, trusted=True, **options)


def points(rng, count=5):
    return (100.0 * rng.normal(size=(count, 3))).astype(np.float32)


def test_half_positions_in_centimetres_below_a_transform(tmp_path, rng):
    p, q = points(rng), Rotation.random(5, rng=rng).as_quat().astype(np.float16)
    harmonics = rng.normal(size=(5, 4, 3)).astype(np.float32)
    stage = author(
        tmp_path / "a.usda",
        positionsh=Vt.Vec3hArray.FromNumpy(p.astype(np.float16)),
        orientationsh=q,
        scales=np.full((5, 3), 2.0, np.float32),
        opacities=np.full(5, 0.25, np.float32),
        radiance__sphericalHarmonicsDegree=1,
        radiance__sphericalHarmonicsCoefficients=harmonics.reshape(-1, 3),
    )
    x, y, z, w = TURN.as_quat()
    parent = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Scan"))
    parent.AddTranslateOp().Set((10.0, 20.0, 30.0))
    parent.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
    parent.AddScaleOp().Set((2.0, 2.0, 2.0))
    found = saved(stage)
    cloud = found[0]
    assert (len(found), found.topology, cloud.axes) == (1, "constant", "rfu")
    assert not cloud.is_relightable
    wanted = 0.01 * (TURN.apply(2.0 * p.astype(np.float16)) + np.array([10.0, 20.0, 30.0]))
    assert np.abs(cloud.positions - wanted).max() < 1e-6  # float32 rounding of values below 8 m
    assert np.allclose(cloud.scales, 0.04)
    assert np.allclose(cloud.opacities, 0.25)
    same = (Rotation.from_quat(cloud.orientations).inv() * TURN * Rotation.from_quat(q.astype(float))).magnitude()
    assert same.max() < 1e-3  # the file's quaternions are half
    directions = Rotation.random(5, rng=rng).apply([0.0, 0.0, 1.0])
    seen = sh_color(cloud.radiance, TURN.apply(directions))
    assert np.abs(seen - sh_color(harmonics, directions)).max() < 1e-6
    assert "taken as srgb_rec709_display; the asset says nothing" in found.metadata["notes"]


def test_a_mirror_keeps_ellipsoids_and_colours(tmp_path, rng):
    p, q = points(rng), Rotation.random(5, rng=rng)
    sigma = np.array([1.0, 2.0, 3.0])
    harmonics = rng.normal(size=(5, 16, 3)).astype(np.float32)
    stage = author(
        tmp_path / "a.usdc",
        meters=1.0,
        positions=p,
        orientations=q.as_quat().astype(np.float32),
        scales=np.tile(sigma, (5, 1)).astype(np.float32),
        radiance__sphericalHarmonicsCoefficients=harmonics.reshape(-1, 3),
    )
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/Scan/Points")).AddScaleOp().Set((-1.0, 1.0, 1.0))
    cloud = saved(stage)[0]
    flip = np.diag([-1.0, 1.0, 1.0])

    def covariances(rotations):
        matrices = rotations.as_matrix() * sigma
        return matrices @ matrices.transpose(0, 2, 1)

    assert np.allclose(covariances(Rotation.from_quat(cloud.orientations)), flip @ covariances(q) @ flip, atol=1e-5)
    directions = Rotation.random(5, rng=rng).apply([0.0, 0.0, 1.0])
    assert np.abs(sh_color(cloud.radiance, directions @ flip) - sh_color(harmonics, directions)).max() < 1e-5


def test_absent_arrays_take_the_defaults_of_usd(tmp_path, rng):
    found = saved(author(tmp_path / "a.usda", up=None, meters=None, positions=points(rng)))
    cloud = found[0]
    assert cloud.axes == "rub"
    assert np.array_equal(cloud.orientations, np.tile([0, 0, 0, 1], (5, 1)))
    assert np.allclose(cloud.scales, 0.01)  # one unit, and USD's unit is a centimetre
    assert np.array_equal(cloud.opacities, np.ones(5))
    assert cloud.radiance is None
    assert found.metadata["notes"] == "one unit is taken as 0.01 m, USD's default; the asset states none"


def test_float_is_preferred_and_long_arrays_are_cut(tmp_path, rng):
    p, opacities = points(rng), np.linspace(0, 1, 9).astype(np.float32)
    half = Vt.Vec3hArray.FromNumpy(np.zeros((5, 3), np.float16))
    cloud = saved(author(tmp_path / "a.usda", meters=1.0, positions=p, positionsh=half, opacities=opacities))[0]
    assert np.array_equal(cloud.positions, p)
    assert np.array_equal(cloud.opacities, opacities[:5])


def test_quaternions_are_normalised(tmp_path, rng):
    q = np.tile(np.float32([0, 0, 3, 4]), (5, 1))
    stage = author(tmp_path / "a.usda", positions=points(rng), orientations=q)
    assert np.allclose(saved(stage)[0].orientations, [0, 0, 0.6, 0.8])


def test_time_samples_are_frames(tmp_path, rng):
    stage = author(tmp_path / "a.usda", meters=1.0)
    stage.SetTimeCodesPerSecond(24.0)
    attribute = stage.GetPrimAtPath("/World/Scan/Points").GetAttribute("positions")
    p = points(rng)
    for time in (10.0, 12.0, 14.0):
        attribute.Set(Vt.Vec3fArray.FromNumpy(p * np.float32(time)), time)
    found = saved(stage)
    assert (len(found), found.frames_per_second, found.topology) == (3, 12.0, "perFrame")
    assert np.array_equal(found[2].positions, p * np.float32(14.0))
    assert found.constant == frozenset()


def test_a_moving_transform_makes_frames(tmp_path, rng):
    stage = author(tmp_path / "a.usda", meters=1.0, positions=points(rng))
    op = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Scan")).AddTranslateOp()
    op.Set((0.0, 0.0, 0.0), 1.0)
    op.Set((1.0, 0.0, 0.0), 2.0)
    found = saved(stage)
    assert len(found) == 2
    assert np.allclose(found[1].positions - found[0].positions, [1.0, 0.0, 0.0], atol=1e-4)
    assert "positions" not in found.constant


@pytest.mark.parametrize(
    ("name", "space"), [("lin_rec709_scene", "lin_rec709_scene"), ("srgb_rec709_scene", "srgb_rec709_display")]
)
def test_colour_space_comes_from_an_ancestor(tmp_path, rng, name, space):
    harmonics = {"Degree": 0, "Coefficients": np.zeros((5, 3), np.float32)}
    radiance = {f"radiance__sphericalHarmonics{name}": value for name, value in harmonics.items()}
    stage = author(tmp_path / "a.usda", positions=points(rng), **radiance)
    Usd.ColorSpaceAPI.Apply(stage.GetPrimAtPath("/World/Scan")).CreateColorSpaceNameAttr(name)
    found = saved(stage)
    assert found[0].radiance_color_space == space
    assert "notes" not in found.metadata


def broken(match, error=AssetFormatError):
    return pytest.raises(error, match=match)


def test_several_prims_are_named(tmp_path, rng):
    stage = author(tmp_path / "a.usda", positions=points(rng))
    UsdVol.ParticleField3DGaussianSplat.Define(stage, "/World/Other")
    with broken(r"must hold one Gaussian-splat prim, got /World/Scan/Points, /World/Other\. Pass one of them"):
        saved(stage)
    assert len(saved(stage, prim_path="/World/Scan/Points")[0]) == 5
    with broken(r"must hold a Gaussian-splat prim /World, got /World/Scan/Points"):
        saved(stage, prim_path="/World")


@pytest.mark.parametrize(("scale", "shear"), [((1.0, 1.0, 1.0), 0.5), ((0.0, 0.0, 0.0), 0.0)])
def test_only_similarities_are_applied(tmp_path, rng, scale, shear):
    stage = author(tmp_path / "a.usda", positions=points(rng))
    matrix = Gf.Matrix4d(1.0)
    matrix.SetScale(scale)
    matrix[1, 0] = shear
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/Scan")).AddTransformOp().Set(matrix)
    with broken(r"at time 0 must be placed by rotation, uniform scale and translation.* Bake the transform"):
        saved(stage)


def test_faults_of_arrays(tmp_path, rng):
    p = Vt.Vec3fArray.FromNumpy(points(rng))
    harmonics = {"radiance__sphericalHarmonicsCoefficients": p}
    cases = [
        ({}, r"/World/Scan/Points at time 0 must have positions, got none"),
        ({"positions": p, "opacities": Vt.FloatArray([1.0])}, r"opacities must have 5 elements, got 1\. USD would"),
        # degree 3 is USD's fallback
        ({"positions": p} | harmonics, r"radiance:sphericalHarmonicsCoefficients must have 80 elements, got 5"),
        ({"positions": p, "radiance__sphericalHarmonicsDegree": 9} | harmonics, "0 to 4, got 9"),
        ({"positions": p, "orientations": Vt.QuatfArray(5)}, r"orientations must have unit length, got 0 at row 0"),
        ({"positions": p, "opacities": Vt.FloatArray([2.0] * 5)}, r"opacities must lie in \[0, 1\], got 2 at row 0"),
        ({"positions": Vt.Vec3fArray([(0, 0, np.nan)])}, r"positions must be finite, got NaN or infinity at row 0"),
    ]
    for index, (values, match) in enumerate(cases):
        with broken(match):
            saved(author(tmp_path / f"{index}.usda", **values))


def test_faults_of_files(tmp_path):
    with broken(r"none.usda must be a readable file, got No such file or directory", MissingFileError):
        read_asset(tmp_path / "none.usda")
    with broken(r"must end in .usd, .usda, .usdc, .usdz, got .ply\. Convert it with beam-convert"):
        read_asset(tmp_path / "a.ply")
    for name, content in (("a.usdc", b"ply\nformat"), ("a.usda", b"ply\nformat"), ("b.usdc", b"#usda 1.0\n")):
        (tmp_path / name).write_bytes(content)
        with broken(re.escape(f"{name} must be a {name[1:]} file, got the first bytes {content[:8]!r}")):
            read_asset(tmp_path / name, trusted=True)
    with broken(r"must hold a ParticleField3DGaussianSplat, got none\. Convert the splats"):
        saved(Usd.Stage.CreateNew(str(tmp_path / "empty.usda")))


def rewritten_version(path, version):
    layer = Sdf.Layer.FindOrOpen(str(path))
    layer.GetAttributeAtPath("/Asset/Splats.beam:schemaVersion").default = version
    layer.Save()


def test_versions(tmp_path, sequence):
    path = tmp_path / "a.usdc"
    write_asset(sequence(1), path)
    rewritten_version(path, "1.7")
    with pytest.warns(UserWarning, match=r"version 1.7 is newer than 1.3: what it added is not read"):
        found = read_asset(path, trusted=True)
    assert found.metadata["notes"].startswith("schema version 1.7 is newer")
    for version in ("2.0", "banana", ""):
        rewritten_version(path, version)
        with broken(r"must have schema version 1.3, got .* at /Asset/Splats\. Upgrade", SchemaVersionError):
            read_asset(path, trusted=True)


def test_a_breaking_schema_is_known_by_its_name(tmp_path, sequence):
    path = tmp_path / "a.usdc"
    write_asset(sequence(1), path)
    layer = Sdf.Layer.FindOrOpen(str(path))
    names = Sdf.TokenListOp.Create(prependedItems=["BeamRelightableGaussianAPI_1"])
    layer.GetPrimAtPath("/Asset/Splats").SetInfo("apiSchemas", names)
    layer.Save()
    with broken(r"got the schema BeamRelightableGaussianAPI_1 at /Asset/Splats", SchemaVersionError):
        read_asset(path, trusted=True)
