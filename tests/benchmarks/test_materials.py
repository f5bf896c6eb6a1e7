"""The materials benchmark: its scores are right where the answer is known, and all of it runs into tables."""

import json
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import materials as benchmark
import numpy as np
import pytest
import tables_materials
from device_memory import peak_memory
from materials_bench import QUICK, bench_of_capture
from materials_contenders import DIRECT_AS_PAPER, OURS, Subject, SubjectFrame, Unavailable, ablation_rows, direct
from materials_cost import Scale, drawn_views
from materials_evaluation import WAYS, best_constant, frames_of, score_of, statistics, true_roughness
from materials_truth import SHARP, Materials, PerfectFrame, TruthViews, light_errors, light_reference
from parts import measure
from scipy.spatial import cKDTree

from beam_warp.capture.matching import match_frames
from beam_warp.demo.figure import build_figure
from beam_warp.device.arrays import resolve_device
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.raster.gbuffer import rasterize
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

pytestmark = pytest.mark.slow  # a benchmark's own tests

TINY = replace(
    QUICK,
    perfect_gaussians=600,
    light_points=8,
    reference_rays=64,
    paths=2,
    scale=Scale(gaussians=200, views=2, size=(32, 24), repeats=2, few_views=1),
)


@pytest.fixture(scope="module")
def perfect(tiny_capture):
    return PerfectFrame.of(tiny_capture, 0, 800, resolve_device("cpu"))


@pytest.fixture(scope="module")
def grey(perfect):
    count = len(perfect.cloud)
    return Materials(np.full((count, 3), 0.25, np.float32), np.full(count, 0.5, np.float32))


class TestScores:
    def test_true_materials_score_by_what_is_drawn_alone(self, tiny_capture, perfect, grey):
        """One base colour, and the truth is compared with it: the error is the truth's spread, in closed form."""
        truth = TruthViews(tiny_capture, 0, SHARP, 1, "cpu")
        found = truth.score(perfect.cloud, grey)
        exact = truth.records[0].truth()
        solid = exact.channels["A"] > 0.999
        openness = exact.stack("ambient_occlusion")[..., 0][solid].astype(np.float64)
        wanted = -10.0 * np.log10(np.square(openness - 0.5).mean())
        assert found["ambient_occlusion"]["solid_psnr"] == pytest.approx(wanted, abs=0.05)
        colors = exact.stack("base_color.R", "base_color.G", "base_color.B")[solid].astype(np.float64)
        # The least-squares scale of a constant is the mean over it.
        np.testing.assert_allclose(found["base_color"]["scale"], colors.mean(axis=0) / 0.25, rtol=1e-3)

    def test_coverage_is_told_from_the_values(self, tiny_capture, perfect, grey):
        truth = TruthViews(tiny_capture, 0, SHARP, 1, "cpu")
        scores = truth.score(perfect.cloud.with_arrays(scales=1.5 * perfect.cloud.scales), grey)
        assert scores["ambient_occlusion"]["true_coverage_psnr"] > scores["ambient_occlusion"]["psnr"]

    def test_light_is_compared_with_many_rays(self, perfect):
        light = PreparedEnvironment(EnvironmentMap.constant([1.0, 2.0, 3.0]), resolve_device("cpu"))
        points = perfect.points()
        rows = np.flatnonzero(points.seen)[:12]
        reference = light_reference(perfect.scene, points, rows, light, 1024)
        errors = [light_errors(perfect.scene, reference, light, sample_count=count) for count in (8, 512)]
        assert errors[1]["relative_rmse"] < 0.5 * errors[0]["relative_rmse"]
        # Under even light, irradiance over pi is radiance times openness, the same in all channels.
        np.testing.assert_allclose(reference.value, reference.value[:, :1] * [1.0, 2.0, 3.0], rtol=1e-4)
        # The layer that a point lies within is not in the way of its rays.
        assert reference.value[:, 0].mean() > 0.5

    def test_true_points_are_those_of_the_mesh(self, perfect):
        points = perfect.points()
        np.testing.assert_array_equal(points.positions.numpy(), perfect.cloud.positions)
        np.testing.assert_array_equal(points.normals.numpy(), perfect.cloud.normals)
        assert np.abs(perfect.points(exact=False).positions.numpy() - perfect.cloud.positions).max() > 1e-4

    def test_true_roughness_is_that_of_the_views(self, tiny_capture, perfect):
        found = perfect.true_roughness("cpu")
        record = next(r for r in tiny_capture.select(split="test", frames=[0]))
        truth = record.truth()
        solid = truth.channels["A"] > 0.999
        shown = truth.stack("roughness")[..., 0][solid]
        assert shown.min() - 0.1 < np.median(found) < shown.max() + 0.1


@pytest.fixture(scope="module")
def subject(perfect, tiny_capture):
    light = PreparedEnvironment(EnvironmentMap.read(tiny_capture.environment_path), resolve_device("cpu"))
    frame = SubjectFrame(0, perfect.cloud, perfect.views)
    return Subject("tiny", [frame], SHARP, light, resolve_device("cpu"))


