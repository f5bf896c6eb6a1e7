"""Stages: where points land, what is seen when, what decides an image, the JSON and every mistake in it."""

import copy
import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from beam_warp import converters
from beam_warp.errors import AssetFormatError, BeamError, InvalidOptionError, MissingFileError, SchemaVersionError
from beam_warp.image.color import DISPLAY_SRGB, srgb_to_linear
from beam_warp.image.files import write_exr
from beam_warp.mesh.files import write_mesh
from beam_warp.stage.assets import StageAsset
from beam_warp.stage.camera_paths import FixedCamera, KeyframePath, OrbitPath
from beam_warp.stage.environments import StageEnvironment
from beam_warp.stage.meshes import Ground
from beam_warp.stage.stage import Stage
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.lights import PointLight
from beam_warp.world.metadata import raster_metadata

EPSILON = 2.0**-24
"""Largest relative rounding of a float32."""

RELIGHTABLE = converters.WriteOptions(profile="beam")

STILL = FixedCamera(Camera.look_at((0, -5, 1), (0, 0, 1), width=4, height=3, vertical_fov=40.0))


def cloud(positions=((0.0, 0.0, 0.0),), seed=3, **changes):
    """Relightable Gaussians at given places; everything else is random but fixed."""
    rng = np.random.default_rng(seed)
    count = len(positions)
    normals = rng.normal(size=(count, 3))
    arrays = {
        "positions": np.asarray(positions, np.float32).reshape(count, 3),
        "orientations": Rotation.random(count, rng=rng).as_quat() if count else np.zeros((0, 4)),
        "scales": 0.01 + 0.1 * rng.random((count, 3)),
        "opacities": 0.5 + 0.5 * rng.random(count),
        "normals": normals / np.linalg.norm(normals, axis=1, keepdims=True),
        "base_color": rng.random((count, 3)),
        "roughness": rng.random(count),
        "ambient_occlusion": rng.random(count),
        "ids": np.arange(count),
    }
    return GaussianCloud(**(arrays | changes))


def sequence(*clouds, fps=10.0, **options):
    return GaussianSequence.from_clouds(clouds, frames_per_second=fps, **options)


def moving(frames=3, fps=10.0, step=1.0, **changes):
    """One Gaussian that moves along x."""
    return sequence(*(cloud([(step * frame, 0.0, 0.0)], **changes) for frame in range(frames)), fps=fps)


def stage(*assets, camera=STILL, **options):
    return Stage(assets=assets, camera=camera, **options)


def asset(source=None, **options):
    return StageAsset(sequence=source or sequence(cloud()), **options)


def covariances(gaussians):
    turned = Rotation.from_quat(gaussians.orientations).as_matrix() * gaussians.scales.astype(np.float64)[:, None, :]
    return turned @ turned.transpose(0, 2, 1)


