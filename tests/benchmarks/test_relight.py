"""The relighting benchmark: scores and z-scores are right where the answer is known, and all of it runs into tables."""

import json
from dataclasses import replace

import numpy as np
import pytest
import relight as benchmark
import tables_relight
from materials_truth import SHARP, true_cloud
from parts import measure
from relight_accuracy import Known, RelitSubject, box_psnr, materials_at, measure_light, scores
from relight_energy import z_scores
from relight_scenes import MovingFigure, posed

from beam_warp import converters
from beam_warp.demo.figure import build_figure
from beam_warp.demo.lights import demo_environments
from beam_warp.device.arrays import resolve_device
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

pytestmark = pytest.mark.slow  # a benchmark's own tests

TINY = replace(
    benchmark.QUICK,
    gaussians=300,
    size=(24, 16),
    perfect_gaussians=300,
    demo_size=(24, 36),
    demo_spacing=0.02,
    furnace_gaussians=200,
    bias_gaussians=200,
    bias_seeds=(3, 2),
)


@pytest.fixture(scope="module")
def bench(relit_capture):
    def make(device, **changes):
        made = benchmark.bench_of_capture(relit_capture, resolve_device(device))
        return replace(made, sky=made.sky.resized(16, 32), effort=TINY, **changes)

    return make


@pytest.fixture
def small_lights(monkeypatch):
    """Smaller environments: preparing one takes long by itself."""
    read, demo = EnvironmentMap.read, demo_environments()
    monkeypatch.setattr("relight_accuracy.EnvironmentMap.read", lambda path: read(path).resized(16, 32))
    monkeypatch.setattr(
        "relight_accuracy.demo_environments", lambda: {name: demo[name].resized(16, 32) for name in demo}
    )


def disc_alpha(size=24):
    x, y = np.meshgrid(*(np.arange(size) - 0.5 * (size - 1),) * 2)
    return (np.hypot(x, y) < 0.4 * size).astype(np.float32)


class TestScores:
    def test_of_one_grey_and_another_in_closed_form(self):
        """sRGB of 0.5 and 0.4 differ by d everywhere inside; outside both are black."""
        alpha = disc_alpha()
        images = [Known(np.repeat(level * alpha[..., None], 3, axis=-1), alpha) for level in (0.4, 0.5)]
        difference = 1.055 * (0.5 ** (1 / 2.4) - 0.4 ** (1 / 2.4))
        found = scores(images[:1], images[1:])
        assert found["solid_psnr"] == pytest.approx(-20.0 * np.log10(difference), abs=1e-3)
        rows, columns = np.nonzero(alpha)
        area = (np.ptp(rows) + 1) * (np.ptp(columns) + 1)
        inside = -20.0 * np.log10(difference) - 10.0 * np.log10(alpha.sum() / area)
        assert found["psnr"] == pytest.approx(inside, abs=1e-3)
        assert found["view_psnr"] == [found["psnr"]]
        assert box_psnr(*images) == found["psnr"]

    def test_true_coverage_takes_silhouettes_away(self):
        alpha = disc_alpha()
        thin = 0.5 * alpha
        ours, known = (Known(np.repeat(0.3 * a[..., None], 3, axis=-1), a) for a in (thin, alpha))
        found = scores([ours], [known])
        assert found["psnr"] < 25.0
        assert found["true_coverage_psnr"] > 100.0


