"""The tracing study: its plan, its references, and that its errors are the estimators' own."""

import re
from dataclasses import replace

import numpy as np
import pytest

import beam_warp.study.tracing_truth
from beam_warp.demo.lights import sunset
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.study.table import run_study
from beam_warp.study.tracing import tracing_study
from beam_warp.study.tracing_plan import DEFAULT_PLAN, TracingPlan, parse_offset
from beam_warp.study.tracing_truth import find_references
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.quaternions import rotation_matrices
from beam_warp.world.shapes import rectangle, still_life, tile

LIGHT = sunset()

SMALL = TracingPlan(
    samplers=("owen", "iid"),
    densities=("product", "mis"),
    offsets=("auto", "0.02"),
    rays=(4, 16),
    points=24,
    reference_rays=256,
    repeats=1,
)


class TestPlan:
    def test_star_is_within_full_and_starts_with_the_defaults(self):
        for settings in (TracingPlan.occlusion_settings, TracingPlan.irradiance_settings):
            star, full = settings(DEFAULT_PLAN), settings(TracingPlan(crossing="full"))
            assert all(each in full for each in star)
            assert len({str(each) for each in full}) == len(full)
            assert set(star[0].values()) <= {"product", "owen", "auto", "ratio"}
        assert len(TracingPlan(crossing="full").occlusion_settings()) == 2 * 3 * 4
        assert len(TracingPlan(crossing="full").irradiance_settings()) == 2 * 3 * 4 * 2

    def test_every_level_occurs(self):
        settings = DEFAULT_PLAN.occlusion_settings() + DEFAULT_PLAN.irradiance_settings()
        for name, levels in (
            ("acceptance", DEFAULT_PLAN.acceptances),
            ("sampler", DEFAULT_PLAN.samplers),
            ("offset", DEFAULT_PLAN.offsets),
            ("density", DEFAULT_PLAN.densities),
            ("ratio", DEFAULT_PLAN.ratios),
        ):
            assert {each[name] for each in settings if name in each} == set(levels)

    def test_offsets(self):
        assert parse_offset("auto") == ("auto", 0.0)
        assert parse_offset("2t") == ("thicknesses", 2.0)
        assert parse_offset("0") == ("metres", 0.0)
        assert parse_offset("0.02") == parse_offset("0.02 m") == ("metres", 0.02)

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            ({"samplers": ("sobol",)}, "samplers must be one of owen, stratified, iid, got 'sobol'"),
            ({"acceptances": ()}, "acceptances must be one or more different values, got ()"),
            ({"rays": (4, 4)}, "rays must be one or more different values, got (4, 4)"),
            ({"rays": (2,)}, "rays must be an integer in [4, 65536], got 2"),
            ({"offsets": ("2x",)}, "offsets must be auto, metres such as 0.02, or thicknesses such as 2t, got '2x'"),
            ({"offsets": ("-1",)}, "offsets must be auto"),
            ({"offsets": ("nan",)}, "offsets must be auto"),
            ({"offsets": ("0.02", "0.020 m")}, "offsets must be one or more different values"),
            ({"points": 1}, "points must be an integer in [2,"),
            ({"repeats": 0}, "repeats must be an integer in [1, 100], got 0"),
            ({"crossing": "some"}, "crossing must be one of star, full, got 'some'"),
        ],
    )
    def test_mistakes(self, options, says):
        with pytest.raises(InvalidOptionError, match=re.escape(says)):
            TracingPlan(**options)


class TestShapes:
    def test_still_life_is_closed_and_faces_out(self):
        cloud = still_life(2000)
        assert abs(len(cloud) - 2000) < 100
        # Every surface is inside the box of floor and wall
        assert (np.abs(cloud.positions[:, :2]) <= 1.0 + 1e-6).all()
        assert cloud.positions[:, 2].min() > -1e-6
        # The shortest axis is the normal's
        shortest = rotation_matrices(cloud.orientations)[:, :, 2]
        np.testing.assert_allclose(np.einsum("nk,nk->n", shortest, cloud.normals), 1.0, atol=1e-6)
        scene = Scene.from_gaussians(cloud, "cpu")
        openness = ambient_occlusion(scene, cloud.positions, cloud.normals, sample_count=16).visibility
        assert openness.mean() > 0.4  # were normals turned inwards, the floor would see nothing but itself from below


