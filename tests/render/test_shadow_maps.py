"""Shadow maps: where views stand, where shadows fall, how wide penumbras are, what is let through, and no acne."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from support.flat_scenes import UP, discs, nothing, plate
from support.kernel_runs import run_kernel
from support.shapes import sphere_points

from beam_warp.device.arrays import resolve_device
from beam_warp.kernels.render.shadow_maps import ShadowMaps, face_towards, visible_share
from beam_warp.raster.sources import upload_gaussians
from beam_warp.render import shadow_maps
from beam_warp.render.shadow_maps import FAR, ROOM, ShadowCasters, ShadowDrawer, disc_taps, distant_view, light_views
from beam_warp.trace.mesh_paths import TracedMesh
from beam_warp.world.lights import DirectionalLight, PointLight, SpotLight

TAPS = (16, 32)


@wp.kernel
def share_kernel(
    maps: ShadowMaps,
    around: int,
    middle: wp.vec3,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    turns: wp.array[wp.vec2],
    out: wp.array[float],
):
    i = wp.tid()
    k = 0
    if around != 0:
        k = face_towards(points[i] - middle)
    out[i] = visible_share(maps, k, points[i], normals[i], turns[i])


def visible(drawer, points, normals, light=None, turned=True):
    """Share of the light of one map, or of six around a light, that reaches points."""
    points, normals = np.broadcast_arrays(np.asarray(points, np.float32), np.asarray(normals, np.float32))
    angles = np.random.default_rng(1).random(len(points)) * 2 * np.pi * turned
    device = drawer.maps.texels.device
    turns = np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32)
    around = len(drawer.cameras) == 6
    middle = wp.vec3(*light.position) if around else wp.vec3()
    inputs = [drawer.maps, int(around), middle, (points, wp.vec3), (normals, wp.vec3), (turns, wp.vec2)]
    return run_kernel(share_kernel, len(points), inputs, [float], device)[0]


def drawn(light, cloud, subject, device, size=128, mesh=None):
    target = resolve_device(device)
    views = light_views(light, subject, size)
    drawer = ShadowDrawer(len(cloud), views, casters=subject, taps=TAPS, device=target)
    traced = None if mesh is None else TracedMesh.from_mesh(mesh.surface, device=device)
    drawer.draw(upload_gaussians(cloud, target), None if traced is None else traced.surface)
    drawer.kept = traced
    return drawer


SUBJECT = ShadowCasters(np.zeros(3), 1.0)
THICK = ShadowCasters(np.zeros(3), 1.0, 0.01)
NOON = DirectionalLight(direction=(0, 0, -1), irradiance=(1, 1, 1))


# ---- where views stand ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("light", "count"),
    [
        (NOON, 1),
        (DirectionalLight(direction=(1, -2, 0.5), irradiance=(1, 1, 1)), 1),
        (PointLight(position=(4, 0, 1), intensity=(1, 1, 1)), 1),
        (PointLight(position=(0.5, 0, 0), intensity=(1, 1, 1)), 6),
        (PointLight(position=(1.1, 0, 0), intensity=(1, 1, 1)), 6),
        (SpotLight(position=(0, 3, 0), direction=(0, -1, 0), intensity=(1, 1, 1), outer_angle=60.0), 1),
        (SpotLight(position=(0, 0, 0), direction=(0, -1, 0), intensity=(1, 1, 1), outer_angle=80.0), 6),
    ],
)
def test_views_see_the_subject(rng, light, count):
    views = light_views(light, SUBJECT, 64)
    assert len(views) == count
    points = rng.normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    pixels = np.stack([view.camera.project(points) for view in views])
    inside = ((pixels[..., :2] >= 0) & (pixels[..., :2] <= 64)).all(-1)  # what is behind has no place: NaN
    assert inside.any(axis=0).all()
    for view, seen, place in zip(views, inside, pixels, strict=True):
        assert (place[seen, 2] >= min(view.front, 0.02) - 1e-9).all()


def test_a_narrow_spot_sees_its_cone():
    light = SpotLight(position=(0, 0, 5), direction=(0, 0.1, -1), intensity=(1, 1, 1), inner_angle=2, outer_angle=5)
    (view,) = light_views(light, SUBJECT, 100)
    assert view.camera.focal_x == pytest.approx(50 / np.tan(np.radians(5.0)))
    np.testing.assert_allclose(view.camera.forward, light.direction, atol=1e-12)


def test_directions_of_a_distant_view_are_nearly_parallel(rng):
    view = distant_view(UP, 0.01, SUBJECT, 64)
    rim = np.array([[1.0, 0, 0], [0, 1, 0]])
    towards = view.camera.position - rim
    angle = np.arctan2(np.linalg.norm(towards[:, :2], axis=1), towards[:, 2])
    assert (angle <= 1.0 / FAR + 1e-9).all()
    assert view.radius / (FAR * SUBJECT.radius) == pytest.approx(np.tan(0.01))


def test_the_subject_is_what_is_there():
    cloud = discs([[0, 0, 0], [2, 0, 0]], UP, 0.01)
    subject = ShadowCasters.of(cloud)
    np.testing.assert_allclose(subject.center, [1, 0, 0])
    assert subject.radius == pytest.approx(1.0)
    assert subject.thickness == pytest.approx(0.01)
    vertices = np.array([[0, 0, 0], [0, 0, 4]], np.float32)
    assert ShadowCasters.of(nothing(), vertices).radius == pytest.approx(2.0)
    assert ShadowCasters.of(nothing()).radius > 0.0
    props = np.array([[1, 1.5, 0], [50, 0, 0]], np.float32)  # one is near
    assert ShadowCasters.of(cloud, props).radius == pytest.approx(1.25)


def test_taps_are_spread_over_the_disc():
    """Vogel's spiral: no tap outside, the mean at the middle, the mean square radius that of an even disc."""
    taps = disc_taps(32)
    radius = np.linalg.norm(taps, axis=1)
    assert radius.max() < 1.0
    assert np.abs(taps.mean(axis=0)).max() < 0.05
    assert (radius**2).mean() == pytest.approx(0.5)


