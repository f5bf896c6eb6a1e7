"""The materials study: its plan, what errors are against, and that both kinds of reference say what they should."""

import re
from dataclasses import replace

import numpy as np
import pytest

import beam_warp.study.materials as study_of_materials
from beam_warp.errors import InvalidOptionError
from beam_warp.raster.gbuffer import rasterize
from beam_warp.study.materials import SHARP, MaterialsSubject, materials_study, without_color
from beam_warp.study.materials_plan import DIRECT_AXES, MaterialsPlan
from beam_warp.study.materials_truth import COLOR, OCCLUSION, ManyRays, TrueViews
from beam_warp.study.table import Interval, run_study
from beam_warp.study.true_surface import gaussians_on_mesh
from beam_warp.world.environment import EnvironmentMap

SMALL = MaterialsPlan(
    samplers=("owen", "iid"),
    offsets=("auto", "0.02"),
    densities=("product",),
    ratios=("ratio",),
    weights=("albedo_scaling",),
    fits=("together",),
    denoisers=("none",),
    rays=(4,),
    reference_rays=64,
)


class TestPlan:
    def test_one_factor_at_a_time_and_density_with_ratio(self):
        plan = MaterialsPlan()
        settings = plan.settings()
        direct = [each for each in settings if each["path"] == "direct"]
        assert set(direct[0].items()) == {("path", "direct"), *((name, plan.axes()[name][0]) for name in DIRECT_AXES)}
        for each in direct[1:]:
            changed = {name for name in DIRECT_AXES if each[name] != direct[0][name]}
            assert len(changed) == 1 or changed == {"density", "ratio"}
        assert len({str(each) for each in settings}) == len(settings)
        for name, levels in plan.axes().items():
            assert {each[name] for each in settings if name in each} == set(levels)

    def test_path_by_images_takes_metres_and_has_no_axes_of_the_other(self):
        images = [each for each in MaterialsPlan().settings() if each["path"] == "images"]
        assert all(set(each) == {"path", "offset", "denoiser"} for each in images)
        assert {each["offset"] for each in images} == {"0.02 m", "0 m", "0.1 m"}
        assert all(each["path"] == "direct" for each in MaterialsPlan(offsets=("auto",)).settings())

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            ({"samplers": ("sobol",)}, "samplers must be one of owen, stratified, iid, got 'sobol'"),
            ({"paths": ("both",)}, "paths must be one of direct, images, got 'both'"),
            ({"bounces": ()}, "bounces must be one or more different values, got ()"),
            ({"rays": (4, 4)}, "rays must be one or more different values, got (4, 4)"),
            ({"rays": (2,)}, "rays must be an integer in [4, 4096], got 2"),
            ({"offsets": ("2t",)}, "offsets must be auto or metres such as 0.02, got '2t'"),
            ({"offsets": ("x",)}, "offsets must be auto, metres"),
            ({"fits": ("robust", "robust")}, "fits must be one or more different values"),
            ({"reference_rays": 1}, "reference_rays must be an integer in [4, 4096], got 1"),
            ({"repeats": 0}, "repeats must be an integer in [1, 100], got 0"),
        ],
    )
    def test_mistakes(self, options, says):
        with pytest.raises(InvalidOptionError, match=re.escape(says)):
            MaterialsPlan(**options)


