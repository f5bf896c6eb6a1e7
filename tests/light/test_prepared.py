"""Prepared environments: each form made once, scaling, and blurred levels against brute force."""

from functools import cache

import numpy as np
import pytest
from support.split_sum import blurred_level, sunny_environment

from beam_warp.errors import DeviceError
from beam_warp.light import prepared
from beam_warp.light.ggx import ggx_distribution
from beam_warp.light.prefiltered import LEVEL_ROUGHNESS, OPENING
from beam_warp.light.prepared import KEPT_ENVIRONMENTS, NO_LIGHT, PreparedEnvironment, PreparedEnvironments
from beam_warp.world.environment import EnvironmentMap, texel_directions

FLOAT32 = float(np.finfo(np.float32).eps)


def blur_brute_force(environment, axis, alpha):
    """Σ w L ΔΩ / Σ w ΔΩ over all texels, w = D(h) (n·l) with n = v."""
    n_dot_l = np.maximum(environment.directions() @ axis, 0.0)
    weights = ggx_distribution(np.sqrt(0.5 * (1 + n_dot_l)), alpha) * n_dot_l * environment.solid_angles()
    return np.einsum("rc,rcx->x", weights, environment.radiance) / weights.sum()


@cache
def sunny_light(device):
    return PreparedEnvironment(sunny_environment(np.random.default_rng(20260)), device=device)


class TestBlurredLevels:
    def test_uniform_light_stays(self, device):
        lighting = PreparedEnvironment(EnvironmentMap.constant([1, 2, 0]), device=device)
        for level in range(len(LEVEL_ROUGHNESS)):
            # Numerator and denominator add the same terms; a few hundred in float32.
            np.testing.assert_allclose(blurred_level(lighting, level)[..., :2] / [1, 2], 1, atol=500 * FLOAT32)
            assert not blurred_level(lighting, level)[..., 2].any()

    @pytest.mark.parametrize("height", [4, 45])
    def test_level_zero_is_the_map(self, device, rng, height):
        environment = EnvironmentMap(rng.random((height, 2 * height, 3)))
        lighting = PreparedEnvironment(environment, device=device)
        np.testing.assert_array_equal(blurred_level(lighting, 0), environment.radiance)

    @pytest.mark.parametrize("level", [3, 6, 9, 12])
    def test_against_brute_force(self, device, rng, level):
        lighting = sunny_light(device)
        blurred = blurred_level(lighting, level)
        directions = texel_directions(*blurred.shape[:2]).reshape(-1, 3)
        picked = [*rng.integers(0, len(directions), 40), blurred[..., 0].argmax()]
        expected = [blur_brute_force(lighting.environment, directions[i], LEVEL_ROUGHNESS[level] ** 2) for i in picked]
        # A cell of size c w counts as a point: the second-order term of (1 + d² / w²)^-2 is c² / 3 of the peak.
        np.testing.assert_allclose(blurred.reshape(-1, 3)[picked], expected, rtol=OPENING**2 / 3)

    def test_the_mean_over_the_sphere_is_kept(self, device):
        lighting = sunny_light(device)
        for level in (8, 12):  # a symmetric, normalised kernel keeps it; these lobes are wider than a texel
            mean = EnvironmentMap(blurred_level(lighting, level)).mean_radiance()
            np.testing.assert_allclose(mean, lighting.environment.mean_radiance(), rtol=1e-2)

    def test_the_sun_stays_in_its_place(self, device):
        lighting = sunny_light(device)
        sun = lighting.environment.directions()[16, 21]
        for level in range(1, len(LEVEL_ROUGHNESS)):
            blurred = blurred_level(lighting, level)
            height = len(blurred)
            brightest = texel_directions(height, 2 * height).reshape(-1, 3)[blurred[..., 0].argmax()]
            assert np.arccos(np.clip(brightest @ sun, -1, 1)) < np.pi / height

    def test_same_bits_for_any_thread_count(self, monkeypatch, rng):
        environment = sunny_environment(rng, height=32)
        results = []
        for threads in ("1", "3"):
            monkeypatch.setenv("BEAM_WARP_THREADS", threads)
            results.append(PreparedEnvironment(environment, device="cpu").blurred.texels.numpy())
        np.testing.assert_array_equal(*results)


class TestForms:
    def test_each_is_made_when_it_is_asked_for_and_once(self, monkeypatch):
        made = []
        for name in ("blurred_environment", "environment_blocks", "environment_distribution", "light_moments"):
            usual = getattr(prepared, name)
            monkeypatch.setattr(prepared, name, lambda *a, n=name, f=usual: made.append(n) or f(*a))
        light = PreparedEnvironment(EnvironmentMap.constant((1.0, 2.0, 3.0)), "cpu")
        assert light.mean_irradiance == pytest.approx(2.0 * np.pi)
        assert light.regions(4) is light.regions(4)
        assert not made
        for _ in range(2):
            assert light.product_tree.blocks.radiance.ptr == light.blocks.radiance.ptr
            assert light.blurred is light.blurred
        assert made == ["environment_blocks", "blurred_environment"]
        assert light.scaled(2.0).mean_irradiance == 2.0 * light.mean_irradiance
        light.scaled(2.0).moments  # noqa: B018
        assert made[2:] == ["light_moments"]

    def test_unknown_device(self):
        with pytest.raises(DeviceError, match=r"device must be one of cpu.*, got 'tpu:0'\. Choose one of them"):
            PreparedEnvironment(EnvironmentMap.constant([1, 1, 1]), device="tpu:0")

    def test_the_last_few_are_kept(self):
        maps = [EnvironmentMap.constant((k, k, k), height=4) for k in range(KEPT_ENVIRONMENTS + 1)]
        given = PreparedEnvironment(maps[0], "cpu")
        kept = PreparedEnvironments(given.device, [given])
        assert kept.of(maps[0]) is given
        others = [kept.of(light) for light in maps[1:]]
        assert [kept.of(light) for light in maps[1:]] == others
        assert kept.of(maps[0]) is not given
        assert kept.of(None).environment is NO_LIGHT
