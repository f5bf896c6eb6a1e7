"""Cameras of USD stages against ones built by hand, and against OpenUSD's own frustum."""

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom
from scipy.spatial.transform import Rotation

from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError
from beam_warp.schema import register
from beam_warp.schema.cameras import read_usd_camera
from beam_warp.world.camera import Camera

OPENGL = np.diag([1.0, -1.0, -1.0])

LENS = {"focalLength": 50.0, "horizontalAperture": 36.0, "verticalAperture": 24.0}


def author(path, *, up="Y", meters=0.01, prims=("/World/Camera",), rate=24.0, times=None, **lens):
    """A stage with cameras that have the attributes given by name; dicts are time samples."""
    register()  # before OpenUSD loads its schemas: other tests of this process need ours
    stage = Usd.Stage.CreateNew(str(path))
    if up:
        UsdGeom.SetStageUpAxis(stage, up)
    if meters:
        UsdGeom.SetStageMetersPerUnit(stage, meters)
    stage.SetTimeCodesPerSecond(rate)
    if times:
        stage.SetStartTimeCode(times[0])
        stage.SetEndTimeCode(times[1])
    for name in prims:
        UsdGeom.Xform.Define(stage, Sdf.Path(name).GetParentPath())
        camera = UsdGeom.Camera.Define(stage, name).GetPrim()
        for attribute, value in (LENS | lens).items():
            for time, sample in value.items() if isinstance(value, dict) else [(Usd.TimeCode.Default(), value)]:
                camera.GetAttribute(attribute).Set(sample, time)
    return stage


def read(path, **options):
    return read_usd_camera(path, trusted=True, **options)


def saved(stage):
    """Save a stage and read its camera."""
    stage.Save()
    return read(stage.GetRootLayer().realPath)


def matrix_of(stage, prim="/World/Camera"):
    """The op to place a camera by."""
    return UsdGeom.Xformable(stage.GetPrimAtPath(prim)).AddTransformOp()


def rigid(turn, position):
    """USD's matrix, for rows."""
    matrix = np.eye(4)
    matrix[:3, :3] = turn.as_matrix().T
    matrix[3, :3] = position
    return Gf.Matrix4d(matrix.tolist())


class TestPlace:
    def test_a_y_up_stage_in_centimetres(self, tmp_path):
        stage = author(tmp_path / "a.usda")
        UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/World")).SetTranslate(Gf.Vec3d(100.0, 0.0, 0.0))
        # level, 2 m up and 3 m back from the origin, 1 m to the right: at rest it looks along -z, USD's forward
        UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/World/Camera")).SetTranslate(Gf.Vec3d(0.0, 200.0, 300.0))
        got = saved(stage).camera_at(0.0, 360, 240)
        fov = 2.0 * np.degrees(np.arctan(12.0 / 50.0))
        hand = Camera.look_at((1.0, -3.0, 2.0), (1.0, 0.0, 2.0), width=360, height=240, vertical_fov=fov)
        np.testing.assert_allclose(got.camera_to_world, hand.camera_to_world, atol=1e-12)
        for name in ("focal_x", "focal_y", "center_x", "center_y"):
            # OpenUSD keeps lenses in float32
            assert getattr(got, name) == pytest.approx(getattr(hand, name), rel=2.0**-22)

    def test_a_z_up_stage_in_metres(self, tmp_path, rng):
        turn, position = Rotation.random(rng=rng), rng.normal(size=3)
        stage = author(tmp_path / "a.usda", up="Z", meters=1.0)
        matrix_of(stage).Set(rigid(turn, position))
        got = saved(stage).camera_at(3.0, 36, 24)
        np.testing.assert_allclose(got.camera_to_world[:3, :3], turn.as_matrix() @ OPENGL, atol=1e-12)
        np.testing.assert_allclose(got.position, position, atol=1e-12)

    def test_uniform_scale_above_a_camera_does_not_matter_but_to_its_place(self, tmp_path):
        stage = author(tmp_path / "a.usda", up="Z", meters=1.0)
        UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/World")).SetScale(Gf.Vec3f(2.0, 2.0, 2.0))
        UsdGeom.XformCommonAPI(stage.GetPrimAtPath("/World/Camera")).SetTranslate(Gf.Vec3d(1.0, 0.0, 0.0))
        got = saved(stage).camera_at(0.0, 36, 24)
        np.testing.assert_allclose(got.camera_to_world[:3, :3], OPENGL, atol=1e-12)
        np.testing.assert_allclose(got.position, [2.0, 0.0, 0.0], atol=1e-12)

    def test_no_unit_is_a_note(self, tmp_path):
        (note,) = saved(author(tmp_path / "a.usda", meters=None)).notes
        assert note == "a.usda: one unit is taken as 0.01 m, USD's default; it states none"


class TestLens:
    @pytest.mark.parametrize(("width", "height"), [(300, 200), (400, 200), (200, 400)])
    def test_offsets_as_openusd_has_them(self, tmp_path, rng, width, height):
        stage = author(tmp_path / "a.usda", horizontalApertureOffset=4.0, verticalApertureOffset=-3.0)
        ours = saved(stage).camera_at(0.0, width, height)
        theirs = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera(Usd.TimeCode.Default()).frustum
        projection = np.array(theirs.ComputeProjectionMatrix())  # for rows
        local = rng.normal((0.0, 0.0, -9.0), size=(30, 3))  # in USD's camera axes, which are the world's: y up
        clip = np.column_stack([local, np.ones(30)]) @ projection
        window = clip[:, :2] / clip[:, 3:]  # -1 to 1 over the aperture
        pixels = min(width / 36.0, height / 24.0)
        expected = np.stack(
            [0.5 * width + 18.0 * pixels * window[:, 0], 0.5 * height - 12.0 * pixels * window[:, 1]], axis=1
        )
        world = 0.01 * local @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).T
        np.testing.assert_allclose(ours.project(world)[:, :2], expected, rtol=2.0**-20)

    def test_nothing_of_the_aperture_is_cut_off(self, tmp_path):
        path = saved(author(tmp_path / "a.usda"))
        assert path.aspect == 1.5
        assert path.camera_at(0.0, 150, 100).focal_x == pytest.approx(50.0 * 150.0 / 36.0)
        assert path.camera_at(0.0, 300, 100).focal_x == pytest.approx(50.0 * 100.0 / 24.0)
        assert path.camera_at(0.0, 150, 300).focal_x == pytest.approx(50.0 * 150.0 / 36.0)


