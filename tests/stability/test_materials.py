"""Every case on which the measurement of materials fails: what is found, flagged, stated, and how it is judged."""

from dataclasses import replace

import numpy as np
import pytest

from beam_warp.errors import BeamError
from beam_warp.materials.agreement import judge_environment
from beam_warp.materials.base_color import BaseColor
from beam_warp.stability.material_cases import MATERIAL_CASES, MIRROR_ROUGHNESS, SUN_OVER_MEAN, MaterialStudio, sun
from beam_warp.stability.materials import (
    TITLES,
    Bench,
    ColorErrors,
    MaterialOutcome,
    cells,
    decompose,
    run_material_case,
    silent_part,
)
from beam_warp.stability.page import case_table
from beam_warp.stability.suite import StabilityCase
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import Observability

pytestmark = pytest.mark.slow  # a stability suite

NAMES = [case.name for case in MATERIAL_CASES]


@pytest.fixture(scope="module")
def studio():
    return MaterialStudio("cpu", camera_count=8, size=40, samples=16, subdivisions=3)


@pytest.fixture(scope="module")
def bench(studio):
    return Bench(studio)


@pytest.fixture(scope="module")
def outcomes(bench):
    return {case.name: run_material_case(bench, case) for case in MATERIAL_CASES}


@pytest.mark.slow
class TestEveryCase:
    @pytest.mark.parametrize("name", NAMES)
    def test_every_case_passes_and_its_other_colors_are_near(self, outcomes, name):
        """Where a case is not about a Gaussian, and the light is the right one, half of the errors are below 0.05.

        Photographs are of 16 paths, Gaussians are 0.07 m wide. A wave of base colour of 0.3 and 7 per metre changes by
        0.15 over such a width, of which drawing blurs a part: half of the errors must be below a third of that.
        """
        outcome = outcomes[name]
        assert outcome.faults == ()
        if not outcome.refused and "environment-turned" not in outcome.found:
            assert outcome.rest.median < 0.05

    @pytest.mark.parametrize(
        ("name", "flag", "other"),
        [
            ("one lit side", "UNLIT", "SATURATED"),
            ("saturated pixels", "SATURATED", "UNLIT"),
            ("2 views only", "UNSEEN", ""),
            ("Gaussians nobody sees", "UNSEEN", ""),
        ],
    )
    def test_what_cannot_be_measured_is_flagged(self, outcomes, name, flag, other):
        """What is dark is not saturated, and what is cut is not dark."""
        hit = outcomes[name].hit
        assert hit.flags[flag] >= 0.9
        assert hit.flags.get(other, 0.0) < 0.05
        if flag != "SATURATED":
            assert hit.flags["FILLED"] >= 0.9
            assert hit.within >= 0.9  # what is filled states by how much it may be off

    def test_wrong_light_is_found(self, outcomes):
        for name in ("wrong environment rotation", "mirrored environment"):
            assert outcomes[name].found == ("environment-turned",)
            assert outcomes[name].rest.median > 1.5 * outcomes["as it is"].rest.median  # and it matters

    def test_flipping_normals_changes_nothing(self, outcomes):
        """Surfaces face the views that show them, whatever the Gaussians say."""
        assert outcomes["normals flipped"].hit.median == pytest.approx(outcomes["as it is"].rest.median, rel=0.1)

    def test_black_is_black(self, outcomes):
        assert outcomes["black base colour"].hit.high < 0.02  # half of the gloss of F0 = 0.04

    def test_sides_of_a_shell_are_kept_apart(self, outcomes):
        """Red and blue differ by 0.6; a tenth of it would be a sixth of the other's light coming through."""
        assert max(outcomes["thin shell"].hit.median, outcomes["thin shell"].rest.median) < 0.06

    def test_a_black_light_is_refused(self, outcomes):
        assert outcomes["black environment"].refused.startswith("environment must shed light")

    def test_records_and_tables(self, outcomes):
        for outcome in outcomes.values():
            assert MaterialOutcome.from_dict(outcome.as_dict()) == replace(outcome, seconds=round(outcome.seconds, 3))
            assert all(isinstance(cell, str) and cell for cell in cells(outcome))
        table = case_table(TITLES, MATERIAL_CASES, list(outcomes.values()), cells)
        assert table.count("\n") == 2 + len(NAMES)
        assert "| 2 views only |" in table


