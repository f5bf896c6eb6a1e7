"""Cameras, lamps and shadow maps that the package makes of Unity's for shaders are those of the deferred renderer."""

import subprocess

import numpy as np
import pytest
from engines.unity.csharp import HERE, MONO, PACKAGE, compiled, needs_mono

from beam_warp.light.regions import EnvironmentRegions
from beam_warp.light.uploaded import upload_lights
from beam_warp.render.shadow_maps import LARGEST_KERNEL, ShadowCasters, distant_view, light_views
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.lights import DirectionalLight, PointLight, SpotLight

pytestmark = [needs_mono, pytest.mark.slow]

SWAP = np.eye(4)[[0, 2, 1, 3]]
"""The way from the renderer's world, x right, y forward, z up, to Unity's, x right, y up, z forward, and back."""

CASTERS = ShadowCasters(np.array([0.2, 0.3, 0.9]), 1.1, 0.01)
LIGHTS = [
    DirectionalLight(direction=(0.48, 0.6, -0.64), irradiance=(2.0, 1.8, 1.5), angular_diameter=4.0),
    PointLight(position=(0.5, -0.4, 1.2), intensity=(1.0, 2.0, 3.0), radius=0.05),  # inside: six maps
    PointLight(position=(3.0, -4.0, 2.0), intensity=(1.0, 2.0, 3.0), radius=0.1),
    SpotLight(
        position=(2.0, -2.0, 3.0),
        direction=(-0.48, 0.6, -0.64),
        intensity=(4.0, 5.0, 6.0),
        inner_angle=10.0,
        outer_angle=25.0,
    ),
]
KINDS = {SpotLight: 0, DirectionalLight: 1, PointLight: 2}
"""Unity's types of lights."""


