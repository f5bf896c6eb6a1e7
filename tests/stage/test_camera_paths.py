"""Cameras over time: closed forms of circles and splines, framing, files of ours and nerfstudio's, mistakes."""

import json
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beam_warp.errors import AssetFormatError, InvalidArrayError, InvalidOptionError, MissingFileError
from beam_warp.stage.camera_paths import (
    FixedCamera,
    Keyframe,
    KeyframePath,
    OrbitPath,
    catmull_rom,
    outline,
    read_camera_path,
)
from beam_warp.world.camera import Camera

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
STRETCHED = np.diag([2.0, 1.0, 1.0, 1.0])


def pose(position=(0.0, 0.0, 0.0), turn=None):
    matrix = np.eye(4)
    matrix[:3, 3] = position
    if turn is not None:
        matrix[:3, :3] = turn.as_matrix()
    return matrix


def key(time, position=(0.0, 0.0, 0.0), turn=None, **more):
    return Keyframe(time=time, camera_to_world=pose(position, turn), **more)


def angle(first, second):
    return Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).magnitude()


def image_extent(camera, points):
    """How far points reach to the edges: 1 is at the edge, in x and y."""
    pixels = camera.project(points)[:, :2]
    half = np.array([camera.width, camera.height]) / 2.0
    return np.abs(pixels / half - 1.0).max(axis=0)


class TestFixed:
    def test_keeps_its_view_at_another_size(self):
        camera = Camera(64, 48, 50.0, 52.0, 30.0, 25.0, pose((1.0, 2.0, 3.0)))
        path = FixedCamera(camera)
        assert path.camera_at(3.0, 64, 48) is camera
        double = path.camera_at(-1.0, 128, 96)
        points = np.random.default_rng(0).normal((1.0, 2.0, 8.0), size=(20, 3))
        np.testing.assert_allclose(double.project(points)[:, :2], 2.0 * camera.project(points)[:, :2], rtol=1e-12)
        wide = path.camera_at(0.0, 100, 48)
        np.testing.assert_allclose(wide.project(points)[:, 0] - 50.0, camera.project(points)[:, 0] - 32.0, atol=1e-9)
        assert path.duration is None


