"""Whether a small turn of a light is found, how sure, and whether a light of another place is told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from support.lit_balls import LIGHTS, Ball

from beam_warp.decomposition.capture_light import CaptureLight
from beam_warp.materials import light_turn
from beam_warp.materials.light import judge_light, possible_scales
from beam_warp.materials.light_fits import (
    LEAST_POINTS,
    LIGHT_COLUMNS,
    LIGHT_ROWS,
    LightEvidence,
    cell_angles,
    cell_directions,
    well_shown,
)
from beam_warp.materials.light_turn import LightTurn, find_turn, missing_light, turned_cells, weaker_explains
from beam_warp.world.environment import EnvironmentMap

WALL = (-0.6, 0.8, 0.0)


def noisy(evidence, seed, part=0.02):
    """Evidence with independent noise on every colour."""
    rng = np.random.default_rng(seed)
    factors = 1.0 + part * rng.normal(size=evidence.colors.shape[:2])[..., None]
    return replace(evidence, colors=(evidence.colors * factors).astype(np.float32))


def test_cells_share_the_light():
    """Power is kept; turns by whole cells move cells; a turn in between moves a sun's middle by as much."""
    light = LIGHTS["studio"]
    turns = np.array([0.0, 11.25, 4.0])
    cells = turned_cells(light, turns).reshape(LIGHT_ROWS, LIGHT_COLUMNS, 3, 3)
    total = 4.0 * np.pi * light.mean_radiance()
    np.testing.assert_allclose(cells.sum(axis=(0, 1)), np.broadcast_to(total, (3, 3)), rtol=1e-5)
    np.testing.assert_allclose(cells[:, :, 1], np.roll(cells[:, :, 0], -1, axis=1), rtol=1e-4, atol=1e-6)
    sun = np.zeros((64, 128, 3), np.float32)
    sun[20, 40] = 1.0
    columns = turned_cells(EnvironmentMap(sun), turns)[..., 0].reshape(LIGHT_ROWS, LIGHT_COLUMNS, 3).sum(axis=0)
    middle = (columns * np.arange(LIGHT_COLUMNS)[:, None]).sum(axis=0) / columns.sum(axis=0)
    np.testing.assert_allclose((middle[0] - middle) * 360.0 / LIGHT_COLUMNS, turns, atol=1e-3)


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("degrees", [0.0, 7.0, -10.0])
def test_a_small_turn_is_found(name, degrees):
    evidence = noisy(Ball.of(count=1000).evidence(LIGHTS[name]), seed=0)
    found = find_turn(evidence, LIGHTS[name].rotated(degrees))
    assert abs(found.degrees + degrees) < 2.0 * found.standard_error
    assert found.standard_error < 2.0
    assert found.is_certain == (degrees != 0.0)


def errors_over_standard_errors(paints):
    """Return errors for a light three degrees askew, on balls of several paints, ``(M, 3)`` each, with noise."""
    light = LIGHTS["stage"]
    white = replace(Ball.of(count=800, roughness=1.0), base_color=np.ones((800, 3))).evidence(light)
    scores = []
    for seed, paint in enumerate(paints):
        evidence = noisy(replace(white, colors=white.colors * paint.astype(np.float32)), seed)
        found = find_turn(evidence, light.rotated(3.0))
        scores.append((found.degrees + 3.0) / found.standard_error)
    return np.array(scores)


def test_the_standard_error_is_honest(monkeypatch):
    """Where paint differs from point to point, errors over standard errors are those of a normal distribution.

    Normals are exact here, so that the part for those that are not is left out.
    """
    monkeypatch.setattr(light_turn, "SYSTEMATIC", 0.0)
    rng = np.random.default_rng(0)
    scores = errors_over_standard_errors([rng.uniform(0.3, 0.6, (800, 3)) for _ in range(24)])
    low, high = chi2.ppf((1e-3, 1.0 - 1e-3), len(scores))
    assert low < np.square(scores).sum() < high
    assert abs(np.mean(scores)) < 3.3 / np.sqrt(len(scores))


def test_the_standard_error_is_not_too_small_in_large_patches():
    """Patches larger than the parts that are left out say less than so many points: still no false certainty."""
    scores = errors_over_standard_errors([Ball.of(count=800, seed=seed).base_color for seed in range(12)])
    assert np.square(scores).sum() < chi2.ppf(1.0 - 1e-3, len(scores))


