"""The reconstruction benchmark: its capture shows what it says, and all of it runs on a made-up reconstruction."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import reconstruction as benchmark
import tables_reconstruction as tables
import trimesh
from parts import measure
from reconstruction_captures import (
    CASE,
    PUT_DOWN,
    box,
    case_places,
    halved,
    refined,
    subdivided,
    texture,
    textured_meshes,
    write_large_capture,
)
from reconstruction_contenders import Contender, follow
from support.tracked_balls import tracked_balls

from beam_warp import converters
from beam_warp.device.arrays import resolve_device
from beam_warp.reconstruction.fit import FIT_RASTER, FitOptions
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud

pytestmark = pytest.mark.slow  # a benchmark's own tests

COUNT = 800

TINY = replace(benchmark.QUICK, gaussians=COUNT, large_size=(96, 64), large_views=2, samples=1)


@dataclass(frozen=True)
class FakeTrack:
    cloud: GaussianCloud


class FakeSteps:
    """Grey balls where the true surface of a frame is; which frame it is, is counted."""

    def __init__(self, capture):
        self.meshes = [read_truth_mesh(capture, frame) for frame in capture.frames]
        self.clouds = tracked_balls(self.meshes, COUNT, 0.02)
        self.frame = 0

    def mesh(self, cloud, cameras):
        """The true mesh whose balls these are."""
        (found,) = (
            mesh
            for mesh, own in zip(self.meshes, self.clouds, strict=True)
            if np.array_equal(cloud.positions, own.positions)
        )
        return found

    def begin(self, views, progress):
        self.frame = 0
        progress(1, 1, {})
        assert all(view.alpha is not None for view in views)
        return FakeTrack(self.clouds[self.frame]), {"psnr": 20.0}

    def advance(self, track, views, progress):
        self.frame = min(self.frame + 1, len(self.meshes) - 1)
        return FakeTrack(self.clouds[self.frame]), {"psnr": 20.0, "lost": ""}


@pytest.fixture
def bench(tiny_capture, tmp_path):
    steps = FakeSteps(tiny_capture)
    captures = {"walker": tiny_capture, "robot": tiny_capture}
    make = lambda fitting, tracking: Contender(steps, steps.mesh, fitting.raster)  # noqa: E731
    return benchmark.Bench(captures, TINY, make, resolve_device("cpu"), tmp_path / "kept")


class TestCapture:
    def test_halving_keeps_the_surface(self):
        sphere = trimesh.creation.icosphere(subdivisions=1)
        edges, faces = halved(np.asarray(sphere.faces, np.int64), len(sphere.vertices))
        fine = trimesh.Trimesh(refined(sphere.vertices, [edges]), faces, process=False)
        assert len(fine.faces) == 4 * len(sphere.faces)
        assert fine.is_watertight
        assert fine.area == pytest.approx(sphere.area)
        assert fine.volume == pytest.approx(sphere.volume)

    def test_texture_stays_with_the_surface(self, tiny_capture):
        (first, second), surfaces = textured_meshes(tiny_capture, (0, 1), 1)
        assert np.array_equal(first.base_color, second.base_color)
        assert not np.array_equal(first.vertices, second.vertices)
        assert len(first.faces) == 4 * len(surfaces[0][1])

    def test_texture_is_a_material_with_detail(self, rng):
        color, roughness = texture(rng.uniform(-1, 1, (500, 3)))
        assert 0.0 < color.min() < 0.2
        assert 0.4 < color.max() < 0.8
        assert 0.2 < roughness.min() < roughness.max() < 0.7

    def test_capture_has_its_size_and_the_given_truth(self, tiny_capture, tmp_path):
        capture = write_large_capture(
            tmp_path / "large",
            tiny_capture,
            frames=(0, 1),
            camera_count=2,
            test_camera_count=1,
            width=40,
            height=24,
            samples=1,
            subdivisions=0,
            device="cpu",
        )
        assert len(capture.records) == 6
        assert (capture.records[0].camera.width, capture.records[0].camera.height) == (40, 24)
        known, written = read_truth_mesh(tiny_capture, 1), read_truth_mesh(capture, 1)
        assert np.array_equal(known.vertices, written.vertices)
        assert capture.records[0].image().alpha.max() == 1.0


class TestCase:
    def test_it_goes_with_the_hand_falls_straight_and_stays(self):
        """The hand moves on, 4 cm a frame along y; the case falls half of g t² from where it was let go."""
        hand = np.stack([np.zeros(24), 0.04 * np.arange(24), np.full(24, 0.75)], axis=1)
        places = case_places(hand)
        np.testing.assert_allclose(np.diff(places - hand, axis=0)[:PUT_DOWN], 0.0, atol=1e-12)
        np.testing.assert_allclose(places[PUT_DOWN:, :2], places[PUT_DOWN, :2][None].repeat(24 - PUT_DOWN, 0))
        assert places[PUT_DOWN, 2] - places[PUT_DOWN + 3, 2] == pytest.approx(0.5 * 9.81 * (3 / 24) ** 2)
        assert places[-1, 2] == 0.5 * CASE[2]
        assert (np.diff(places[:, 2]) <= 1e-12).all()

    def test_it_is_a_box_that_faces_outwards(self):
        corners, faces = box(CASE)
        plans, fine = subdivided(faces, len(corners), 2)
        mesh = trimesh.Trimesh(refined(corners, plans), fine, process=False)
        assert mesh.volume == pytest.approx(np.prod(CASE))
        np.testing.assert_allclose(mesh.bounds, [-0.5 * np.array(CASE), 0.5 * np.array(CASE)])


class TestSections:
    def test_first_frame_is_fitted_and_others_are_tracked(self, bench):
        contender = bench.make(bench.fitting, TINY.tracking)
        found = list(follow(contender, bench.capture, (0, 1), bench.device))
        assert [entry.frame for entry in found] == [0, 1]
        assert not np.array_equal(found[0].cloud.positions, found[1].cloud.positions)
        (last,) = follow(contender, bench.capture, (1,), bench.device, track=found[0].track)
        assert np.array_equal(last.cloud.positions, found[1].cloud.positions)

    def test_all_sections_run_and_tables_show_them(self, bench, tmp_path):
        kept = []
        result = measure(
            benchmark.SECTIONS, bench, keep=lambda state: kept.append(json.dumps(state, default=np.ndarray.tolist))
        )
        assert result["failed"] == []
        assert len(kept) == 2 + 4 + 1 + 4 + 6 + 1 + 4 + 1  # after every row
        walker, _ = result["captures"]["rows"]
        assert [row["frame"] for row in walker["frames"]] == [0, 1]
        assert walker["frames"][0]["surface"]["chamfer_mm"] < 1e-3  # the made-up mesh is the truth
        assert walker["frames"][1]["drift"]["gaussians"]["p95_mm"] < 0.01
        assert walker["first_seconds"]["count"] == TINY.repeats
        assert walker["same_bits"]
        assert [row["steps"] for row in result["large"]["frames"]] == ["default", "default", "draft", "draft"]
        for function in (
            tables.captures,
            tables.results,
            tables.drawn,
            tables.large,
            tables.rade,
            tables.variants,
            tables.few_cameras,
            tables.strides,
        ):
            head, *rows = function(result)
            assert len(rows) >= (1 if function is tables.strides else 2)
            assert all(len(row) == len(head) for row in rows)
        assert tables.frames_tracked(result) == 2
        assert tables.frames_lost(result) == 0
        tables.draw(result, result, result, tmp_path / "chart.png")
        assert (tmp_path / "chart.png").stat().st_size > 10_000

    def test_kept_sequences_say_how_they_are_drawn_and_what_they_show(self, bench):
        assert measure(benchmark.SECTIONS, bench, only=("captures",))["failed"] == []
        sequence = converters.read(bench.keep / "robot" / "gaussians.usda")
        assert sequence.metadata["capture_frames"] == "0 1"
        assert benchmark.RasterOptions.from_metadata(sequence.metadata) == FIT_RASTER
        known = bench.make(bench.fitting, TINY.tracking).steps.clouds
        for index in range(2):
            found = change_axes(sequence[index], WORLD_AXES)
            assert np.array_equal(found.positions, known[index].positions)
            assert np.array_equal(found.ids, known[index].ids)


class TestTrials:
    """Rows differ in what they say, and end at what they are compared with."""

    @pytest.fixture
    def full(self, bench):
        return replace(bench, effort=benchmark.Effort())

    def test_ladders_end_at_ours(self, full):
        few = replace(full.fitting, gaussian_count=full.effort.few[1])
        assert benchmark.variant_trials(full)[-1].options == few
        assert benchmark.rade_trials(full)[-1].options == full.fitting == FitOptions(gaussian_count=140_000)

    def test_a_rival_has_as_many_steps_the_same_samples_and_the_loss_on_masks(self, full):
        alone, fine, masked, ours = (trial.options for trial in benchmark.rade_trials(full))
        for options in (alone, fine, masked):
            total = options.color_iterations + options.normal_iterations
            assert total == ours.color_iterations + ours.normal_iterations
            assert options.gaussian_count == ours.gaussian_count
        assert fine.samples == masked.samples == ours.samples
        assert masked.weights.alpha == ours.weights.alpha > 0.0
        preset = FitOptions.of_preset("rade", gaussian_count=140_000)
        assert replace(masked, samples=1, weights=preset.weights) == alone
        assert replace(alone, color_iterations=6_000, normal_iterations=6_000) == preset

    def test_the_long_row_has_the_steps_of_the_preset(self, full):
        (trial,) = benchmark._rade_trials(full, full.effort.long)[-1:]
        preset = FitOptions.of_preset("rade")
        assert trial.options.color_iterations == preset.color_iterations
        assert trial.options.normal_iterations == preset.normal_iterations
