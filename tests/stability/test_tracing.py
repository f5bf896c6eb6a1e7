"""Every stress case on every device under every hierarchy; that the suite notices faults."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from reference.visibility import FrozenVisibility
from support.shapes import aligned, random_cloud, random_rays, unit
from support.structures import filled

from beam_warp import Scene, visibility
from beam_warp.kernels.trace.bounds import (
    INVISIBLE,
    NOT_FINITE,
    RAISED,
    TRACED,
    CloudArrays,
    GaussianBounds,
    launch_pack_gaussians,
)
from beam_warp.kernels.trace.gaussian import Gaussians
from beam_warp.stability import tracing as stability
from beam_warp.stability import tracing_cases as stress_cases
from beam_warp.stability.tracing import HIERARCHIES, run_case, scene_under
from beam_warp.stability.tracing_cases import CASES
from beam_warp.trace.reference import visibility_enclosure, visibility_reference
from beam_warp.trace.transmittance import EXACT, TraceOptions

pytestmark = pytest.mark.slow  # a stability suite

CASE = {case.name: case for case in CASES}
SMALL = [case for case in CASES if not case.large]

TREES = [HIERARCHIES[0], *(pytest.param(name, marks=pytest.mark.slow) for name in HIERARCHIES[1:])]
"""Every hierarchy; the other builds and refits are guarded in tests/trace/test_wide_tree.py too."""


class TestCases:
    @pytest.mark.parametrize("hierarchy", TREES)
    @pytest.mark.parametrize("case", SMALL, ids=lambda case: case.name)
    def test_holds(self, device, hierarchy, case):
        """The bound of each ray is derived in `beam_warp.trace.reference`: no case has a tolerance."""
        (outcome,) = run_case(case, device, hierarchies=(hierarchy,))
        assert outcome.faults == ()

    @pytest.mark.parametrize("hierarchy", TREES)
    @pytest.mark.parametrize("seed", range(12))
    def test_random_clouds_stay_in_their_intervals(self, device, hierarchy, seed):
        """Every mixture of scales, rules and degrees, without the stop that would hide rounding below it."""
        rng = np.random.default_rng(seed)
        cloud = random_cloud(rng, 300, scale=[(-3.5, 0.8), (-5.0, 1.5), (-3.0, 2.5), (-7.0, 1.0)][seed % 4])
        cloud = cloud.with_arrays(opacities=0.6 * cloud.opacities)
        rays = stress_cases.aimed_rays(rng, cloud, 300, distance=(-0.1, 2.0))
        degree, front = (2, 2, 4)[seed % 3], ("peak", "entry")[seed // 2 % 2]
        t_max = rng.uniform(0.0, 2.0, 300).astype(np.float32) if seed % 5 == 0 else np.inf
        scene = scene_under(hierarchy, cloud, device, degree)
        result = visibility(scene, *rays, t_max=t_max, options=TraceOptions(front=front, stop=0.0))
        truth = visibility_enclosure(
            stability.traced_cloud(cloud, scene),
            *rays,
            t_max=t_max,
            front=front,
            response_degree=degree,
            middle=scene.origin,
        )
        assert ((result >= truth.low) & (result <= truth.high)).all()

    @pytest.mark.parametrize("case", SMALL, ids=lambda case: case.name)
    def test_cases_are_the_same_each_time_and_their_rays_meet_something(self, case):
        """A case whose rays all miss would prove nothing."""
        stress, again = case.build(), case.build()
        assert np.array_equal(stress.cloud.positions, again.cloud.positions)
        assert np.array_equal(stress.rays[0], again.rays[0])
        if stress.known is None and len(stress.rays[0]):
            truth = stability.ReferenceVisibility.of(stress, Scene.from_gaussians(stress.cloud, "cpu"))
            assert (truth.rays.hits > 0).mean() > 0.5


class TestTheSuiteItself:
    """A check that cannot fail is none."""

    def outcome(self, monkeypatch, change, name="round"):
        real = stability.visibility
        monkeypatch.setattr(stability, "visibility", lambda *rays, **options: change(real(*rays, **options)))
        return run_case(CASE[name], "cpu", hierarchies=("quality",))[0]

    def test_a_small_bias_is_noticed(self, monkeypatch):
        outcome = self.outcome(monkeypatch, lambda v: v * np.float32(1.0 + 1e-3))
        assert any("rays differ by more than rounding explains" in fault for fault in outcome.faults)
        assert not outcome.passed

    def test_lost_hits_are_noticed(self, monkeypatch):
        def lose(v):
            v[7] = 1.0
            return v

        assert self.outcome(monkeypatch, lose).faults == ("1 rays differ by more than rounding explains",)

    def test_nonsense_is_noticed(self, monkeypatch):
        def spoil(v):
            v[3:7] = np.nan, np.inf, -0.1, 1.5
            return v

        outcome = self.outcome(monkeypatch, spoil, "duplicates on 2⁻ᵏ")
        assert outcome.faults[0] == "4 rays are not finite or outside [0, 1]"
        assert np.isfinite(outcome.error)

    @pytest.mark.parametrize(
        ("name", "change", "fault"),
        [
            ("transmittance", lambda x: x * np.float32(1.001), "rays let pass what rounding does not explain"),
            ("expected_depth", lambda x: x * np.nan, "rays have no finite expected depth in front"),
            ("expected_depth", lambda x: -x, "rays have no finite expected depth in front"),
            ("normals", lambda x: 0.999 * x, "rays have normals that are no directions"),
            ("normals", lambda x: np.nan * x, "rays have normals that are no directions"),
            ("depth", lambda x: np.random.default_rng(0).permutation(x), "rays meet their thresholds out of order"),
            ("depth", lambda x: x * np.nan, "rays meet their thresholds out of order"),
        ],
        ids=["too light", "NaN depth", "depth behind", "short normals", "NaN normals", "shuffled", "NaN threshold"],
    )
    def test_wrong_surfaces_are_noticed(self, monkeypatch, name, change, fault):
        real = stability.closest_surface
        seen = []

        def spoiled(*rays, **options):
            hit = real(*rays, **options)
            seen.append(hit)
            return dataclasses.replace(hit, **{name: change(getattr(hit, name))}) if len(seen) == 1 else hit

        monkeypatch.setattr(stability, "closest_surface", spoiled)
        (outcome,) = run_case(CASE["round"], "cpu", hierarchies=("quality",))
        assert len(outcome.faults) == 1
        assert fault in outcome.faults[0]

    @pytest.mark.parametrize(
        ("change", "fault"),
        [
            (lambda v: np.maximum(v, np.arange(len(v)) % 10 == 0), "Bernoulli samples have mean"),
            (lambda v: np.minimum(v, np.arange(len(v)) % 10 > 0), "Bernoulli samples have mean"),
            (lambda v: v * 0.5, "Bernoulli samples are not 0 or 1"),
            (lambda v: v * np.nan, "Bernoulli samples are not 0 or 1"),
        ],
        ids=["too bright", "too dark", "half", "NaN"],
    )
    def test_biased_samples_are_noticed(self, monkeypatch, change, fault):
        real = stability.visibility

        def spoiled(*rays, options, **others):
            v = real(*rays, options=options, **others)
            return change(v) if options.acceptance == "bernoulli" else v

        monkeypatch.setattr(stability, "visibility", spoiled)
        (outcome,) = run_case(CASE["t_max cuts through Gaussians"], "cpu", hierarchies=("quality",))
        assert len(outcome.faults) == 1
        assert outcome.faults[0].startswith(fault)

    def test_counts_that_differ_are_noticed(self):
        case = CASE["opacity 0, 1/255, just above, 1"]
        wrong = dataclasses.replace(
            case, build=lambda: dataclasses.replace(case.build(), expected={"dropped": 7}, expected_left_out=(1, 0, 0))
        )
        (outcome,) = run_case(wrong, "cpu", hierarchies=("quality",))
        assert outcome.faults == ("dropped must be 7, got 200", "rows left out must be (1, 0, 0), got (0, 0, 0)")


class TestReference:
    """The oracle has one too: another in float64, for each rule."""

    @pytest.mark.parametrize(
        "rules",
        [
            {},
            {"front": "entry"},
            {"cull": True},
            {"response_degree": 4},
            {"t_max": 0.4},
            {"t_max": np.linspace(0.0, 2.0, 150)},
            {"t_max": 0.5, "front": "entry", "cull": True, "response_degree": 4},
        ],
        ids=str,
    )
    def test_agrees_with_another(self, rng, rules):
        cloud = random_cloud(rng, 200, scale=(-2.5, 0.8))
        cloud = cloud.with_arrays(normals=unit(rng.normal(size=(200, 3))))
        rays = random_rays(rng, 150)
        named = {"degree" if name == "response_degree" else name: value for name, value in rules.items()}
        expected = FrozenVisibility(cloud, *rays, **named).visibility()
        assert visibility_reference(cloud, *rays, **rules) == pytest.approx(expected, abs=1e-12)
        enclosure = visibility_enclosure(cloud, *rays, **rules)
        assert enclosure.exact == pytest.approx(expected, abs=1e-12)
        assert (enclosure.low <= expected).all()
        assert (enclosure.high >= expected).all()
        assert expected.min() < 0.5

    def test_without_roundings_the_interval_is_the_value(self, rng):
        cloud, rays = random_cloud(rng, 200, scale=(-2.5, 0.8)), random_rays(rng, 150)
        enclosure = visibility_enclosure(cloud, *rays, roundoff=0.0)
        assert np.array_equal(enclosure.low, enclosure.exact)
        assert np.array_equal(enclosure.high, enclosure.exact)

    def test_the_interval_follows_distance_over_scale(self, rng):
        """Ten times farther away or ten times smaller: ten times wider."""
        widths = []
        for scale, distance in ((1e-2, 1.0), (1e-2, 10.0), (1e-3, 1.0)):
            ray = [[-distance, scale, 0.0]], [[1.0, 0.0, 0.0]]
            widths.append(visibility_enclosure(aligned(np.zeros((1, 3)), 0.5, scale), *ray).width[0])
        assert widths[1] / widths[0] == pytest.approx(10.0, rel=0.2)
        assert widths[2] / widths[0] == pytest.approx(10.0, rel=0.2)


class TestOnTheDevice:
    """Arrays that come from a device were never checked: packing leaves out what cannot be traced, and says why."""

    def pack(self, device, **changes):
        arrays = {
            "positions": np.zeros((1, 3)),
            "orientations": np.array([[0, 0, 0, 1.0]]),
            "scales": np.full((1, 3), 0.1),
            "opacities": np.array([0.5]),
        } | changes
        cloud = filled(CloudArrays, device, **{name: np.asarray(array) for name, array in arrays.items()})
        rows = ("center_opacity", "whitening_0", "whitening_1", "whitening_2")
        gaussians = filled(Gaussians, device, degree=2, **{name: np.zeros((1, 4)) for name in rows})
        boxes, numbers = np.zeros((1, 3)), np.zeros(1)
        bounds = filled(GaussianBounds, device, lower=boxes, upper=boxes, fate=numbers, takes_part=numbers)
        launch_pack_gaussians(
            len(cloud.positions), cloud, wp.vec3(), 1e-7, 1e-4, gaussians, bounds, wp.get_device(device)
        )
        packed = [getattr(gaussians, f"whitening_{k}").numpy() for k in range(3)]
        values = [gaussians.center_opacity.numpy()[:, :3], bounds.lower.numpy(), bounds.upper.numpy(), *packed]
        return int(bounds.fate.numpy()[0]), float(packed[0][0, 3]), all(np.isfinite(value).all() for value in values)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    @pytest.mark.parametrize(("name", "width"), [("positions", 3), ("orientations", 4), ("scales", 3)])
    def test_broken_vectors(self, device, name, width, bad):
        for column in range(width):
            value = np.full((1, width), 0.5)
            value[0, column] = bad
            assert self.pack(device, **{name: value}) == (int(NOT_FINITE), -1.0, True), column

    @pytest.mark.parametrize(
        ("changes", "fate"),
        [
            ({}, TRACED),
            ({"scales": [[0.1, -0.1, 0.1]]}, NOT_FINITE),
            ({"orientations": [[0.0, 0.0, 0.0, 0.0]]}, NOT_FINITE),
            ({"scales": [[0.1, 0.1, 0.0]]}, RAISED),
            ({"opacities": [1.0 / 255.0]}, INVISIBLE),
            ({"opacities": [0.0]}, INVISIBLE),
            ({"opacities": [1.1]}, NOT_FINITE),
            ({"opacities": [np.nan]}, NOT_FINITE),
            ({"opacities": [np.inf]}, NOT_FINITE),
            ({"opacities": [-np.inf]}, INVISIBLE),
        ],
        ids=str,
    )
    def test_fates(self, device, changes, fate):
        found, radius, finite = self.pack(device, **changes)
        assert found == int(fate)
        assert finite
        assert radius > 0.0 if fate in (TRACED, RAISED) else radius == -1.0

    @pytest.mark.parametrize("tree", ["refit", "fast", "quality"])
    def test_rows_that_break_on_the_way_are_left_out_and_counted(self, device, rng, tree):
        cloud, rays = random_cloud(rng, 60, scale=(-2.0, 0.3), opacity=(0.1, 0.9)), random_rays(rng, 200)
        scene = Scene.from_gaussians(cloud, device)
        positions = cloud.positions.copy()
        positions[7] = np.nan
        scene.move(positions, cloud.orientations, cloud.scales, tree=tree)
        truth = visibility_enclosure(
            cloud.select(np.delete(np.arange(60), 7)), *rays, stop=EXACT.stop, middle=scene.origin
        )
        result = visibility(scene, *rays)
        assert ((result >= truth.low) & (result <= truth.high)).all()
        assert (scene.report.traced, scene.report.not_finite) == (59, 1)