def test_light_from_other_surfaces_counts():
    """A white ball in a corner whose walls send its own mean colour: without their light, the turn is off."""
    light, ball = LIGHTS["studio"], Ball.of(count=800, roughness=1.0)
    evidence, cells = ball.evidence(light), cell_directions()
    corner = (cells @ np.array(WALL) > 0.3).astype(np.float32)
    openness = evidence.openness * (1.0 - corner)
    cosine = np.maximum(evidence.normals @ cells.T, 0.0)
    sky = (cosine * openness) @ turned_cells(light, np.zeros(1))[:, 0] / np.pi
    hidden = (cosine * (1.0 - openness)) @ cell_angles() / np.pi
    shown, paint = sky, 0.5 + 0.5 * ball.base_color
    for _ in range(50):
        shown = paint * (sky + hidden[:, None] * shown.mean(axis=0))
    colors = np.broadcast_to(shown.astype(np.float32), evidence.colors.shape)
    whole, dark = (
        find_turn(replace(evidence, openness=openness, colors=colors * np.float32(scale)), light)
        for scale in (1.0, 1e-4)
    )
    assert abs(whole.degrees) < 2.0 * whole.standard_error
    assert abs(dark.degrees) > 2.0 * abs(whole.degrees) + 1.0


def test_what_tells_no_turn():
    """An even light, no light, few points, and a turn beyond reach."""
    evidence = Ball.of(count=400).evidence(LIGHTS["studio"])
    even = EnvironmentMap.constant((0.7, 0.7, 0.7))
    assert np.isnan(find_turn(Ball.of().evidence(even), even).degrees)
    assert np.isnan(find_turn(evidence, EnvironmentMap(np.zeros((16, 32, 3)))).degrees)
    few = Ball.of(LEAST_POINTS // 2).evidence(LIGHTS["studio"])
    assert np.isnan(find_turn(few, LIGHTS["studio"]).degrees)
    assert not find_turn(evidence, LIGHTS["studio"].rotated(90.0)).is_certain


@pytest.mark.parametrize(
    ("degrees", "error", "is_certain"),
    [(6.0, 1.5, True), (-6.0, 1.5, True), (6.0, 2.5, False), (2.0, 0.1, False), (14.0, 1.0, False)],
)
def test_what_is_beyond_doubt(degrees, error, is_certain):
    """Three standard errors, more than hardly shows, less than another convention."""
    assert LightTurn(degrees, error).is_certain == is_certain
    assert not LightTurn().is_certain


def bunch(light, paint=None, count=200, balls=5):
    """Evidence of balls of several sizes that do not shade each other: on them, places do not tell normals."""
    ball = Ball.of(count=count, roughness=1.0)
    if paint is not None:
        ball = replace(ball, base_color=paint)
    one = ball.evidence(light)
    rows = np.tile(np.arange(count), balls)
    rng = np.random.default_rng(5)
    centers = rng.uniform(-6.0, 6.0, (balls, 3)).repeat(count, axis=0)
    radii = np.geomspace(0.2, 2.0, balls).repeat(count)[:, None]
    return LightEvidence(
        positions=(radii * one.positions[rows] + centers).astype(np.float32),
        normals=one.normals[rows],
        openness=one.openness[rows],
        colors=one.colors[:, rows],
        weights=one.weights[:, rows],
        directions=one.directions[:, rows],
    )


def cells_of(light):
    """Power of the cells of a light as stated, ``(L, 3)``."""
    return turned_cells(light, np.zeros(1))[:, 0]


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("stated", LIGHTS)
def test_the_light_of_another_place_is_told(name, stated):
    """One warning, and no turn that would not mend it; none of the right light, two degrees askew and too bright."""
    evidence = noisy(bunch(LIGHTS[name]), seed=2)
    scale = 1.1 * LIGHTS[name].mean_radiance().mean() / LIGHTS[stated].mean_radiance().mean()
    said = [finding.code for finding in judge_light(evidence, LIGHTS[stated].scaled(scale).rotated(2.0)).findings]
    assert said == ([] if name == stated else ["environment-unexplained"])


@pytest.mark.parametrize("name", LIGHTS)
def test_less_contrast_explains_more_of_another_light_only(name):
    """The right light, two degrees askew and a tenth too bright, explains; one of more and other contrast does not."""
    light = LIGHTS[name]
    evidence = noisy(Ball.of(count=800).evidence(light), seed=1)
    shown = well_shown(evidence)
    right = light.rotated(2.0).scaled(1.1)
    assert weaker_explains(shown, right.resized(LIGHT_ROWS, LIGHT_COLUMNS).radiance.reshape(-1, 3)) < 0.0
    assert judge_light(evidence, right).findings == ()
    other = np.ones((LIGHT_ROWS, LIGHT_COLUMNS, 3)) * 0.02
    other[LIGHT_ROWS - 3] = 5.0  # from below
    assert weaker_explains(shown, other.reshape(-1, 3)) > 1.0
    said = [finding.code for finding in judge_light(evidence, EnvironmentMap(other)).findings]
    assert said == ["environment-unexplained"]


def tilted(evidence, angle):
    """Evidence whose normals are off by independent angles, ``angle`` in the root mean square [rad]."""
    off = np.random.default_rng(1).normal(scale=angle / np.sqrt(2.0), size=evidence.normals.shape)
    normals = evidence.normals + off
    return replace(evidence, normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32))