class TestPlacing:
    def test_two_assets_land_where_they_should_and_everything_turns_along(self, rng):
        places = rng.normal(size=(20, 3))
        first, second = cloud(places, seed=1), cloud(places, seed=2)
        angles, turn = (20.0, -30.0, 130.0), Rotation.from_euler("z", 130, degrees=True)
        turn = turn * Rotation.from_euler("y", -30, degrees=True) * Rotation.from_euler("x", 20, degrees=True)
        scene = stage(
            asset(sequence(first), translate=(1.0, 2.0, 3.0), rotate=90.0, scale=2.0),
            asset(sequence(second), translate=(-4.0, 0.0, 0.5), rotate=angles),
        )
        got = scene.shot(0.0, 8, 6).cloud
        assert len(got) == 40
        quarter = np.stack([-places[:, 1], places[:, 0], places[:, 2]], axis=1)
        bound = 8 * EPSILON * 10.0
        np.testing.assert_allclose(got.positions[:20], 2.0 * quarter + [1.0, 2.0, 3.0], atol=bound)
        np.testing.assert_allclose(got.positions[20:], turn.apply(places) + np.array((-4.0, 0.0, 0.5)), atol=bound)
        np.testing.assert_allclose(got.normals[20:], turn.apply(second.normals), atol=bound)
        np.testing.assert_allclose(got.scales[:20], 2.0 * first.scales, rtol=2 * EPSILON)
        exact = turn.as_matrix() @ covariances(second) @ turn.as_matrix().T
        np.testing.assert_allclose(covariances(got)[20:], exact, atol=0.02 * bound)
        for name in ("base_color", "roughness", "ambient_occlusion", "opacities"):
            whole = np.concatenate([getattr(first, name), getattr(second, name)])
            assert np.array_equal(getattr(got, name), whole)
        assert got.ids is None

    def test_other_axes_become_the_worlds_as_they_are(self):
        given = cloud([(1.0, 2.0, 3.0)], axes="rdf", normals=[(0.0, 0.0, 1.0)])
        got = stage(asset(sequence(given))).shot(0.0, 8, 6).cloud
        assert got.axes == WORLD_AXES
        np.testing.assert_array_equal(got.positions, [[1.0, 3.0, -2.0]])
        turned = stage(asset(sequence(given), rotate=90.0)).shot(0.0, 8, 6).cloud
        np.testing.assert_allclose(turned.positions, [[-3.0, 1.0, -2.0]], atol=1e-6)
        np.testing.assert_allclose(turned.normals, [[-1.0, 0.0, 0.0]], atol=1e-6)

    def test_on_the_ground_and_centred(self, rng):
        places = rng.normal((5.0, -3.0, 7.0), size=(50, 3))
        frames = sequence(*(cloud(places + np.array((0.0, 0.0, 0.1 * frame))) for frame in range(3)))
        placed = {"rotate": (90.0, 0.0, 0.0), "scale": 0.5, "translate": (1.0, 0.0, 2.0)}
        got = asset(frames, on_ground=True, centered=True, **placed)
        low, high = got.subject.min(axis=0), got.subject.max(axis=0)
        np.testing.assert_allclose([low[2], *(0.5 * (low + high))[:2]], [2.0, 1.0, 0.0], atol=1e-5)
        only = asset(frames, on_ground=True).placement.translation
        np.testing.assert_allclose(only, [0.0, 0.0, -places[:, 2].min()], atol=1e-5)

    def test_captured_radiance_is_left_out(self):
        bright = cloud(radiance=np.ones((1, 4, 3)), radiance_color_space=DISPLAY_SRGB)
        assert stage(asset(sequence(bright))).shot(0.0, 8, 6).cloud.radiance is None

    def test_arrays_that_not_all_have_are_left_out(self):
        first, second = cloud(roughness_error=[0.1], observability=[1]), cloud(observability=[4])
        got = stage(asset(sequence(first)), asset(sequence(second))).cloud_at(0.0)
        assert got.roughness_error is None
        assert got.observability.tolist() == [1, 4]

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"translate": (0.0, 1.0)}, r"translate must have shape \(3,\), got \(2,\)"),
            ({"translate": (0.0, np.nan, 1.0)}, "translate must be finite"),
            ({"rotate": (0.0, 1.0)}, r"rotate must be an angle about z, or three angles .* and z, got \(0.0, 1.0\)"),
            ({"rotate": np.nan}, "rotate must be a number in"),
            ({"start": np.inf}, "start must be a number in"),
        ],
    )
    def test_mistakes(self, options, message):
        with pytest.raises(BeamError, match=message):
            asset(**options)

    def test_what_is_not_relightable(self):
        message = "asset must be relightable, got one without roughness, normals in frame 0 of ghost. Estimate its"
        with pytest.raises(InvalidOptionError, match=message):
            asset(sequence(cloud(roughness=None, normals=None)), name="ghost")