# ---- where shadows fall ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (0.4, 0.2, -1.0)])
def test_the_shadow_of_a_square(device, direction):
    """Triangles under a light without size: lit turns dark within the filter of a texel and a half, and a bias."""
    light = DirectionalLight(direction=direction, irradiance=(1, 1, 1), angular_diameter=0.0)
    drawer = drawn(light, nothing(), SUBJECT, device, mesh=plate(0.5, 0.25))
    x = np.linspace(-0.6, 0.6, 121)
    points = np.stack([x, 0 * x, 0 * x], axis=-1) + 0.5 * np.array([direction[0], direction[1], 0.0])
    share = visible(drawer, points, UP)
    texel = 2.0 * ROOM / 128
    margin = 2.5 * texel / -np.asarray(light.direction)[2] + 1.0 / FAR
    assert (share[np.abs(x) < 0.25 - margin] == 0.0).all()
    assert (share[np.abs(x) > 0.25 + margin] == 1.0).all()


def test_what_is_outside_of_the_map_is_lit(device):
    drawer = drawn(NOON, nothing(), SUBJECT, device, mesh=plate(0.5, 5.0))
    assert visible(drawer, [[0, 0, 0], [3, 0, 0], [0, 0, 1e4]], UP).tolist() == [0.0, 1.0, 1.0]


@pytest.mark.parametrize("diameter", [6.0, 12.0])
def test_the_penumbra_of_an_edge(device, diameter):
    """Behind a straight edge at a height h a point at x sees the part of the disc beyond a line: a circle's
    segment of height 1 + x / (h tan). In the mean over many points with taps turned at random the place where half is
    seen, and the width (the standard deviation of its slope), are found within a texel."""
    light = replace(NOON, angular_diameter=diameter)
    height, size = 0.8, 256
    drawer = drawn(light, nothing(), SUBJECT, device, size=size, mesh=plate(height - 0.4, 2.0, -2.0))
    x = np.linspace(-0.25, 0.25, 201)
    points = np.stack([x, 0 * x, 0 * x - 0.4], axis=-1)
    rows = points + np.linspace(-0.3, 0.3, 25)[:, None, None] * np.array([0.0, 1.0, 0.0])
    share = visible(drawer, rows.reshape(-1, 3), UP).reshape(25, -1).mean(axis=0)
    radius = height * np.tan(np.radians(diameter / 2))
    s = np.clip(x / radius, -1.0, 1.0)
    expected = 0.5 + (s * np.sqrt(1 - s**2) + np.arcsin(s)) / np.pi

    def moments(profile):
        slope = np.maximum(np.diff(profile), 0.0)
        middle = 0.5 * (x[1:] + x[:-1])
        mean = (slope * middle).sum() / slope.sum()
        return mean, np.sqrt((slope * (middle - mean) ** 2).sum() / slope.sum())

    texel = 2.0 * ROOM / size
    found, wanted = moments(share), moments(expected)
    assert abs(found[0] - wanted[0]) < texel
    assert abs(found[1] - wanted[1]) < texel
    assert share[0] < 0.02
    assert share[-1] == 1.0


def test_a_point_light_inside_sees_all_around(device):
    """Six small squares around it darken what is behind them, and nothing else; faces meet without seams."""
    light = PointLight(position=(0.1, 0.0, -0.1), intensity=(1, 1, 1))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    cloud = discs(np.asarray(light.position) + 0.4 * axes, axes, 0.05)
    drawer = drawn(light, cloud, ShadowCasters(np.zeros(3), 1.0, 0.002), device)
    assert len(drawer.cameras) == 6
    behind = np.asarray(light.position) + 0.9 * axes
    assert visible(drawer, behind, -axes, light).max() < 0.02
    diagonal = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3.0)
    edges = np.array([[1, 1, 0], [1, -1, 0], [-1, 0, 1], [0, 1, -1.0]]) / np.sqrt(2.0)
    for directions in (diagonal, edges):
        assert (visible(drawer, np.asarray(light.position) + 0.9 * directions, -directions, light) == 1.0).all()