class TestOrbit:
    def test_positions_are_on_a_circle_at_constant_speed(self):
        path = OrbitPath(center=(1.0, 2.0, 3.0), distance=2.0, elevation=30.0, azimuth=15.0, degrees_per_second=90.0)
        for time in (0.0, 0.25, 1.0, 7.3):
            camera = path.camera_at(time, 40, 30)
            around = np.radians(15.0 + 90.0 * time)
            flat, high = 2.0 * np.cos(np.radians(30.0)), 2.0 * np.sin(np.radians(30.0))
            place = np.array([1.0 + flat * np.sin(around), 2.0 - flat * np.cos(around), 3.0 + high])
            np.testing.assert_allclose(camera.position, place, atol=1e-12)
            np.testing.assert_allclose(camera.project([[1.0, 2.0, 3.0]])[0], [20.0, 15.0, 2.0], atol=1e-9)
        assert path.duration == 4.0

    def test_turns_in_a_duration(self):
        path = OrbitPath(center=(0.0, 0.0, 0.0), distance=1.0, turns=-2.0).lasting(8.0)
        assert path.degrees_per_second == -90.0
        np.testing.assert_allclose(path.camera_at(1.0, 8, 8).position, [-1.0, 0.0, 0.0], atol=1e-15)

    @pytest.mark.parametrize(
        ("elevation", "width", "height"),
        [(-89.0, 160, 90), (-30.0, 90, 160), (0.0, 160, 90), (20.0, 90, 160), (60.0, 160, 90), (90.0, 90, 160)],
    )
    def test_a_turn_frames_the_subject_all_the_way_round_and_tightly(self, rng, elevation, width, height):
        subject = rng.normal((3.0, -2.0, 1.0), (1.0, 0.4, 0.7), size=(200, 3))
        lens = {"elevation": elevation, "margin": 1.25}
        path = OrbitPath(subject=subject, degrees_per_second=1.0, **lens)
        center = 0.5 * (subject.min(axis=0) + subject.max(axis=0))
        away, needed, reached = [], [], []
        for azimuth in range(0, 360, 2):
            camera = path.camera_at(float(azimuth), width, height)
            tight = Camera.frame_points(path.subject, azimuth=azimuth, width=width, height=height, **lens)
            away.append(np.linalg.norm(camera.position - center))
            needed.append(np.linalg.norm(tight.position - center))
            reached.append(image_extent(camera, subject).max())
        assert max(reached) <= 1.0 / 1.25 + 1e-9
        assert max(away) - min(away) < 1e-9
        # What a point at radius r needs is r k cos(azimuth - its worst) and a constant, k at most the hypotenuse of 1
        # and focal length over half the narrower side; the worst azimuth is at most a degree from one that was tried.
        steepness = np.hypot(1.0, 1.25 * camera.focal_y / (0.5 * min(width, height)))
        slack = np.hypot(*(subject - center)[:, :2].T).max() * steepness * (1.0 - np.cos(np.radians(1.0)))
        assert max(needed) - 1e-9 <= away[0] <= max(needed) + slack

    def test_without_a_turn_it_is_the_camera_that_frames_from_there(self, rng):
        subject = rng.normal(size=(50, 3))
        ours = OrbitPath(subject=subject, azimuth=40.0, elevation=10.0).camera_at(2.0, 64, 48)
        other = Camera.frame_points(subject, azimuth=40.0, elevation=10.0, width=64, height=48)
        np.testing.assert_allclose(ours.camera_to_world, other.camera_to_world, atol=1e-12)

    def test_a_point_and_a_line_can_be_framed(self):
        point = OrbitPath(subject=np.zeros((1, 3)), degrees_per_second=1.0)
        assert np.linalg.norm(point.camera_at(0, 9, 9).position) == 1
        upright = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        camera = OrbitPath(subject=upright, degrees_per_second=1.0, margin=1.0).camera_at(5.0, 64, 64)
        assert image_extent(camera, upright)[1] == pytest.approx(1.0, abs=1e-12)

    def test_the_outline_has_the_same_bounds(self, rng):
        points = rng.normal(size=(500, 3))
        corners = outline(points)
        assert len(corners) < 120
        assert np.array_equal(corners.min(axis=0), points.min(axis=0))
        assert np.array_equal(corners.max(axis=0), points.max(axis=0))

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"elevation": 91.0}, "elevation must be a number in"),
            ({"fov": 0.0}, r"fov must be a number in \[0.01, 179\], got 0.0"),
            ({"fov": np.nan}, "fov must be a number in"),
            ({"distance": 0.0}, "distance must be a number in"),
            ({"degrees_per_second": np.inf}, "degrees_per_second must be a number in"),
            ({"turns": 1.0, "degrees_per_second": 3.0}, "turns must be left out beside degrees_per_second"),
        ],
    )
    def test_mistakes(self, options, message):
        with pytest.raises(InvalidOptionError, match=message):
            OrbitPath(**options)

    def test_nothing_to_frame(self):
        with pytest.raises(InvalidOptionError, match="camera must have a center and a distance where there is nothing"):
            OrbitPath().camera_at(0.0, 8, 8)
        with pytest.raises(InvalidArrayError, match="center must be finite"):
            OrbitPath(center=(0.0, np.nan, 0.0))


