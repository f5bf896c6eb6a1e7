"""Small sources of an environment: discs in closed form, nothing lost, and nothing taken that is not small."""

import numpy as np
import pytest

from beam_warp.light.compact_sources import LEAST_SHARE, MOST_SOURCES, split_sources
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.world.environment import EnvironmentMap, texel_directions

SKY = np.array([0.4, 0.5, 0.8])
HEIGHT = 360
"""Half a degree a texel."""


def toward(azimuth, elevation):
    a, e = np.radians([azimuth, elevation])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def sky_with(*discs, height=HEIGHT):
    """An even sky with discs on it: (direction, half angle [degree], radiance); edges fade over a texel."""
    directions = texel_directions(height, 2 * height)
    radiance = np.broadcast_to(SKY, directions.shape).copy()
    for direction, half_angle, value in discs:
        away = np.degrees(np.arccos(np.clip(directions @ direction, -1.0, 1.0)))
        covered = np.clip((half_angle - away) * height / 180.0 + 0.5, 0.0, 1.0)[..., None]
        radiance += covered * (np.asarray(value) - radiance)
    return EnvironmentMap(radiance.astype(np.float32))


def irradiance(environment, normals):
    """Sum of radiance times cosine times solid angle over all texels, float64."""
    cosine = np.maximum(normals @ environment.directions().reshape(-1, 3).T, 0.0)
    flux = environment.radiance.astype(np.float64) * environment.solid_angles()[..., None]
    return cosine @ flux.reshape(-1, 3)


@pytest.mark.parametrize(("azimuth", "elevation"), [(40.0, 8.0), (179.9, 30.0), (10.0, 89.5), (-100.0, -20.0)])
@pytest.mark.parametrize("half_angle", [1.0, 3.0])
def test_a_disc_in_an_even_sky(azimuth, elevation, half_angle):
    """A light of its size, and of the power that texels have beyond the sky, float64; what is left is the sky."""
    sun, radiance = toward(azimuth, elevation), np.array([900.0, 700.0, 400.0])
    environment = sky_with((sun, half_angle, radiance))
    split = split_sources(environment)
    (light,) = split.sources
    assert np.degrees(np.arccos(-np.dot(light.direction, sun))) < 0.05
    texel = 90.0 / HEIGHT
    assert light.angular_diameter == pytest.approx(2.0 * np.hypot(half_angle, texel), rel=0.05)
    cosine = environment.directions() @ -np.array(light.direction)
    beyond = (environment.radiance - SKY) * environment.solid_angles()[..., None]
    np.testing.assert_allclose(light.irradiance, np.einsum("rc,rcx->x", cosine, beyond), rtol=1e-5)
    np.testing.assert_allclose(split.rest.radiance, np.broadcast_to(SKY, split.rest.radiance.shape), rtol=1e-6)


def test_several_sources(rng):
    """Three lamps; what they shed on any normal that faces them all, and what is left, is what the map does."""
    lamps = [(toward(20.0, 50.0), 1.5, (300.0, 200.0, 100.0)), (toward(-30.0, 60.0), 3.0, (200.0, 200.0, 200.0))]
    lamps.append((toward(70.0, 75.0), 1.0, (300.0, 400.0, 500.0)))
    environment = sky_with(*lamps)
    split = split_sources(environment)
    assert len(split.sources) == 3
    normals = np.stack([toward(*angles) for angles in rng.uniform((-10.0, 70.0), (50.0, 90.0), (20, 2))])
    sources = sum(
        np.maximum(-(normals @ np.array(light.direction)), 0.0)[:, None] * light.irradiance for light in split.sources
    )
    found = irradiance(split.rest, normals) + sources
    np.testing.assert_allclose(found, irradiance(environment, normals), rtol=1e-5)


@pytest.mark.parametrize(
    "environment",
    [
        EnvironmentMap.constant((0.0, 0.0, 0.0)),
        EnvironmentMap.constant((1.0, 2.0, 3.0), height=256),
        sky_with((toward(30.0, 40.0), 12.0, (50.0, 50.0, 50.0))),  # a soft box
        sky_with((toward(30.0, 40.0), 1.0, (30.0, 30.0, 30.0))),  # a lamp of 2 % of the power
        sky_with((toward(30.0, 40.0), 1.0, (9e4, 9e4, 9e4)), height=16),  # a texel is 11 degrees wide
        sky_with((toward(30.0, 40.0), 1.0, (1e30, 1e30, 1e30))),  # more than a light can state
    ],
    ids=["black", "even", "soft box", "faint", "coarse", "beyond lights"],
)
def test_nothing_is_taken_that_is_not_small_and_strong(environment):
    split = split_sources(environment)
    assert split.rest is environment
    assert split.sources == ()


def test_a_sun_is_told_from_its_glare_and_a_soft_box_stays():
    """The glare of 25 degrees stays with the sky, and a box of more power does not hide the sun."""
    sun, box = toward(0.0, 30.0), toward(150.0, 20.0)
    directions = texel_directions(HEIGHT, 2 * HEIGHT)
    radiance = sky_with((box, 15.0, (60.0, 60.0, 60.0)), (sun, 1.0, (4000.0, 3000.0, 2000.0))).radiance.copy()
    away = np.degrees(np.arccos(np.clip(directions @ sun, -1.0, 1.0)))
    radiance += (8.0 * np.exp(-((away / 25.0) ** 2)))[..., None].astype(np.float32)
    environment = EnvironmentMap(radiance)
    (light,) = split_sources(environment).sources
    assert np.degrees(np.arccos(-np.dot(light.direction, sun))) < 0.1
    assert light.angular_diameter == pytest.approx(2.0, rel=0.1)


def test_no_more_than_the_most():
    lamps = [(toward(60.0 * k, 20.0), 1.0, (900.0, 900.0, 900.0)) for k in range(MOST_SOURCES + 2)]
    assert len(split_sources(sky_with(*lamps)).sources) == MOST_SOURCES
    assert MOST_SOURCES * LEAST_SHARE < 1.0


def test_of_a_scaled_and_of_a_turned_light():
    """Sources of a light twice as bright are twice as bright, and those of a turned one turned."""
    environment = sky_with((toward(20.0, 35.0), 1.0, (900.0, 700.0, 400.0)))
    light = PreparedEnvironment(environment, "cpu")
    rest, (source,) = light.split
    assert light.split[0] is rest
    twice, (brighter,) = light.scaled(2.0).split
    np.testing.assert_allclose(brighter.irradiance, 2.0 * np.array(source.irradiance), rtol=1e-12)
    np.testing.assert_allclose(twice.environment.radiance, 2.0 * rest.environment.radiance, rtol=1e-6)
    (expected,) = split_sources(environment.rotated(90.0)).sources
    np.testing.assert_allclose(source.turned(90.0).direction, expected.direction, atol=1e-6)
    even = PreparedEnvironment(EnvironmentMap.constant((1.0, 1.0, 1.0)), "cpu")
    assert even.split == (even, ())
    scaled = even.scaled(3.0)
    assert scaled.split == (scaled, ())
