"""Steadiness over time: sums against NumPy, known flicker, and that only points of one surface count."""

import json
import shutil
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
import trimesh
from support.figure_asset import changed, figure_asset

from beam_warp.capture.capture import Capture
from beam_warp.evaluate.compared import ComparedAsset
from beam_warp.evaluate.steadiness import (
    Deviation,
    RunningFlicker,
    RunningVariance,
    gaussian_deviation,
    interpolated,
    readable_points,
    surface_scores,
)
from beam_warp.image.color import srgb_to_linear
from beam_warp.mesh.distances import SurfaceTree
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianSequence

POINTS = 2_000
STEP = np.array([0.05, 0.02, 0.01])
BOTH = {0: 0, 1: 1}
CHANNEL = "ambient_occlusion"


@pytest.fixture(scope="module")
def asset():
    return figure_asset()


@pytest.fixture
def folder(relit_capture, tmp_path):
    """A copy of the capture's folder, to be changed."""
    return shutil.copytree(relit_capture.folder, tmp_path / "capture")


def scores(sequence, capture, device, matched=MappingProxyType(BOTH), channel="base_color"):
    compared = ComparedAsset(sequence, capture, matched, "test")
    return surface_scores(compared, point_count=POINTS, device=device)[channel]


def flickering(asset, middle, step):
    """One display colour everywhere, below and above the middle in turn."""

    def change(frame, cloud):
        encoded = middle + (step if frame % 2 else -step)
        return cloud.with_arrays(base_color=np.tile(srgb_to_linear(encoded), (len(cloud), 1)))

    return changed(asset, change)


class TestRunningVariance:
    def test_it_is_that_of_numpy(self, rng):
        values = rng.normal(5.0, 0.1, (6, 40, 3))
        running = RunningVariance(40, 3)
        for number, frame in enumerate(values):
            running.add(number, frame)
        expected = np.sqrt(values.var(axis=0).mean(axis=-1))
        np.testing.assert_allclose(running.deviations(), expected, rtol=1e-12)

    def test_missing_rows_count_for_nothing(self, rng):
        values, seen = rng.random((5, 30, 2)), rng.random((5, 30)) < 0.5
        running = RunningVariance(30, 2)
        for number, (frame, there) in enumerate(zip(values, seen, strict=True)):
            running.add(number, frame, there)
        for row, found in enumerate(running.deviations()):
            some = values[seen[:, row], row]
            if len(some) < 2:
                assert np.isnan(found)
            else:
                assert found == pytest.approx(np.sqrt(some.var(axis=0).mean()), rel=1e-10)

    def test_a_summary_leaves_out_what_is_not_known(self):
        found = Deviation.of(np.array([0.1, np.nan, 0.3]), (4, 7))
        assert (found.mean, found.count, found.frames) == (pytest.approx(0.2), 2, (4, 7))
        assert Deviation.of(np.array([np.nan]), (0, 1)) is None


class TestRunningFlicker:
    def test_noise_is_told_from_even_change(self, rng):
        """Rows that change by what they like, but evenly, show the deviation of their noise alone."""
        start, rate = rng.normal(0.0, 1.0, (2, 4_000, 1))
        noise = rng.normal(0.0, 0.03, (10, 4_000, 1))
        still, noisy = RunningFlicker(4_000, 1), RunningFlicker(4_000, 1)
        for frame in range(10):
            still.add(frame, start + frame * rate)
            noisy.add(frame, start + frame * rate + noise[frame])
        assert still.deviations().max() < 1e-14
        # The variance is a mean over 32,000 second differences, of which eight in a row depend on each other.
        assert np.sqrt((noisy.deviations() ** 2).mean()) == pytest.approx(0.03, rel=0.03)

    def test_up_and_down(self):
        """Values that go up and down by s about their mean differ by 4 s."""
        running = RunningFlicker(1, 3)
        for frame in range(5):
            running.add(frame, (1.0 if frame % 2 else -1.0) * STEP[None])
        assert running.deviations() == pytest.approx(4.0 / np.sqrt(6.0) * np.sqrt((STEP**2).mean()), rel=1e-12)

    def test_only_three_frames_that_are_evenly_apart_count(self):
        """Frames 0 1 3 5 hold one such three, and a row that is missing in it has none."""
        running = RunningFlicker(2, 1)
        values = {0: 9.0, 1: 1.0, 3: 1.5, 5: 1.0}
        for frame, value in values.items():
            running.add(frame, np.full((2, 1), value), np.array([True, frame != 3]))
        found = running.deviations()
        assert found[0] == pytest.approx(1.0 / np.sqrt(6.0), rel=1e-12)
        assert np.isnan(found[1])