class TestTime:
    def test_samples_of_place_and_lens(self, tmp_path):
        stage = author(tmp_path / "a.usda", up="Z", meters=1.0, times=(101, 125), focalLength={101: 40.0, 125: 60.0})
        op = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Camera")).AddTranslateOp()
        op.Set(Gf.Vec3d(0.0, 0.0, 0.0), 101)
        op.Set(Gf.Vec3d(0.0, 8.0, 0.0), 113)
        path = saved(stage)
        assert path.duration == 1.0
        for time, y, focal in ((-1, 0, 40), (0, 0, 40), (0.25, 4, 45), (0.5, 8, 50), (2, 8, 60)):
            camera = path.camera_at(time, 360, 240)
            np.testing.assert_allclose(camera.position, [0.0, y, 0.0], atol=1e-12)
            assert camera.focal_x == pytest.approx(10.0 * focal, rel=2.0**-20)

    def test_a_whole_turn_of_two_samples_is_one(self, tmp_path):
        stage = author(tmp_path / "a.usda", up="Z", meters=1.0, rate=10.0)
        op = UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddRotateZOp()
        op.Set(0.0, 0)
        op.Set(360.0, 10)
        got = saved(stage).camera_at(0.25, 36, 24)
        turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
        np.testing.assert_allclose(got.camera_to_world[:3, :3], turn @ OPENGL, atol=1e-7)

    def test_matrices_between_samples_are_rotations(self, tmp_path):
        stage = author(tmp_path / "a.usda", up="Z", meters=1.0, rate=1.0)
        op = matrix_of(stage)
        for time, degrees in ((0, 0.0), (1, 90.0)):
            op.Set(rigid(Rotation.from_euler("x", degrees, degrees=True), (time, 0.0, 0.0)), time)
        got = saved(stage).camera_at(0.5, 36, 24)
        half = Rotation.from_euler("x", 45, degrees=True).as_matrix()
        np.testing.assert_allclose(got.camera_to_world[:3, :3], half @ OPENGL, atol=1e-12)


class TestMistakes:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"projection": "orthographic"}, "/World/Camera must be a perspective camera, got 'orthographic'."),
            ({"focalLength": 0.0}, "/World/Camera at time 0: focalLength must be a number in"),
            ({"verticalAperture": {3: 24.0, 7: -1.0}}, "/World/Camera at time 7: verticalAperture must be a number in"),
            ({"focalLength": float("nan")}, "focalLength must be a number in [1e-06, 1e+09], got nan."),
            ({"focalLength": 0.01}, "at time 0: fov must be a number in [0.01, 179]"),
            ({"rate": -1.0}, "must have a positive timeCodesPerSecond, got -1."),
            ({"prims": ("/A/One", "/A/Two")}, "must hold one camera, got /A/One, /A/Two. Name one of them as prim."),
            ({"prims": ()}, "must hold a camera, got none."),
        ],
    )
    def test_lenses_and_prims(self, tmp_path, changes, message):
        with pytest.raises(AssetFormatError) as caught:
            saved(author(tmp_path / "a.usda", **changes))
        assert str(caught.value).startswith(str(tmp_path / "a.usda"))
        assert message in str(caught.value)

    @pytest.mark.parametrize(
        ("matrix", "message"),
        [
            (np.diag([1.0, 2.0, 1.0, 1.0]), "must be placed by rotation, uniform scale and translation"),
            (np.diag([-1.0, 1.0, 1.0, 1.0]), "must not be mirrored, got a negative scale."),
            (np.diag([np.nan, 1.0, 1.0, 1.0]), "must have a finite transform, got NaN or infinity."),
            (np.diag([0.0, 0.0, 0.0, 1.0]), "must be placed by rotation"),
        ],
    )
    def test_poses(self, tmp_path, matrix, message):
        stage = author(tmp_path / "a.usda")
        op = matrix_of(stage)
        op.Set(Gf.Matrix4d(1.0), 0)
        op.Set(Gf.Matrix4d(matrix.tolist()), 5)
        with pytest.raises(AssetFormatError) as caught:
            saved(stage)
        assert "/World/Camera at time 5 " in str(caught.value)
        assert message in str(caught.value)

    def test_which_prim(self, tmp_path):
        author(tmp_path / "a.usda", prims=("/A/One", "/A/Two")).Save()
        assert read(tmp_path / "a.usda", prim_path="/A/Two").prim_path == "/A/Two"
        message = r"prim must be a camera of .*, got '/A' \(it has /A/One, /A/Two\)"
        with pytest.raises(InvalidOptionError, match=message):
            read(tmp_path / "a.usda", prim_path="/A")

    def test_files(self, tmp_path):
        with pytest.raises(MissingFileError, match="must be a readable file"):
            read(tmp_path / "none.usda")
        (tmp_path / "a.usda").write_text("#usda 1.0\ndef Camera {")
        with pytest.raises(AssetFormatError, match="must open in OpenUSD, got"):
            read_usd_camera(tmp_path / "a.usda")