# ---- how much is let through ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("opacity", [0.3, 0.5, 0.8])
def test_a_translucent_layer_lets_the_rest_through(device, opacity):
    """One flat Gaussian of 0.3 m: under its middle, within two texels of 0.017 m, its response is above 1 - 0.013."""
    drawer = drawn(NOON, discs([[0, 0, 0.5]], UP, 0.3, opacity=opacity), THICK, device)
    assert visible(drawer, [[0, 0, -0.5]], UP)[0] == pytest.approx(1.0 - opacity, abs=0.015 * opacity)
    assert visible(drawer, [[0, 0, 0.8]], UP)[0] == 1.0


def test_two_layers_of_gaussians(device):
    """Where a layer of more than half is before another, the nearer one's share is told from both depths."""
    cloud = discs([[0, 0, 0.5], [0, 0, -0.5]], UP, 0.3).with_arrays(opacities=[0.7, 0.99])
    drawer = drawn(NOON, cloud, THICK, device)
    assert visible(drawer, [[0, 0, -0.5]], UP)[0] == pytest.approx(0.3, abs=0.03)


def test_a_layer_does_not_shadow_itself(device, rng):
    """A ball of discs, each with a depth of its own, in the light: what faces it by more than 17 degrees is lit."""
    count = 16000
    normals = sphere_points(count)[0]
    positions = 0.8 * normals + rng.normal(size=(count, 1)) * 0.001 * normals
    cloud = discs(positions, normals, 0.0225)  # 6 on top of each other
    for diameter in (0.0, 0.53, 40.0):
        light = DirectionalLight(direction=(0.3, 0.2, -1), irradiance=(1, 1, 1), angular_diameter=diameter)
        drawer = drawn(light, cloud, ShadowCasters.of(cloud), device, size=256)
        cosine = normals @ -np.asarray(light.direction)
        share = visible(drawer, positions, normals)
        assert share[cosine > 0.3].min() > 0.98
        if diameter < 1.0:  # a filter wider than the ball looks past it
            assert share[cosine < -0.3].max() < 0.02


def test_a_plane_of_triangles_does_not_shadow_itself(device):
    """The tangent plane at a texel is the plane itself, for any slope and any kernel."""
    x = np.linspace(-0.5, 0.5, 33)
    points = np.stack([*np.meshgrid(x, x), np.zeros((33, 33))], axis=-1).reshape(-1, 3)
    for elevation in (90.0, 45.0, 12.0):
        direction = (-np.cos(np.radians(elevation)), 0.1, -np.sin(np.radians(elevation)))
        light = DirectionalLight(direction=direction, irradiance=(1, 1, 1), angular_diameter=20.0)
        drawer = drawn(light, nothing(), SUBJECT, device, mesh=plate())
        assert visible(drawer, points, UP).min() > 0.98


# ---- again and again ------------------------------------------------------------------------------------------------


def test_redraw_and_move_are_draw(device):
    """Redrawing gives the same bits; so does moving to a light and back."""
    cloud = discs([[0, 0, 0.5]], UP, 0.3, opacity=0.7)
    drawer = drawn(NOON, cloud, THICK, device)
    first = drawer.maps.texels.numpy().copy()
    drawer.redraw()
    np.testing.assert_array_equal(drawer.maps.texels.numpy(), first)
    for light, is_first in ((replace(NOON, direction=(1, 0, -1)), False), (NOON, True)):
        drawer.move(light_views(light, THICK, 128), THICK)
        drawer.redraw()
        assert np.array_equal(drawer.maps.texels.numpy(), first) == is_first


def test_maps_in_groups_are_the_same_maps(device, monkeypatch):
    """Views that are drawn one after the other, into the same images, make the same texels."""
    light = PointLight(position=(0.1, 0.0, -0.1), intensity=(1, 1, 1))
    cloud = discs(0.5 * np.eye(3), np.eye(3), 0.1)
    subject = ShadowCasters(np.zeros(3), 1.0, 0.002)
    whole = drawn(light, cloud, subject, device, mesh=plate(-0.5, 0.5))
    monkeypatch.setattr(shadow_maps, "GROUP_SPLATS", 13)
    grouped = drawn(light, cloud, subject, device, mesh=plate(-0.5, 0.5))
    assert len(grouped.pair_capacities) == 2
    np.testing.assert_array_equal(grouped.maps.texels.numpy(), whole.maps.texels.numpy())
    grouped.redraw()
    np.testing.assert_array_equal(grouped.maps.texels.numpy(), whole.maps.texels.numpy())