class TestInterpolation:
    def test_a_ramp_is_met_between_pixels(self, rng):
        y, x = np.mgrid[:8, :9] + 0.5
        image = np.stack([2.0 * x - y, 0.5 * x + 3.0], axis=-1)
        places = rng.uniform((0.5, 0.5), (8.5, 7.5), (50, 2))
        found = interpolated(image, np.ones((8, 9)), places, np.ones(50, bool))
        expected = np.stack([2.0 * places[:, 0] - places[:, 1], 0.5 * places[:, 0] + 3.0], axis=-1)
        np.testing.assert_allclose(found, expected, rtol=1e-12)

    def test_what_is_not_covered_has_no_say(self):
        image = np.array([[[0.2], [9.0]], [[0.4], [9.0]]])
        alpha = np.array([[1.0, 0.0], [1.0, 0.0]])
        places, read = np.array([[1.0, 1.0], [0.75, 1.0], [1.0, 1.0]]), np.array([True, True, False])
        np.testing.assert_allclose(interpolated(image, alpha, places, read), [[0.3], [0.3], [0.0]])
        assert interpolated(image, 0.0 * alpha, places, read).max() == 0.0


class TestGaussians:
    def test_known_flicker(self, asset):
        found = gaussian_deviation(flickering(asset, np.array([0.5, 0.4, 0.3]), STEP), (0, 1))
        # Float32 of linear colours: 6e-8 of at most 0.3, 4 times as much when encoded, of 0.03.
        expected = np.sqrt((STEP**2).mean())
        assert (found.mean, found.p95) == (pytest.approx(expected, rel=1e-5), pytest.approx(expected, rel=1e-5))
        assert (found.count, found.frames) == (len(asset[0]), (0, 1))

    def test_occlusion_that_goes_up_and_down(self, asset):
        """Three frames of half of the Gaussians' occlusion being .6, .5 and .6, of the others being steady."""
        count = len(asset[0])

        def at(frame):
            occlusion = np.full(count, 0.6)
            occlusion[: count // 2] -= 0.1 * (frame % 2)
            return asset[0].with_arrays(ambient_occlusion=occlusion)

        sequence = GaussianSequence.from_clouds([at(i) for i in range(3)])
        found, expected = gaussian_deviation(sequence, (4, 5, 6), CHANNEL), 0.2 / np.sqrt(6.0)
        assert (found.mean, found.p95) == (pytest.approx(0.5 * expected, rel=1e-3), pytest.approx(expected, rel=1e-5))
        assert gaussian_deviation(sequence, (4, 5, 7), CHANNEL) == "no three frames of the asset are evenly apart"

    def test_none_without_persistence(self, asset):
        without = changed(asset, lambda _, cloud: cloud.with_arrays(ids=None))
        assert gaussian_deviation(without, (0, 1)) == "Gaussians do not persist from frame to frame"

    def test_constant_colour_is_steady_without_a_look(self, asset):
        read = []

        def read_frame(frame):
            read.append(frame)
            return asset[0]

        constant = replace(asset, read_frame=read_frame, constant=frozenset({"base_color"}))
        assert gaussian_deviation(constant, (4, 5)) == Deviation(0.0, 0.0, len(asset[0]), (4, 5))
        assert read == [0]


def test_points_are_read_where_four_pixels_show_their_piece(device):
    """A wall at 3 m, half of it behind a screen at 2 m: hidden, beside the edge, beyond the image, from behind."""

    def square(left, right, y, toward):
        corners = np.array([(left, y, -1.0), (right, y, -1.0), (right, y, 1.0), (left, y, 1.0)])
        return corners if toward else corners[::-1]

    corners = np.concatenate([square(-3, 3, 3.0, True), square(-3, 0, 2.0, True), square(1, 1.2, 2.5, False)])
    faces = np.array([(4 * i, 4 * i + a, 4 * i + a + 1) for i in range(3) for a in (1, 2)])
    tree = SurfaceTree(corners, faces, device=device)
    camera = Camera.look_at((0, 0, 0), (0, 1, 0), width=100, height=100, vertical_fov=60.0)
    pixel = 3.0 / camera.focal_x  # of the wall
    points = {
        "screen": (-0.5, 2.0, 0.1, True),
        "wall": (0.5, 3.0, 0.1, True),
        "hidden": (-0.5, 3.0, 0.1, False),
        "at the edge": (0.4 * pixel, 3.0, 0.1, False),
        "past the edge": (2.1 * pixel, 3.0, 0.1, True),
        "beyond": (2.5, 3.0, 0.1, False),
        "from behind": (1.1, 2.5, 0.1, False),
        "at the rim": (0.5, 3.0, 0.999, False),
    }
    wanted = np.array([point[:3] for point in points.values()])
    found = tree.closest(wanted)
    np.testing.assert_allclose(found.points, wanted, atol=1e-6)
    places, readable = readable_points(tree, camera, found.faces, found.weights)
    assert dict(zip(points, readable.tolist(), strict=True)) == {name: point[3] for name, point in points.items()}
    np.testing.assert_allclose(places[:, 2], wanted[:, 1], rtol=1e-6)


class TestSurface:
    def test_known_flicker_at_every_point(self, asset, relit_capture, device):
        """What is drawn is one colour in every frame, whatever covers a pixel."""
        sequence = flickering(asset, np.array([0.5, 0.4, 0.3]), STEP)
        found = scores(sequence, relit_capture, device)
        expected = np.sqrt((STEP**2).mean())
        # Means of equal values in float32: 1e-6 of at most 0.3, 4 times as much when encoded, of 0.03.
        assert found.ours.mean == pytest.approx(expected, rel=1e-4)
        assert found.ours.p95 == pytest.approx(expected, rel=1e-4)
        assert found.ours.frames == (0, 1)
        assert found.ours.count > POINTS / 4  # two cameras see about half of a figure, less what is too steep
        assert found.ours_where_known == found.ours  # the truth is drawn in both frames

    def test_occlusion_that_goes_up_and_down_at_every_point(self, asset, relit_capture, folder, device):
        """One value everywhere, .6, .5 and .6; a third frame is the second once more, and has no image."""
        shutil.copy(folder / "truth/mesh_0001.npz", folder / "truth/mesh_0002.npz")
        clouds = [
            asset[min(frame, 1)].with_arrays(ambient_occlusion=np.full(len(asset[0]), value))
            for frame, value in enumerate((0.6, 0.5, 0.6))
        ]
        sequence, matched = GaussianSequence.from_clouds(clouds), {0: 0, 1: 1, 2: 2}
        found = scores(sequence, Capture.read(folder), device, matched, CHANNEL)
        assert found.ours.mean == pytest.approx(0.2 / np.sqrt(6.0), rel=1e-4)
        assert found.ours.p95 == pytest.approx(0.2 / np.sqrt(6.0), rel=1e-4)
        assert found.ours.count > POINTS / 4
        assert found.ours_where_known is found.truth is None  # two frames have no second difference
        assert scores(sequence, relit_capture, "cpu", channel=CHANNEL) == (
            "no point of the true surface is seen in three frames that are evenly apart by a camera"
        )

    def test_a_steady_asset_is_steady(self, asset, relit_capture):
        sequence = flickering(asset, np.array([0.5, 0.4, 0.3]), 0.0)
        found = scores(sequence, relit_capture, "cpu")
        assert found.ours.p95 < 1e-5
        # The true images are of a painted surface that moves over coarse pixels: some of it is all that they have.
        assert 0.0 < found.truth.mean < 0.1

    def test_error_is_that_to_the_true_images(self, asset, relit_capture):
        """A colour of one is off by what the truth lacks of it: more than where discs have the truth's colours."""
        white = changed(asset, lambda _, cloud: cloud.with_arrays(base_color=np.ones((len(cloud), 3))))
        errors = [scores(sequence, relit_capture, "cpu").error for sequence in (asset, white)]
        assert errors[0] < 0.25 * errors[1]

    @pytest.mark.parametrize("shift", [0.0, 0.01])
    def test_cameras_that_stand_still_need_no_image(self, asset, relit_capture, folder, shift):
        """Without records of the second frame, what they would show of it is drawn unless cameras move."""
        content = json.loads((folder / "transforms.json").read_text())
        for record in content["frames"]:
            if record["frame"] == 1:
                record["frame"] = 9
                record["transform_matrix"][0][3] += shift
        (folder / "transforms.json").write_text(json.dumps(content))
        found = scores(asset, Capture.read(folder), "cpu")
        if shift:
            assert found == "no point of the true surface is seen in two frames by a camera"
        else:
            assert found.ours == scores(asset, relit_capture, "cpu").ours
            assert found.truth is None

    def test_triangles_that_are_cut_otherwise_are_left_out(self, asset, relit_capture, folder):
        mesh = read_truth_mesh(relit_capture, 1)
        for shift, of_one in ((2, True), (2 + len(mesh.faces) // 2, False)):
            faces = np.array(mesh.faces)
            faces[:shift] = np.roll(faces[:shift], 1, axis=1)  # the same triangles, said in another order
            np.savez(folder / "truth/mesh_0001.npz", vertices=mesh.vertices, faces=faces)
            found = scores(asset, Capture.read(folder), "cpu")
            assert (found != "the true surface is not of one topology in all frames") == of_one

    def test_one_frame_is_not_enough(self, asset, relit_capture):
        said = scores(asset, relit_capture, "cpu", {0: 0})
        assert said == "fewer than two frames of the asset have a true surface"


def test_rays_stop_at_a_box(device):
    """Rays hit at the distance that arithmetic gives, from outside and from within; those that miss are NaN."""
    box = trimesh.creation.box(bounds=[(0, 0, 0), (1, 1, 1)])
    tree = SurfaceTree(box.vertices, box.faces, device=device)
    slant = np.array([3.0, 0.0, 4.0]) / 5.0
    origins = [(-2.0, 0.3, 0.4), (0.4, 0.6, 0.3), (-2.0, 0.3, 1.4), (-0.75, 0.3, -1.2)]
    directions = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), slant]
    np.testing.assert_allclose(tree.cast(origins, directions), [2.0, 0.4, np.nan, 1.5], rtol=1e-6)