class TestTime:
    def place(self, scene, time):
        return float(scene.shot(time, 8, 6).cloud.positions[0, 0])

    def test_start_speed_and_held_ends(self):
        scene = stage(asset(moving(4), start=1.0, speed=2.0))
        for time, x in ((0.0, 0.0), (1.0, 0.0), (1.05, 1.0), (1.075, 1.5), (1.15, 3.0), (9.0, 3.0)):
            assert self.place(scene, time) == pytest.approx(x, abs=1e-6)

    def test_loop(self):
        scene = stage(asset(moving(4), start=0.2, loop=True))
        for time, x in ((0.2, 0.0), (0.25, 0.5), (0.5, 3.0), (0.6, 0.0), (0.1, 3.0), (4.2, 0.0)):
            assert self.place(scene, time) == pytest.approx(x, abs=1e-5)

    def test_a_frame_is_its_own_bits(self):
        given = moving(3)
        scene = stage(asset(given))
        assert np.array_equal(scene.shot(0.2, 8, 6).cloud.orientations, given[2].orientations)
        assert np.shares_memory(scene.shot(0.2, 8, 6).cloud.positions, given[2].positions)

    def test_duration_rate_and_count(self):
        assert (stage(asset()).seconds, stage(asset()).frame_count) == (1.0 / 30.0, 1)
        two = stage(asset(), asset(moving(4, fps=24.0), start=1.0), asset(moving(6, fps=12.0), speed=0.25))
        assert (two.rate, two.seconds, two.frame_count) == (24.0, 2.0, 48)
        assert stage(asset(moving(6)), fps=25, duration=2.0).frame_count == 50
        assert stage(asset(), camera=OrbitPath(degrees_per_second=-36.0)).seconds == 10.0
        turning = stage(asset(), camera=OrbitPath(turns=2.0))
        assert (turning.seconds, turning.camera.degrees_per_second) == (5.0, 144.0)
        assert stage(asset(moving(4)), camera=OrbitPath(turns=2.0)).camera.degrees_per_second == 1800.0
        light = StageEnvironment(map=EnvironmentMap.constant((1, 1, 1)), degrees_per_second=-90.0)
        assert stage(asset(), environment=light).seconds == 4.0
        assert two.time_of(12) == 0.5

    @pytest.mark.parametrize(("options"), [{"fps": 0.0}, {"duration": 0.0}, {"duration": np.nan}])
    def test_no_rate_or_duration(self, options):
        with pytest.raises(InvalidOptionError, match=f"{next(iter(options))} must be a number in"):
            stage(asset(), **options)

    def test_what_stays_is_the_same_object(self):
        light = StageEnvironment(map=EnvironmentMap.constant((1, 1, 1)), rotate=-10.0, degrees_per_second=20.0)
        scene = stage(asset(), asset(), meshes=(Ground(),), environment=light, camera=OrbitPath(degrees_per_second=9.0))
        first, second = scene.shot(0.0, 8, 6), scene.shot(2.0, 8, 6)
        assert first.cloud is second.cloud
        assert first.mesh is second.mesh
        assert first.environment is second.environment is light.map
        assert (first.environment_rotation, second.environment_rotation) == (350.0, 30.0)
        assert not np.array_equal(first.camera.position, second.camera.position)
        walking = stage(asset(moving(3)), asset())
        assert walking.cloud_at(0.1) is not walking.cloud_at(0.15)
        assert walking.cloud_at(5.0) is walking.cloud_at(6.0)

    def test_each_frame_is_read_once_on_the_way(self):
        given, read = moving(4), []
        watched = replace(given, read_frame=lambda frame: (read.append(frame), given[frame])[1])
        scene = stage(asset(watched))
        for time in np.arange(0.0, 0.31, 0.025):
            scene.shot(float(time), 8, 6)
        assert read == [0, 1, 2, 3]

    def test_no_time(self):
        with pytest.raises(InvalidOptionError, match="time must be a number in"):
            stage(asset()).shot(np.nan, 8, 6)


class TestFramesThatDiffer:
    def test_different_counts_show_the_nearer_and_a_note(self):
        scene = stage(asset(sequence(cloud(np.zeros((4, 3))), cloud(np.zeros((6, 3)))), name="crowd"))
        assert scene.notes == ()
        assert [len(scene.shot(time, 8, 6).cloud) for time in (0.0, 0.04, 0.06, 0.1)] == [4, 4, 6, 6]
        (note,) = scene.notes
        assert note == "crowd: frames have different numbers of Gaussians: the nearer frame is shown between frames"

    def test_empty_frames(self):
        none = np.zeros((0, 3))
        scene = stage(asset(sequence(cloud(none), cloud(), cloud(none))), meshes=(Ground(height=0.0),))
        assert [len(scene.shot(time, 8, 6).cloud) for time in (0.0, 0.1, 0.2)] == [0, 1, 0]
        bare = GaussianCloud(positions=none, orientations=np.zeros((0, 4)), scales=none, opacities=np.zeros(0))
        assert len(stage(asset(sequence(bare)), asset()).cloud_at(0.0)) == 1
        assert len(stage(asset(sequence(bare)), asset(sequence(bare), on_ground=True)).shot(0.0, 8, 6).cloud) == 0

    def test_nothing_at_all(self):
        shot = stage().shot(0.0, 8, 6)
        assert len(shot.cloud) == 0
        assert shot.mesh is None
        with pytest.raises(InvalidOptionError, match="camera must have a center and a distance where there is nothing"):
            Stage().shot(0.0, 8, 6)