class TestScenes:
    def test_true_materials_are_within_what_views_show(self, relit_capture):
        cloud = true_cloud(relit_capture, 0, 400, resolve_device("cpu"))
        truth = next(iter(relit_capture.select(split="test", frames=[0]))).truth()
        solid = truth.channels["A"] > 0.999
        for name, array in (("roughness", cloud.roughness), ("ambient_occlusion", cloud.ambient_occlusion)):
            shown = truth.stack(name)[solid]
            assert shown.min() - 0.1 < np.median(array) < shown.max() + 0.1
        assert cloud.base_color.shape == (400, 3)

    def test_materials_of_a_mesh_are_those_of_its_points(self, rng):
        mesh = build_figure(0.02).at(0.0)
        faces = rng.integers(0, len(mesh.faces), 200)
        weights = rng.dirichlet(np.ones(3), 200)
        points = mesh.interpolate(mesh.vertices, faces, weights).astype(np.float32)
        color, roughness = materials_at(mesh, points)
        # Where sheets of the surface touch, a point is on both; a float32 metre is 1e-7 off its triangle.
        close = np.abs(color - mesh.interpolate(mesh.base_color, faces, weights)).max(axis=1) < 1e-4
        assert close.mean() > 0.98
        assert np.abs(roughness - mesh.interpolate(mesh.roughness, faces, weights))[close].max() < 1e-3

    def test_poses_are_rigid_but_for_sway_and_size(self, bench):
        cloud = bench("cpu").figure().cloud
        positions, orientations, scales = posed(cloud, 0.5 * np.pi)
        assert scales == pytest.approx(cloud.scales, rel=1e-5)
        np.testing.assert_allclose(np.linalg.norm(orientations, axis=1), 1.0, atol=1e-5)
        swayed = positions - cloud.positions
        assert 0.0 < np.linalg.norm(swayed, axis=1).max() < 0.25  # ten degrees of a radius of 1.06, and 3 cm

    def test_moving_writes_the_poses_in_turn(self, bench, device):
        from beam_warp.raster.sources import upload_gaussians

        cloud = bench(device).figure().cloud
        gaussians = upload_gaussians(cloud, resolve_device(device))
        moving = MovingFigure(cloud, 2, resolve_device(device))
        seen = []
        for _ in range(3):
            moving.move(gaussians)
            seen.append(gaussians.positions.numpy().copy())
        assert not np.array_equal(seen[0], seen[1])
        np.testing.assert_array_equal(seen[0], seen[2])


class TestBias:
    @pytest.mark.parametrize("bias", [0.0, 0.3])
    def test_z_scores_find_a_bias_and_no_other(self, rng, bias):
        """Normal images have, without a bias, z-scores of mean 0, spread 1, and the tails of Student's t."""
        few, many = rng.normal(10.0, 1.0, (64, 2000)), rng.normal(10.0 + bias, 0.25, (16, 2000))
        variances = [images.var(axis=0, ddof=1) / len(images) for images in (few, many)]
        found = z_scores([few.mean(axis=0), many.mean(axis=0)], variances, (64, 16))
        assert found["pixels"] == 2000
        if bias:
            assert found["mean_in_standard_errors"] < -20.0
            assert found["relative_bias"] == pytest.approx(-0.3 / 10.3, abs=0.002)
        else:
            assert abs(found["mean_in_standard_errors"]) < 4.0
            assert found["root_mean_square"] == pytest.approx(1.0, abs=0.08)
            assert found["largest"] < 1.3 * found["largest_by_chance"]
            # a share of 0.4 % of 2000 pixels: 4 standard deviations of a Poisson count
            assert abs(found["beyond"] - found["beyond_by_chance"]) < 4.0 * np.sqrt(found["beyond_by_chance"] / 2000)


def test_levels_that_take_too_long_are_left_out(bench, small_lights):
    small = bench("cpu")
    small = replace(small, effort=replace(TINY, levels=(1, 2, 2**20), level_seconds=60.0))
    shot = small.small_figure()
    truth = Known(np.zeros((18, 32, 3), np.float32), np.ones((18, 32), np.float32))
    light = EnvironmentMap.constant((1.0, 1.0, 1.0))
    subject = RelitSubject("figure", shot.cloud, SHARP, [shot.camera], {"white": light}, {"white": [truth]})
    found = measure_light(small, subject, "white", {})
    assert found["left_out"] == [2**20]
    assert [row["setting"] for row in found["rows"] if row["method"] == "path traced"] == ["1 samples", "2 samples"]