@pytest.fixture(scope="module")
def adapter(tmp_path_factory):
    program = tmp_path_factory.mktemp("adapter") / "adapter.exe"
    runtime = sorted((PACKAGE / "Runtime").rglob("*.cs"))
    said = compiled([HERE / "Adapter.cs", *sorted((HERE / "stubs").glob("*.cs")), *runtime], program)
    assert not said, said

    def ask(*lines):
        text = "\n".join(
            " ".join([word, *(f"{float(n)!r}" for n in np.concatenate([np.ravel(v) for v in values]))])
            for word, *values in lines
        )
        done = subprocess.run([MONO, program], input=text, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return [np.array(line.split(), float).reshape(-1, 4) for line in done.stdout.splitlines()]

    return ask


def test_an_eye_is_the_camera_with_rows_from_below(adapter):
    camera = Camera.look_at((1.0, -3.0, 1.6), (0.1, 0.2, 0.8), width=320, height=240, vertical_fov=40.0)
    pose = SWAP @ camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # Unity's camera: right, up, back
    projection = np.zeros((4, 4))
    near, far = 0.1, 50.0
    projection[0, 0], projection[1, 1] = 2.0 * camera.focal_x / 320, 2.0 * camera.focal_y / 240
    projection[0, 2], projection[1, 2] = 0.1, -0.2  # an eye of a headset
    projection[2, 2:] = (far + near) / (near - far), 2.0 * far * near / (near - far)
    projection[3, 2] = -1.0
    position, right, down, forward, lens, depths = adapter(("camera", np.linalg.inv(pose), projection, 320, 240))[0]
    wanted = camera.camera_to_world[:3]
    np.testing.assert_allclose([position[:3], right[:3], forward[:3]], wanted[:, [3, 0, 2]].T, atol=1e-6)
    np.testing.assert_allclose(down[:3], -wanted[:, 1], atol=1e-6)
    # a point, by Unity's own matrices and by the package's
    point = camera.position + 2.0 * camera.forward + 0.3 * wanted[:, 0] - 0.2 * wanted[:, 1]
    x, y, _, w = projection @ np.linalg.inv(pose) @ SWAP @ [*point, 1.0]
    away = point - position[:3]
    depth = away @ forward[:3]
    place = lens[:2] * [away @ right[:3], away @ down[:3]] / depth + lens[2:]
    np.testing.assert_allclose(place, [160.0 * (1.0 + x / w), 120.0 * (1.0 + y / w)], rtol=1e-5)
    stored = (depths[1] - depths[0] * depth) / (depths[3] - depths[2] * depth)
    np.testing.assert_allclose(stored, near * (far - depth) / (depth * (far - near)), rtol=1e-4)


def test_an_object_turns_its_take_into_the_world(adapter):
    """A container's x, y, z are right, up and back; Unity's are right, up, forward."""
    place = np.array(
        [[0, 0, 2, 5], [0, 2, 0, 6], [-2, 0, 0, 7], [0, 0, 0, 1]]
    )  # a quarter turn about up, twice the size
    found = adapter(("object", place), ("sphere", 0, 0, 0, 1))[0].T
    point = np.array([1.0, 2.0, 3.0, 1.0])
    np.testing.assert_allclose(found @ point, SWAP @ place @ [1.0, 2.0, -3.0, 1.0])
    assert np.linalg.det(found[:3, :3]) > 0.0


def test_lamps_and_their_maps_are_those_of_the_renderer(adapter):
    lines = []
    for light in LIGHTS:
        place = SWAP[:3, :3] @ getattr(light, "position", (0.0, 0.0, 0.0))
        way = SWAP[:3, :3] @ getattr(light, "direction", (0.0, 0.0, -1.0))
        power = light.irradiance if isinstance(light, DirectionalLight) else light.intensity
        size = light.angular_diameter if isinstance(light, DirectionalLight) else light.radius
        cone = [2.0 * getattr(light, "inner_angle", 20.0), 2.0 * getattr(light, "outer_angle", 30.0)]
        lines.append(("light", KINDS[type(light)], place, way, power, size, cone))
    lamps, rows = adapter(("sphere", CASTERS.center, CASTERS.radius), *lines)
    uploaded = upload_lights(LIGHTS, "cpu")
    views = [light_views(light, CASTERS, 256) for light in LIGHTS]
    lamps = lamps.reshape(-1, 16)
    distant = uploaded.kinds.numpy() == 0
    np.testing.assert_allclose(lamps[:, 3], uploaded.kinds.numpy())
    np.testing.assert_allclose(lamps[~distant, :3], uploaded.positions.numpy()[~distant], rtol=1e-6)
    np.testing.assert_allclose(lamps[:, 7], uploaded.sizes.numpy(), rtol=1e-5)
    np.testing.assert_allclose(lamps[:, 8:11], uploaded.powers.numpy(), rtol=1e-6)
    np.testing.assert_allclose(lamps[3, 4:7], LIGHTS[3].direction, rtol=1e-5)
    np.testing.assert_allclose(lamps[0, 4:7], LIGHTS[0].direction, rtol=1e-5)
    np.testing.assert_allclose(lamps[3, 12:14], uploaded.cones.numpy()[3], rtol=1e-5)
    np.testing.assert_array_equal(lamps[:, 14], [len(each) for each in views])
    np.testing.assert_array_equal(lamps[:, 11], np.cumsum([0, *(len(each) for each in views[:-1])]))
    are_maps_of(rows, [view for each in views for view in each])


def are_maps_of(rows, views):
    for found, view in zip(rows.reshape(-1, 24), views, strict=True):
        camera, pose = view.camera, view.camera.camera_to_world
        lens = [camera.focal_x, camera.focal_y, camera.center_x, camera.center_y]
        axes = [*pose[:3, 0], view.front, *pose[:3, 1], CASTERS.thickness, *pose[:3, 2], LARGEST_KERNEL * 256]
        wanted = [*camera.position, view.radius, *axes, *lens, 256, 256, 0, 0]
        np.testing.assert_allclose(found, wanted, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize(("count", "most"), [(16, 256), (5, 256), (4, 8)])
def test_regions_of_environments_and_their_maps_are_those_of_the_renderer(adapter, count, most):
    """A map is black below, or has more rows than are cut."""
    radiance = np.random.default_rng(3).gamma(0.2, size=(16, 32, 3)).astype(np.float32)
    radiance[10:] = 0.0
    light = EnvironmentMap(radiance)
    cut = light if most > 16 else light.resized(most, 2 * most)
    wanted = EnvironmentRegions.of(cut, count).turned(40.0)
    line = ("environment", 16, count, most, np.radians(40.0), radiance)
    discs, moments, rows = adapter(("sphere", CASTERS.center, CASTERS.radius), line)[:3]
    np.testing.assert_allclose(discs[:, :3], wanted.directions, atol=1e-6)
    np.testing.assert_allclose(discs[:, 3], wanted.half_angles, atol=1e-5)
    np.testing.assert_allclose(moments.reshape(-1, 3, 4).transpose(1, 0, 2), wanted.moments, rtol=1e-5, atol=1e-5)
    pairs = zip(wanted.directions, wanted.half_angles, strict=True)
    are_maps_of(rows, [distant_view(way, float(half), CASTERS, 256) for way, half in pairs])
