"""The offline renderer: energy, lights and shadows against closed forms, no bias, and where things go wrong."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from support.estimates import LARGEST_Z, require_zero_mean
from support.flat_scenes import brdf_twin, mesh_of, nothing, plate
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp.errors import AssetFormatError, InvalidArrayError, InvalidOptionError
from beam_warp.light.ggx import specular_albedo
from beam_warp.render.path import FEWEST_PASSES, PASS_SAMPLES, PathOptions, PathRenderer
from beam_warp.trace.mesh_paths import TracedMesh, trace_radiance
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.lights import DirectionalLight, PointLight, SpotLight
from beam_warp.world.mesh import MaterialMesh
from beam_warp.world.quaternions import turns_from_z
from beam_warp.world.shot import Shot, ShotMesh

WHITE = EnvironmentMap.constant((1.0, 1.0, 1.0))
SUN = DirectionalLight(direction=(0.0, 0.0, -1.0), irradiance=(1.0, 1.0, 1.0), angular_diameter=0.0)
ALPHA_MAX = 0.99


def relightable(base_color=0.5, roughness=0.5, **arrays):
    """Gaussians whose normals are their shortest axes, of one material unless arrays are given."""
    count = len(arrays["positions"])
    return GaussianCloud(
        **arrays,
        base_color=np.broadcast_to(np.asarray(base_color, float).reshape(-1, 1), (count, 3)),
        roughness=np.broadcast_to(roughness, count),
        ambient_occlusion=np.ones(count),
        axes="rfu",
    )


def disc(height=0.0, normal=(0.0, 0.0, 1.0), *, size=1.0, opacity=ALPHA_MAX, center=(0.0, 0.0), **material):
    """One large flat Gaussian: a plane, as far as a narrow view of its middle is concerned."""
    normal = np.asarray(normal, float)[None] / np.linalg.norm(normal)
    place = {"positions": [[*center, height]], "orientations": turns_from_z(normal), "normals": normal}
    return relightable(**place, scales=[[size, size, 1e-3 * size]], opacities=[opacity], **material)


def together(*clouds):
    return cloud_of(*(cloud.arrays() for cloud in clouds), axes="rfu")


def ball(count=600, radius=1.0, **material):
    points, spacing = sphere_points(count)
    parts = tiles(points * radius, points, spacing * radius, opacity=ALPHA_MAX)
    return relightable(normals=points, **parts, **material)


def look(eye, target=(0.0, 0.0, 0.0), *, size=4, fov=1.0):
    """A square view."""
    return Camera.look_at(eye, target, width=size, height=size, vertical_fov=fov)


ABOVE = (0.01, 0.0, 2.0)


def render(shot, device="cpu", **options):
    return PathRenderer(PathOptions(**options), device=device).draw(shot)


def brdf_cosine(n, v, light, base_color, roughness):
    """The BSDF times n.l in float64: the twin of `kernels.scattering`."""
    n, v, light = (np.asarray(x, float) / np.linalg.norm(x) for x in (n, v, light))
    diffuse = base_color * (1.0 - specular_albedo(n @ v, roughness)) / np.pi
    return (diffuse + brdf_twin(n, v, light, roughness)) * (n @ light)


@pytest.mark.parametrize("roughness", [0.03, 0.3, 0.6, 1.0])
def test_a_white_plane_under_even_light_shows_it(device, roughness):
    view = look(ABOVE, size=8, fov=2.0)
    shot = Shot(cloud=disc(base_color=1.0, roughness=roughness), camera=view, environment=WHITE)
    image = render(shot, device, samples=256)
    assert image.alpha.min() > 0.9
    assert np.allclose(image.rgb.mean() / image.alpha.mean(), 1.0, atol=0.01)  # the bound on the furnace


def test_a_white_ball_sends_back_all_that_arrives(device):
    """Light that one side of a dimple sends to the other is not lost: with bounces the furnace is even everywhere."""
    view = look((0.0, -4.0, 0.0), size=12, fov=20.0)
    shot = Shot(cloud=ball(base_color=1.0, roughness=0.7), camera=view, environment=WHITE)
    image = render(shot, device, samples=64, bounces=16)
    inside = image.alpha > 0.99
    assert inside.sum() > 60
    assert np.allclose(image.rgb[inside].mean(), image.alpha[inside].mean(), atol=0.01)


LIGHTS = {
    "directional": DirectionalLight(direction=(-1.0, 0.0, -1.0), irradiance=(3.0, 2.0, 1.0), angular_diameter=0.0),
    "point": PointLight(position=(1.0, 0.0, 1.0), intensity=(6.0, 4.0, 2.0)),
    "spot": SpotLight(position=(1.0, 0.0, 1.0), direction=(-1.0, 0.0, -1.0), intensity=(6.0, 4.0, 2.0)),
}


@pytest.mark.parametrize("roughness", [0.3, 0.8])
@pytest.mark.parametrize("kind", LIGHTS)
def test_lights_shed_what_their_units_say(device, kind, roughness):
    """Irradiance 3, 2, 1 at the middle from all of them: intensity over the distance squared."""
    shot = Shot(cloud=disc(roughness=roughness), camera=look(ABOVE, size=8, fov=2.0), lights=(LIGHTS[kind],))
    image = render(shot, device, samples=16)
    expected = brdf_cosine((0, 0, 1), ABOVE, (1, 0, 1), 0.5, roughness) * np.array([3.0, 2.0, 1.0])
    seen = image.rgb[3:5, 3:5].mean(axis=(0, 1)) / image.alpha[3:5, 3:5].mean()
    # pixels are off the middle by up to 0.02: of the direction to the light, 2 %, and of its distance squared
    assert np.allclose(seen, expected, rtol=0.03)


@pytest.mark.parametrize("roughness", [0.2, 1.0])
def test_a_light_of_a_size_sheds_as_much_as_a_point(device, roughness):
    """A sphere's irradiance on what faces it is that of a point, and samples of light and BSDF agree on it."""
    small = PointLight(position=(0.0, 0.0, 1.0), intensity=(1.0, 1.0, 1.0))
    cloud = disc(base_color=1.0, roughness=roughness)
    means = []
    for light in (small, replace(small, radius=0.3)):
        image = render(Shot(cloud=cloud, camera=look((1.5, 0.0, 1.0)), lights=(light,)), device, samples=1024)
        means.append(image.rgb.mean() / image.alpha.mean())
    # off the mirror direction the lobe is flat enough over 17 degrees; the diffuse part is exact for a sphere
    assert np.isclose(means[1], means[0], rtol=0.03)