def test_all_of_it_runs_into_tables(device, bench, tmp_path, small_lights, relit_capture, monkeypatch):
    pytest.importorskip("matplotlib")
    pictures, states = tmp_path / "pictures", []
    cloud = true_cloud(relit_capture, 0, 300, resolve_device(device))
    asset = GaussianSequence.from_clouds([cloud], metadata={"capture_frames": "0", **SHARP.as_metadata()})
    converters.write(asset, tmp_path / "asset.usda")
    ready = bench(device, pictures=pictures, assets={"demo": tmp_path / "asset.usda"})
    result = measure(benchmark.PARTS, ready, keep=lambda state: states.append(json.dumps(state)))
    assert result["failed"] == []
    assert len(states) > 12  # a kill loses one row
    result = json.loads(states[-1])
    cases = result["deferred"]["cases"]
    assert [row["lights"] for row in cases.values()] == [0, 2, 0]
    assert all(row["launched_is_drawn"] for row in cases.values())
    for row in cases.values():
        assert sum(row["shares_ms"].values()) == pytest.approx(row["whole"]["ms"]["median"])
    for row in result["path"]["cases"].values():
        rate, covered = row["samples_per_second"]["median"], row["covered_samples_per_second"]["median"]
        assert covered == pytest.approx(row["covered"] * rate)
    covered = [row["covered"] for row in result["path"]["cases"].values()]
    assert covered[0] == covered[1] < covered[2] == covered[3]
    assert set(result["moving"]["trees"]) == {"refit", "fast"}
    subjects = result["accuracy"]["subjects"]
    assert list(subjects) == ["demo", "demo figure"]
    for subject in subjects.values():
        for found in subject["lights"].values():
            assert {row["method"] for row in found["rows"]} == {"path traced", "deferred"}
            assert [row["against_path"] is None for row in found["rows"]].count(True) == 1
    shadows = result["shadows"]["subjects"]["demo"]
    assert shadows["views"] == 2
    assert [row["shadows"] for row in shadows["lights"]["sunset"]] == [0, 4]
    assert len(result["furnace"]["rows"]) == 30
    assert all(row["pixels"] > 0 for row in result["furnace"]["rows"])
    assert result["consistent"]["pixels"] > 0
    assert [row[0] for row in tables_relight.deferred(result)[1:]] == list(cases)
    assert [row[0] for row in tables_relight.path(result)[1:]] == list(result["path"]["cases"])
    assert len(tables_relight.results_speed(result)) == 2 + len(cases)
    assert tables_relight.samples(result)[0] == ["PSNR [dB]", "2 samples", "4 samples"]
    assert len(tables_relight.furnace(result)) == 7
    assert len(tables_relight.consistent(result)) == 5
    monkeypatch.setattr(tables_relight, "USUAL", "N = 4")
    assert len(tables_relight.accuracy(result)) == 1 + 3 * (2 + 2)
    relit = {way: {light: {"psnr": 30.0} for light in ("stage", "sunset")} for way in ("deferred", "path")}
    evaluated = {"paths": 2, "captures": {"demo": {"ways": {"direct": {"mean": {"relit": relit}}}}}}
    scored = tables_relight.results_accuracy(result, {"evaluation": evaluated})
    assert [row[:2] for row in scored[1:3]] == [["demo", "stage"], ["demo", "sunset"]]
    assert [(row[0], row[4:]) for row in scored[3:]] == 2 * [("demo figure", ["", ""])]  # no capture was decomposed
    monkeypatch.setattr(tables_relight, "PICTURES", pictures)
    tables_relight.draw_comparison(result, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 1000


def test_shadow_maps_are_scored_of_assets_alone(bench):
    result = measure(benchmark.PARTS, bench("cpu"), only=("shadows",))
    assert "materials.py --keep" in result["shadows"]["failed"]


def test_assets_are_found_by_the_name_of_their_capture(tmp_path):
    (tmp_path / "walker").mkdir()
    (tmp_path / "walker" / "asset.usda").write_text("#usda 1.0")
    assert benchmark.find_assets(tmp_path, ["walker", "runner"]) == {"walker": tmp_path / "walker" / "asset.usda"}
    assert benchmark.find_assets(None, ["walker"]) == {}