class TestReferences:
    @pytest.fixture
    def scene(self, device):
        return Scene.from_gaussians(still_life(500), device)

    def test_come_back_from_their_file(self, scene, tmp_path, monkeypatch):
        file = tmp_path / "references.npz"
        first = find_references(still_life(500), LIGHT, SMALL, scene, file=file)
        assert [path.name for path in tmp_path.iterdir()] == ["references.npz"]
        assert first.occlusion.shape == (2, 24)

        def fail(*arguments, **options):
            raise AssertionError("traced again")

        with monkeypatch.context() as patch:
            patch.setattr(beam_warp.study.tracing_truth, "_trace_block", fail)
            again = find_references(still_life(500), LIGHT, SMALL, scene, file=file)
            np.testing.assert_array_equal(again.light, first.light)
            with pytest.raises(AssertionError, match="traced again"):  # another light
                find_references(still_life(500), LIGHT.scaled(2.0), SMALL, scene, file=file)
        file.write_bytes(file.read_bytes()[:100])
        anew = find_references(still_life(500), LIGHT, SMALL, scene, file=file)
        np.testing.assert_array_equal(anew.occlusion, first.occlusion)

    def test_take_fewer_points_when_time_is_short(self, monkeypatch):
        scene = Scene.from_gaussians(still_life(500), "cpu")
        monkeypatch.setattr(beam_warp.study.tracing_truth, "BLOCK", {False: 8, True: 8})
        few = find_references(still_life(500), LIGHT, SMALL, scene, seconds=0.0)
        whole = find_references(still_life(500), LIGHT, SMALL, scene)
        assert len(few.points) == 8
        np.testing.assert_array_equal(few.occlusion, whole.occlusion[:, :8])

    def test_need_something_to_see(self, device):
        cloud = still_life(500)
        invisible = cloud.with_arrays(opacities=np.zeros(len(cloud)))
        with pytest.raises(InvalidArrayError, match="scene must hold at least 2 Gaussians"):
            find_references(invisible, LIGHT, SMALL, Scene.from_gaussians(invisible, device))


def test_error_is_the_estimators_own(device):
    """Under Bernoulli acceptance, every independent ray is 0 or 1 with mean A: the error is sqrt(A (1 - A) / n)."""
    only = {"acceptances": ("bernoulli",), "samplers": ("iid",), "offsets": ("auto",), "rays": (16,)}
    plan = replace(SMALL, **only, points=32, reference_rays=4096, repeats=2)
    cloud = still_life(800)
    study = tracing_study(cloud, LIGHT, plan, device=device)
    scene = Scene.from_gaussians(cloud, device)
    truth = find_references(cloud, LIGHT, plan, scene).occlusion[0].astype(np.float64)
    (settings,) = (settings for settings in study.plan if "density" not in settings)
    error = study.measure(settings).errors["occlusion_error"].value
    expected = np.sqrt((truth * (1.0 - truth)).mean() / 16)
    # 32 points × 64 copies × 2 repeats: squared errors of nearly normal means have relative variance 2
    assert error == pytest.approx(expected, rel=4.0 * 0.5 * np.sqrt(2.0 / (32 * 64 * 2)))


def test_end_to_end(tmp_path):
    stages = []
    study = tracing_study(
        still_life(500), LIGHT, SMALL, device="cpu", progress=lambda stage, done, total: stages.append(stage)
    )
    table, skipped = run_study(study, tmp_path)
    assert not skipped
    assert "references" in stages
    assert len(table.rows) == len(study.plan)
    metric = {metric.name: metric for metric in table.subject.metrics}
    occlusion = {
        str(row.settings): row.errors["occlusion_error"].value for row in table.rows_of(metric["occlusion_error"])
    }
    for row in table.rows_of(metric["occlusion_error"]):
        if row.settings["rays"] == 4 and row.settings["sampler"] == "iid":
            # Four times the rays halve an independent error, and the interval knows how surely
            assert occlusion[str({**row.settings, "rays": 16})] < row.errors["occlusion_error"].low
    bias = {row.settings["offset"]: row.errors["offset_bias"].value for row in table.rows_of(metric["offset_bias"])}
    assert min(bias.values()) == 0.0
    assert bias["auto" if bias["auto"] else "0.02 m"] > 0.0
    assert metric["irradiance_error"].floor > 0.0
    assert "largest error of 256 rays" in table.subject.notes["Tracer against float64"]
    worst = float(re.search(r"rays: (\S+)", table.subject.notes["Tracer against float64"]).group(1))
    assert worst < 2e-4
    assert table.frontier(metric["irradiance_error"])


def test_tile_takes_a_normal_that_points_down():
    floor = rectangle(np.zeros(3), np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]), 0.5)
    cloud = tile((floor,))
    np.testing.assert_array_equal(cloud.normals, np.tile([0.0, 0.0, -1.0], (16, 1)))
