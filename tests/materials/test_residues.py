"""What light does at pixels' surface points: closed forms, a quadrature of the same integrals, noise as stated."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from support.estimates import require_honest, require_zero_mean
from support.flat_scenes import brdf_twin
from support.shapes import cloud_of, disc_points, random_cloud, sphere_points, tiles

from beam_warp import Camera, Scene
from beam_warp.errors import InvalidOptionError
from beam_warp.light.ggx import DIELECTRIC_F0, specular_albedo
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.residues import surface_residues, view_surfaces
from beam_warp.raster.sources import upload_gaussians
from beam_warp.trace.transmittance import visibility
from beam_warp.world.environment import EnvironmentMap

UP = np.array([0.0, 0.0, 1.0])


def surfaces_of(cloud, camera, device, roughness=0.5, **options):
    rough = np.full((len(cloud), 1), roughness, np.float32)
    return view_surfaces(upload_gaussians(cloud, device, values=rough), camera, device=device, **options)


def nothing(device):
    """A scene in which nothing is in the way."""
    return Scene.from_gaussians(random_cloud(np.random.default_rng(0), 3).select(np.arange(0)), device)


def ball(count=1500):
    points, spacing = sphere_points(count)
    return cloud_of(tiles(points, points, spacing, opacity=0.99))


def looking_at(azimuth=20.0, elevation=30.0, size=24, distance=4.0, fov=30.0, at=(0, 0, 0)):
    camera = Camera.orbit(at, distance, azimuth, elevation, width=size, height=size, vertical_fov=fov)
    return replace(camera, focal_x=0.9 * camera.focal_y)  # pixels are not square


class TestSurfaces:
    @pytest.mark.parametrize("depth", ["median", "mean"])
    def test_points_of_a_plane_lie_on_it(self, device, depth):
        spacing = 0.05
        floor = disc_points(1.0, spacing)
        cloud = cloud_of(tiles(floor, np.tile(UP, (len(floor), 1)), spacing, flatness=1e-3))
        camera = looking_at(size=80)
        found = surfaces_of(cloud, camera, device, 0.3, surface_depth=depth)
        alpha, images = found.alpha.numpy(), found.rows
        pixels = images.pixels.numpy()
        assert np.array_equal(pixels, np.flatnonzero(alpha >= 0.5))
        assert 0 < len(pixels) < len(alpha)
        toward = -camera.directions().reshape(-1, 3)[pixels]
        np.testing.assert_allclose(images.to_camera.numpy(), toward, atol=1e-6)
        # inside, largest responses are in the plane but for the Gaussians' thickness, 1e-3 of 0.65 spacings; what the
        # pixel filter shows of one beyond three deviations has its depth cut there: alpha 0.99 exp(-4.5) at most, by
        # the filter's deviation of half a pixel, which is 12 mm there; the median does not feel it
        t = camera.position[2] / toward[:, 2]
        inside = np.linalg.norm((camera.position - t[:, None] * toward)[:, :2], axis=1) < 0.8
        height = np.abs(images.positions.numpy()[inside, 2])
        assert inside.sum() > 50
        assert height.max() < (4e-5 if depth == "median" else 4e-5 + 0.011 * 0.012 * 4)

    def test_points_are_where_the_depth_says(self, device, rng):
        camera = looking_at(size=17)
        found = surfaces_of(random_cloud(rng, 300, scale=(-2.0, 0.4), opacity=(0.5, 1.0)), camera, device)
        pixels, rays = found.rows.pixels.numpy(), camera.directions().reshape(-1, 3)
        depth = found.depth.numpy().astype(np.float64)[pixels]
        expected = camera.position + rays[pixels] * (depth / (rays[pixels] @ camera.forward))[:, None]
        np.testing.assert_allclose(found.rows.positions.numpy(), expected, atol=4e-6)  # 8 roundings of 4 m in float32
        normals = found.rows.normals.numpy()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
        assert (np.einsum("ij,ij->i", normals, found.rows.to_camera.numpy()) > 0.0).all()

    def test_images_are_rows_at_their_pixels(self, device):
        found = surfaces_of(ball(500), looking_at(), device)
        image = found.image(found.rows.normals).numpy()
        pixels = found.rows.pixels.numpy()
        assert np.array_equal(image[pixels], found.rows.normals.numpy())
        assert not np.delete(image, pixels, axis=0).any()

    @pytest.mark.parametrize("size", [1, 2])
    def test_nothing_in_view(self, device, size):
        camera = looking_at(size=size, at=(0, 0, 50.0))
        found = surfaces_of(ball(100), camera, device)
        light = PreparedEnvironment(EnvironmentMap.constant((1, 1, 1), height=32), found.alpha.device)
        scene = Scene.from_gaussians(ball(100), device)
        assert len(found) == 0
        assert len(surface_residues(scene, found, light).diffuse) == 0
        assert not found.image(found.rows.roughness).numpy().any()


def test_noise_is_independent_by_frame_and_repeats(device, rng, monkeypatch):
    cloud = random_cloud(rng, 500, scale=(-2.0, 0.4), opacity=(0.5, 1.0))
    scene = Scene.from_gaussians(cloud, device)
    found = surfaces_of(cloud, looking_at(), device)
    light = PreparedEnvironment(sunny(), scene.device)

    def both(frame):
        residues = surface_residues(scene, found, light, sample_count=8, frame=frame)
        return np.concatenate([residues.diffuse.numpy(), residues.specular.numpy()])

    first, again, other = both(1), both(1), both(2)
    monkeypatch.setenv("BEAM_WARP_THREADS", "3")
    monkeypatch.setattr("beam_warp.trace.rays.RAYS_AT_ONCE", 8 * 37)
    assert np.array_equal(first, again)
    assert np.array_equal(first, both(1))
    assert not np.array_equal(first, other)


def sunny():
    """Dim and coloured, with a sun of a few texels."""
    radiance = EnvironmentMap.constant((0.3, 0.4, 0.6), height=32).radiance.copy()
    radiance[16:] *= 0.3
    radiance[7:9, 20:22] += np.float32((60.0, 45.0, 30.0))
    return EnvironmentMap(radiance)


class TestEvenLight:
    """Light of radiance 1 from everywhere, nothing in the way: both residues are albedos."""

    @pytest.mark.parametrize("roughness", [0.15, 0.5, 0.9])
    def test_white_furnace(self, device, roughness):
        found = surfaces_of(ball(), looking_at(size=32), device, roughness)
        light = PreparedEnvironment(EnvironmentMap.constant((1, 1, 1), height=32), found.alpha.device)
        result = surface_residues(
            nothing(device), found, light, sample_count=256, diffuse_weight="albedo_scaling", seed=5
        )
        cosine = np.einsum("ij,ij->i", found.rows.normals.numpy(), found.rows.to_camera.numpy()).astype(np.float64)
        albedo = specular_albedo(cosine, np.full_like(cosine, roughness))
        diffuse, specular = (getattr(result, name).numpy()[:, 0] for name in ("diffuse", "specular"))
        usual = cosine > 0.1  # the table's last cell before grazing is bilinear in a steep function
        for error in (specular - albedo, diffuse - (1.0 - albedo), diffuse + specular - 1.0):
            require_zero_mean(error[usual], allowance=1e-3)
        require_honest((specular - albedo)[usual], result.specular_error.numpy()[usual], independent=False)


def quadrature(scene, found, environment, roughness, offset, cuts):
    """Both residues by midpoints of every texel, cut into ``cuts`` x ``cuts``: another way to the same integrals."""
    fine = EnvironmentMap(environment.radiance.repeat(cuts, axis=0).repeat(cuts, axis=1))
    w = fine.directions().reshape(-1, 3)
    power = (fine.radiance * fine.solid_angles()[..., None]).reshape(-1, 3).astype(np.float64)
    diffuse, specular = [], []
    for x, n, v in zip(
        *(getattr(found.rows, k).numpy().astype(np.float64) for k in ("positions", "normals", "to_camera")), strict=True
    ):
        cosine = w @ n
        up = cosine > 0.0
        origins = np.tile((x + offset * n).astype(np.float32), (up.sum(), 1))
        seen = visibility(scene, origins, w[up].astype(np.float32))
        arriving = power[up] * (seen * cosine[up])[:, None]
        h = w[up] + v
        h /= np.linalg.norm(h, axis=1, keepdims=True)
        fresnel = DIELECTRIC_F0 + (1.0 - DIELECTRIC_F0) * (1.0 - h @ v) ** 5
        diffuse.append((1.0 - fresnel) @ arriving / np.pi)
        specular.append(brdf_twin(n, v, w[up], roughness) @ arriving)
    return np.array(diffuse), np.array(specular)


def test_residues_are_unbiased(device, rng):
    """Means over many seeds against a quadrature, under a sun, in the midst of soft occluders."""
    cloud = random_cloud(rng, 400, scale=(-2.0, 0.3), opacity=(0.5, 1.0))
    scene = Scene.from_gaussians(cloud, device)
    found = surfaces_of(cloud, looking_at(size=5, fov=15.0), device, 0.4)
    assert len(found) > 10
    light = PreparedEnvironment(sunny(), scene.device)
    coarse = quadrature(scene, found, sunny(), 0.4, 0.05, 2)
    fine = quadrature(scene, found, sunny(), 0.4, 0.05, 4)
    runs = 60
    sums = {"diffuse": [], "specular": []}
    stated = {"diffuse": 0.0, "specular": 0.0}
    for seed in range(runs):
        result = surface_residues(scene, found, light, sample_count=40, offset=0.05, seed=seed)
        for name in sums:
            sums[name].append(getattr(result, name).numpy().astype(np.float64))
            stated[name] = stated[name] + getattr(result, f"{name}_error").numpy().astype(np.float64) ** 2 / runs
    for name, less, more in zip(sums, coarse, fine, strict=True):
        values = np.array(sums[name])
        # pixels are near each other and share no samples: a mean over pixels is one number a seed; midpoints of half
        # the width have a quarter of the error, so that a third of the change is what is left of it
        allowance = np.abs(more - less).mean() / 3.0
        require_zero_mean(values.mean(axis=(1, 2)) - more.mean(), allowance=allowance)
        true = values.mean(axis=2).var(axis=0, ddof=1)
        # 60 seeds know a variance to a fifth, its mean over pixels better; parts by density make it less than stated
        assert true.mean() < 1.2 * stated[name].mean()
        assert true.mean() > stated[name].mean() / 25.0


def test_mirrors_in_the_sun_are_finite(device):
    found = surfaces_of(ball(400), looking_at(size=12), device, 0.0)
    light = PreparedEnvironment(sunny(), found.alpha.device)
    result = surface_residues(nothing(device), found, light, sample_count=16)
    for name in ("diffuse", "specular", "diffuse_error", "specular_error"):
        values = getattr(result, name).numpy()
        assert np.isfinite(values).all()
        assert (values >= 0.0).all()


def test_darkness_is_dark(device):
    found = surfaces_of(ball(400), looking_at(size=6), device)
    light = PreparedEnvironment(EnvironmentMap.constant((0, 0, 0), height=32), found.alpha.device)
    result = surface_residues(nothing(device), found, light)
    assert not result.diffuse.numpy().any()
    assert not result.specular.numpy().any()


@pytest.mark.parametrize(
    "options", [{"sample_count": 3}, {"offset": np.nan}, {"diffuse_weight": "half"}, {"seed": -1}, {"frame": 2**32}]
)
def test_refusals(options):
    found = surfaces_of(ball(50), looking_at(size=2), wp.get_device("cpu"))
    light = PreparedEnvironment(EnvironmentMap.constant((1, 1, 1), height=32), found.alpha.device)
    with pytest.raises(InvalidOptionError, match=f"^{next(iter(options))} must be"):
        surface_residues(nothing("cpu"), found, light, **options)
    with pytest.raises(InvalidOptionError, match=r"^surface_depth must be"):
        surfaces_of(ball(50), looking_at(size=2), wp.get_device("cpu"), surface_depth="nearest")
