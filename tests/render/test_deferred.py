"""The deferred renderer: closed forms of light on planes, furnace, turning, bounces, meshes, hazards, and frames again.

Scenes are flat Gaussians so large that a pixel sees a plane; environments have 8 to 32 rows. Environments that several
tests take are module constants: each is prepared once for a device, which takes longer than most images.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.figure_asset import figure_asset
from support.flat_scenes import UP, brdf_twin, discs, mesh_of, nothing, plate
from support.shapes import sphere_points
from support.split_sum import shade

from beam_warp.errors import InvalidOptionError
from beam_warp.light.ggx import specular_albedo
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap, texel_directions
from beam_warp.world.lights import DirectionalLight, PointLight, SpotLight
from beam_warp.world.shot import Shot

PLAIN = DeferredOptions(environment_shadows=0, bounces=0, light_map_size=128)
SMALL = DeferredOptions(environment_shadows=4, bounces=2, light_map_size=128, environment_map_size=64)
FLOAT32 = float(np.finfo(np.float32).eps)


def even_but(radiance, place, value, height=16):
    """An even environment with other radiance at some texels."""
    texels = np.full((height, 2 * height, 3), radiance, np.float32)
    texels[place] = value
    return EnvironmentMap(texels)


BLACK, WHITE, FURNACE = (EnvironmentMap.constant(color) for color in ((0, 0, 0), (1, 1, 1), (1.0, 0.5, 2.0)))
WALL_OF_LIGHT = even_but(0.02, np.s_[:8, 4:12], (1.0, 0.7, 0.5))
FIREFLY = even_but(0.1, np.s_[3, 5], 5e4)
SKY, OTHER_SKY = (
    EnvironmentMap((np.random.default_rng(seed).random((8, 16, 3)) ** 4).astype(np.float32)) for seed in (1, 2)
)
LOW_SUN = even_but(0.0, np.s_[82:84, 89:91], (400.0, 300.0, 200.0), height=180)  # at azimuth 90 degrees, 7 high
SUN = DirectionalLight(direction=(0, 0, -1), irradiance=(1, 1, 1), angular_diameter=0.0)


def floor(**material):
    """A plane z = 0, one Gaussian."""
    return discs([0.0, 0.0, 0.0], UP, 50.0, **material)


def camera(eye=(0.0, -2.0, 2.0), target=(0.0, 0.0, 0.0), size=9, fov=10.0):
    up = (0, 0, 1) if abs(eye[0] - target[0]) + abs(eye[1] - target[1]) > 1e-6 else (0, 1, 0)
    return Camera.look_at(eye, target, up=up, width=size, height=size, vertical_fov=fov)


def middle(image):
    """Colour of the pixel in the middle, not multiplied by alpha."""
    row, column = (n // 2 for n in image.alpha.shape)
    return image.rgb[row, column] / image.alpha[row, column]


prepared = cache(PreparedEnvironment)


def render(shot, device, options=PLAIN, raster=None):
    """Draw with a new renderer; the environment alone is prepared before."""
    light = [prepared(shot.environment, device)] if shot.environment else []
    return DeferredRenderer(options, raster=raster, device=device, prepared=light).draw(shot)


@pytest.fixture(scope="module")
def figure():
    """Two frames of the demo figure. Read only."""
    return list(figure_asset(frame_count=2))


def figure_camera(cloud, size=(20, 30), azimuth=30.0):
    """A view whose pixels are not square."""
    camera = Camera.frame_cloud(cloud.positions, azimuth=azimuth, width=size[0], height=size[1])
    return replace(camera, focal_x=0.9 * camera.focal_y)


# ---- lights on a plane: closed forms --------------------------------------------------------------------------------


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (1.0, 0.3, -0.7)])
def test_a_plane_in_the_sun(device, roughness, direction):
    """E cos (rho (1 - E_spec) / pi + f_s). Bilinear lookup of E_spec errs by 2e-4 of its values of up to 0.1, as tested
    with its table; the rest is some hundred roundings."""
    color = np.array([0.9, 0.5, 0.2])
    light = DirectionalLight(direction=direction, irradiance=(3.0, 2.0, 1.0), angular_diameter=0.0)
    eye = np.array([0.0, -2.0, 2.0])
    plane = floor(color=color, roughness=roughness)
    found = middle(render(Shot(cloud=plane, camera=camera(eye), lights=(light,)), device))
    view, to_light = eye / np.linalg.norm(eye), -np.asarray(light.direction)
    diffuse = color * (1.0 - specular_albedo(view[2], roughness)) / np.pi
    expected = np.array([3.0, 2.0, 1.0]) * to_light[2] * (diffuse + brdf_twin(UP, view, to_light, roughness))
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_a_point_light_falls_with_the_square(device):
    """White and rough, seen from above: intensity cos / r^2 (1 - E_spec) / pi + f_s at three places of the plane."""
    light = PointLight(position=(0.0, 0.0, 1.5), intensity=(2.0, 2.0, 2.0), casts_shadows=False)
    for x in (0.0, 1.0, 3.0):
        eye = np.array([x, 0.0, 4.0])
        shot = Shot(cloud=floor(), camera=camera(eye, (x, 0.0, 0.0)), lights=(light,))
        away = np.array([-x, 0.0, 1.5])
        cosine, squared = 1.5 / np.linalg.norm(away), away @ away
        scattered = (1.0 - specular_albedo(1.0, 1.0)) / np.pi + brdf_twin(UP, UP, away, 1.0)
        assert middle(render(shot, device))[1] == pytest.approx(2.0 * cosine / squared * scattered, rel=1e-3)


def test_a_spot_fades_from_its_inner_to_its_outer_angle(device):
    """Light fades by 3 x^2 - 2 x^3, x the place of the cosine between those of both angles, on a white, rough floor."""
    light = SpotLight(position=(0, 0, 2), direction=(0, 0, -1), intensity=(2, 2, 2), inner_angle=10.0, outer_angle=20.0)
    outer, inner = np.cos(np.radians([20.0, 10.0]))
    scattered = (1.0 - specular_albedo(1.0, 1.0)) / np.pi
    for angle in (8.0, 12.0, 15.0, 18.0, 24.0):
        at = 2.0 * np.tan(np.radians(angle))
        shot = Shot(cloud=floor(), camera=camera((at, 0, 4.0), (at, 0, 0), fov=0.1), lights=(light,))
        away = np.array([-at, 0.0, 2.0])
        cosine = 2.0 / np.linalg.norm(away)
        x = np.clip((cosine - outer) / (inner - outer), 0.0, 1.0)
        shed = 2.0 * cosine / (away @ away) * (3.0 * x**2 - 2.0 * x**3)
        found = middle(render(shot, device))[1]
        # E_spec from its table, as in the sun
        assert found == pytest.approx(shed * (scattered + brdf_twin(UP, UP, away, 1.0)), rel=1e-3, abs=1e-7)


@pytest.mark.parametrize(("roughness", "diameter", "most"), [(1.0, 20.0, 0.02), (0.5, 10.0, 0.03), (0.25, 0.53, 0.02)])
def test_a_wide_light_in_a_glossy_plane(device, roughness, diameter, most):
    """Against the sum over 4000 directions of the disc, at the mirror direction and away from it, black below. The
    widened lobe is a model: what it is off by is stated, as a share of the highlight."""
    half = np.radians(diameter / 2)
    k = np.arange(4000) + 0.5
    height, phi = 1.0 - (1.0 - np.cos(half)) * k / 4000, k * np.pi * (3.0 - 5.0**0.5)
    cone = np.stack([np.sqrt(1 - height**2) * np.cos(phi), np.sqrt(1 - height**2) * np.sin(phi), height], axis=-1)
    eye = np.array([0.0, -1.0, 1.0])
    view = eye / np.linalg.norm(eye)
    errors, values = [], []
    for tilt in (0.0, 10.0, 25.0):
        angle = np.radians(45.0 - tilt)
        to_light = np.array([0.0, np.sin(angle), np.cos(angle)])
        light = DirectionalLight(direction=tuple(-to_light), irradiance=(1, 1, 1), angular_diameter=diameter)
        shot = Shot(cloud=floor(color=0.0, roughness=roughness), camera=camera(eye), lights=(light,))
        side = np.array([1.0, 0.0, 0.0])
        directions = cone @ np.stack([side, np.cross(to_light, side), to_light])
        scattered = brdf_twin(UP, view, directions, roughness) * directions[:, 2]
        expected = scattered.sum() / height.sum()  # even radiance whose irradiance on a plane that faces it is 1
        errors.append(abs(middle(render(shot, device))[0] - expected))
        values.append(expected)
    assert max(errors) < most * max(values)


@pytest.mark.parametrize(("roughness", "most"), [(0.3, 0.08), (0.6, 0.02)])
def test_a_low_sun_of_an_environment_in_a_glossy_plane(device, roughness, most):
    """Sum over texels of L cos (rho (1 - E_spec) / pi + f_s), float64: a sun of 2 degrees, 7 above a plane that is seen
    from 15 above it. Round lobes show it through the gaps between them: half of it, or a sixth too much; a lobe that is
    widened by a disc is not stretched as it grazes.
    """
    environment, color = LOW_SUN, np.array([0.9, 0.5, 0.2])
    eye = 2.0 * np.array([0.0, -np.cos(np.radians(15.0)), np.sin(np.radians(15.0))])
    shot = Shot(cloud=floor(color=color, roughness=roughness), camera=camera(eye, fov=1.0), environment=environment)
    view, expected = eye / np.linalg.norm(eye), np.zeros(3)
    directions, angles = environment.directions(), environment.solid_angles()
    for row, column in np.argwhere(environment.radiance[..., 0] > 0.0):
        way = directions[row, column]
        diffuse = color * (1.0 - specular_albedo(view[2], roughness)) / np.pi
        scattered = diffuse + brdf_twin(UP, view, way, roughness)
        expected += environment.radiance[row, column] * way[2] * angles[row, column] * scattered
    found = middle(render(shot, device, SMALL))
    np.testing.assert_allclose(found, expected, rtol=most)
    turned = replace(shot, environment=environment.rotated(-90.0), environment_rotation=90.0)
    np.testing.assert_allclose(middle(render(turned, device, SMALL)), found, rtol=1e-4)
    assert (np.abs(middle(render(shot, device)) / expected - 1.0) > 0.12).all()  # what the split sum alone makes of it


def test_shadows_of_gaussians_on_gaussians(device):
    """A disc 1 m above the floor: dark below, lit beside, and partly lit if it is translucent."""
    for opacity, most in ((1.0, 0.05), (0.8, 0.25)):
        cloud = discs([[0, 0, 0], [0, 0, 1]], UP, 1.0)
        cloud = cloud.with_arrays(scales=[[3.0, 3.0, 0.0], [0.2, 0.2, 0.0]], opacities=[1.0, opacity])

        def seen_at(x, light, options, cloud=cloud):
            shot = Shot(cloud=cloud, camera=camera((x, -3.0, 0.8), (x, 0, 0)), lights=(light,))
            return middle(render(shot, device, options))[0]

        free = seen_at(0.0, replace(SUN, casts_shadows=False), replace(SMALL, bounces=0))
        assert seen_at(0.0, SUN, SMALL) < most * free
        assert seen_at(1.5, SUN, SMALL) > 0.9 * free


# ---- the environment ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0.0, 180.0])
def test_without_shadows_it_is_the_split_sum(device, figure, degrees):
    """Pixel by pixel of the G-buffer, to rounding: sums of some fifty float32 terms. Half a turn of the light is half a
    turn of normals and views, which changes signs."""
    cloud = figure[0]
    view = figure_camera(cloud)
    found = render(Shot(cloud=cloud, camera=view, environment=SKY, environment_rotation=degrees), device)
    buffer = rasterize(cloud, view, device=device)
    turn = 1.0 if degrees == 0.0 else np.array([-1.0, -1.0, 1.0])
    surface = buffer.channels | {"normals": turn * buffer.channels["normals"], "alpha": buffer.alpha}
    expected = shade(prepared(SKY, device), **surface, view_directions=turn * view.directions())
    np.testing.assert_allclose(found.rgb, expected, rtol=200 * FLOAT32, atol=200 * FLOAT32 * expected.max())


@pytest.mark.parametrize("options", [PLAIN, SMALL])
def test_turning_the_light_is_turning_everything_else_back(device, figure, options):
    """Any angle. Without shadows up to rounding; with them maps see the subject at another angle and their texels fall
    elsewhere: what differs is small against what turning the light changes."""
    cloud, light, degrees = figure[0], WALL_OF_LIGHT, 40.0
    angle = -np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    q = np.array([0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)])
    x, y, z, w = cloud.orientations.T
    turned_q = np.stack([q[3] * x - q[2] * y, q[3] * y + q[2] * x, q[3] * z + q[2] * w, q[3] * w - q[2] * z], axis=-1)
    turned = {"positions": cloud.positions @ turn.T, "normals": cloud.normals @ turn.T, "orientations": turned_q}
    back = cloud.with_arrays(**{name: array.astype(np.float32) for name, array in turned.items()})
    view = figure_camera(cloud)
    pose = np.eye(4)
    pose[:3, :3] = turn
    moved = replace(view, camera_to_world=pose @ view.camera_to_world)
    one = render(Shot(cloud=cloud, camera=view, environment=light, environment_rotation=degrees), device, options)
    two = render(Shot(cloud=back, camera=moved, environment=light), device, options)
    three = render(Shot(cloud=cloud, camera=view, environment=light), device, options)
    difference = np.abs(one.rgb - two.rgb).mean()
    assert difference < (1e-3 if options is PLAIN else 0.05) * np.abs(one.rgb - three.rgb).mean()


@pytest.mark.parametrize("roughness", [0.0, 0.03, 0.5, 1.0])
@pytest.mark.parametrize("options", [PLAIN, SMALL], ids=["plain", "shadows"])
def test_white_furnace(device, roughness, options):
    """A white open plane under even light shows it, at every angle and roughness, within 1 %."""
    for eye in ((0.0, -0.1, 2.0), (0.0, -2.0, 1.0), (0.0, -2.0, 0.25)):
        shot = Shot(cloud=floor(roughness=roughness), camera=camera(eye), environment=FURNACE)
        np.testing.assert_allclose(middle(render(shot, device, options)), [1.0, 0.5, 2.0], rtol=0.01)


def test_a_convex_body_is_open(device):
    """Under any light a ball of rough white discs is as bright as without shadows, within 2 %: none falls on itself."""
    normals = sphere_points(3000)[0]
    cloud = discs(normals, normals, 0.06)
    radiance = 1.0 + texel_directions(16, 32) @ [0.5, -0.3, 0.4]
    light = EnvironmentMap(radiance[..., None] * np.ones(3))
    shot = Shot(cloud=cloud, camera=figure_camera(cloud, (24, 24)), environment=light)
    one, two = (render(shot, device, options) for options in (PLAIN, replace(SMALL, environment_map_size=128)))
    core = one.alpha > 0.999
    assert core.sum() > 100
    assert np.abs(two.rgb[core] / one.rgb[core] - 1.0).mean() < 0.02


def test_a_roof_darkens_what_is_below(device):
    """A floor under a roof that hides all of a sky that comes from above is dark; ambient occlusion says nothing."""
    light = even_but(1e-6, np.s_[:2], 50.0, height=32)
    seen = []
    for places in ([[0, 0, 0]], [[0, 0, 0], [0, 0, 0.4]]):
        shot = Shot(cloud=discs(places, UP, 0.5), camera=camera((0.0, -3.0, 0.3)), environment=light)
        seen.append(middle(render(shot, device, replace(SMALL, bounces=0)))[0])
    assert seen[1] < 0.15 * seen[0]


def test_bounces_in_a_closed_room(device):
    """Discs on a sphere that look inward see nothing but each other in 1 - V of their hemisphere: after b bounces what
    arrives is pi V sum_k ((1 - V) R)^k, k to b. All clusters send alike, so that the mean over them is exact; the
    specular lobe's albedo of diffuse light stands for its mean, which is off by less than 0.01 of R."""
    openness, color = 0.4, 0.6
    outward = sphere_points(2000)[0]
    cloud = discs(outward, -outward, 0.06, color=color, openness=openness)
    shot = Shot(cloud=cloud, camera=figure_camera(cloud), environment=WHITE)
    for bounces in (1, 3):
        options = replace(PLAIN, bounces=bounces)
        frame = DeferredRenderer(options, device=device, prepared=[prepared(WHITE, device)]).frame(shot)
        arriving = frame.gaussians.values.numpy()[:, 8:11]
        share = specular_albedo(2.0 / 3.0, 1.0)
        reflects = color * (1.0 - share) + share
        expected = np.pi * openness * sum(((1 - openness) * reflects) ** k for k in range(bounces + 1))
        np.testing.assert_allclose(arriving, expected, rtol=2e-3)


