"""The rasteriser: closed forms, a float64 brute force without tiles, invariances, and every awkward input."""

import numpy as np
import pytest
from reference import rasterizing as reference
from reference.harmonics import sh_color
from support.raster_clouds import around
from support.raster_clouds import cloud as make_cloud
from support.shapes import aligned

from beam_warp.errors import DeviceError, InvalidArrayError, InvalidOptionError
from beam_warp.raster.gbuffer import rasterize, rasterize_values
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import MATERIAL_CHANNELS, GaussianCloud

WEIGHT_ROUNDING = 1e-5
"""A pixel coordinate below 64 is rounded by up to 4e-6 twice (centre, offset), and a response changes by at most
exp(-1/2) / sqrt(0.3) = 1.1 per pixel, since no splat is narrower than the low-pass; the rest is far smaller."""

DEPTH_ROUNDING = 1e-6
"""Relative: eight single-precision operations on a depth, 6e-8 each."""


def sums(images):
    """Alpha, and the sums of depth and values, as the reference gives them."""
    return images.alpha, images.depth * images.alpha, images.values


def front(width=40, height=40):
    """A camera at (0, -2, 0), looking along +y."""
    return Camera.orbit((0, 0, 0), 2.0, 0.0, 0.0, width=width, height=height, vertical_fov=50.0)


@pytest.mark.parametrize("antialiased", [False, True])
def test_against_brute_force(device, rng, antialiased):
    cloud, camera = make_cloud(rng, 300), around()
    values = rng.uniform(0, 1, (300, 5)).astype(np.float32)
    options = RasterOptions(antialiased=antialiased)
    got = sums(rasterize_values(cloud, camera, values, device=device, options=options))
    expected = reference.rasterize(cloud, camera, values, antialiased=antialiased)
    assert expected[0].mean() > 0.5
    for actual, wanted, magnitude in zip(got, expected, (1.0, 4.0, 1.0), strict=True):
        np.testing.assert_allclose(actual, wanted, atol=WEIGHT_ROUNDING * magnitude)


def test_opaque_plane_has_its_exact_depth_everywhere(device, rng):
    x, z = rng.uniform(-1.5, 1.5, (2, 3000))
    cloud = GaussianCloud(
        positions=np.stack([x, 0.3 * x, z], axis=-1),
        orientations=np.tile([0.0, 0.0, np.sin(0.5 * np.arctan(0.3)), np.cos(0.5 * np.arctan(0.3))], (3000, 1)),
        scales=np.tile([0.06, 1e-4, 0.06], (3000, 1)),
        opacities=np.full(3000, 0.9),
    )
    camera = front()
    buffer = rasterize(cloud, camera, channels=(), device=device)
    rays = camera.directions()
    depth = 2.0 / (rays[..., 1] - 0.3 * rays[..., 0]) * rays[..., 1]
    assert buffer.alpha.min() > 0.9
    # Three dozen layers each contribute a rounded weight and depth.
    np.testing.assert_allclose(buffer.depth, depth, rtol=36 * DEPTH_ROUNDING)


def test_what_is_not_in_view_is_not_drawn(device, rng):
    camera = front()
    empty = make_cloud(rng, 0, base_color=np.zeros((0, 3)))
    buffer = rasterize(empty, camera, channels=("base_color",), device=device)
    assert not buffer.alpha.any()
    assert not buffer.depth.any()
    assert buffer.channels["base_color"].shape == (40, 40, 3)
    for position in ([0, -3, 0], [0, -2, 0], [0, -1.995, 0], [50, 0, 0], [0, 0, -50]):
        assert not rasterize(aligned([position], 1.0, 0.1), camera, channels=(), device=device).alpha.any(), position
    assert not rasterize(aligned([[0, 0, 0]], 0.003, 0.1), camera, channels=(), device=device).alpha.any()