class TestContenders:
    def test_ladder_goes_from_the_paper_to_ours_one_idea_at_a_time(self, monkeypatch):
        calls = []
        monkeypatch.setattr("materials_contenders.direct", lambda subject, choices: calls.append(choices))
        rows = [row for row in ablation_rows() if row.group == "ladder"]
        for row in rows[1:]:
            row.method(None)
        assert calls[0] == DIRECT_AS_PAPER
        assert calls[-1] == OURS
        for before, after in pairwise(calls):
            changed = [
                name for name in ("offset", "observed", "joint") if getattr(before, name) != getattr(after, name)
            ]
            changed += [
                name
                for name in MaterialOptions.__dataclass_fields__
                if getattr(before.materials, name) != getattr(after.materials, name)
            ]
            assert len(changed) == 1 or changed == ["density", "ratio"]

    def test_all_rows_are_named_once(self):
        names = [(row.group, row.name) for row in ablation_rows()]
        assert len(set(names)) == len(names)

    def test_joint_fit_needs_frames(self, subject):
        with pytest.raises(Unavailable, match="two frames"):
            direct(subject)
        twice = replace(subject, frames=[subject.frames[0], replace(subject.frames[0], number=1)])
        joint = direct(twice, OURS.but(sample_count=4))
        alone = direct(subject, OURS.but(sample_count=4, joint=False))
        assert joint.frames == 2
        # The same images twice say the same of all but the noise of the light.
        assert np.median(np.abs(joint.materials.base_color - alone.materials.base_color)) < 0.05


class TestCost:
    def test_views_are_what_is_drawn(self, perfect):
        camera = Camera.orbit(
            perfect.cloud.positions.mean(axis=0), 4.0, 20.0, 5.0, width=40, height=30, vertical_fov=35
        )
        (view,) = drawn_views(perfect.cloud, [camera], resolve_device("cpu"))
        buffer = rasterize(perfect.cloud, camera, channels=("radiance",), options=SHARP, device="cpu")
        np.testing.assert_allclose(view.alpha, buffer.alpha, atol=1e-6)
        np.testing.assert_allclose(view.color, buffer.channels["radiance"] * buffer.alpha[..., None], atol=1e-5)

    def test_memory_is_that_of_what_is_done_inside(self, device):
        import warp as wp

        target = resolve_device(device)
        with peak_memory(target) as found:
            array = wp.zeros(1 << 20, dtype=float, device=target)
            del array
        assert found["peak_host_bytes"] > 1 << 20
        if target.is_cuda:
            assert found["peak_device_bytes"] >= found["device_bytes_before"] + (4 << 20)


class TestRoughness:
    def test_truth_is_spread_back_from_the_test_views(self, perfect, tiny_capture):
        records = tiny_capture.select(split="test", frames=[0])
        truth, known = true_roughness(perfect.cloud, records, SHARP, "cpu")
        assert 0.1 < known.mean() < 1.0
        figure = build_figure(0.02).at(0.0)
        exact = figure.roughness[cKDTree(figure.vertices).query(perfect.cloud.positions)[1]]
        # Gaussians some pixels wide blur parts into each other; a constant would be off by the spread of the parts
        spread = np.abs(exact - np.median(exact))[known].mean()
        assert np.abs(truth - exact)[known].mean() < 0.5 * spread

    def test_best_constant_beats_the_others(self, perfect, tiny_capture):
        records = tiny_capture.select(split="test", frames=[0])
        best, score = best_constant(perfect.cloud, records, SHARP, "cpu")
        cloud = perfect.cloud.with_arrays(roughness=np.full(len(perfect.cloud), best, np.float32))
        assert score_of(cloud, records, SHARP, "cpu").psnr == pytest.approx(score.psnr, abs=1e-3)
        worse = [score_of(cloud, records, SHARP, "cpu", constant).psnr for constant in (best - 0.05, best + 0.05)]
        assert max(worse) <= score.psnr

    def test_stated_errors_that_are_right_have_the_shares_of_a_normal_distribution(self, rng):
        truth, error = rng.uniform(0.2, 0.8, 20_000), rng.uniform(0.05, 0.2, 20_000)
        estimate = SimpleNamespace(roughness=truth + error * rng.normal(size=len(truth)), standard_error=error)
        found = statistics(estimate, truth, truth > 0.3)
        # four standard errors of a share of some 17,000
        assert found["within_1"] == pytest.approx(0.6827, abs=0.015)
        assert found["within_2"] == pytest.approx(0.9545, abs=0.007)
        assert found["median_z"] == pytest.approx(0.6745, abs=0.03)


def test_chosen_frames_are_those_of_the_capture(perfect):
    clouds = [perfect.cloud.with_arrays(opacities=np.full(len(perfect.cloud), 0.1 * n, np.float32)) for n in (1, 2, 3)]
    sequence = GaussianSequence.from_clouds(clouds, metadata={"capture_frames": "4 6 9"})
    chosen = frames_of(sequence, [4, 9])
    assert [cloud.opacities[0] for cloud in chosen] == pytest.approx([0.1, 0.3])
    assert match_frames(chosen) == {4: 0, 9: 1}