def test_bounces_are_those_of_form_factors(device, rng):
    """Gaussians at random, so few that each is a cluster, against float64: sizes, opacities, colours, two bounces."""
    count = 60
    places, normals = rng.uniform(-1.0, 1.0, (count, 3)), rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    color, roughness, openness = rng.random((count, 3)), rng.random(count), rng.random(count)
    material = {"color": color, "roughness": roughness, "openness": openness}
    sides = rng.uniform(0.05, 0.8, (count, 2))
    cloud = discs(places, normals, 1.0, **material, opacity=0.5)
    cloud = cloud.with_arrays(
        scales=np.column_stack([sides, 0.1 * sides.min(axis=1)]), opacities=rng.uniform(0.2, 1.0, count)
    )
    shot = Shot(cloud=cloud, camera=figure_camera(cloud), environment=FURNACE)
    renderer = DeferredRenderer(replace(PLAIN, bounces=2), device=device, prepared=[prepared(FURNACE, device)])
    found = renderer.frame(shot).gaussians.values.numpy()[:, 8:11]

    share = specular_albedo(np.full(count, 2.0 / 3.0), roughness)[:, None]
    reflects = color * (1.0 - share) + share
    area = 2.0 * np.pi * cloud.opacities * sides.prod(axis=1)
    away = places[None] - places[:, None]
    squared = (away**2).sum(axis=-1) + np.eye(count)  # none sees itself
    here = np.maximum(np.einsum("ijk,ik->ij", away, normals), 0.0)
    there = np.maximum(-np.einsum("ijk,jk->ij", away, normals), 0.0)
    form = area * here * there / squared / (squared + area / np.pi)
    form /= np.maximum(form.sum(axis=1, keepdims=True), 1e-12)
    straight = np.pi * openness[:, None] * [1.0, 0.5, 2.0]
    hidden = (1.0 - openness)[:, None]
    once = straight + hidden * (form @ (reflects * straight))
    # sums of 60 float32 terms, and an albedo from its table
    np.testing.assert_allclose(found, straight + hidden * (form @ (reflects * once)), rtol=2e-3)