class TestKeyframes:
    def test_at_a_key_frame_it_is_there(self):
        frames = [key(0.0), key(1.0, (1.0, 0.0, 0.0), Rotation.from_euler("z", 20, degrees=True)), key(4.0, (0, 9, 0))]
        path = KeyframePath(tuple(frames))
        for frame in frames:
            assert np.array_equal(path.camera_at(frame.time, 8, 8).camera_to_world, frame.camera_to_world)
        assert np.array_equal(path.camera_at(-5.0, 8, 8).camera_to_world, frames[0].camera_to_world)
        assert np.array_equal(path.camera_at(50.0, 8, 8).camera_to_world, frames[2].camera_to_world)
        assert path.duration == 4.0

    def test_a_quarter_turn_goes_at_constant_speed(self):
        end = key(2.0, turn=Rotation.from_euler("x", 90, degrees=True), fov=55.0)
        path = KeyframePath((key(0.0, fov=35.0), end))
        for time in (0.5, 1.0, 1.9):
            camera = path.camera_at(time, 10, 10)
            assert angle(np.eye(4), camera.camera_to_world) == pytest.approx(np.radians(45.0 * time), abs=1e-12)
            fov = 2.0 * np.degrees(np.arctan(5.0 / camera.focal_y))
            assert fov == pytest.approx(35.0 + 10.0 * time, abs=1e-9)

    def test_lines(self):
        path = KeyframePath((key(1.0, (0, 0, 0)), key(3.0, (4, 2, 0)), key(4.0, (0, 0, 8))), "linear")
        np.testing.assert_allclose(path.camera_at(2.5, 8, 8).position, [3.0, 1.5, 0.0], atol=1e-15)
        np.testing.assert_allclose(path.camera_at(3.25, 8, 8).position, [3.0, 1.5, 2.0], atol=1e-15)

    def test_a_spline_through_points_of_a_line_stays_on_it_and_does_not_turn_back(self):
        points = [np.array([x, 0.0, 0.0]) for x in (0.0, 1.0, 1.1, 9.0)]
        places = [catmull_rom(*points, share)[0] for share in np.linspace(0.0, 1.0, 101)]
        assert places[0] == 1.0
        assert places[-1] == pytest.approx(1.1, abs=1e-15)
        assert (np.diff(places) > 0.0).all()

    def test_a_spline_through_evenly_spaced_points_is_the_uniform_one(self):
        angles = np.radians([0.0, 60.0, 120.0, 180.0])
        points = list(np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1))
        a, b, c, d = points
        for u in (0.2, 0.5, 0.9):
            uniform = 0.5 * (2 * b + (c - a) * u + (2 * a - 5 * b + 4 * c - d) * u**2 + (3 * b - a - 3 * c + d) * u**3)
            np.testing.assert_allclose(catmull_rom(*points, u), uniform, atol=1e-14)

    def test_a_spline_of_two_points_is_a_line_and_of_equal_ones_a_place(self):
        a, b = np.array([0.0, 1.0, 2.0]), np.array([3.0, 1.0, -4.0])
        np.testing.assert_allclose(catmull_rom(None, a, b, None, 0.3), a + 0.3 * (b - a), atol=1e-14)
        np.testing.assert_allclose(catmull_rom(a, a, b, b, 0.3), a + 0.3 * (b - a), atol=1e-14)
        assert np.array_equal(catmull_rom(b, a, a, b, 0.3), a)

    def test_it_is_continuous(self):
        path = KeyframePath((key(0), key(1, (3, 0, 0)), key(1.5, (3, 1, 0)), key(4, (9, 9, 9))))
        for time in (1.0, 1.5):
            before, after = (path.camera_at(time + e, 8, 8).position for e in (-1e-7, 1e-7))
            assert np.linalg.norm(before - after) < 1e-5
            here = path.camera_at(time, 8, 8).position
            steps = [path.camera_at(time + e, 8, 8).position - here for e in (-1e-6, 1e-6)]
            backward, forward = (step / np.linalg.norm(step) for step in steps)
            assert -backward @ forward > 1.0 - 1e-4  # no corner

    def test_a_target_stays_in_the_middle_and_the_camera_level(self):
        places = [((0, -3, 1), 0.0), ((3, 0, 2), 1.0), ((0, 3, 0), 2.0)]
        path = KeyframePath(tuple(Keyframe.looking_at(time, place, (0.0, 0.0, 1.0)) for place, time in places))
        for time in np.linspace(0.0, 2.0, 21):
            camera = path.camera_at(time, 80, 60)
            np.testing.assert_allclose(camera.project([[0.0, 0.0, 1.0]])[0, :2], [40.0, 30.0], atol=1e-9)
            assert abs(camera.camera_to_world[2, 0]) < 1e-12

    def test_a_gaze_over_the_top_is_turned_instead(self):
        start, end = (Keyframe.looking_at(t, (0.0, y, 3.0), (0.0, 0.0, 0.0)) for t, y in ((0.0, -3.0), (1.0, 3.0)))
        path = KeyframePath((start, end))
        turns = [path.camera_at(time, 8, 8).camera_to_world for time in np.linspace(0.0, 1.0, 101)]
        whole = angle(start.camera_to_world, end.camera_to_world)
        steps = [angle(a, b) for a, b in pairwise(turns)]
        np.testing.assert_allclose(steps, whole / 100.0, atol=1e-7)

    @pytest.mark.parametrize(
        ("make", "error", "message"),
        [
            (lambda: KeyframePath(()), InvalidOptionError, "keyframes must be 1 to 1000000, got 0"),
            (lambda: KeyframePath((key(1.0), key(1.0))), InvalidOptionError, r"keyframes\[1\].time must be after the"),
            (lambda: KeyframePath((key(0.0),), "cubic"), InvalidOptionError, "interpolation must be .* smooth, linear"),
            (lambda: key(np.nan), InvalidOptionError, "time must be a number in"),
            (lambda: key(0.0, fov=180.0), InvalidOptionError, r"fov must be a number in \[0.01, 179\], got 180.0"),
            (lambda: key(0.0, (0.0, np.nan, 0.0)), InvalidArrayError, "camera_to_world must be finite"),
            (lambda: Keyframe(time=0.0, camera_to_world=STRETCHED), InvalidArrayError, "world must hold a rotation"),
        ],
    )
    def test_mistakes(self, make, error, message):
        with pytest.raises(error, match=message):
            make()