@pytest.fixture
def bench(device, tiny_capture, tmp_path):
    made = bench_of_capture(tiny_capture, tmp_path, resolve_device(device))
    return replace(made, effort=TINY)


def test_true_surface_and_cost_run_into_tables(bench, tmp_path):
    pytest.importorskip("matplotlib")
    states = []
    result = measure(
        benchmark.PARTS, bench, only=("perfect", "cost"), keep=lambda state: states.append(json.dumps(state))
    )
    assert result["failed"] == []
    assert len(states) > 10  # a kill loses one row
    rows = result["perfect"]["captures"]["demo"]["rows"]
    assert {(row["points"], row["bounce"]) for row in rows} == {(p, b) for p in ("true", "seen") for b in (True, False)}
    cost = json.loads(states[-1])["cost"]
    assert cost["scene"]["views"] == 2
    for name, views in (("direct, roughness given", 2), ("paper, bilateral", 2), ("paper, bilateral, few views", 1)):
        seconds = cost[name]["seconds"]
        assert cost[name]["views"] == views
        assert seconds["lowest"] < seconds["median"] < seconds["highest"]
    assert "roughness" in cost["direct, with roughness"]["stages"]
    assert len(tables_materials.perfect(result)) == 1 + len(rows)
    assert [row[0] for row in tables_materials.light(result)] == ["light", "its own"]
    assert tables_materials.cost(result)[1][:2] == ("direct, roughness given", "2")
    tables_materials.draw_perfect(result, tmp_path / "perfect.png")
    tables_materials.draw_cost(result, tmp_path / "cost.png")
    assert all((tmp_path / name).stat().st_size > 1000 for name in ("perfect.png", "cost.png"))


def test_evaluation_is_of_what_the_package_makes(bench, perfect, tmp_path, monkeypatch):
    """Two ways are decomposed, scored and relit; the direct path's asset and its picture are kept."""
    given = GaussianSequence.from_clouds([perfect.cloud], metadata={"capture_frames": "0", **SHARP.as_metadata()})
    monkeypatch.setattr("materials_evaluation.reconstruction", lambda bench, name: given)
    monkeypatch.setattr("materials_evaluation.WAYS", {name: WAYS[name] for name in ("direct", "paper, bilateral")})
    bench = replace(bench, keep=tmp_path / "keep", pictures=tmp_path / "pictures")
    result = measure(benchmark.PARTS, bench, only=("evaluation", "roughness"))
    assert result["failed"] == []
    found = result["evaluation"]["captures"]["demo"]["ways"]
    assert list(found) == ["direct", "paper, bilateral"]
    assert (tmp_path / "keep" / "demo" / "asset.usda").exists()
    assert (tmp_path / "pictures" / "materials_demo.png").stat().st_size > 1000
    assert [row[0] for row in tables_materials.quality(result)] == ["", "demo, direct", "demo, paper, bilateral"]
    # no estimate is asked for in the paper's preset: its roughness is a constant
    assert found["paper, bilateral"]["decompose"]["roughness"] == {}
    (row,) = result["roughness"]["captures"]["demo"]["rows"]
    assert row["frames"] == 1
    assert len(tables_materials.roughness(result)) == 2


def test_ablation_runs_on_what_was_reconstructed(bench, subject, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(benchmark, "subject_of", lambda bench, name: subject)
    kept = ("paper: image path, 2 cm, 50 + 100 iid rays", "+ offset auto", "+ all frames", "offset 10 cm")
    rows = [row for row in ablation_rows(high=4, low=4) if row.name in kept]
    monkeypatch.setattr(benchmark, "ablation_rows", lambda **options: rows)
    result = measure(benchmark.PARTS, bench, only=("ablation",))
    assert result["failed"] == []
    found = {(row["group"], row["name"]): row for row in result["ablation"]["captures"]["demo"]["rows"]}
    assert "two frames" in found["ladder", "+ all frames"]["unavailable"]
    assert "psnr" in found["ladder", "+ offset auto"]["base_color"]
    ladder = tables_materials.ladder(result)
    assert [row[0] for row in ladder[1:]] == [name for group, name in found if group == "ladder"]
    assert ladder[-1][1] is None
    tables_materials.draw_ablation(result, tmp_path / "ablation.png")
    assert (tmp_path / "ablation.png").stat().st_size > 1000


def test_a_part_that_fails_says_so_and_the_others_are_kept():
    def fail(bench):
        yield {"so far": 1}
        raise ZeroDivisionError

    kept = []
    parts = {"first": fail, "second": lambda bench: iter([{"found": 2}]), "third": fail}
    result = measure(parts, None, only=("first", "second"), keep=lambda state: kept.append(json.dumps(state)))
    assert result["failed"] == ["first"]
    assert result["first"]["so far"] == 1
    assert result["first"]["failed"].startswith("ZeroDivisionError")
    assert result["second"]["found"] == 2
    assert json.loads(kept[0]) == {"failed": [], "first": {"so far": 1}}