# ---- triangles ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flip", [False, True])
def test_a_mesh_is_shaded_like_gaussians(device, flip):
    """A plane of triangles and one of Gaussians show the same, from either side of its faces, up to their depths."""
    sun = DirectionalLight(direction=(0.3, 0.2, -1), irradiance=(3, 2, 1))
    rest = {"camera": camera(), "lights": (sun,), "environment": FURNACE}
    one = middle(render(Shot(cloud=floor(color=0.4), **rest), device))
    two = render(Shot(cloud=nothing(), mesh=mesh_of(plate(color=0.4, flip=flip)), **rest), device)
    assert (two.alpha == 1.0).all()
    np.testing.assert_allclose(middle(two), one, rtol=1e-3)
    np.testing.assert_allclose(two.layers["base_color"], 0.4, rtol=1e-6)
    np.testing.assert_allclose(two.layers["normals"][4, 4], UP, atol=1e-6)
    assert two.layers["depth"][4, 4] == pytest.approx(8**0.5, rel=1e-5)


@pytest.mark.parametrize("z", [-0.5, 0.5])
def test_the_nearer_one_is_in_front(device, z):
    """A red plate of Gaussians before a white one of triangles, and behind it."""
    cloud = discs([0.0, 0.0, 0.0], UP, 5.0, color=(0.8, 0.0, 0.0), opacity=0.6)
    rest = {"camera": camera((0.0, -0.01, 1.2)), "environment": WHITE}
    alone = render(Shot(cloud=cloud, **rest), device)
    mesh = render(Shot(cloud=nothing(), mesh=mesh_of(plate(z)), **rest), device)
    both = render(Shot(cloud=cloud, mesh=mesh_of(plate(z)), **rest), device)
    expected = mesh.rgb if z > 0 else alone.rgb + (1.0 - alone.alpha[..., None]) * mesh.rgb
    np.testing.assert_allclose(both.rgb, expected, rtol=1e-5)
    np.testing.assert_allclose(both.alpha, 1.0, rtol=1e-6)
    depth = 1.2 - z if z > 0 else 0.6 * 1.2 + 0.4 * 1.7
    assert both.layers["depth"][4, 4] == pytest.approx(depth, rel=1e-3)