def written(folder, content, name="path.json"):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


EYE = {"time": 0, "camera_to_world": np.eye(4).tolist()}
MIRRORED = EYE | {"camera_to_world": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}
SHORT = EYE | {"camera_to_world": [1]}
UNSORTED = [{"time": t, "position": [0, -1, 0], "target": [0, 0, 0]} for t in (0, 2, 1)]


class TestOurFile:
    def test_positions_and_targets(self, tmp_path):
        start = {"time": 0, "position": [0, -4, 1], "target": [0, 0, 1]}
        end = start | {"time": 2, "position": [0, -2, 1], "fov": 50}
        path = read_camera_path(written(tmp_path, {"interpolation": "linear", "keyframes": [start, end]}))
        expected = Camera.look_at((0, -3, 1), (0, 0, 1), width=80, height=60, vertical_fov=42.5)
        got = path.camera_at(1.0, 80, 60)
        np.testing.assert_allclose(got.camera_to_world, expected.camera_to_world, atol=1e-15)
        assert got.focal_x == pytest.approx(expected.focal_x, rel=1e-15)

    def test_a_list_of_poses(self, tmp_path):
        frames = [{"time": 0, "camera_to_world": pose((1, 2, 3)).tolist(), "fov": 20}]
        camera = read_camera_path(written(tmp_path, frames)).camera_at(9.0, 8, 8)
        assert np.array_equal(camera.position, [1.0, 2.0, 3.0])

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ("[", "camera path must be JSON in UTF-8, got Expecting value"),
            ([], "keyframes must be a list of 1 to 1000000 key frames, got []. Give at least one."),
            (7, "must be an object, got 7."),
            ({"keyframe": []}, "must have no field but type, keyframes, interpolation, got 'keyframe'."),
            ([3], "keyframes[0] must be an object, got 3."),
            ([{"time": 0}], "keyframes[0].position must be 3 finite numbers, got nothing."),
            ([{"time": "0"}], "keyframes[0].time must be a finite number, got '0'."),
            ([{"time": 0, "position": [0, 0, 0], "target": [0, 0, 0]}], "keyframes[0].target must differ from eye"),
            ([{"time": 0, "position": [0, 0, 0], "target": [0, 0, 1]}], "keyframes[0]: up must not be parallel"),
            ('[{"time": 0, "position": [0, NaN, 0]}]', "keyframes[0].position must be 3 finite numbers, got [0, NaN,"),
            ([SHORT], "keyframes[0].camera_to_world must have shape (4, 4), got (1,)."),
            ([MIRRORED], "keyframes[0].camera_to_world must hold a rotation"),
            ([EYE | {"target": [0, 0, 1]}], "keyframes[0].target must be left out beside camera_to_world"),
            ([EYE | {"fov": 181}], "keyframes[0].fov must be a number in [0.01, 179], got 181.0."),
            (UNSORTED, "keyframes[2].time must be after the one before (2), got 1. Sort the key frames by time."),
        ],
    )
    def test_mistakes(self, tmp_path, content, message):
        with pytest.raises(AssetFormatError) as caught:
            read_camera_path(written(tmp_path, content))
        assert message in str(caught.value)

    def test_no_file(self, tmp_path):
        with pytest.raises(MissingFileError, match=r"camera path must be a readable file, got .*none\.json"):
            read_camera_path(tmp_path / "none.json")

    def test_a_prim_is_of_usd(self, tmp_path):
        with pytest.raises(InvalidOptionError, match="prim must be left out for a camera path in JSON"):
            read_camera_path(written(tmp_path, []), prim_path="/Camera")


