"""A sound ball keeps all rules of physics; one change breaks one rule and no other."""

from dataclasses import replace

import numpy as np
import pytest
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp.errors import InvalidOptionError
from beam_warp.evaluate import physical, physical_rules
from beam_warp.evaluate.physical import furnace_albedo, measure_physics
from beam_warp.evaluate.physical_rules import PHYSICAL_RULES, Measured, broken
from beam_warp.light.ggx import specular_albedo_terms
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.gaussians import GaussianSequence, Observability
from beam_warp.world.quaternions import rotation_matrices

F0 = 0.04
COUNT = 200


@pytest.fixture(autouse=True)
def few_rays(monkeypatch):
    monkeypatch.setattr(physical, "RAY_COUNT", 64)


def ball(**changes):
    """A closed ball of tiles, which sees all of the hemispheres outside."""
    points, spacing = sphere_points(COUNT)
    arrays = {
        "normals": points,
        "base_color": np.full((COUNT, 3), 0.5),
        "base_color_error": np.full((COUNT, 3), 0.01),
        "roughness": np.full(COUNT, 0.5),
        "roughness_error": np.full(COUNT, 0.01),
        "ambient_occlusion": np.ones(COUNT),
        "ambient_occlusion_error": np.zeros(COUNT),
    }
    return cloud_of(tiles(points, points, spacing), **(arrays | changes), axes="rfu")


def traced(cloud):
    """The cloud with the ambient occlusion that its normals have."""
    found = ambient_occlusion(Scene.from_gaussians(cloud, "cpu"), cloud.positions, cloud.normals, sample_count=256)
    return cloud.with_arrays(ambient_occlusion=found.visibility, ambient_occlusion_error=found.standard_error)


def sideways(cloud):
    """Normals along the tiles: as open to the one side as to the other."""
    return traced(cloud.with_arrays(normals=rotation_matrices(cloud.orientations)[:, :, 0]))


def over_time(*clouds):
    return replace(GaussianSequence.from_clouds(clouds), topology="constant")


def jittered(deviation):
    rng = np.random.default_rng(3)
    colors = 0.5 + deviation * rng.standard_normal((2, COUNT, 3))
    return over_time(*(ball(base_color=np.clip(color, 0.0, 0.85)) for color in colors))


BROKEN = {
    "BEAM-PHYS-002": lambda: over_time(*[ball(ambient_occlusion=np.full(COUNT, 0.5))] * 2),
    "BEAM-PHYS-003": lambda: over_time(*[traced(ball(normals=-sphere_points(COUNT)[0]))] * 2),
    "BEAM-PHYS-004": lambda: over_time(*[sideways(ball())] * 2),
    "BEAM-PHYS-005": lambda: over_time(*[ball(base_color=np.full((COUNT, 3), 0.95))] * 2),
    "BEAM-PHYS-006": lambda: jittered(0.1),
    "BEAM-PHYS-007": lambda: replace(jittered(0.01), metadata={"relit_certificate": "{}"}),
}
"""One change that breaks a rule; a base colour above 1 would break BEAM-PHYS-001, but is none that a cloud can have."""


def test_a_sound_ball_keeps_all_rules():
    measured = measure_physics(jittered(0.01), device="cpu")
    assert [each.rule for each in measured] == [rule.id for rule in PHYSICAL_RULES]
    assert all(each.passed for each in measured[:-1]), measured
    assert (measured[-1].rule, measured[-1].passed) == ("BEAM-PHYS-007", None)  # nothing was reduced
    assert broken(measured) == []
    assert measured == measure_physics(jittered(0.01), device="cpu")


@pytest.mark.parametrize("rule", BROKEN)
def test_breaking_one_rule_breaks_no_other(rule):
    (found,) = broken(measure_physics(BROKEN[rule](), device="cpu"))
    assert found.rule == rule
    assert ", got " in found.message


def test_every_rule_of_an_asset_has_its_breaker():
    assert ["BEAM-PHYS-001", *BROKEN] == [rule.id for rule in PHYSICAL_RULES]