def test_a_caught_shadow_is_what_light_is_missing(device):
    """Below a plate the sun's part of the irradiance is gone; beside it nothing is. The catcher is not seen."""
    sun = replace(SUN, irradiance=(6, 6, 6))
    mesh = mesh_of(plate(catches=True), plate(0.5, 0.3))
    cloud = discs([[-0.9, 0.0, 0.0], [0.9, 0.0, 0.0]], UP, 1e-3)  # the subject that shadow maps look at
    for environment, share in ((None, 1.0), (WHITE, 6.0 / (6.0 + np.pi))):
        for x, expected in ((0.0, share), (0.7, 0.0)):
            view = camera((x, -2.0, 0.2), (x, 0.0, 0.0))
            image = render(Shot(cloud=cloud, camera=view, lights=(sun,), environment=environment, mesh=mesh), device)
            assert image.alpha[4, 4] == pytest.approx(expected, abs=1e-3)
            assert not image.rgb[4, 4].any()
            assert not image.layers["base_color"][4, 4].any()


def test_gaussians_cast_on_triangles_and_triangles_on_gaussians(device):
    sun = DirectionalLight(direction=(0, 0, -1), irradiance=(1, 1, 1))
    ball = discs([[0, 0, 1.0], [0.1, 0.1, 1.0], [-0.1, 0, 1.0]], UP, 0.3)
    view = camera((0.0, -2.0, 0.5))
    on_mesh = render(Shot(cloud=ball, camera=view, lights=(sun,), mesh=mesh_of(plate())), device, SMALL)
    assert middle(on_mesh).max() < 0.02 / np.pi
    low = discs([[-0.9, 0, 0], [0, 0, 0], [0.9, 0, 0]], UP, 0.3)
    on_cloud = render(Shot(cloud=low, camera=view, lights=(sun,), mesh=mesh_of(plate(0.8, 0.3))), device, SMALL)
    assert middle(on_cloud).max() < 0.05 / np.pi