def test_a_half_opaque_disc_takes_half_of_the_light(device):
    ground = Shot(cloud=disc(roughness=1.0), camera=look((1.0, 0.0, 0.4)), lights=(SUN,))
    screen = disc(height=0.8, size=0.05, opacity=0.5)
    renderer = PathRenderer(PathOptions(samples=16, bounces=0), device=device)
    free = renderer.draw(ground)
    shaded = renderer.draw(replace(ground, cloud=together(ground.cloud, screen)))
    # the middle 1 cm of a Gaussian of 5 cm: alpha 0.5 exp(-0.02 / 2)
    assert np.isclose(shaded.rgb[1:3, 1:3].mean() / free.rgb[1:3, 1:3].mean(), 0.5, atol=0.02)


@pytest.mark.parametrize("diameter", [0.0, 60.0])
def test_a_light_that_casts_no_shadows_passes_what_is_in_its_way(device, diameter):
    """Whether the light is drawn, or met by a ray that the surface scatters: only one of a size is."""
    sun = replace(SUN, angular_diameter=diameter, casts_shadows=False)
    ground = Shot(cloud=disc(roughness=0.3), camera=look((0.0, -1.0, 0.4)), lights=(sun,))
    roof = disc(height=0.8, size=0.5)
    images = [
        render(replace(ground, cloud=cloud), device, samples=16, bounces=0)
        for cloud in (ground.cloud, together(ground.cloud, roof))
    ]
    np.testing.assert_allclose(images[1].rgb, images[0].rgb, rtol=1e-3)


