"""Stress captures: each changes what it says and nothing else; path-traced ones show what they say."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from beam_warp.demo.figure import SKELETON
from beam_warp.errors import InvalidArrayError, MissingFileError
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.stability.capture_cases.alterations import evenly, training_cameras, with_every
from beam_warp.stability.capture_cases.cameras import (
    black_camera,
    camera_that_stops,
    camera_without_files,
    eight_cameras,
    empty_camera,
    four_cameras,
    wrong_exposure,
)
from beam_warp.stability.capture_cases.case import Detection, detections_of
from beam_warp.stability.capture_cases.delivered import as_delivered, poses_off
from beam_warp.stability.capture_cases.studio import StressStudio
from beam_warp.stability.capture_cases.subjects import no_texture, object_appears, touching
from beam_warp.stability.capture_cases.surfaces import pixel, rod

CAMERA = "train_03"
"""The middle one of six."""


@pytest.fixture
def studio(tiny_capture, tmp_path):
    return StressStudio(tmp_path, given=tiny_capture, device="cpu")


@pytest.fixture(scope="module")
def tracing_studio(tmp_path_factory):
    """A studio of the smallest images that show what cases are about."""
    folder = tmp_path_factory.mktemp("stress")
    return StressStudio(folder, frame_count=2, camera_count=2, size=48, samples=4, device="cpu")


def records_of(capture, camera):
    return [record for record in capture.records if record.camera_name == camera]


class TestChanges:
    @pytest.mark.parametrize(
        ("case", "code", "factors"),
        [(black_camera, "black-image", (0, 0, 0, 1)), (empty_camera, "empty-mask", (0, 0, 0, 0))],
    )
    def test_void_camera_is_void_and_others_are_as_they_were(self, studio, tiny_capture, case, code, factors):
        stress = case.build(studio)
        assert stress.required == (Detection(code, CAMERA),)
        for record, original in zip(stress.capture.records, tiny_capture.records, strict=True):
            changed, known = record.image().linear_rgba(), original.image().linear_rgba()
            assert np.array_equal(changed, known * factors if record.camera_name == CAMERA else known)

    def test_wrong_exposure_is_twice_the_light_and_the_same_coverage(self, studio, tiny_capture):
        capture = wrong_exposure.build(studio).capture
        for record, original in zip(records_of(capture, CAMERA), records_of(tiny_capture, CAMERA), strict=True):
            changed, known = record.image(), original.image()
            assert np.array_equal(changed.rgb(), 2.0 * known.rgb())
            assert np.array_equal(changed.alpha, known.alpha)
        assert sum(type(a) is not type(b) for a, b in zip(capture.records, tiny_capture.records, strict=True)) == 2

    def test_camera_without_files_is_listed_and_unreadable(self, studio):
        stress = camera_without_files.build(studio)
        assert stress.may_refuse
        assert len(stress.capture.records) == 14
        with pytest.raises(MissingFileError):
            records_of(stress.capture, CAMERA)[0].image()

    def test_camera_that_stops_is_there_in_the_first_frame_only(self, studio):
        capture = camera_that_stops.build(studio).capture
        assert [record.frame for record in records_of(capture, CAMERA)] == [0]
        assert len(capture.records) == 13

    def test_few_cameras_keep_the_test_views(self, studio):
        capture = four_cameras.build(studio).capture
        assert training_cameras(capture) == ("train_00", "train_01", "train_03", "train_04")
        assert len(capture.select(split="test")) == 2

    def test_more_cameras_than_there_are_is_refused(self, studio):
        with pytest.raises(InvalidArrayError, match="capture must have 8 training cameras, got 6"):
            eight_cameras.build(studio)

    def test_left_out_frames_keep_numbers_and_times_of_the_others(self, tiny_capture):
        with pytest.raises(InvalidArrayError, match="capture must have more than 2 frames"):
            with_every(tiny_capture, 2)
        assert with_every(tiny_capture, 1).records == tiny_capture.records

    def test_names_are_picked_evenly(self):
        assert evenly("abcdefghijkl", 4) == ("a", "d", "g", "j")
        assert evenly("abc", 3) == ("a", "b", "c")


class TestDelivered:
    def test_training_views_are_flawed_and_test_views_are_the_clean_ones(self, studio, tiny_capture):
        stress = as_delivered.build(studio)
        clean = {record.name: record for record in tiny_capture.records}
        assert {record.name for record in stress.capture.records} == set(clean)
        assert stress.may_blame
        for record in stress.capture.records:
            assert (record.image_path == clean[record.name].image_path) == (record.split == "test")
        # Test views are in the units of the photographs, in which white is 1.
        (one, *_), (other, *_) = (capture.select(split="test") for capture in (stress.capture, tiny_capture))
        gain = one.image().rgb().sum() / other.image().rgb().sum()
        lit = [(r.view().color.sum(), clean[r.name].view().color.sum()) for r in stress.capture.select(split="train")]
        mean = np.mean([mine / known for mine, known in lit])
        assert 0.7 < mean / gain < 1.3  # but for masks of a pixel in 64
        assert one.truth().channels.keys() == other.truth().channels.keys()

    def test_a_case_can_be_made_twice(self, studio):
        first, second = (poses_off.build(studio).capture.records[0] for _ in range(2))
        np.testing.assert_array_equal(first.camera.camera_to_world, second.camera.camera_to_world)


class TestFine:
    """Meshes alone: what is traced of them is a matter of the path tracer."""

    def test_rods_are_as_thick_as_they_say_and_end_where_they_say(self):
        mesh = rod((0.0, 0.0, 1.0), (0.0, 2.0, 1.0), 0.01, (0.1, 0.2, 0.3))
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
        octagon = 2.0 * np.sqrt(2.0) * 0.005**2
        assert solid.is_watertight
        assert solid.volume == pytest.approx(2.0 * octagon, rel=1e-3)
        np.testing.assert_allclose(solid.bounds[:, 1], [0.0, 2.0], atol=1e-6)
        assert np.all(np.einsum("fk,fk->f", mesh.normals[mesh.faces[:, 0]], solid.face_normals) > 0.999)

    def test_a_pixel_is_that_of_the_cameras(self, tracing_studio):
        camera = no_texture.build(tracing_studio).capture.records[0].camera
        middle = tracing_studio.dancing()[0].vertices.mean(axis=0)
        across = np.linalg.norm(camera.position - middle) / camera.focal_x
        assert pixel(tracing_studio) == pytest.approx(across, rel=0.3)


class TestTraced:
    def test_figure_without_texture_has_one_color(self, tracing_studio):
        capture = no_texture.build(tracing_studio).capture
        truth = capture.select(split="test")[0].truth()
        solid = truth.channels["A"] > 0.999
        np.testing.assert_allclose(truth.stack("base_color.R", "base_color.G")[solid], 0.35, rtol=1e-6)
        assert no_texture.build(tracing_studio).capture is capture  # traced once

    def test_hands_touch_the_dress_in_the_last_frame_only(self, tracing_studio):
        figure = tracing_studio.figure
        names = [bone.name for bone in SKELETON]
        carrier = figure.bone_weights.argmax(axis=1)
        for hand in ("left hand", "right hand"):
            distances = []
            for mesh in touching(figure, 3):
                dress = mesh.vertices[carrier == names.index("dress")]
                distances.append(cKDTree(dress).query(mesh.vertices[carrier == names.index(hand)])[0].min())
            assert distances[0] > 0.05
            assert distances[-1] < 0.018  # the side of a cell: the surfaces meet

    def test_the_object_is_there_from_its_frame_on(self, tracing_studio):
        stress = object_appears.build(tracing_studio)
        assert stress.required == (Detection("new-surface", frame=1),)
        before, after = (read_truth_mesh(stress.capture, frame) for frame in (0, 1))
        assert len(after.vertices) == len(before.vertices) + 2562
        first, second = (
            np.mean([r.image().alpha.sum() for r in stress.capture.select(split="train", frames=[f])]) for f in (0, 1)
        )
        assert second > first + 5.0  # some of the ball's 30 pixels are beside the figure


class TestDetections:
    def test_an_inspection_is_read_by_code_and_camera(self):
        said = [
            SimpleNamespace(code="camera-exposure", what="1 camera is off", where="train_1 +1.0"),
            SimpleNamespace(code="black-image", what="2 images are black", where="train_10_0000, train_10_0001"),
            SimpleNamespace(code="few-cameras", what="4 cameras leave parts unseen", where=""),
        ]
        assert detections_of(said, ("train_1", "train_10", "train_2")) == (
            Detection("camera-exposure", "train_1"),
            Detection("black-image", "train_10"),
            Detection("few-cameras"),
        )

    @pytest.mark.parametrize(
        ("need", "found", "covered"),
        [
            (Detection("camera-exposure", "a"), Detection("camera-exposure", "a", 3), True),
            (Detection("camera-exposure", "a"), Detection("camera-exposure", "b"), False),
            (Detection("camera-exposure", "a"), Detection("black-image", "a"), False),
            (Detection("new-surface", frame=2), Detection("new-surface", frame=1), False),
            (Detection("few-cameras"), Detection("few-cameras"), True),
        ],
    )
    def test_a_finding_covers_what_it_says(self, need, found, covered):
        assert found.covers(need) is covered