# ---- what is hard, and what is kept ---------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [PLAIN, SMALL], ids=["plain", "shadows"])
def test_hazards_are_finite(device, figure, rng, options):
    """Roughness 0.03 and 1, a firefly of 5e4, lights inside the subject and at a Gaussian, a camera among Gaussians,
    black and no light, no Gaussians."""
    cloud = figure[0]
    extremes = cloud.with_arrays(roughness=np.where(rng.random(len(cloud)) < 0.5, 0.03, 1.0).astype(np.float32))
    inside = PointLight(position=tuple(np.median(cloud.positions, axis=0)), intensity=(5, 5, 5), radius=0.05)
    touching = PointLight(position=tuple(cloud.positions[0].tolist()), intensity=(5, 5, 5))
    spot = SpotLight(position=inside.position, direction=(0, 0, 1), intensity=(1, 1, 1), outer_angle=85.0)
    view = figure_camera(cloud, (12, 16))
    pose = view.camera_to_world.copy()
    pose[:3, 3] = cloud.positions[100]
    among = replace(view, camera_to_world=pose)
    lights = [prepared(light, device) for light in (FIREFLY, BLACK)]
    renderer = DeferredRenderer(options, device=device, prepared=lights)
    shots = [
        Shot(cloud=extremes, camera=view, environment=FIREFLY, lights=(inside, touching, spot)),
        Shot(cloud=extremes, camera=among, environment=FIREFLY, lights=(inside,)),
        Shot(cloud=cloud, camera=view, environment=BLACK),
        Shot(cloud=cloud, camera=view),
        Shot(cloud=nothing(), camera=view, environment=FIREFLY, lights=(inside,)),
        Shot(cloud=nothing(), camera=view, lights=(inside,), mesh=mesh_of(plate(catches=True))),
    ]
    for shot in shots:
        image = renderer.draw(shot)
        for array in (image.rgb, image.alpha, *image.layers.values()):
            assert np.isfinite(array).all()
        assert image.rgb.min() >= 0.0
        if shot.environment is None and not shot.lights:
            assert not image.rgb.any()
            assert image.alpha.any()


