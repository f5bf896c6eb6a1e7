"""The reconstruction benchmark: its capture shows what it says, and all of it runs on a made-up reconstruction."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import reconstruction as benchmark
import trimesh
from reconstruction_captures import halved, refined, texture, textured_meshes, write_large_capture
from reconstruction_contenders import Contender, follow
from reconstruction_plot import draw
from support.tracked_balls import tracked_balls

from beam_warp.device.arrays import resolve_device
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.world.gaussians import GaussianCloud

pytestmark = pytest.mark.slow  # a benchmark's own tests

COUNT = 800

TINY = replace(benchmark.QUICK, counts=(COUNT,), cameras=(4, 6), large_size=(96, 64), large_views=2, samples=1)


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
def bench(tiny_capture):
    device = resolve_device("cpu")
    steps = FakeSteps(tiny_capture)

    def make(name, count):
        return Contender(name, steps, steps.mesh)

    return benchmark.Bench(tiny_capture, TINY, make, device, lambda text: None)


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


class TestSections:
    def test_first_frame_is_fitted_and_others_are_tracked(self, bench):
        found = list(follow(bench.make("ours", COUNT), bench.capture, (0, 1), bench.device))
        assert [entry.frame for entry in found] == [0, 1]
        assert not np.array_equal(found[0].cloud.positions, found[1].cloud.positions)
        assert all(entry.seconds >= 0.0 for entry in found)

    def test_all_sections_run_and_are_json(self, bench, tmp_path):
        kept = []
        names = ("walker", "gaussians", "cameras", "large")
        result = benchmark.measure(bench, only=names, keep=lambda state: kept.append(len(state)))
        assert result["failed"] == []
        assert len(kept) == len(names)
        walker = result["walker"]["contenders"]
        assert set(walker) == {"ours", "RaDe-GS-like settings"}
        rows = walker["ours"]["frames"]
        assert [row["frame"] for row in rows] == [0, 1]
        assert rows[1]["surface"]["chamfer_mm"] < 1e-3  # the made-up mesh is the truth
        assert walker["ours"]["drift"][1]["gaussians"]["p95_mm"] < 0.01
        assert walker["ours"]["reached"]["chamfer_mm"]
        assert not walker["ours"]["reached"]["psnr"]
        assert [row["cameras"] for row in result["cameras"]["rows"]] == [4, 6]
        assert len(result["large"]["frames"]) == 2
        record = {"benchmark": "reconstruction", "commit": "none", **result}
        path = tmp_path / "result.json"
        path.write_text(json.dumps(record, default=benchmark._plain))
        text = benchmark.markdown(record)
        assert text.count("| frame 0 |") == 3
        draw([json.loads(path.read_text())], tmp_path / "chart.png")
        assert (tmp_path / "chart.png").stat().st_size > 10_000

    def test_a_section_that_fails_says_so_and_others_run(self, bench):
        def refuse(name, count):
            raise RuntimeError("no contender")

        result = benchmark.measure(replace(bench, make=refuse), only=("gaussians", "cameras"))
        assert result["failed"] == ["gaussians", "cameras"]
        assert result["gaussians"] == {"failed": "RuntimeError: no contender"}

    def test_targets_are_missed_by_nothing_that_is_not_a_number(self):
        good = {"psnr": 38.0, "whole_psnr": 40.0, "normals_median_degrees": 5.0, "surface": {"chamfer_mm": 1.5}}
        assert all(benchmark.reached([good, good]).values())
        worse = {"psnr": 36.9, "whole_psnr": 40.0, "normals_median_degrees": 9.0, "surface": {"chamfer_mm": 2.6}}
        found = benchmark.reached([good, worse])
        assert found["psnr"]
        assert not found["psnr after tracking"]
        assert not found["chamfer_mm after tracking"]
        assert not any(benchmark.reached([good | {"psnr": np.nan}] * 2)[key] for key in ("psnr", "psnr after tracking"))
