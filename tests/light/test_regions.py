"""Regions of an environment: equal power, nothing lost, small suns, and turning."""

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


def test_regions_have_equal_power(rng):
    """A cut is off by at most the row or column of texels that it falls on: here 1/32 of what it halves, each time, and
    twice that for how uneven random texels are."""
    light = cloudy(rng, height=64)
    regions = EnvironmentRegions.of(light, 8)
    power = regions.moments[..., :3].transpose(1, 0, 2)
    assert len(power) == 8
    lengths = np.linalg.norm(np.einsum("kxd,x->kd", power, LUMINANCE), axis=1)
    # the length of the mean direction falls with the width of a region: compare with how far its directions spread
    spread = (1.0 + np.cos(regions.half_angles)) / 2.0
    assert np.ptp(lengths / spread) / np.mean(lengths / spread) < 3 * 2 / 32 + 0.1


def test_a_sun_is_a_small_region():
    """A texel of 512 times the power of all others gets all regions but those that the rest of its rows and columns are
    cut into, and one has its direction and its size."""
    radiance = np.full((64, 128, 3), 1e-3, np.float32)
    radiance[16, 40] = 5e4
    light = EnvironmentMap(radiance)
    regions = EnvironmentRegions.of(light, 16)
    strongest = np.argmax(np.linalg.norm(regions.moments[0, :, :3], axis=1))
    cosine = regions.directions[strongest] @ light.directions()[16, 40]
    assert np.arccos(min(cosine, 1.0)) < 0.5 * np.pi / 64
    assert regions.half_angles[strongest] < np.pi / 64


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
    for count in (0, 3, 512):
        with pytest.raises(InvalidOptionError, match="count must be"):
            EnvironmentRegions.of(EnvironmentMap.constant((1, 1, 1)), count)


def test_more_regions_than_texels():
    """What is one texel is not cut; empty regions shed no light."""
    light = EnvironmentMap.constant((1.0, 1.0, 1.0), height=4)
    regions = EnvironmentRegions.of(light, 64)
    assert np.isfinite(regions.moments).all()
    np.testing.assert_allclose(regions.moments[..., :3].sum(axis=1), 0.0, atol=1e-6)
