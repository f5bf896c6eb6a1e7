"""What a viewer looks at: cameras agree with ours, numbers that are none change nothing, lights point where they do."""

import asyncio
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.drawn_ball import drawn_ball

from beam_warp.errors import InvalidOptionError
from beam_warp.view.state import (
    ALPHA,
    DEFERRED,
    DEPTH,
    LIT,
    TRACED,
    PlacedLight,
    Playback,
    SubjectBox,
    Viewpoint,
    ViewState,
    channels_of,
    rotation_of,
    turn_to,
)
from beam_warp.world.camera import Camera
from beam_warp.world.lights import DirectionalLight, PointLight, SpotLight


def test_names_that_are_no_choice_are_left_as_they_were():
    state = ViewState(environment="noon", choices={**ViewState().choices, "environment": ("noon", "none")})
    hostile = {"environment": "no such", "mode": "x", "ground": ["none"], "transform": None}
    assert state.changed(**hostile) == state
    assert state.changed(environment="none", mode=TRACED).environment == "none"


@pytest.mark.parametrize("name", ["position", "wxyz"])
@pytest.mark.parametrize("numbers", [(1.0, 2.0), ("a", "b", "c", "d"), (math.inf,) * 3, ()])
def test_a_light_stays_where_it_is_if_it_is_put_nowhere(name, numbers):
    placed = PlacedLight(kind="spot", position=(1.0, 2.0, 3.0))
    assert placed.changed(**{name: numbers}) == placed
    assert placed.changed(position=(1e300, 0.0, 0.0)).position == (1e6, 0.0, 0.0)


def seen_by(camera, fov):
    x, y, z, w = Rotation.from_matrix(camera.camera_to_world[:3, :3]).as_quat()
    return Viewpoint((w, x, y, z), tuple(camera.position), math.radians(fov), camera.width, camera.height)


@pytest.mark.parametrize("size", [(320, 200), (200, 320), (1, 1), (1, 7)])
def test_a_page_sees_what_our_camera_sees(size):
    ours = Camera.look_at((1.0, -3.0, 1.2), (0.1, 0.2, 0.9), width=size[0], height=size[1], vertical_fov=35.0)
    theirs = seen_by(ours, 35.0).camera(1.0, 4096)
    # quaternions from and to float64 matrices: a few roundings of 1e-16 on entries of 1
    np.testing.assert_allclose(theirs.camera_to_world, ours.camera_to_world, atol=1e-14)
    for name in ("focal_x", "focal_y", "center_x", "center_y"):
        assert getattr(theirs, name) == pytest.approx(getattr(ours, name), rel=1e-12)


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.375, 0.1, 1e-6])
def test_a_smaller_picture_shows_the_same(scale):
    page = seen_by(Camera.look_at((0, -3, 1), (0, 0, 1), width=901, height=613, vertical_fov=40.0), 40.0)
    small, full = page.camera(scale, 4096), page.camera(1.0, 4096)
    assert small.width == max(1, round(901 * scale))
    corner = np.array([[0.3, 0.4, 1.2]])
    relative = [camera.project(corner)[0, :2] / (camera.width, camera.height) for camera in (small, full)]
    np.testing.assert_allclose(relative[0], relative[1], rtol=1e-12)  # a place of the page, not of the rounded picture


def test_no_side_is_longer_than_asked():
    page = seen_by(Camera.look_at((0, -3, 1), (0, 0, 1), width=4000, height=1000, vertical_fov=40.0), 40.0)
    assert page.size(1.0, 1000) == (1000, 250)
    assert page.size(0.1, 1000) == (400, 100)


@pytest.mark.parametrize(
    "broken",
    [
        {"wxyz": (0.0, 0.0, 0.0, 0.0)},
        {"wxyz": (math.nan, 0.0, 0.0, 1.0)},
        {"position": (math.inf, 0.0, 0.0)},
        {"fov": math.nan},
        {"fov": 0.0},
        {"width": 0},
        {"height": 100_000},
    ],
)
def test_a_page_that_is_nowhere_is_not_drawn(broken):
    sound = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 0.0), "fov": 0.6, "width": 100, "height": 80}
    assert Viewpoint(**sound).is_usable
    assert not Viewpoint(**{**sound, **broken}).is_usable


def test_numbers_that_are_none_change_nothing():
    state = ViewState(rotation=10.0, exposure=1.0, samples=64, background=(1, 2, 3))
    assert state.changed(rotation=math.nan, exposure=math.inf, samples=None, background=(math.nan, 2, 3)) == state
    assert state.changed(background="red", rotation="much") == state


def test_numbers_out_of_range_are_cut():
    state = ViewState().changed(rotation=1e9, exposure=-1e9, samples=0, background=(-5, 300, 12.6), frame=-3)
    assert (state.rotation, state.exposure, state.samples, state.frame) == (360.0, -16.0, 1, 0)
    assert state.background == (0, 255, 13)
    assert isinstance(ViewState().changed(samples=12.7).samples, int)


def test_a_state_has_no_other_parts():
    with pytest.raises(InvalidOptionError, match="state must have background, channel, "):
        ViewState().changed(zoom=2)


def test_only_what_is_lit_is_traced():
    assert ViewState(mode=TRACED).is_traced
    assert not ViewState(mode=DEFERRED).is_traced
    assert not ViewState(mode=TRACED, channel=DEPTH).is_traced