def test_shots_of_any_order_and_size(device, figure):
    """What a renderer keeps of shots before changes nothing: the same bits as a new renderer's."""
    one, two = figure
    sun = DirectionalLight(direction=(1, 0.5, -1), irradiance=(1, 1, 1))
    lamp = PointLight(position=(2, -2, 2), intensity=(3, 3, 3), radius=0.1)
    inside = PointLight(position=tuple(np.median(one.positions, axis=0)), intensity=(1, 1, 1))
    first = Shot(cloud=one, camera=figure_camera(one), environment=SKY, lights=(sun,))
    later = replace(first, cloud=two, environment=OTHER_SKY)
    shots = [
        first,
        replace(first, camera=figure_camera(one, azimuth=90.0)),
        replace(first, environment_rotation=70.0),
        later,  # under the same light
        replace(later, lights=(lamp,)),
        replace(later, environment=None, lights=(inside, sun)),
        replace(later, mesh=mesh_of(plate())),
        replace(later, lights=(sun, lamp)),
        Shot(cloud=one.select(np.arange(0, len(one), 2)), camera=figure_camera(one, (10, 11)), environment=SKY),
    ]
    renderer = DeferredRenderer(SMALL, device=device)
    for shot in shots:
        found, fresh = renderer.draw(shot), DeferredRenderer(SMALL, device=device).draw(shot)
        np.testing.assert_array_equal(found.rgb, fresh.rgb)
        np.testing.assert_array_equal(found.alpha, fresh.alpha)


