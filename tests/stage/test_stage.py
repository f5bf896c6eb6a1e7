"""Stages: where points land, what is seen when, and how it is drawn."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.small_stages import asset, cloud, moving, read, sequence, stage

from beam_warp.errors import AssetFormatError, BeamError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB, srgb_to_linear
from beam_warp.mesh.files import write_mesh
from beam_warp.stage.camera_paths import OrbitPath
from beam_warp.stage.environments import StageEnvironment
from beam_warp.stage.meshes import Ground
from beam_warp.stage.stage import Stage
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud
from beam_warp.world.metadata import raster_metadata

EPSILON = 2.0**-24
"""Largest relative rounding of a float32."""


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
