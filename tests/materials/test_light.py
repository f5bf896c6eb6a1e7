"""Whether an environment is told from its turns, mirror images and other lights, on surfaces whose light is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.lit_balls import LIGHTS, Ball

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import linear_to_srgb, srgb_to_linear
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.light import check_light, judge_light, light_evidence, looks_like_ldr
from beam_warp.materials.light_fits import LEAST_POINTS, LIGHT_COLUMNS
from beam_warp.materials.normals import SurfacePoints
from beam_warp.stability.material_cases import MaterialStudio
from beam_warp.study.true_surface import surface_of_capture
from beam_warp.trace.scene import Scene
from beam_warp.world.environment import EnvironmentMap

CELL = 360.0 / LIGHT_COLUMNS


@pytest.fixture(scope="module")
def ball():
    return Ball.of()


@pytest.fixture(scope="module")
def shown(ball):
    """What the ball shows under each light."""
    return {name: ball.evidence(light) for name, light in LIGHTS.items()}


def mirror(light):
    return EnvironmentMap(light.radiance[:, ::-1])


def codes(check):
    return [finding.code for finding in check.findings]


@pytest.mark.parametrize("name", LIGHTS)
def test_the_right_light_is_not_blamed(shown, name):
    check = judge_light(shown[name], LIGHTS[name])
    assert check.findings == ()
    assert abs(check.best_rotation_degrees) <= CELL / 2
    assert not check.is_mirrored
    assert check.exposure_stops == 0.0
    assert check.spread_best < check.spread_even
    assert check.certainty < 1.0


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("degrees", [30.0, 180.0])
def test_a_turned_light_is_told_with_its_turn(shown, name, degrees):
    """The turn that undoes it is found to within half a cell, which the cells resolve."""
    check = judge_light(shown[name], LIGHTS[name].rotated(degrees))
    assert codes(check) == ["environment-turned"]
    assert check.misfit_as_given > 0.0
    assert check.certainty > 1.0
    off = (check.best_rotation_degrees + degrees + 180.0) % 360.0 - 180.0
    assert check.is_mirrored or abs(off) <= CELL / 2
    assert "degrees about the up axis" in str(check.findings[0])


@pytest.mark.parametrize("name", ["studio", "stage"])
def test_a_mirrored_light_is_told(shown, name):
    """Lights of several sources: a lone sun is its own mirror image."""
    light, degrees = LIGHTS[name], 120.0
    check = judge_light(shown[name], mirror(light.rotated(degrees)))
    assert codes(check) == ["environment-turned"]
    assert check.is_mirrored
    assert "mirrored" in str(check.findings[0])
    undone = mirror(mirror(light.rotated(degrees))).rotated(check.best_rotation_degrees).resized(16, 32).radiance
    assert np.abs(undone - light.resized(16, 32).radiance).mean() < 0.1 * light.radiance.mean() * 2.0


@pytest.mark.parametrize("roughness", [0.3, 0.8])
def test_other_roughness_does_not_matter(roughness):
    evidence = Ball.of(roughness=roughness).evidence(LIGHTS["studio"])
    assert judge_light(evidence, LIGHTS["studio"]).findings == ()
    assert codes(judge_light(evidence, LIGHTS["studio"].rotated(90.0))) == ["environment-turned"]


def test_without_gloss_shading_alone_tells(shown):
    """Colours without change from view to view, as Gaussians of degree 0 have them."""
    evidence = shown["sunset"]
    flat = replace(evidence, colors=np.broadcast_to(evidence.colors.mean(axis=0), evidence.colors.shape))
    right, turned = (judge_light(flat, LIGHTS["sunset"].rotated(degrees)) for degrees in (0.0, 90.0))
    assert right.findings == ()
    assert right.gloss_best == 0.0
    assert codes(turned) == ["environment-turned"]


@pytest.mark.parametrize("stated", ["sunset", "stage"])
def test_another_light_is_told(shown, stated):
    check = judge_light(shown["studio"], LIGHTS[stated])
    assert "warning" in {finding.severity for finding in check.findings}


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("front", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
def test_paint_is_not_taken_for_light(name, front):
    """A ball white in front and dark behind looks lit from the front, but its neighbours say otherwise."""
    ball = Ball.of(roughness=1.0)
    white = (ball.normals @ np.array(front) > 0.0)[:, None]
    two_tone = replace(ball, base_color=np.where(white, 0.8, 0.1) * np.ones(3))
    assert judge_light(two_tone.evidence(LIGHTS[name]), LIGHTS[name]).findings == ()


@pytest.mark.parametrize("roughness", [0.6, 1.0])
def test_a_light_that_is_none_from_any_side_is_told(roughness):
    """A patchy ball under an even sky, said to be lit by a sun: any turn of it puts shading in."""
    even = EnvironmentMap.constant((0.8, 0.8, 0.8), height=32)
    check = judge_light(Ball.of(roughness=roughness).evidence(even), LIGHTS["sunset"])
    assert codes(check) == ["environment-unexplained"]
    assert check.spread_even < check.spread_best


def test_scale_of_the_light(shown):
    """Stops are proposed that bring base colours back; the turn is found whatever the scale."""
    light = LIGHTS["studio"]
    evidence = shown["studio"]
    dim = judge_light(evidence, light.exposed(-3.0))
    assert codes(dim) == ["environment-exposure"]
    assert abs(dim.exposure_stops - 3.0) < 1.0
    assert "too dim" in str(dim.findings[0])
    slight = judge_light(evidence, light.exposed(dim.exposure_stops - 3.8))
    assert slight.exposure_stops == pytest.approx(0.8, abs=1e-3)
    assert "too dim" in str(slight.findings[0])
    bright = judge_light(evidence, light.exposed(5.0))
    assert codes(bright) == ["environment-exposure"]
    assert abs(bright.exposure_stops + 5.0) < 1.0
    assert "too bright" in str(bright.findings[0])
    turned = judge_light(evidence, light.exposed(-3.0).rotated(90.0))
    assert codes(turned) == ["environment-turned", "environment-exposure"]


def test_uniform_light_has_no_turn(ball):
    """All turns are alike, up to what float32 makes of them."""
    light = EnvironmentMap.constant((0.7, 0.7, 0.7))
    check = judge_light(ball.evidence(light), light)
    assert check.findings == ()
    assert check.misfit_as_given < 1e-3


@cache
def traced_ball(device):
    """A path traced ball as Gaussians, and its photographs."""
    return MaterialStudio(device, camera_count=6, size=40, samples=16, subdivisions=3).plain


def photographed(device, images=True):
    """The ball as Gaussians on a device, and what photographs show of them."""
    stress = traced_ball(device)
    cameras = [view.camera for view in stress.views]
    views = view_evidence(stress.cloud, cameras, stress.views if images else None, device=device)
    scene = Scene.from_gaussians(stress.cloud, device)
    return scene, SurfacePoints.seen_by(stress.cloud, views, scene), views, stress.environment


def test_gaussians_and_photographs_tell(device, monkeypatch):
    """Visibility is traced, colours are those of images with noise; the light is the path tracer's."""
    scene, points, views, light = photographed(device)
    right = check_light(scene, points, views, light, subset=256)
    assert right.findings == ()
    assert LEAST_POINTS <= right.point_count <= 256
    assert abs(right.best_rotation_degrees) <= CELL / 2
    assert codes(check_light(scene, points, views, light.rotated(90.0), subset=256)) == ["environment-turned"]
    assert check_light(scene, points, views, light, subset=256) == right
    monkeypatch.setattr("beam_warp.materials.light.MOST_VIEWS", 4)
    assert len(light_evidence(scene, points, views, 256).weights) == 4 < len(views.colors)