def test_launching_is_drawing(device, figure):
    """After Gaussians, light and camera changed, one launch shows what a new renderer does, to the bit."""
    one, two = figure
    sun, lower = (DirectionalLight(direction=(1, 0.5, z), irradiance=(1, 1, 1)) for z in (-1.0, -0.3))
    first = Shot(cloud=one, camera=figure_camera(one), environment=SKY, lights=(sun,), mesh=mesh_of(plate()))
    frame = DeferredRenderer(SMALL, device=device).frame(first)
    drawn = frame.image()
    for again in (frame.launch, frame.launch_view, frame.launch):
        again()
        np.testing.assert_array_equal(frame.image().rgb, drawn.rgb)
    view = figure_camera(one, azimuth=60.0)
    later = replace(first, cloud=two, camera=view, environment_rotation=25.0, lights=(lower,))
    frame.set(later)
    frame.launch()
    np.testing.assert_array_equal(frame.image().rgb, render(later, device, SMALL).rgb)


def test_gaussians_moved_on_the_device(device, figure):
    """Who writes positions into the frame's arrays and launches sees them there, with shadows of where they are."""
    one, two = figure
    shot = Shot(cloud=one, camera=figure_camera(one), environment=SKY)
    frame = DeferredRenderer(SMALL, device=device).frame(shot)
    before = frame.image().rgb
    frame.gaussians.positions.assign(two.positions)
    frame.launch()
    moved = frame.image().rgb
    assert (moved != before).any()
    frame.gaussians.positions.assign(one.positions)
    frame.launch()
    np.testing.assert_array_equal(frame.image().rgb, before)