class TestCamera:
    def test_by_default_it_frames_the_assets_from_the_front(self, rng):
        places = rng.normal(size=(100, 3))
        camera = Stage(assets=(asset(sequence(cloud(places)), translate=(9.0, 0.0, 0.0)),)).shot(0.0, 64, 48).camera
        moved = places + np.array((9.0, 0.0, 0.0))
        expected = Camera.frame_cloud(moved, cloud(places).opacities, width=64, height=48, vertical_fov=35.0)
        np.testing.assert_allclose(camera.camera_to_world, expected.camera_to_world, atol=1e-5)

    def test_it_frames_all_assets_and_their_way(self):
        scene = Stage(assets=(asset(moving(5)), asset(translate=(0.0, 0.0, 3.0))))
        for time in (0.0, 0.2, 0.4):
            shot = scene.shot(time, 64, 48)
            pixels = shot.camera.project(shot.cloud.positions)[:, :2]
            assert (pixels > 0.0).all()
            assert (pixels < [64.0, 48.0]).all()

    def test_meshes_alone_are_framed(self, tmp_path):
        write_mesh(trimesh.creation.box((1, 1, 1)), tmp_path / "box.ply")
        scene = read(tmp_path, {"meshes": ["box.ply"]})
        middle = scene.shot(0.0, 8, 8).camera.project([[0.0, 0.0, 0.0]])[0, :2]
        np.testing.assert_allclose(middle, [4.0, 4.0], atol=1e-6)


def read(folder, content, name="stage.json", version=True):
    path = folder / name
    content = {"beam-stage": 1} | content if version else content
    path.write_text(json.dumps(content), encoding="utf-8")
    return Stage.read(path)