@pytest.mark.parametrize(("name", "other"), [("studio", "stage"), ("stage", "sunset")])
def test_errors_of_normals_are_no_other_light(name, other):
    """The right light, two degrees askew, explains under normals 17 degrees off; another under 11 still does not."""
    right = LIGHTS[name]
    for evidence in (bunch(right), Ball.of(count=800).evidence(right)):
        assert judge_light(tilted(noisy(evidence, 2), 0.3), right.rotated(2.0)).findings == ()
    scaled = LIGHTS[other].scaled(right.mean_radiance().mean() / LIGHTS[other].mean_radiance().mean())
    said = judge_light(tilted(noisy(bunch(right), 2), 0.2), scaled).findings
    assert [finding.code for finding in said] == ["environment-unexplained"]


def test_smooth_light_is_explained_and_paint_is_not():
    """White times e^(x / 2): most is explained, and its size found. Paint of any kind, and of places: none."""
    light, rng = LIGHTS["studio"], np.random.default_rng(0)
    white = well_shown(bunch(light, paint=np.ones((200, 3))))
    smooth = np.exp(0.5 * white.normals[:, :1])
    found = missing_light(replace(white, colors=white.colors * smooth), cells_of(light))
    assert found.gain > 0.7  # half of it
    assert found.is_certain
    # what mean normals of neighbours are apart from the points' own, of 200 on a ball, makes it look a little smaller
    np.testing.assert_allclose(found.size, 0.5 * white.normals[:, 0].std(), rtol=0.1)
    spots = well_shown(bunch(light, paint=rng.uniform(0.1, 0.9, (200, 3))))
    assert not missing_light(spots, cells_of(light)).is_certain
    faded = np.exp(0.3 * white.positions[:, :1]).astype(np.float32)
    assert not missing_light(replace(white, colors=white.colors * faded), cells_of(light)).is_certain
    ball = well_shown(Ball.of(count=800).evidence(light))
    assert not missing_light(ball, cells_of(LIGHTS["sunset"])).is_certain


def test_physics_alone_bounds_the_scale():
    """Paint between 0.1 and 0.8: brighter by a quarter at most, darker until its darkest is a dielectric's surface."""
    ball = Ball.of(count=800, roughness=1.0)
    least, most = possible_scales(ball.evidence(LIGHTS["studio"]), LIGHTS["studio"])
    assert 0.9 / 0.85 < most < 1.5
    assert least < 1.0 < most
    doubled = possible_scales(ball.evidence(LIGHTS["studio"]), LIGHTS["studio"].scaled(2.0))
    np.testing.assert_allclose(doubled, (2.0 * least, 2.0 * most), rtol=1e-5)
    few = Ball.of(LEAST_POINTS // 2).evidence(LIGHTS["studio"])
    assert np.isnan(possible_scales(few, LIGHTS["studio"])).all()


def test_how_far_base_colors_are_known_is_said():
    """A note with both bounds, beside the warning about a turn; nothing where nothing was asked."""
    light = LIGHTS["studio"]
    known = CaptureLight(light, None, 0.0, False, LightTurn(6.0, 1.0), 0.0, (0.2, 0.9))
    turned, scale = known.findings
    assert (turned.code, turned.severity) == ("environment-turned", "warning")
    assert (scale.code, scale.severity) == ("base-color-scale", "note")
    assert "0.2 to 0.9 times as bright" in str(scale)
    assert "standard error" not in str(scale)
    assert "10 % is one standard error" in str(replace(known, scale_errors=(0.1, 0.09, 0.11)).findings[1])
    assert replace(known, turn=LightTurn(), scales=(float("nan"), float("nan"))).findings == []