def test_a_frame_refuses_what_does_not_fit(device, figure):
    cloud = figure[0]
    frame = DeferredRenderer(PLAIN, device=device).frame(Shot(cloud=cloud, camera=figure_camera(cloud)))
    other = Shot(cloud=cloud, camera=figure_camera(cloud, (9, 9)))
    assert not frame.fits(other)
    message = "shot must have 6000 Gaussians and 20 x 30 pixels, got 6000 and 9 x 9"
    with pytest.raises(InvalidOptionError, match=message):
        frame.set(other)


def test_same_bits_with_any_number_of_threads(figure, monkeypatch):
    cloud = figure[0]
    lamp = PointLight(position=(1, -1, 1.5), intensity=(3, 3, 3), radius=0.1)
    view = figure_camera(cloud, (60, 80))
    shot = Shot(cloud=cloud, camera=view, environment=SKY, lights=(lamp,), mesh=mesh_of(plate()))
    images = []
    for threads in ("1", "2", "2"):
        monkeypatch.setenv("BEAM_WARP_THREADS", threads)
        images.append(DeferredRenderer(SMALL, device="cpu").draw(shot).rgb)
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_array_equal(images[1], images[2])


def test_samples_are_averaged(device, figure):
    """Three by three samples a pixel are the means of the image of three times the side; layers by coverage."""
    view = figure_camera(figure[0])
    shot = Shot(cloud=figure[0], camera=view, environment=SKY)
    found = render(shot, device, replace(PLAIN, samples=3))
    fine = render(replace(shot, camera=view.supersampled(3)), device)
    np.testing.assert_allclose(found.rgb, fine.rgb.reshape(30, 3, 20, 3, 3).mean(axis=(1, 3)), rtol=1e-5, atol=1e-7)
    weight = fine.alpha.reshape(30, 3, 20, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(found.alpha, weight, rtol=1e-5, atol=1e-7)
    seen = weight > 0.01
    roughness = (fine.layers["roughness"] * fine.alpha).reshape(30, 3, 20, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(found.layers["roughness"][seen], roughness[seen] / weight[seen], rtol=1e-4)


def test_layers_are_those_of_rasterize(device, figure):
    cloud = figure[0]
    view = figure_camera(cloud)
    raster = RasterOptions(antialiased=True, low_pass=0.1)
    found = render(Shot(cloud=cloud, camera=view), device, raster=raster)
    buffer = rasterize(cloud, view, options=raster, device=device)
    for name, layer in found.layers.items():
        expected = buffer.depth if name == "depth" else buffer.channels[name]
        assert layer.shape == expected.shape
        np.testing.assert_allclose(layer, expected, rtol=1e-4, atol=1e-5)
    assert not render(Shot(cloud=cloud, camera=view), device, replace(PLAIN, layers=())).layers


def test_options_are_checked():
    for bad in ({"environment_shadows": 257}, {"bounces": -1}, {"samples": 0}, {"layers": ("colour",)}):
        with pytest.raises(InvalidOptionError, match=next(iter(bad))):
            DeferredOptions(**bad)


def test_where_the_front_leaks_light_still_falls_on_the_front(device):
    """Before a far back, a front of 0.8: the mean depth lies between the two, in the shadow of the front."""
    view = camera((0.01, 0.0, 3.0), size=8, fov=4.0)
    means = []
    for opacity in (0.8, 0.99):
        cloud = discs([[0, 0, 0], [0, 0, -1]], UP, 1.0, color=0.5)
        cloud = cloud.with_arrays(scales=[[1.0, 1.0, 1e-3]] * 2, opacities=[opacity, 0.99])
        image = render(Shot(cloud=cloud, camera=view, lights=(SUN,)), device)
        means.append(image.rgb.mean() / image.alpha.mean())
    # one surface of one material: what leaks is lit as the front is, shadowed by nothing that is nearer
    assert means[0] == pytest.approx(means[1], rel=0.02)