@pytest.fixture(scope="module")
def figure(tiny_capture):
    """Evidence of the demo's capture, seen by 6 cameras of 64 x 64 pixels."""
    cloud, views = surface_of_capture(tiny_capture, 0, 2000, device="cpu")
    seen = view_evidence(cloud, [view.camera for view in views], views, device="cpu")
    scene = Scene.from_gaussians(cloud, "cpu")
    return light_evidence(scene, SurfacePoints.seen_by(cloud, seen, scene), seen, 1024)


def test_the_light_of_the_demo_is_not_blamed(figure):
    """Photographs of so few pixels show hardly any gloss; shading alone tells the wrong lights."""
    light = LIGHTS["studio"]
    assert judge_light(figure, light).findings == ()
    assert codes(judge_light(figure, light.rotated(180.0))) == ["environment-turned"]
    assert codes(judge_light(figure, mirror(light))) == ["environment-turned"]


def test_matt_surfaces_tell_a_wrong_sun():
    sun = LIGHTS["sunset"]
    evidence = Ball.of(roughness=1.0).evidence(sun)
    assert judge_light(evidence, sun).findings == ()
    for wrong in (sun.rotated(45.0), mirror(sun.rotated(90.0))):
        assert codes(judge_light(evidence, wrong)) == ["environment-turned"]


def test_images_are_needed(device):
    scene, points, views, light = photographed(device, images=False)
    with pytest.raises(InvalidArrayError, match="views must have images"):
        check_light(scene, points, views, light)
    with pytest.raises(InvalidOptionError, match="subset must be an integer"):
        check_light(scene, points, views, light, subset=0)


def test_what_cannot_be_judged_is_said(shown):
    """Few points; few views, for many lights look alike from one side; no light."""
    whole = shown["studio"]
    points = judge_light(Ball.of(LEAST_POINTS // 2).evidence(LIGHTS["studio"]), LIGHTS["studio"])
    assert codes(points) == ["light-unchecked"]
    assert points.point_count < LEAST_POINTS
    assert not any(value for name, value in vars(points).items() if name not in ("point_count", "findings"))
    few = replace(whole, colors=whole.colors[:3], weights=whole.weights[:3], directions=whole.directions[:3])
    views = judge_light(few, LIGHTS["studio"].rotated(90.0))
    assert codes(views) == ["light-unchecked"]
    assert "3 views" in str(views.findings[0])
    assert codes(judge_light(whole, EnvironmentMap(np.zeros((16, 32, 3))))) == ["environment-black"]


def clipped(light):
    return np.clip(light.radiance * (0.4 / light.mean_radiance().mean()), 0.0, 1.0)


def encoded(light):
    """A light as an 8-bit sRGB picture shows it, decoded again."""
    return srgb_to_linear(np.round(linear_to_srgb(clipped(light)) * 255.0) / 255.0).astype(np.float32)


@pytest.mark.parametrize("name", LIGHTS)
def test_pictures_are_told_from_light(name):
    light = LIGHTS[name]
    assert looks_like_ldr(light) is None
    finding = looks_like_ldr(EnvironmentMap(clipped(light)))
    assert finding is not None
    assert finding.code == "ldr-environment"
    assert "cut at white" in str(finding)
    # Scaled, or through half floats: the steps remain
    for picture in (3.0 * encoded(light), encoded(light).astype(np.float16)):
        assert looks_like_ldr(EnvironmentMap(picture)) is not None


def test_drawings_are_light():
    assert looks_like_ldr(EnvironmentMap.constant((1, 1, 1))) is None
    half = np.zeros((32, 64, 3), np.float32)
    half[:16] = 1.0
    assert looks_like_ldr(EnvironmentMap(half)) is None