class TestMeshes:
    def test_the_ground_lies_under_the_assets(self):
        places = [(2.0, 1.0, 0.5), (4.0, 3.0, 2.5)]
        scene = stage(asset(sequence(cloud(places))), meshes=(Ground(size=4.0, base_color=(0.1, 0.2, 0.3)),))
        surface = scene.mesh.surface
        np.testing.assert_allclose(surface.vertices.min(axis=0), [1.0, 0.0, 0.5], atol=1e-6)
        np.testing.assert_allclose(surface.vertices.max(axis=0), [5.0, 4.0, 0.5], atol=1e-6)
        assert np.array_equal(surface.normals, np.tile(np.float32([0, 0, 1]), (4, 1)))
        corners = surface.vertices[surface.faces]
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        np.testing.assert_allclose(facing, [[0.0, 0.0, 16.0]] * 2, atol=1e-5)
        assert not scene.mesh.catches_shadows.any()
        stated = stage(meshes=(Ground(size=2.0, height=-1.0, center=(5.0, 5.0), catches_shadows=True),)).mesh
        np.testing.assert_array_equal(stated.surface.vertices.min(axis=0), [4.0, 4.0, -1.0])
        assert stated.catches_shadows.all()

    def test_a_file_is_placed_and_joined_with_the_rest(self, tmp_path):
        write_mesh(trimesh.creation.icosphere(1, 1.0), tmp_path / "ball.ply")
        placed = {"path": "ball.ply", "translate": [0, 0, 5], "rotate": [0, 90, 0], "scale": 2, "roughness": 0.25}
        meshes = [{"ground": True, "height": 1}, placed | {"base_color": [0.2, 0.4, 0.6]}, "ball.ply"]
        scene = read(tmp_path, {"meshes": meshes})
        surface = scene.mesh.surface
        assert surface.faces.max() == len(surface.vertices) - 1
        assert len(surface.faces) == 2 + 80 + 80
        ball = surface.vertices[4:46]
        np.testing.assert_allclose(np.linalg.norm(ball - [0, 0, 5], axis=1), 2.0, rtol=1e-6)
        np.testing.assert_allclose(surface.normals[4:46], (ball - [0, 0, 5]) / 2.0, atol=0.02)
        np.testing.assert_array_equal(surface.base_color[4], np.float32([0.2, 0.4, 0.6]))
        np.testing.assert_array_equal(surface.roughness[[0, 4, 46]], np.float32([0.6, 0.25, 0.6]))
        assert scene.notes == ("ball.ply: has no colours; its base colour is taken as 0.5",)

    def test_colours_of_vertices(self, tmp_path):
        mesh = trimesh.creation.box((1, 1, 1))
        mesh.visual.vertex_colors = np.tile(np.uint8([200, 100, 0, 255]), (8, 1))
        write_mesh(mesh, tmp_path / "a.ply")
        write_mesh(mesh, tmp_path / "a.glb")
        scene = read(tmp_path, {"meshes": ["a.ply"]})
        display = np.array([200, 100, 0]) / 255.0
        np.testing.assert_allclose(scene.mesh.surface.base_color[0], srgb_to_linear(display), rtol=1e-6)
        assert scene.notes == ("a.ply: colours of vertices are taken as sRGB",)
        linear = read(tmp_path, {"meshes": ["a.glb"]})
        np.testing.assert_allclose(linear.mesh.surface.base_color[0], display, rtol=1e-6)
        assert linear.notes == ()

    def test_flat_triangles_have_normals_of_their_own(self, tmp_path):
        box = trimesh.creation.box((1, 1, 1))
        (tmp_path / "box.obj").write_text(trimesh.exchange.obj.export_obj(box, include_normals=False))
        smooth = read(tmp_path, {"meshes": ["box.obj"]}).mesh.surface
        flat = read(tmp_path, {"meshes": [{"path": "box.obj", "smooth": False}]}).mesh.surface
        assert (len(smooth.vertices), len(flat.vertices)) == (8, 36)
        np.testing.assert_allclose(np.abs(smooth.normals), 3.0**-0.5, atol=1e-6)
        np.testing.assert_allclose(np.sort(np.abs(flat.normals), axis=1), [[0.0, 0.0, 1.0]] * 36, atol=1e-6)
        corners = flat.vertices[flat.faces].mean(axis=1)
        assert (np.einsum("ij,ij->i", corners, flat.normals[::3]) > 0.3).all()

    def test_triangles_without_an_area_are_left_out(self, tmp_path):
        (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5\nf 1 2 3\nf 1 1 4\n")
        mesh = read(tmp_path, {"meshes": ["a.obj"]}).mesh
        assert (len(mesh.surface.vertices), len(mesh.surface.faces)) == (3, 1)
        (tmp_path / "b.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
        with pytest.raises(AssetFormatError, match=r"stage.json: meshes\[0\]: mesh must hold a triangle with an area"):
            read(tmp_path, {"meshes": ["b.obj"]})


class TestDrawing:
    def test_it_says_how_its_gaussians_are_drawn(self):
        plain, other = (sequence(cloud(), metadata=raster_metadata(*how)) for how in ((True, 0.1), (False, 0.3)))
        assert stage(asset()).raster_metadata == {}
        assert stage(asset(), asset(plain)).raster_metadata == raster_metadata(True, 0.1)
        both = stage(asset(plain, name="one"), asset(other, name="two"))
        assert both.raster_metadata == raster_metadata(True, 0.1)
        assert both.notes == ("assets were fitted to be drawn in different ways: all are drawn as one",)

    def test_notes_of_its_readers(self):
        noted = sequence(cloud(), metadata={"notes": "axes are guessed\nunits too"})
        assert stage(asset(noted, name="a.ply")).notes == ("a.ply: axes are guessed", "a.ply: units too")


@pytest.fixture
def folder(tmp_path):
    """Two assets, a light map, a mesh and camera key frames."""
    converters.write(sequence(cloud([(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)])), tmp_path / "still.ply", RELIGHTABLE)
    (tmp_path / "walk").mkdir()
    converters.write(moving(3, ids=None), tmp_path / "walk" / "walk.ply", RELIGHTABLE)
    write_exr(tmp_path / "sky.exr", {name: np.full((4, 8), 0.5, np.float32) for name in "RGB"})
    write_mesh(trimesh.creation.box((1, 1, 1)), tmp_path / "box.ply")
    keys = [{"time": t, "position": [0, -4 - t, 1], "target": [0, 0, 1]} for t in (0, 1)]
    (tmp_path / "keys.json").write_text(json.dumps({"keyframes": keys}))
    lights = [{"type": "directional", "direction": [0, 0, -1], "irradiance": [1, 1, 1]}]
    (tmp_path / "lights.json").write_text(json.dumps(lights))
    return tmp_path


FULL = {
    "beam-stage": 1,
    "fps": 20,
    "duration": 1.5,
    "assets": [
        {"path": "still.ply", "name": "statue", "translate": [1, 2, 3], "rotate": [10, 20, 30], "scale": 0.5},
        {"path": "walk", "start": 0.25, "speed": 2, "loop": True, "blend": "rows", "on_ground": True, "centered": True},
    ],
    "meshes": [{"ground": True, "size": 8, "height": "auto", "catches_shadows": True}, {"path": "box.ply"}],
    "lights": [{"type": "point", "position": [1, -2, 2], "intensity": [4, 4, 4], "radius": 0.1}],
    "environment": {"path": "sky.exr", "rotate": 30, "degrees_per_second": 10, "exposure": 1},
    "camera": {"type": "orbit", "turns": 1, "elevation": 10, "fov": 30},
}


class TestFile:
    def test_everything_is_as_it_says(self, folder):
        scene = read(folder, FULL)
        assert (scene.rate, scene.seconds, scene.frame_count) == (20.0, 1.5, 30)
        statue, walk = scene.assets
        assert (statue.name, statue.translate, statue.rotate, statue.scale) == ("statue", (1, 2, 3), (10, 20, 30), 0.5)
        assert (walk.name, walk.start, walk.speed, walk.loop, walk.blend) == ("walk", 0.25, 2.0, True, "rows")
        assert (walk.on_ground, walk.centered) == (True, True)
        assert scene.lights == (PointLight(position=(1, -2, 2), intensity=(4, 4, 4), radius=0.1),)
        shot = scene.shot(0.75, 16, 12)
        np.testing.assert_array_equal(shot.environment.radiance, np.ones((4, 8, 3), np.float32))
        assert shot.environment_rotation == 37.5
        assert shot.mesh.catches_shadows.tolist() == [True, True, *([False] * 12)]
        assert scene.camera.degrees_per_second == 240.0
        assert len(shot.cloud) == 3

    def test_a_stage_made_without_a_file_is_the_same(self, folder):
        content = {"assets": ["still.ply", "walk"], "environment": "sky.exr", "camera": "keys.json"}
        scene = read(folder, content)
        light = StageEnvironment(map=EnvironmentMap.read(folder / "sky.exr"))
        made = Stage.of([folder / "still.ply", folder / "walk"], environment=light, camera=scene.camera)
        assert made.digest() == scene.digest()
        assert made.digest(0.1) == scene.digest(0.1)
        assert isinstance(scene.camera, KeyframePath)

    def test_a_row_of_assets(self, folder):
        scene = Stage.of([folder / "still.ply"] * 3, spacing=2.0, on_ground=True)
        got = scene.shot(0.0, 8, 6).cloud.positions
        np.testing.assert_allclose(got[:, 0], [-2, -2, 0, 0, 2, 2], atol=1e-6)
        np.testing.assert_allclose(got[:, 2], [0, 1, 0, 1, 0, 1], atol=1e-6)

    def test_texts_stand_for_paths(self, folder):
        scene = read(folder, {"assets": ["still.ply"], "lights": "lights.json", "camera": "keys.json"})
        assert len(scene.lights) == 1
        assert scene.seconds == 1.0
        np.testing.assert_allclose(scene.shot(1.0, 8, 6).camera.position, [0.0, -5.0, 1.0])

    def test_light_from_all_around_without_a_file(self, folder):
        shot = read(folder, {"assets": ["still.ply"], "environment": {"radiance": [1, 2, 3]}}).shot(0, 8, 6)
        np.testing.assert_array_equal(shot.environment.radiance[0, 0], [1, 2, 3])

    def test_fixed_cameras(self, folder):
        expected = Camera.look_at((0, -3, 1), (0, 0, 1), width=64, height=48, vertical_fov=50.0)
        by_place = {"type": "fixed", "position": [0, -3, 1], "target": [0, 0, 1], "fov": 50}
        by_pose = {"type": "fixed", "camera_to_world": expected.camera_to_world.tolist(), "fov": 50}
        for record in (by_place, by_pose):
            got = read(folder, {"camera": record}).shot(3.0, 64, 48).camera
            np.testing.assert_allclose(got.camera_to_world, expected.camera_to_world, atol=1e-15)
            assert got.focal_y == pytest.approx(expected.focal_y, rel=1e-14)


class TestDigest:
    def test_it_is_the_same_in_another_place(self, folder, tmp_path_factory):
        other = tmp_path_factory.mktemp("copy") / "stage"
        shutil.copytree(folder, other)
        first, second = read(folder, FULL), read(other, FULL)
        assert first.digest() == second.digest()
        assert first.digest(0.2) == second.digest(0.2)
        assert first.digest(0.2) != first.digest(0.25)

    @pytest.mark.parametrize(
        "change",
        [
            {"assets": FULL["assets"][:1]},
            {"assets": FULL["assets"][::-1]},
            {"assets": [{**FULL["assets"][0], "translate": [1, 2, 4]}, FULL["assets"][1]]},
            {"assets": [FULL["assets"][0], {**FULL["assets"][1], "start": 0}]},
            {"meshes": []},
            {"meshes": [{**FULL["meshes"][0], "catches_shadows": False}, FULL["meshes"][1]]},
            {"lights": []},
            {"environment": {**FULL["environment"], "exposure": 2}},
            {"environment": {**FULL["environment"], "rotate": 31}},
            {"camera": {**FULL["camera"], "fov": 31}},
        ],
    )
    def test_any_change_shows(self, folder, change):
        assert read(folder, FULL | change).digest(0.2) != read(folder, FULL).digest(0.2)

    def test_a_changed_file_shows_where_it_matters(self, folder):
        content = FULL | {"assets": [{"path": "walk"}], "meshes": []}
        camera = {"camera": {"type": "orbit", "center": [0, 0, 0], "distance": 3}}
        scene = read(folder, content | camera)
        before = {time: scene.digest(time) for time in (None, 0.0, 0.05, 0.1, 0.2)}
        path = sorted((folder / "walk").iterdir())[0]
        status, data = path.stat(), bytearray(path.read_bytes())
        data[-1] ^= 1
        path.write_bytes(data)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))  # size and time say nothing
        after = {time: scene.digest(time) for time in before}
        assert [after[time] != before[time] for time in before] == [True, True, True, False, False]

    def test_clouds_in_memory(self):
        def scene(place):
            return stage(asset(sequence(cloud(), cloud([(place, 0.0, 0.0)]))))

        assert scene(1.0).digest() == scene(1.0).digest()
        assert scene(1.0).digest() != scene(2.0).digest()
        assert scene(1.0).digest(0.0) == scene(2.0).digest(0.0)
        assert scene(1.0).digest(0.05) != scene(2.0).digest(0.05)

    def test_layers_of_a_usd_asset_count(self, tmp_path):
        converters.write(moving(2, axes="rub"), tmp_path / "a.usda")
        scene = Stage.of([tmp_path / "a.usda"], camera=STILL)
        before = scene.digest(), scene.digest(0.1)
        layer = tmp_path / "a.frames.usdc"
        data = bytearray(layer.read_bytes())
        data[-1] ^= 1
        layer.write_bytes(data)
        assert scene.digest() != before[0]
        assert scene.digest(0.1) != before[1]
        layer.write_bytes(bytes(data[:-1]) + bytes([data[-1] ^ 1]))
        assert (scene.digest(), scene.digest(0.1)) == before
        root = tmp_path / "a.usda"
        root.write_text(root.read_text() + "# seen\n")
        assert scene.digest(0.1) != before[1]

    def test_a_file_that_is_gone(self, folder):
        scene = read(folder, FULL)
        (folder / "still.ply").unlink()
        with pytest.raises(MissingFileError, match=r"input must be readable, got .*still\.ply"):
            scene.digest(0.0)