def test_the_sun_is_as_hot_as_it_says():
    light = sun()
    assert light.radiance.max() / light.mean_radiance().mean() == pytest.approx(SUN_OVER_MEAN, rel=1e-3)
    assert judge_environment(light) == []


def test_the_varnish_is_known_to_one_case_only(studio):
    by_name = {case.name: case.build(studio) for case in MATERIAL_CASES if case.name.startswith("mirror-like")}
    known, unknown = by_name["mirror-like, known"], by_name["mirror-like, unknown"]
    assert (known.roughness[known.hit] == np.float32(MIRROR_ROUGHNESS)).all()
    assert (unknown.roughness > 2 * MIRROR_ROUGHNESS).all()


def faults_of(bench, stress):
    return run_material_case(bench, StabilityCase("trial", "", "", lambda _: stress)).faults


def test_what_must_be_found_and_is_not_is_a_fault(bench, studio, monkeypatch):
    measured = decompose(bench, studio.plain)
    monkeypatch.setattr("beam_warp.stability.materials.decompose", lambda *_: measured)
    stress = replace(studio.plain, finding="environment-turned", flags=Observability.UNLIT, hit=studio.plain.hit | True)
    faults = faults_of(bench, stress)
    assert faults[0] == "not found: environment-turned"
    assert "flagged as UNLIT, 90% must be" in faults[1]
    assert faults_of(bench, replace(studio.plain, refused=True)) == ("must be refused, and was not",)


def test_what_is_found_and_is_not_is_a_fault(bench, studio):
    stress = replace(studio.plain, environment=studio.plain.environment.exposed(-3.0))
    assert "found where it is not: environment-exposure" in faults_of(bench, stress)


def test_refusals_are_judged(bench, studio):
    black = replace(studio.plain, environment=EnvironmentMap(np.zeros((16, 32, 3))))
    [fault] = faults_of(bench, black)
    assert fault.startswith("refused: environment must shed light")
    with pytest.raises(BeamError):
        decompose(bench, black)


def test_crashes_are_told(bench, studio, monkeypatch):
    def crash(*_):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("beam_warp.stability.materials.decompose", crash)
    assert faults_of(bench, studio.plain) == ("ended with ZeroDivisionError: division by zero",)


def solved(error, stated, flags):
    """Base colours that are off by so much from 0.5."""
    count = len(error)
    return BaseColor(
        np.repeat(0.5 + np.float32(error)[:, None], 3, axis=1),
        np.repeat(np.float32(stated)[:, None], 3, axis=1),
        np.array(flags, np.uint8),
        0.0,
    ), np.full((count, 3), 0.5, np.float32)


def test_what_is_wrong_without_a_word():
    """Off by 0.2: stated at 0.01 it is silent; flagged, stated at 0.1, or off by less than 0.1 it is not; NaN is."""
    result, truth = solved([0.2, 0.2, 0.2, 0.05, 0.2], [0.01, 0.01, 0.1, 0.001, np.nan], [0, 1, 0, 0, 0])
    assert silent_part(result, truth) == pytest.approx(2 / 5)


def test_errors_are_of_the_rows_asked_for():
    result, truth = solved([0.1, -0.15, 0.3, 0.0], [0.1, 0.1, 0.1, 0.1], [1, 17, 0, 0])
    errors = ColorErrors.of(result, truth, np.array([True, True, True, False]))
    assert errors.count == 3
    assert errors.median == pytest.approx(0.15, abs=1e-6)
    assert errors.stated == pytest.approx(0.1)
    assert errors.within == pytest.approx(2 / 3)
    assert errors.flags == {"UNLIT": pytest.approx(2 / 3), "FILLED": pytest.approx(1 / 3)}
    assert ColorErrors.of(result, truth, np.zeros(4, bool)) is None
