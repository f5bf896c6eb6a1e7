"""The materials benchmark: its scores are right where the answer is known, and all of it runs."""

import json
from dataclasses import replace
from itertools import pairwise

import materials as benchmark
import numpy as np
import pytest
from device_memory import peak_memory
from materials_bench import QUICK, bench_of_capture
from materials_contenders import DIRECT_AS_PAPER, OURS, Subject, SubjectFrame, Unavailable, ablation_rows, direct
from materials_cost import Scale, drawn_views
from materials_plot import draw_all
from materials_truth import SHARP, Materials, PerfectFrame, TruthViews, light_errors, light_reference

from beam_warp.device.arrays import resolve_device
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.direct import MaterialOptions
from beam_warp.raster.gbuffer import rasterize
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap

pytestmark = pytest.mark.slow  # a benchmark's own tests

TINY = replace(
    QUICK,
    perfect_gaussians=600,
    light_points=8,
    reference_rays=64,
    frames=2,
    scale=Scale(
        gaussians=200,
        views=2,
        size=(32, 24),
        repeats=1,
        counts=(100, 200),
        view_counts=(1, 2),
        ray_counts=(4, 8),
        series_views=1,
    ),
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


def test_all_of_it_runs(device, tiny_capture, tmp_path):
    pytest.importorskip("matplotlib")
    target = resolve_device(device)
    pictures = tmp_path / "pictures"
    bench = bench_of_capture(tiny_capture, target, lambda text: None)
    bench = replace(bench, effort=TINY, pictures=pictures)
    states = []
    result = benchmark.measure(bench, only=("perfect", "cost"), keep=lambda state: states.append(json.dumps(state)))
    assert result["failed"] == []
    assert len(states) > 10  # a kill loses one row
    rows = result["perfect"]["captures"]["demo"]["rows"]
    assert {(row["points"], row["bounce"]) for row in rows} == {(p, b) for p in ("true", "seen") for b in (True, False)}
    assert all((pictures / row["picture"]).stat().st_size > 100 for row in rows)
    parts = json.loads(states[-1])["cost"]["parts"]
    assert parts["scene"]["views"] == 2
    assert [row["views"] for row in parts["series"]["views"]] == [1, 2, 1, 2]
    for name in ("direct", "image path"):
        assert parts[name]["seconds"] == pytest.approx(sum(parts[name]["stages"].values()))
    text = benchmark.markdown(result)
    assert "with the bounce" in text
    assert "- image path: " in text
    written = draw_all([{**json.loads(states[-1])}], tmp_path / "plots", pictures)
    assert {path.name for path in written} == {
        "materials_perfect.png",
        "materials_cost.png",
        "materials_rows_perfect_demo.png",
    }


def test_ablation_runs_on_what_was_reconstructed(subject, tiny_capture, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    device = resolve_device("cpu")
    monkeypatch.setattr(benchmark, "reconstruction", lambda bench, name, capture: (subject, {"asset": "made up"}))
    kept = ("paper: image path, .02 m, 50 + 100 iid rays", "+ offset auto", "+ all frames", "offset .1 m")
    rows = [row for row in ablation_rows(high=4, low=4, steps=2) if row.name in kept]
    monkeypatch.setattr(benchmark, "ablation_rows", lambda **options: rows)
    bench = bench_of_capture(tiny_capture, device, lambda text: None)
    result = benchmark.measure(replace(bench, effort=TINY, pictures=tmp_path), only=("ablation",))
    assert result["failed"] == []
    found = {(row["group"], row["name"]): row for row in result["ablation"]["captures"]["demo"]["rows"]}
    assert "two frames" in found["ladder", "+ all frames"]["unavailable"]
    assert "psnr" in found["ladder", "+ offset auto"]["base_color"]
    assert len(benchmark.markdown(result).splitlines()) > len(found)
    names = {path.name for path in draw_all([result], tmp_path / "plots", tmp_path)}
    assert names == {"materials_ablation.png", "materials_rows_ablation_demo.png"}


def test_a_part_that_fails_says_so_and_the_others_are_kept(tiny_capture, monkeypatch):
    def fail(bench):
        yield {"so far": 1}
        raise ZeroDivisionError

    monkeypatch.setitem(benchmark.PARTS, "perfect", fail)
    monkeypatch.setitem(benchmark.PARTS, "cost", lambda bench: iter([{"parts": {}}]))
    bench = bench_of_capture(tiny_capture, resolve_device("cpu"), lambda text: None)
    result = benchmark.measure(bench, only=("perfect", "cost"))
    assert result["failed"] == ["perfect"]
    assert result["perfect"]["so far"] == 1
    assert "ZeroDivisionError" in benchmark.markdown(result)
    assert result["cost"]["parts"] == {}