class TestNerfstudio:
    def content(self, **changes):
        poses = [Camera.orbit((0, 0, 1), 3.0, a, 20.0, width=8, height=8, vertical_fov=40.0) for a in (0, 10, 20)]
        matrices = [(camera.camera_to_world @ OPENGL).ravel().tolist() for camera in poses]
        entries = [{"camera_to_world": matrix, "fov": 40, "aspect": 1} for matrix in matrices]
        film = {"camera_type": "perspective", "render_height": 90, "render_width": 160, "fps": 10, "seconds": 0.3}
        return film | {"camera_path": entries, "keyframes": []} | changes

    def test_one_pose_an_image(self, tmp_path):
        path = read_camera_path(written(tmp_path, self.content()))
        for index, azimuth in enumerate((0, 10, 20)):
            expected = Camera.orbit((0, 0, 1), 3.0, azimuth, 20.0, width=160, height=90, vertical_fov=40.0)
            got = path.camera_at(index / 10.0, 160, 90)
            np.testing.assert_allclose(got.camera_to_world, expected.camera_to_world, atol=1e-15)
            assert got.focal_y == pytest.approx(expected.focal_y, rel=1e-12)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"camera_type": "fisheye"}, "camera_type must be perspective, got 'fisheye'."),
            ({"camera_path": []}, "camera_path must be a list of 1 to 1000000 cameras, got []."),
            ({"camera_path": [1]}, "camera_path[0] must be an object, got 1."),
            ({"camera_path": [SHORT]}, "camera_path[0].camera_to_world must have shape (4, 4), got (1,)."),
            ({"camera_path": [{"fov": 1}]}, "camera_path[0].camera_to_world must"),
            ({"fps": 0}, "fps must be a number in [0.001, 1e+06], got 0."),
        ],
    )
    def test_mistakes(self, tmp_path, changes, message):
        with pytest.raises(AssetFormatError) as caught:
            read_camera_path(written(tmp_path, self.content(**changes)))
        assert message in str(caught.value)