def test_pixels_need_not_be_square_and_depth_is_along_the_axis(device):
    """A wide view of a level square from 2 m above: as many pixels as its sides have focal lengths, all 2 m deep."""
    view = replace(look((0.0, -1e-3, 2.0), size=32, fov=60.0), focal_x=40.0, focal_y=24.0)
    image = render(
        Shot(cloud=nothing(), camera=view, lights=(SUN,), mesh=plate(half=0.6)), device, samples=64, bounces=0
    )
    assert image.alpha.sum() == pytest.approx(0.6 * 40.0 * 0.6 * 24.0, rel=0.01)
    np.testing.assert_allclose(image.layers["depth"][image.alpha == 1.0], 2.0, rtol=1e-3)


def test_penumbras_are_as_wide_as_the_light_says(device):
    """A straight edge at half the height of a sphere light: light rises from 0 to 1 over the disc's area."""
    radius, height = 0.2, 2.0
    light = PointLight(position=(0.0, 0.0, height), intensity=(4.0, 4.0, 4.0), radius=radius)
    ground, wall = plate(half=4.0, color=0.5), plate(1.0, 4.0, -4.0, color=0.5)
    camera = Camera.look_at((0.0, -0.01, 0.9), (0.0, 0.0, 0.0), width=64, height=8, vertical_fov=6.0)
    shot = Shot(cloud=nothing(), camera=camera, lights=(light,), mesh=ground)
    renderer = PathRenderer(PathOptions(samples=256, bounces=0), device=device)
    free, shaded = renderer.draw(shot), renderer.draw(replace(shot, mesh=mesh_of(ground, wall)))
    share = (shaded.rgb[..., 0] / free.rgb[..., 0]).mean(axis=0)
    x = (np.arange(64) + 0.5 - camera.center_x) / camera.focal_x * 0.9
    # the edge at x = 0, height 1 appears on the light's disc at 2 x' - x seen from x: its chord divides the disc
    edge = np.clip(-x / radius, -1.0, 1.0)  # part of the disc with x > edge is seen
    expected = (np.arccos(edge) - edge * np.sqrt(1.0 - edge**2)) / np.pi
    # 256 rays a pixel, 8 pixels; a sphere is a cone, not a disc: 1 % of 0.2 / 2 squared
    assert np.abs(share - expected).max() < 0.03


def test_catchers_show_the_light_that_is_missing(device):
    """Under a small ball at height h a catcher's alpha is the share of a cosine sky that the ball hides: (r / h)^2."""
    radius, height = 0.25, 0.6
    cloud = ball(2000, radius, base_color=0.0)
    cloud = cloud.with_arrays(positions=cloud.positions + np.float32([0.0, 0.0, height]))
    mesh = plate(half=50.0, catches=True)
    shot = Shot(cloud=cloud, camera=look((0.0, 1e-3, 0.3)), environment=WHITE, mesh=mesh)
    image = render(shot, device, samples=1024)
    assert np.all(image.rgb == 0.0)
    # tiles reach beyond the ball by a part of their size, 4 % of its radius: 8 % of the hidden share
    assert np.isclose(image.alpha.mean(), (radius / height) ** 2, rtol=0.1)
    away = look((30.0, 0.0, 1.0), (30.0, 1.0, 0.0))
    free = render(replace(shot, camera=away), device, samples=64)
    assert free.alpha.max() < 0.01