KEYS_OF_NO_PLACE = {"type": "keyframes", "keyframes": [{"time": 0, "position": [0, 0], "target": [0, 1, 0]}]}
LOOKS_NOWHERE = {"type": "fixed", "position": [0, 0, 0], "target": [0, 0, 0]}


def changed(place, value):
    """The full stage with one field changed; ``...`` removes it."""
    content = copy.deepcopy(FULL)
    target = content
    for step in place[:-1]:
        target = target[step]
    if value is ...:
        del target[place[-1]]
    else:
        target[place[-1]] = value
    return content


class TestMistakes:
    @pytest.mark.parametrize(
        ("place", "value", "message"),
        [
            (("beam-stage",), ..., "beam-stage must be 1, got nothing. State the version"),
            (("beam-stage",), True, "beam-stage must be 1, got true."),
            (("asets",), [], "must have no field but beam-stage, fps, duration, assets,"),
            (("fps",), "30", "fps must be a finite number, got '30'. Write one."),
            (("fps",), -3, "fps must be a number in [0.001, 1e+06], got -3.0."),
            (("duration",), 0, "duration must be a number in [1e-06, 1e+09], got 0.0."),
            (("assets",), {}, "assets must be a list, got {}. Put it in [ ]."),
            (("assets", 1), 5, "assets[1] must be an object, got 5. Write it in { }."),
            (("assets", 1, "path"), 3, "assets[1].path must be a text, got 3. Write it in quotes."),
            (("assets", 1, "translat"), 3, "assets[1] must have no field but path, name,"),
            (("assets", 1, "translate"), [1, 2, "3"], "assets[1].translate must be 3 finite numbers, got [1,"),
            (("assets", 1, "rotate"), [1, 2], "assets[1].rotate must be 3 finite numbers, got [1, 2]."),
            (("assets", 1, "rotate"), "90", "assets[1].rotate must be a finite number, got '90'."),
            (("assets", 1, "scale"), -1, "assets[1].scale must be a number in [1e-06, 1e+06], got -1.0."),
            (("assets", 1, "speed"), 0, "assets[1].speed must be a number in [0.001, 1000], got 0.0."),
            (("assets", 1, "loop"), "yes", "assets[1].loop must be true or false, got 'yes'."),
            (("assets", 1, "blend"), "x", "assets[1].blend must be one of identified, rows, nearest, got 'x'."),
            (("assets", 0, "source_axes"), "xyz", "assets[0].source_axes must be three letters, one each of"),
            (("assets", 0, "path"), "box.ply", "assets[0]: "),
            (("assets", 0, "path"), "sky.exr", "assets[0]: file name must end in one of .ply, .usd,"),
            (("meshes", 1, "path"), "sky.exr", "meshes[1]: mesh must be readable, got"),
            (("meshes", 1, "base_color"), [1, 2, 3], "meshes[1].base_color must lie in [0, 1], got 2"),
            (("meshes", 1, "roughness"), 2, "meshes[1].roughness must be a number in [0, 1], got 2.0."),
            (("meshes", 1, "scale"), 0, "meshes[1].scale must be a number in [1e-06, 1e+06], got 0.0."),
            (("meshes", 1, "smooth"), 1, "meshes[1].smooth must be true or false, got 1."),
            (("meshes", 0, "ground"), False, "meshes[0].ground must be true, got false."),
            (("meshes", 0, "height"), "low", "meshes[0].height must be a finite number, got 'low'."),
            (("meshes", 0, "size"), 0, "meshes[0].size must be a number in [0.001, 1e+06], got 0.0."),
            (("meshes", 0, "center"), [1], "meshes[0].center must be 2 finite numbers, got [1]."),
            (("meshes", 0, "path"), "a.ply", "meshes[0] must have no field but ground, size, height, center,"),
            (("lights", 0, "type"), "lamp", "lights[0].type must be one of directional, point, spot,"),
            (("lights", 0, "radius"), -1, "lights[0]: radius must be a number in"),
            (("lights",), 3, "lights must be a list of lights, got int."),
            (("lights",), "keys.json", "lights: keys.json: lights must be a list of lights, got dict."),
            (("environment", "path"), ..., "environment must have a path or a radiance, got neither."),
            (("environment", "radiance"), [1, 1, 1], "environment must have a path or a radiance, got both."),
            (("environment", "path"), "box.ply", "environment: environment must be an .exr or .hdr file"),
            (("environment", "rotate"), None, ""),
            (("environment", "exposure"), 99, "environment.exposure must be a number in [-64, 64], got 99.0."),
            (("camera", "type"), ..., "camera.type must be one of fixed, orbit, keyframes, file, got null."),
            (("camera",), 3, "camera must be an object, got 3."),
            (("camera", "fov"), 0, "camera.fov must be a number in [0.01, 179], got 0.0."),
            (("camera", "subject"), [], "camera must have no field but type, center, distance, azimuth,"),
            (("camera", "degrees_per_second"), 3, "camera.turns must be left out beside degrees_per_second"),
            (("camera",), {"type": "keyframes"}, "camera.keyframes must be a list of 1 to 1000000 key frames,"),
            (("camera",), KEYS_OF_NO_PLACE, "camera.keyframes[0].position must be 3 finite numbers, got [0, 0]."),
            (("camera",), LOOKS_NOWHERE, "camera.target must differ from eye, got [0.0, 0.0, 0.0] for both."),
            (("camera",), "lights.json", "camera: lights.json: keyframes[0] must have no field but time,"),
            (("camera",), {"type": "file", "path": "keys.json", "prim": "/C"}, "camera.prim must be left out"),
        ],
    )
    def test_one_clear_error(self, folder, place, value, message):
        if not message:  # null is as if it were not there
            assert read(folder, changed(place, value)).environment.rotate == 0.0
            return
        with pytest.raises(AssetFormatError) as caught:
            read(folder, changed(place, value), version=False)
        assert str(caught.value).startswith(f"stage.json: {message}")
        assert str(caught.value).endswith(".")

    @pytest.mark.parametrize(
        ("place", "what"),
        [
            (("assets", 0, "path"), "assets[0].path must be an existing file or folder"),
            (("meshes", 1, "path"), "meshes[1].path must be an existing file"),
            (("environment", "path"), "environment.path must be an existing file"),
            (("lights",), "lights must be an existing file"),
            (("camera",), "camera.path must be an existing file"),
        ],
    )
    def test_missing_files(self, folder, place, what):
        with pytest.raises(MissingFileError) as caught:
            read(folder, changed(place, "none.json"))
        assert str(caught.value) == (
            f"stage.json: {what}, got 'none.json' (looked for {folder / 'none.json'}). Correct the name; relative "
            "ones start where this file is."
        )

    def test_a_later_version(self, folder):
        with pytest.raises(SchemaVersionError, match=r"stage.json: beam-stage must be 1, got 2\. Upgrade"):
            read(folder, changed(("beam-stage",), 2), version=False)

    def test_no_file_and_no_json(self, tmp_path):
        with pytest.raises(MissingFileError, match="stage must be a readable file, got"):
            Stage.read(tmp_path / "none.json")
        for content, message in (
            (b"{", "stage must be JSON in UTF-8, got Expecting"),
            (b"\xff\xfe", "stage must be JSON in UTF-8, got"),
            (b"[1]", r"a.json: must be an object, got \[1\]"),
        ):
            (tmp_path / "a.json").write_bytes(content)
            with pytest.raises(AssetFormatError, match=message):
                Stage.read(tmp_path / "a.json")