class TestReferences:
    def test_interval_is_over_clusters_of_unequal_size(self, rng):
        sizes = rng.integers(0, 20, 200)
        squares = rng.exponential(4.0, (200, 20)) * (np.arange(20) < sizes[:, None])
        found = Interval.of_root_mean_square(squares.sum(axis=1), sizes)
        assert found.value == pytest.approx(np.sqrt(squares.sum() / sizes.sum()))
        # 2000 values of standard deviation 4 around 4: the root of their mean is within 2 sd 0.022 of 2.
        assert found.low < found.value < found.high
        assert 0.5 * 0.044 < found.high - found.value < 2.0 * 0.044

    def test_one_cluster_has_no_interval(self):
        found = Interval.of_root_mean_square([8.0, 0.0], [2.0, 0.0])
        assert (found.low, found.value, found.high) == (2.0, 2.0, 2.0)

    @pytest.mark.slow
    def test_truth_is_compared_where_it_is_solid(self, tiny_capture):
        records = tiny_capture.select(split="test", frames={0})
        mesh = np.load(tiny_capture.folder / "truth/mesh_0000.npz")
        cloud = gaussians_on_mesh(mesh["vertices"], mesh["faces"], 1500)
        reference = TrueViews(cloud, records, SHARP, samples=1, device="cpu")
        found = reference.squares(np.zeros((1500, 3), np.float32), np.full(1500, 0.5, np.float32))
        truth = records[0].truth()
        solid = truth.channels["A"] > 0.999
        assert found[OCCLUSION][:, 1].sum() == found[COLOR][:, 1].sum() == solid.sum()
        expected = np.square(truth.stack("ambient_occlusion")[..., 0][solid].astype(np.float64) - 0.5).sum()
        # A mean over what a pixel sees of one value is that value, but for holes.
        assert found[OCCLUSION][:, 0].sum() == pytest.approx(expected, rel=0.01)

    def test_many_rays_are_compared_where_gaussians_are_seen(self):
        seen = np.array([True, False, True])
        reference = ManyRays(np.zeros((3, 3), np.float32), np.float32([0.5, 0.5, 1.0]), seen, 100)
        found = reference.squares(np.ones((3, 3), np.float32), np.float32([0.25, 0.0, 1.0]))
        np.testing.assert_allclose(found[OCCLUSION], [(0.0625, 1.0), (0.0, 1.0)])
        np.testing.assert_allclose(found[COLOR], [(1.0, 1.0), (1.0, 1.0)])
        assert "no truth" in reference.note


class TestStudy:
    @pytest.fixture(scope="class")
    @staticmethod
    def subject(tiny_capture):
        light = EnvironmentMap.read(tiny_capture.environment_path).resized(16, 32)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(study_of_materials, "GAUSSIANS", {False: 1000, True: 1000})
            whole = MaterialsSubject.on_true_surface(tiny_capture, light, 0, "tiny", "cpu")
        return replace(whole, views=whole.views[:3])

    @pytest.mark.slow
    def test_errors_are_against_the_truth_where_there_is_one(self, subject, tmp_path):
        study = materials_study(subject, SMALL, device="cpu")
        table, skipped = run_study(study, tmp_path)
        assert skipped == []
        assert len(table.rows) == len(SMALL.settings())
        assert "exact channels of 1 test view" in table.subject.notes["Reference"]
        occlusion = [row for row in table.rows if OCCLUSION in row.errors]
        # What changes light alone has no occlusion of its own.
        assert {(row.settings["path"], row.settings.get("bounce")) for row in occlusion} == {
            ("direct", "one"),
            ("images", None),
        }
        assert all(0.0 < row.errors[COLOR].value < 1.0 for row in table.rows)
        assert all(row.cost.value > 0.0 for row in table.rows)

    @pytest.mark.slow
    def test_without_truth_errors_fall_with_rays(self, subject, tiny_capture):
        training = replace(tiny_capture, records=tiny_capture.select(split="train"))
        plan = replace(SMALL, reference_rays=1024)
        study = materials_study(replace(subject, capture=training), plan, device="cpu")
        assert "1,024 rays" in study.subject.notes["Reference"]
        default = plan.settings()[0]
        few, many = (study.measure({**default, "rays": rays}) for rays in (4, 256))
        for name in (OCCLUSION, COLOR):
            assert many.errors[name].value < 0.5 * few.errors[name].value

    def test_gaussians_without_color_send_out_nothing(self, subject):
        camera = subject.views[0].camera
        drawn = rasterize(without_color(subject.cloud), camera, channels=("radiance",), options=SHARP, device="cpu")
        assert np.abs(drawn.channels["radiance"]).max() < 1e-6
        assert drawn.alpha.max() > 0.9