def test_a_mesh_alone_is_what_the_path_tracer_of_meshes_sees(device):
    """Another integrator, with another way to draw the sky, of the same materials."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    mesh.apply_transform(np.diag([1.0, 1.0, 0.4, 1.0]))
    count = len(mesh.vertices)
    shape = {"vertices": mesh.vertices, "faces": mesh.faces, "normals": mesh.vertex_normals}
    surface = MaterialMesh(**shape, base_color=np.full((count, 3), 0.7), roughness=np.full(count, 0.4))
    part = ShotMesh(surface=surface, catches_shadows=np.zeros(len(mesh.faces), bool))
    rng = np.random.default_rng(1)
    sky = EnvironmentMap(rng.gamma(0.3, 1.0, (16, 32, 3)).astype(np.float32))
    view = look((0.0, -4.0, 1.0), size=10, fov=30.0)
    shot = Shot(cloud=nothing(), camera=view, environment=sky, mesh=part)
    ours = render(shot, device, samples=512, bounces=3)
    traced = TracedMesh.from_mesh(surface, device=device)
    other = trace_radiance(traced, view, sky, sample_count=512, bounce_count=3)
    assert np.abs(ours.alpha - other.alpha).max() < 0.1  # both count samples that meet an edge
    solid = (ours.alpha == 1.0) & (other.alpha == 1.0)
    assert solid.sum() > 10
    require_zero_mean((ours.rgb - other.rgb)[solid])


@pytest.fixture(scope="module")
def corner():
    """A ball in front of a wall under a sky with a sun and a lamp of a size: all that a path can meet."""
    wall = disc(normal=(0.0, -1.0, 0.0), height=0.0, size=2.0, center=(0.0, 1.3), base_color=0.8)
    sky = np.full((16, 32, 3), 0.3, np.float32)
    sky[5, 20] = (60.0, 50.0, 40.0)
    return Shot(
        cloud=together(ball(300, roughness=0.3), wall),
        camera=look((0.3, -4.0, 0.4), size=6, fov=30.0),
        environment=EnvironmentMap(sky),
        lights=(PointLight(position=(1.5, -1.5, 1.5), intensity=(3.0, 3.0, 3.0), radius=0.3),),
    )


def test_few_samples_have_the_mean_of_many(corner):
    """No bias: the z-scores of pixels over seeds, against sixteen times as many samples a seed."""
    few = [render(corner, samples=4, bounces=3, seed=s).rgb for s in range(48)]
    many = [render(corner, samples=64, bounces=3, seed=1000 + s).rgb for s in range(6)]
    means = [np.asarray(images, np.float64).mean(axis=-1) for images in (few, many)]
    variance = sum(m.var(axis=0, ddof=1) / len(m) for m in means)
    # six seeds give a variance of its own noise: pooled over the image it is known well
    z = (means[0].mean(axis=0) - means[1].mean(axis=0)) / np.sqrt(np.maximum(variance, variance.mean()))
    assert np.abs(z).max() < LARGEST_Z
    assert abs(z.mean() * np.sqrt(z.size)) < LARGEST_Z


def test_indirect_light_is_what_bounces_add(corner):
    direct, whole = (render(corner, samples=64, bounces=bounces) for bounces in (0, 2))
    assert np.all(direct.layers["indirect"] == 0.0)
    assert np.allclose(whole.rgb - whole.layers["indirect"], direct.rgb, atol=1e-5)
    assert whole.layers["indirect"].mean() > 0.02 * whole.rgb.mean()


def test_channels_do_not_mix(corner, device, rng):
    """Where red, green and blue of materials and lights change places they do so in the image, bounces included."""
    colors, lamp = rng.random((len(corner.cloud), 3)), corner.lights[0]
    images = []
    for order in ([0, 1, 2], [1, 2, 0]):
        cloud = corner.cloud.with_arrays(base_color=colors[:, order])
        light = replace(lamp, intensity=tuple(np.array([3.0, 2.0, 1.0])[order]))
        shot = replace(corner, cloud=cloud, environment=WHITE, lights=(light,))
        images.append(render(shot, device, samples=4, bounces=2))
    one, two = images
    # the same paths: only sums over channels are rounded otherwise
    np.testing.assert_allclose(two.rgb, one.rgb[..., [1, 2, 0]], rtol=1e-4)
    np.testing.assert_allclose(two.layers["indirect"], one.layers["indirect"][..., [1, 2, 0]], rtol=1e-4, atol=1e-6)


def test_the_same_seed_gives_the_same_bits(corner, monkeypatch):
    first = render(corner, samples=20)
    monkeypatch.setenv("BEAM_WARP_THREADS", "1")
    again = render(corner, samples=20)
    other = render(corner, samples=20, seed=1)
    assert np.array_equal(first.rgb, again.rgb)
    assert not np.array_equal(first.rgb, other.rgb)


def test_turning_the_sky_is_a_turned_sky(corner):
    """A quarter is a whole number of columns, so that nothing is resampled."""
    turned = replace(corner, environment_rotation=90.0)
    rotated = replace(corner, environment=corner.environment.rotated(90.0))
    a, b, plain = (render(shot, samples=256, bounces=1) for shot in (turned, rotated, corner))
    require_zero_mean((a.rgb - b.rgb).reshape(-1, 3))
    assert np.abs(a.rgb - plain.rgb).mean() > 5.0 * np.abs(a.rgb - b.rgb).mean()


def test_an_interrupted_render_ends_with_the_same_bits(corner, tmp_path):
    renderer = PathRenderer(PathOptions(samples=4 * PASS_SAMPLES, target_error=1e-6), device="cpu")
    whole = renderer.draw(corner)
    path = tmp_path / "frame.checkpoint"

    def stop(done, most):
        if done >= PASS_SAMPLES:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        renderer.draw(corner, checkpoint=path, report=stop)
    assert path.exists()
    seen = []
    image = renderer.draw(corner, checkpoint=path, report=lambda done, most: seen.append(done))
    assert seen == [2 * PASS_SAMPLES, 3 * PASS_SAMPLES, 4 * PASS_SAMPLES]
    assert np.array_equal(image.rgb, whole.rgb)
    assert not path.exists()


def test_checkpoints_of_something_else_are_not_taken_up(corner, tmp_path):
    path = tmp_path / "frame.checkpoint"
    options = PathOptions(samples=2 * PASS_SAMPLES)
    progress = PathRenderer(options, device="cpu").start(corner)
    progress.advance()
    progress.save(path)
    assert PathRenderer(options, device="cpu").start(corner).resume(path)
    for changed in (
        {"environment": corner.environment.scaled(2.0)},
        {"environment_rotation": 10.0},
        {"lights": ()},
        {"lights": (replace(corner.lights[0], intensity=(1.0, 2.0, 3.0)),)},
        {"mesh": plate()},
    ):
        assert not PathRenderer(options, device="cpu").start(replace(corner, **changed)).resume(path)
    assert not PathRenderer(PathOptions(samples=4 * PASS_SAMPLES), device="cpu").start(corner).resume(path)
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(AssetFormatError, match="Delete it"):
        PathRenderer(options, device="cpu").start(corner).resume(path)


def test_adaptive_sampling_reaches_its_error_and_stops_where_it_is_reached(corner):
    target = 0.02
    shot = replace(corner, camera=look((0.3, -4.0, 0.4), size=16, fov=60.0))
    image = render(shot, samples=1024, target_error=target, bounces=1)
    counts = image.layers["samples"]
    assert FEWEST_PASSES * PASS_SAMPLES <= counts.min() < counts.max()
    reference = render(shot, samples=512, bounces=1, seed=7)
    luminance = [np.sqrt(np.maximum(i.rgb @ [0.2126, 0.7152, 0.0722], 1e-3)) for i in (image, reference)]
    assert np.sqrt(np.mean((luminance[0] - luminance[1]) ** 2)) < target


def test_the_inside_of_a_surface_is_not_seen_through_its_leaks(device):
    """Two half-opaque discs back to back: what passes the front one shows the front one, not the dark inside."""
    front = disc(height=0.5, opacity=0.5, base_color=0.8, roughness=1.0, size=0.2)
    back = disc(height=0.0, normal=(0.0, 0.0, -1.0), base_color=0.1, size=2.0)
    shot = Shot(cloud=together(front, back), camera=look(ABOVE), lights=(SUN,))
    image = render(shot, device, samples=64, bounces=0)
    assert np.allclose(image.layers["base_color"], 0.8, atol=1e-5)
    assert np.allclose(image.layers["depth"], 1.5, atol=2e-3)
    assert image.alpha.mean() > 0.98  # both together stop nearly all: 1 - 0.5 x 0.01


def test_layers_do_not_mix_what_is_apart(device):
    """The foreground of an outline and what is behind it are shaded apart, never at a place in between."""
    front = disc(height=1.0, opacity=0.5, base_color=0.9, size=0.2)
    back = disc(height=0.0, base_color=0.1, size=2.0)
    shot = Shot(cloud=together(front, back), camera=look(ABOVE))
    depths = [render(shot, device, samples=1, bounces=0, seed=seed).layers["depth"] for seed in (0, 3)]
    found = np.concatenate([d[d > 0.0] for d in depths])
    assert np.all((np.abs(found - 1.0) < 2e-3) | (np.abs(found - 2.0) < 4e-3))
    assert 4 < (found < 1.5).sum() < len(found) - 4


def test_before_the_first_sample_an_image_is_empty(corner):
    image = PathRenderer(device="cpu").start(corner).image()
    for array in (image.rgb, image.alpha, *image.layers.values()):
        assert not array.any()


def test_denoising_takes_noise_off_and_leaves_texture(corner, rng):
    """Every Gaussian has a colour of its own, no more than a pixel or two from the next."""
    painted = corner.cloud.with_arrays(base_color=rng.uniform(0.1, 0.9, (len(corner.cloud), 3)))
    view = look((0.3, -4.0, 0.4), size=32, fov=20.0)
    shot = replace(corner, cloud=painted, camera=view, environment=WHITE, lights=())
    noisy, clean = (render(shot, samples=8, bounces=1, denoiser=denoiser) for denoiser in ("none", "bilateral"))
    truth = render(shot, samples=64, bounces=1, seed=5)
    errors = [np.sqrt(np.mean((image.rgb - truth.rgb) ** 2)) for image in (noisy, clean)]
    assert errors[1] < 0.5 * errors[0]
    assert np.array_equal(noisy.alpha, clean.alpha)


HARD_CASES = {
    "no Gaussians": {"cloud": nothing()},
    "no light": {"environment": None, "lights": ()},
    "black sky": {"environment": EnvironmentMap.constant((0.0, 0.0, 0.0)), "lights": ()},
    "light inside": {"lights": (PointLight(position=(0.0, 0.0, 0.0), intensity=(5.0, 5.0, 5.0), radius=0.3),)},
    "light on the surface": {"lights": (PointLight(position=(0.0, -1.0, 0.0), intensity=(5.0, 5.0, 5.0)),)},
    "camera inside": {"camera": look((0.0, -0.2, 0.0), (0.0, 1.0, 0.0), size=6, fov=60.0)},
    "mirror": {"cloud": ball(300, roughness=0.03)},
    "roughness 0": {"cloud": ball(300, roughness=0.0)},
    "roughness 1": {"cloud": ball(300, roughness=1.0)},
}


@pytest.mark.parametrize("case", HARD_CASES)
def test_hard_cases_are_finite(corner, device, case):
    shot = replace(corner, **HARD_CASES[case])
    image = render(shot, device, samples=32)
    for array in (image.rgb, image.alpha, *image.layers.values()):
        assert np.isfinite(array).all()
        assert array.shape[:2] == (shot.camera.height, shot.camera.width)
    if case in ("no light", "black sky"):
        assert np.all(image.rgb == 0.0)
    if case == "no Gaussians":
        assert np.all(image.alpha == 0.0)


def test_a_sun_of_fifty_thousand_does_not_make_fireflies_of_direct_light(device):
    """The sky is drawn by its product with the cosine: a sun that is 5e4 times the rest is found by every sample."""
    sky = np.full((64, 128, 3), 0.2, np.float32)
    sky[16, 40] = 5e4
    sky = EnvironmentMap(sky)
    direction = sky.directions()[16, 40]
    shot = Shot(cloud=disc(roughness=1.0), camera=look(ABOVE, size=8, fov=2.0), environment=sky)
    image = render(shot, device, samples=64)
    values = image.rgb.mean(axis=-1) / image.alpha
    assert values.std() / values.mean() < 0.05
    sun = 5e4 * sky.solid_angles()[16, 0] * brdf_cosine((0, 0, 1), ABOVE, direction, 0.5, 1.0)
    assert np.isclose(values.mean(), sun + 0.2 * 0.5, rtol=0.05)  # the even sky: base colour and a little specular


def test_options_are_checked():
    for wrong in ({"samples": 0}, {"bounces": -1}, {"target_error": 0.0}, {"target_error": np.nan}, {"seed": -1}):
        with pytest.raises(InvalidOptionError):
            PathOptions(**wrong)
    with pytest.raises(InvalidOptionError, match="denoiser"):
        PathOptions(denoiser="magic")


def test_what_cannot_be_relit_is_refused(corner):
    with pytest.raises(InvalidArrayError, match="Decompose"):
        Shot(cloud=corner.cloud.with_arrays(roughness=None), camera=corner.camera)
    with pytest.raises(InvalidOptionError, match="axes"):
        Shot(cloud=corner.cloud.with_arrays(axes="rub"), camera=corner.camera)
