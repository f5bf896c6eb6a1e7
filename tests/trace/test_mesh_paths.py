"""The path tracer that makes the demo's truth: furnace, closed forms of visibility, light from the right side."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from support.shapes import unit

from beam_warp.trace.mesh_paths import TracedMesh, outgoing_radiance, trace_channels, trace_radiance
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.mesh import MaterialMesh

UNIFORM = EnvironmentMap.constant((1.0, 1.0, 1.0))


def one_material(vertices, faces, normals, base_color=0.5, roughness=0.5):
    colors, roughnesses = np.full((len(vertices), 3), base_color), np.full(len(vertices), roughness)
    return MaterialMesh(vertices=vertices, faces=faces, normals=normals, base_color=colors, roughness=roughnesses)


def material_mesh(mesh, *material):
    return one_material(mesh.vertices, mesh.faces, mesh.vertex_normals, *material)


def ball(radius=1.0, center=(0.0, 0.0, 0.0), subdivisions=4):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    mesh.apply_translation(center)
    return mesh


def bowl(*material, rings=48):
    """Half of a sphere, open towards -y, with normals inwards."""
    theta = np.linspace(0.0, np.pi / 2.0, rings + 1)
    phi = np.linspace(0.0, 2.0 * np.pi, 2 * rings, endpoint=False)
    tt, pp = np.meshgrid(theta, phi, indexing="ij")
    points = np.stack([np.sin(tt) * np.cos(pp), np.cos(tt), np.sin(tt) * np.sin(pp)], axis=-1).reshape(-1, 3)
    columns = len(phi)
    i, j = np.meshgrid(np.arange(rings), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    corners = points[faces]
    outward = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * corners.mean(1)).sum(1) > 0.0
    faces[outward] = faces[outward][:, ::-1]
    return one_material(points, faces, -points, *material)


def camera(width=24):
    return Camera.look_at((0.0, -4.0, 0.0), (0.0, 0.0, 0.0), width=width, height=width, vertical_fov=25.0)


@pytest.mark.parametrize("roughness", [0.3, 0.7, 1.0])
def test_white_furnace(device, roughness):
    """A convex white body under uniform light sends back what arrives: base colour 1, albedo scaling."""
    traced = TracedMesh.from_mesh(material_mesh(ball(), 1.0, roughness), device=device)
    image = trace_radiance(traced, camera(), UNIFORM, sample_count=256)
    solid = image.alpha > 0.999
    # Monte Carlo noise of 256 paths on some 300 pixels; facets of 2 degrees shadow a little at grazing
    assert image.rgb[solid].mean() == pytest.approx(1.0, abs=0.01)
    assert image.rgb[solid].max() < 1.3


def test_furnace_never_gains_energy_inside_concavities(device):
    traced = TracedMesh.from_mesh(bowl(1.0, 1.0), device=device)
    image = trace_radiance(traced, camera(), UNIFORM, sample_count=64, bounce_count=40)
    inside = image.alpha > 0.999
    assert inside.any()
    assert image.rgb[inside].mean() == pytest.approx(1.0, abs=0.02)


def test_channels_do_not_mix(device, rng):
    """Where red, green and blue of a bowl change places they do so in its image, bounces included."""
    white = bowl(rings=12)
    colors, images = rng.random((len(white.vertices), 3)), []
    for order in ([0, 1, 2], [1, 2, 0]):
        traced = TracedMesh.from_mesh(replace(white, base_color=colors[:, order]), device=device)
        images.append(trace_radiance(traced, camera(8), UNIFORM, sample_count=4, bounce_count=3).rgb)
    # the same paths: only sums over channels are rounded otherwise
    np.testing.assert_allclose(images[1], images[0][..., [1, 2, 0]], rtol=1e-4)


def test_bowl_sees_half_of_the_sky(device):
    channels = trace_channels(
        TracedMesh.from_mesh(bowl(), device=device), camera(), sample_count=4, visibility_count=64
    )
    inside = channels.ambient_occlusion > 0.0
    assert channels.ambient_occlusion[inside].mean() == pytest.approx(0.5, abs=0.01)


def test_floor_under_a_resting_ball(device):
    """1 - (R / sqrt(x^2 + R^2))^3 at distance x from the contact point."""
    radius = 0.5
    floor = trimesh.creation.box((8.0, 8.0, 0.02))
    floor.apply_translation((0.0, 0.0, -0.01))
    scene = trimesh.util.concatenate([floor, ball(radius, (0.0, 0.0, radius), 5)])
    faces = np.arange(3 * len(scene.faces)).reshape(-1, 3)
    mesh = one_material(scene.triangles.reshape(-1, 3), faces, np.repeat(scene.face_normals, 3, axis=0))
    view = Camera.look_at((1.5, 0.0, 6.0), (1.5, 0.0, 0.0), up=(0, 1, 0), width=32, height=16, vertical_fov=10.0)
    channels = trace_channels(TracedMesh.from_mesh(mesh, device=device), view, sample_count=4, visibility_count=256)
    hits = view.position + view.directions() * (channels.depth / (view.directions() @ view.forward))[..., None]
    floor_pixels = (channels.normals[..., 2] > 0.999) & (np.abs(hits[..., 2]) < 1e-3)
    x = np.linalg.norm(hits[..., :2], axis=-1)[floor_pixels]
    truth = 1.0 - (radius / np.sqrt(x**2 + radius**2)) ** 3
    found = channels.ambient_occlusion[floor_pixels]
    # 1,024 rays a pixel: a standard error of at most 0.5 / 32, in the mean over pixels far less
    assert len(x) > 100
    assert np.abs(found - truth).max() < 5 * 0.5 / 32
    assert abs((found - truth).mean()) < 3 * 0.5 / 32 / np.sqrt(len(x)) + 1e-3


def test_light_comes_from_the_side_it_stands_on(device):
    radiance = np.zeros((16, 32, 3), np.float32)
    radiance[8, 16] = 100.0  # just right of the image's centre: +x, a little towards -y
    traced = TracedMesh.from_mesh(material_mesh(ball()), device=device)
    image = trace_radiance(traced, camera(48), EnvironmentMap(radiance), sample_count=64)
    # the camera looks along +y, so +x is on the right
    assert image.rgb[:, 30:].sum() > 20.0 * image.rgb[:, :18].sum()


def test_outgoing_radiance_is_what_a_camera_sees(device):
    mesh = material_mesh(ball(subdivisions=3), 0.6, 0.8)
    traced = TracedMesh.from_mesh(mesh, device=device)
    faces = np.arange(0, len(mesh.faces), 40)
    weights = np.full((len(faces), 3), 1.0 / 3.0)
    normals = unit(mesh.interpolate(mesh.normals, faces, weights))
    light = EnvironmentMap.constant((1.0, 2.0, 0.5))
    out = outgoing_radiance(traced, faces, weights, normals[:, None], light, sample_count=256)
    # open diffuse surface: (1 - E) rho + E with E near 0.04, in proportion to the light
    expected = (0.96 * 0.6 + 0.04) * np.array([1.0, 2.0, 0.5])
    assert out.mean(axis=(0, 1)) == pytest.approx(expected, rel=0.02)


def test_same_seed_same_bits(device):
    traced = TracedMesh.from_mesh(material_mesh(ball(subdivisions=2)), device=device)
    one, again, other = (trace_radiance(traced, camera(), UNIFORM, sample_count=4, seed=s).rgb for s in (1, 1, 2))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)