def test_extreme_gaussians_stay_finite(device, rng):
    positions = [[0, 0, 0], [1e30, 1e30, 1e30], [0, -1.98, 0], [0, 1e6, 0], [0.0, 0.5, 0.0], [3, -1.98, 0.0]]
    scales = [[1e-30, 1e-30, 1e-30], [1e20, 1e20, 1e20], [5, 5, 5], [1e15, 1, 1e15], [1e4, 0, 0], [10, 1e-6, 1]]
    cloud = aligned(np.asarray(positions, float), 0.9, np.asarray(scales, float))
    for antialiased in (False, True):
        options = RasterOptions(antialiased=antialiased)
        for array in rasterize_values(cloud, front(), np.ones((6, 2)), device=device, options=options):
            assert np.isfinite(array).all()


def test_channels_are_means_whatever_the_coverage(device, rng):
    count = 200
    cloud = make_cloud(
        rng,
        count,
        base_color=np.tile([0.2, 0.4, 0.8], (count, 1)),
        roughness=np.full(count, 0.3),
        ambient_occlusion=rng.uniform(0, 1, count),
        normals=np.tile([0.6, 0.0, 0.8], (count, 1)),
    )
    buffer = rasterize(cloud, around(), device=device)
    assert list(buffer.channels) == list(MATERIAL_CHANNELS)
    covered = buffer.alpha > 0
    for name, expected in (("base_color", [0.2, 0.4, 0.8]), ("roughness", 0.3), ("normals", [0.6, 0.0, 0.8])):
        np.testing.assert_allclose(buffer.channels[name][covered] - expected, 0.0, atol=WEIGHT_ROUNDING)
        assert not buffer.channels[name][~covered].any()
    assert buffer.channels["roughness"].shape == (36, 40)
    layers = buffer.layers()
    assert sorted(layers) == sorted(
        ["A", "depth", "roughness", "ambient_occlusion"]
        + [f"base_color.{part}" for part in "RGB"]
        + [f"normal.{part}" for part in "XYZ"]
    )
    np.testing.assert_array_equal(layers["normal.Z"], buffer.channels["normals"][..., 2])
    occlusion = buffer.channels["ambient_occlusion"][covered]
    assert occlusion.min() >= 0.0
    assert occlusion.max() <= 1.0


def test_more_channels_than_one_pass(device, rng):
    cloud, values = make_cloud(rng, 50), rng.uniform(0, 1, (50, 37)).astype(np.float32)
    together = rasterize_values(cloud, around(), values, device=device).values
    for start in (0, 16, 36):
        alone = rasterize_values(cloud, around(), values[:, start : start + 1], device=device).values
        np.testing.assert_array_equal(together[..., start], alone[..., 0])


def test_radiance_is_seen_from_the_camera(device, rng):
    camera = around()
    radiance = rng.normal(0, 0.3, (1, 16, 3))
    cloud = aligned([[0.1, 0.0, 0.1]], 0.9, 0.2, radiance=radiance, radiance_color_space="srgb_rec709_display")
    direction = cloud.positions - camera.position
    expected = sh_color(radiance, direction / np.linalg.norm(direction))[0]
    buffer = rasterize(cloud, camera, channels=("radiance",), device=device)
    np.testing.assert_allclose(buffer.channels["radiance"][20, 20], expected, atol=WEIGHT_ROUNDING)


def test_errors_name_the_contract(rng):
    cloud = make_cloud(rng, 3)
    with pytest.raises(InvalidArrayError, match="cloud holds, got 'base_color', which it lacks"):
        rasterize(cloud, front())
    with pytest.raises(
        InvalidOptionError, match=r"channels must be one of radiance, surface_normals, base_color, .* got 'colour'"
    ):
        rasterize(cloud, front(), channels=("colour",))
    with pytest.raises(InvalidOptionError, match="cloud must be in the axes 'rfu', got 'rub'"):
        rasterize(cloud.with_arrays(axes="rub"), front(), channels=())
    with pytest.raises(DeviceError, match=r"device must be one of cpu.* got 'cuda:77'"):
        rasterize(cloud, front(), channels=(), device="cuda:77")
    with pytest.raises(InvalidArrayError, match="values must have as many rows as positions"):
        rasterize_values(cloud, front(), np.zeros((2, 1)))
