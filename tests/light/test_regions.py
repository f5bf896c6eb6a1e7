"""Regions of an environment: least blur, nothing lost, a region for a sun, and turning."""

import numpy as np
import pytest

from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import LUMINANCE
from beam_warp.light.regions import EnvironmentRegions
from beam_warp.world.environment import EnvironmentMap


def cloudy(rng, height=32):
    return EnvironmentMap((rng.random((height, 2 * height, 3)) ** 4).astype(np.float32))


@pytest.mark.parametrize("count", [1, 2, 8, 64])
def test_regions_hold_all_light(rng, count):
    """The sums of radiance times direction are those of the whole map, in float64 up to the order of sums."""
    light = cloudy(rng)
    regions = EnvironmentRegions.of(light, count)
    assert len(regions) == count
    flux = light.radiance.astype(np.float64) * light.solid_angles()[..., None]
    expected = np.einsum("rcx,rck->xk", flux, light.directions())
    np.testing.assert_allclose(regions.moments[..., :3].sum(axis=1), expected, rtol=1e-9, atol=1e-9 * flux.sum())
    np.testing.assert_allclose(np.linalg.norm(regions.directions, axis=1), 1.0, rtol=1e-12)


def blur(power, directions):
    """Power times the standard deviation of directions, by its definition."""
    if not power.sum() > 0.0:
        return 0.0
    mean = np.average(directions, axis=0, weights=power)
    return float(power.sum() * np.sqrt(np.average(np.square(directions - mean).sum(axis=1), weights=power)))


def blurs_of_cuts(light):
    """The blur that each cut of a whole map leaves, of all rows and columns, brute force."""
    power = (light.radiance.astype(np.float64) @ LUMINANCE) * light.solid_angles()
    directions = light.directions()
    left = []
    for axis in range(2):
        for place in range(1, power.shape[axis]):
            parts = zip(np.split(power, [place], axis), np.split(directions, [place], axis), strict=True)
            left.append(sum(blur(some.reshape(-1), ways.reshape(-1, 3)) for some, ways in parts))
    return left


def blur_of(regions):
    """The blur that is left, of what regions tell: their power, and the half angles of discs that spread alike."""
    lengths = np.linalg.norm(np.einsum("xkd,x->kd", regions.moments[..., :3], LUMINANCE), axis=1)
    cosines = 0.5 * (1.0 + np.cos(regions.half_angles))  # lengths of the mean directions
    return float((lengths / cosines * np.sqrt(1.0 - np.square(cosines))).sum())


def window(rng):
    """A light that is narrow enough for the discs of its parts to be as wide as they are."""
    radiance = np.zeros((32, 64, 3), np.float32)
    radiance[12:24, 20:40] = rng.random((12, 20, 3)) ** 4
    return EnvironmentMap(radiance)


def test_the_first_cut_leaves_least_blur(rng):
    light = window(rng)
    assert blur_of(EnvironmentRegions.of(light, 2)) == pytest.approx(min(blurs_of_cuts(light)), rel=1e-9)


def test_every_further_cut_leaves_less(rng):
    light = window(rng)
    left = [blur_of(EnvironmentRegions.of(light, count)) for count in (2, 3, 5, 8, 16, 40)]
    assert (np.diff(left) < 0.0).all()


def test_a_sun_is_a_region_and_the_sky_has_the_others():
    """A texel of 100 times the power of all others is one small region: a second one would see nothing else."""
    radiance = np.full((64, 128, 3), 1e-3, np.float32)
    radiance[16, 40] = 1e3
    light = EnvironmentMap(radiance)
    regions = EnvironmentRegions.of(light, 16)
    power = np.linalg.norm(regions.moments[0, :, :3], axis=1)
    strongest = np.argmax(power)
    cosine = regions.directions[strongest] @ light.directions()[16, 40]
    assert np.arccos(min(cosine, 1.0)) < 0.5 * np.pi / 64
    assert regions.half_angles[strongest] < np.pi / 64
    others = np.delete(regions.half_angles, strongest)
    assert (others > 0.2).sum() >= 12
    assert np.delete(power, strongest).max() < 0.01 * power[strongest]


def test_rounding_does_not_choose_between_cuts_that_gain_alike():
    """A window in an even wall: cuts to the left and to the right of it are mirror images."""
    radiance = np.full((16, 32, 3), 0.3)
    radiance[3:7, 20:26] = (6.0, 5.0, 4.0)
    regions = EnvironmentRegions.of(EnvironmentMap(radiance.astype(np.float32)), 16)
    for seed in range(4):
        noise = 1.0 + 1e-7 * np.random.default_rng(seed).normal(size=radiance.shape)
        other = EnvironmentRegions.of(EnvironmentMap((radiance * noise).astype(np.float32)), 16)
        np.testing.assert_allclose(other.directions, regions.directions, atol=1e-5)
        np.testing.assert_allclose(other.half_angles, regions.half_angles, atol=1e-4)


def test_turning_is_turning_the_map(rng):
    """A map turned by whole columns has the same texels; cuts at other columns than 0 do not matter for one region."""
    light = cloudy(rng)
    turned = EnvironmentRegions.of(light, 1).turned(90.0)
    expected = EnvironmentRegions.of(light.rotated(90.0), 1)
    for name in ("directions", "half_angles", "moments"):
        np.testing.assert_allclose(getattr(turned, name), getattr(expected, name), rtol=1e-6, atol=1e-6)


def test_black_light_and_bad_counts():
    black = EnvironmentRegions.of(EnvironmentMap.constant((0, 0, 0)), 8)
    assert np.isfinite(black.directions).all()
    assert not black.moments.any()
    for count in (0, 512):
        with pytest.raises(InvalidOptionError, match="count must be"):
            EnvironmentRegions.of(EnvironmentMap.constant((1, 1, 1)), count)


def test_more_regions_than_texels():
    """What is one texel is not cut; empty regions shed no light."""
    light = EnvironmentMap.constant((1.0, 1.0, 1.0), height=4)
    regions = EnvironmentRegions.of(light, 64)
    assert np.isfinite(regions.moments).all()
    np.testing.assert_allclose(regions.moments[..., :3].sum(axis=1), 0.0, atol=1e-6)