@pytest.mark.parametrize(("color", "passed"), [(0.0, True), (1.0, True), (1.01, False)])
def test_a_white_furnace_tells_what_reflects_more_than_arrives(color, passed):
    albedo = furnace_albedo(np.full((3, 3), color), np.array([0.0, 0.5, 1.0]))
    assert physical_rules.furnace(albedo).passed is passed


@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
def test_the_furnace_is_the_integral_over_all_directions(roughness):
    """Black and grey dielectrics, against Gauss-Legendre over the cosine of the terms themselves."""
    nodes, weights = np.polynomial.legendre.leggauss(48)
    cosine = 0.5 + 0.5 * nodes
    a, b = specular_albedo_terms(cosine, np.full_like(cosine, roughness))
    lobe = (weights * cosine * (F0 * a + b)).sum()
    albedo = furnace_albedo(np.array([[0.0] * 3, [0.2, 0.6, 0.4]]), np.full(2, roughness))
    # Linear between 64 nodes x, the square roots of cosines; a mirror's (1 - x^2)^5 curves most, by 10 at x = 0.
    np.testing.assert_allclose(albedo, [lobe, 0.6 + 0.4 * lobe], atol=10.0 / 8.0 / 63.0**2)


@pytest.mark.parametrize(("understated", "passed"), [(1.0, True), (10.0, False)])
def test_stated_errors_are_taken_at_their_word(understated, passed):
    rng = np.random.default_rng(7)
    stored = 0.5 + 0.02 * rng.standard_normal(1000)
    stated, fresh = np.full(1000, 0.02 / understated), np.full((2, 1000), 0.5)
    assert physical_rules.occlusion(stored, stated, fresh, 0.0 * fresh).passed is passed


def test_a_sheet_may_be_more_open_below():
    """A floor in the shade of a ball, whose underside nothing shades, has the normals of a floor all the same."""
    x, y = np.meshgrid(*[np.arange(-1.4, 1.5, 0.2)] * 2)
    floor = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.2)])
    points, spacing = sphere_points(COUNT)
    up = np.broadcast_to([0.0, 0.0, 1.0], floor.shape)
    places, normals = np.vstack([points, floor]), np.vstack([points, up])
    arrays = {"normals": normals, "base_color": np.full((len(places), 3), 0.5), "roughness": np.full(len(places), 0.5)}
    arrays["ambient_occlusion"] = np.ones(len(places))
    for turned, passed in ((1.0, True), (-1.0, False)):
        arrays["normals"] = normals * np.where(np.arange(len(places)) < COUNT, turned, 1.0)[:, None]
        cloud = cloud_of(tiles(places, normals, max(spacing, 0.2)), **arrays, axes="rfu")
        facing = measure_physics(GaussianSequence.from_clouds([cloud]), device="cpu")[2]
        assert (facing.rule, facing.passed) == ("BEAM-PHYS-003", passed), facing


def test_random_normals_do_not_follow_shapes():
    vectors = np.random.default_rng(5).normal(size=(500, 3))
    cosines = vectors[:, 2] / np.linalg.norm(vectors, axis=1)
    assert physical_rules.shape(cosines).passed is False
    assert physical_rules.shape(0.2 * cosines + 0.8).passed is True


def test_what_cannot_be_judged_says_why():
    unseen = ball(observability=np.full(COUNT, Observability.UNSEEN, np.uint8))
    measured = {each.rule: each for each in measure_physics(over_time(unseen), device="cpu")}
    assert measured["BEAM-PHYS-001"].passed is True
    for rule in BROKEN:
        assert measured[rule].passed is None
        assert "not measured: " in str(measured[rule])
    assert str(Measured.absent(PHYSICAL_RULES[0], "why")) == "-       BEAM-PHYS-001  not measured: why"


def test_the_worst_frame_is_told():
    sound, dark = ball(), ball(ambient_occlusion=np.full(COUNT, 0.5))
    measured = measure_physics(GaussianSequence.from_clouds([sound, sound, dark]), device="cpu")
    assert [(each.rule, each.frame) for each in measured if each.passed is False] == [("BEAM-PHYS-002", 2)]


def test_ordinary_splats_are_refused():
    bare = cloud_of(tiles(*sphere_points(4)[:1] * 2, 0.1))
    with pytest.raises(InvalidOptionError, match="must be relightable for physical checks, got one without"):
        measure_physics(over_time(bare))