@pytest.mark.parametrize("direction", [(0, 0, -1), (0, 0, 1), (1, 0, 0), (0, -2, 0), (0.3, -0.4, 0.8), (1e-9, 0, 1)])
def test_a_handle_turned_to_a_direction_shines_there(direction):
    wxyz = turn_to(direction)
    unit = np.asarray(direction) / np.linalg.norm(direction)
    np.testing.assert_allclose(-rotation_of(wxyz)[:, 2], unit, atol=1e-8)  # 1e-9 off the pole is turned by half a turn
    light = PlacedLight(kind="spot", position=(0, 0, 0), wxyz=wxyz).light()
    np.testing.assert_allclose(light.direction, unit, atol=1e-8)


def test_lights_are_what_was_placed():
    placed = PlacedLight(kind="point", position=(1.0, 2.0, 3.0), color=(255, 0, 128), power=2.0, size=0.1)
    light = placed.light()
    assert isinstance(light, PointLight)
    linear = ((128 / 255 + 0.055) / 1.055) ** 2.4  # IEC 61966-2-1
    np.testing.assert_allclose(light.intensity, (2.0, 0.0, 2.0 * linear), rtol=1e-12)
    assert (light.position, light.radius, light.casts_shadows) == ((1.0, 2.0, 3.0), 0.1, True)
    sun = PlacedLight(kind="directional", position=(0, 0, 0), size=0.53, casts_shadows=False).light()
    assert isinstance(sun, DirectionalLight)
    assert (sun.direction, sun.angular_diameter, sun.casts_shadows) == ((0.0, 0.0, -1.0), 0.53, False)


def test_a_spot_light_has_a_cone():
    spot = PlacedLight(kind="spot", position=(0, 0, 0)).changed(cone=40.0).light()
    assert (spot.outer_angle, spot.inner_angle) == (40.0, pytest.approx(28.0))
    for cone in (-5.0, 1e9, math.nan):
        assert isinstance(PlacedLight(kind="spot", position=(0, 0, 0)).changed(cone=cone).light(), SpotLight)


def test_placed_lights_take_no_nonsense():
    placed = PlacedLight(kind="spot", position=(1.0, 2.0, 3.0), power=2.0)
    nowhere = placed.changed(position=(math.nan, 0, 0), wxyz=(0, 0, 0, 0), power=math.nan, size=math.inf, color=(1, 2))
    assert nowhere == placed
    assert placed.changed(power=-3.0, size=1e9).power == 0.0
    assert isinstance(placed.changed(power=-3.0, size=1e9).light(), SpotLight)


@pytest.mark.parametrize("kind", ["point", "spot", "directional"])
def test_a_new_light_shines_on_the_subject(kind):
    subject = SubjectBox(np.array([-0.5, -0.5, 0.0]), np.array([0.5, 0.5, 2.0]))
    placed = subject.new_light(kind)
    light = placed.light()
    offset = subject.center - np.asarray(placed.position)
    if kind != "point":
        np.testing.assert_allclose(light.direction, offset / np.linalg.norm(offset), atol=1e-12)
    strength = light.irradiance if kind == "directional" else np.asarray(light.intensity) / (offset @ offset)
    np.testing.assert_allclose(strength, math.pi, rtol=0.05)  # two digits are shown


def test_a_box_around_nothing():
    assert SubjectBox.of(np.zeros((0, 3))).extent > 0.0
    assert SubjectBox.of(np.zeros((1, 3))).extent > 0.0


def test_channels_are_those_that_there_are():
    cloud = drawn_ball()
    names = channels_of(cloud)
    assert names[0] == LIT
    assert {"base_color", "roughness", "ambient_occlusion", "normals", "radiance", DEPTH, ALPHA} <= set(names)
    assert not {"base_color_error", "observability"} & set(names)
    materials = ("base_color", "roughness", "ambient_occlusion", "normals")
    bare = cloud.with_arrays(**dict.fromkeys((*materials, "radiance", "radiance_color_space")))
    assert channels_of(bare) == ("surface_normals", DEPTH, ALPHA)


def test_time_runs():
    playback = Playback(started=100.0, first=2, frames_per_second=4.0, frame_count=5)
    assert [playback.frame_at(100.0 + 0.25 * step) for step in range(5)] == [2, 3, 4, 0, 1]
    assert playback.frame_at(99.0) == 2  # a clock that was read a moment earlier
    assert not playback.is_over(200.0)
    once = Playback(100.0, 2, 4.0, 5, loops=False)
    assert [once.frame_at(100.0 + 0.25 * step) for step in range(5)] == [2, 3, 4, 4, 4]
    assert not once.is_over(100.4)
    assert once.is_over(100.5)


def test_a_control_shows_what_holds_and_not_what_a_page_asked_for():
    """An environment that is none would fail every page until somebody chose another."""
    from beam_warp.view.viewer import _Controls

    state = ViewState(environment="noon", choices={"environment": ("noon",)})
    control = SimpleNamespace(value="noon")
    control.on_update = lambda heard: setattr(control, "heard", heard)
    controls = object.__new__(_Controls)
    controls._loop, controls._bound = SimpleNamespace(change=state.changed), {}
    controls._bind("environment", control)
    control.value = "no such"
    asyncio.run(control.heard(SimpleNamespace(client=1, target=control)))
    assert control.value == "noon"
