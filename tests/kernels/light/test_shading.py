"""The split sum at single surfaces: furnace, float64 twin, and the full rendering equation."""

import itertools
from functools import cache

import numpy as np
import pytest
from reference.specular_lobe import reflected_lobe
from support.split_sum import LINEAR, blurred_level, shade, smooth_environment, sunny_environment

from beam_warp.kernels.light.stretched_lobe import COEFFICIENTS, LOBES
from beam_warp.light.ggx import DIELECTRIC_F0, specular_albedo
from beam_warp.light.prefiltered import LEVEL_ROUGHNESS
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.world.environment import EnvironmentMap

FLOAT32 = float(np.finfo(np.float32).eps)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_surfaces(rng, shape=(9, 30)):
    """Surfaces of every kind; a part of the normals faces away from the camera."""
    return {
        "base_color": rng.random((*shape, 3)).astype(np.float32),
        "roughness": rng.random(shape).astype(np.float32),
        "ambient_occlusion": rng.random(shape).astype(np.float32),
        "normals": (rng.normal(size=(*shape, 3)) * 3).astype(np.float32),
        "alpha": rng.random(shape).astype(np.float32),
        "view_directions": unit(rng.normal(size=(*shape, 3))).astype(np.float32),
    }


def facing_surfaces(n_dot_v, roughness, base_color):
    """One row of surfaces with normal +z, seen under the given cosines."""
    n_dot_v, roughness = np.broadcast_arrays(np.atleast_1d(n_dot_v), np.atleast_1d(roughness))
    count = len(n_dot_v)
    sine = np.sqrt(1 - n_dot_v**2)
    return {
        "base_color": np.full((1, count, 3), base_color),
        "roughness": roughness[None],
        "ambient_occlusion": np.ones((1, count)),
        "normals": np.broadcast_to([0.0, 0.0, 1.0], (1, count, 3)),
        "alpha": np.ones((1, count)),
        "view_directions": -np.stack([sine, 0 * sine, n_dot_v], axis=-1)[None],
    }


# ---- the float64 twin -----------------------------------------------------------------------------------------------


def bilinear_twin(image, d):
    height, width = image.shape[:2]
    x = (0.5 - np.arctan2(d[..., 1], d[..., 0]) / (2 * np.pi)) * width - 0.5
    y = np.arccos(np.clip(d[..., 2], -1, 1)) / np.pi * height - 0.5
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - column)[..., None], (y - row)[..., None]

    def at(r, c):
        across = (r < 0) | (r >= height)  # over a pole and down the other side
        return image[
            np.where(r < 0, -1 - r, np.where(r >= height, 2 * height - 1 - r, r)), (c + across * (width // 2)) % width
        ]

    top = at(row, column) * (1 - fx) + at(row, column + 1) * fx
    bottom = at(row + 1, column) * (1 - fx) + at(row + 1, column + 1) * fx
    return top * (1 - fy) + bottom * fy


def blurred_twin(lighting, d, roughness):
    ratio = LEVEL_ROUGHNESS[2] / LEVEL_ROUGHNESS[1]
    relative = roughness / LEVEL_ROUGHNESS[1]
    position = np.where(relative > 1, 1 + np.log(np.maximum(relative, 1)) / np.log(ratio), relative)
    level = np.clip(position.astype(int), 0, len(LEVEL_ROUGHNESS) - 2)
    images = [blurred_level(lighting, k).astype(np.float64) for k in range(len(LEVEL_ROUGHNESS))]
    every = np.stack([bilinear_twin(image, d) for image in images])
    pick = np.take_along_axis
    low = pick(every, level[None, ..., None], axis=0)[0]
    high = pick(every, level[None, ..., None] + 1, axis=0)[0]
    f = (position - level)[..., None]
    return low * (1 - f) + high * f


def shade_twin(lighting, *, base_color, roughness, ambient_occlusion, normals, alpha, view_directions):
    v = -view_directions.astype(np.float64)
    n = unit(normals.astype(np.float64))
    r, openness = roughness.astype(np.float64), ambient_occlusion.astype(np.float64)
    cosine = (n * v).sum(-1)
    bent = np.where((cosine < 1e-4)[..., None], unit(n + (1e-4 - cosine)[..., None] * v), n)
    facing = (bent * v).sum(-1)[..., None]
    mirrored, aside = 2 * facing * bent - v, facing * v + (1 - 2 * facing**2) * bent
    n_dot_v = np.clip(cosine, 1e-4, 1)
    albedo = specular_albedo(n_dot_v, r)
    occlusion = np.clip((n_dot_v + openness) ** np.exp2(-16 * r - 1) - 1 + openness, 0, 1)
    irradiance = bilinear_twin(lighting.blurred.irradiance.numpy().astype(np.float64), n)
    diffuse = base_color * irradiance * ((1 - albedo) * openness / np.pi)[..., None]
    x = np.sqrt(np.maximum(facing[..., 0], 0.01))
    powers = np.stack([x**i * r**k for i in range(3) for k in range(3)], axis=-1)
    numbers = powers @ np.transpose(COEFFICIENTS)
    weights = np.exp(np.concatenate([numbers[..., 8:], np.zeros((*r.shape, 1))], axis=-1))
    weights /= weights.sum(-1, keepdims=True)
    reflected = sum(
        weights[..., k, None]
        * blurred_twin(
            lighting,
            unit(mirrored + (r**2 * numbers[..., k])[..., None] * aside),
            np.clip(r * numbers[..., 4 + k], 0, 1),
        )
        for k in range(LOBES)
    )
    specular = reflected * (albedo * occlusion)[..., None]
    return (diffuse + specular) * alpha[..., None]


@cache
def smooth_light(device):
    return PreparedEnvironment(smooth_environment(), device=device)


class TestShade:
    def test_white_furnace(self, device):
        lighting = PreparedEnvironment(EnvironmentMap.constant([1, 1, 1]), device=device)
        n_dot_v, roughness = np.meshgrid([0.0, 0.01, 0.1, 0.4, 0.8, 1.0], [0.0, 0.05, 0.2, 0.5, 0.8, 1.0])
        radiance = shade(lighting, **facing_surfaces(n_dot_v.ravel(), roughness.ravel(), 1.0))
        # By construction; what is left is the irradiance of uniform light (1e-5) and float32.
        np.testing.assert_allclose(radiance, 1.0, atol=1e-4)

    def test_equals_its_float64_twin(self, device, rng):
        lighting = smooth_light(device)
        surfaces = random_surfaces(rng)
        expected = shade_twin(lighting, **surfaces)
        np.testing.assert_allclose(shade(lighting, **surfaces), expected, atol=1e-5, rtol=1e-5)

    @pytest.mark.parametrize("n_dot_v", [0.1, 0.2, 0.4, 0.7, 1.0])
    @pytest.mark.parametrize("roughness", [0.1, 0.2, 0.35, 0.5, 0.75, 1.0])
    def test_against_the_full_rendering_equation(self, device, n_dot_v, roughness):
        """Under L = 1 + g·ω a lobe sees 1 + g·m, m its mean direction, which is not the mirror direction."""
        base_color = 0.5
        radiance = shade(smooth_light(device), **facing_surfaces(n_dot_v, roughness, base_color))[0, 0, 0]
        directions, shares = reflected_lobe(n_dot_v, roughness, DIELECTRIC_F0, count=400)
        mean_direction = (directions * shares).sum(axis=(1, 2)) / shares.sum()
        albedo = specular_albedo(n_dot_v, roughness)
        specular = albedo * (1 + LINEAR @ mean_direction)
        diffuse = (1 - albedo) * base_color * (1 + LINEAR[2] * 2 / 3)
        # Bilinear lookup of a level with texels of π / 32 loses (π / 32)² / 8 of a linear function; cells of the tree
        # count as points; the mean direction of round lobes is off by 0.05 at the most, where the view grazes.
        most = 0.05 if n_dot_v < 0.15 else 0.03
        assert abs(radiance - diffuse - specular) < most * np.linalg.norm(LINEAR) * albedo + 1e-3 * diffuse

    def test_degenerate_normals_stay_finite(self, device, rng):
        lighting = PreparedEnvironment(sunny_environment(rng, height=16), device=device)
        view = unit(np.array([0.3, -0.2, 0.9]))
        side = unit(np.cross(view, [0.0, 0.0, 1.0]))
        normals = np.array([[0 * view, view, -view, side, 1e-30 * view, 1e30 * side, [0, 0, 1], [0, 0, -1]]])
        count = normals.shape[1]
        radiance = shade(
            lighting,
            base_color=np.ones((1, count, 3)),
            roughness=np.linspace(0, 1, count)[None],
            ambient_occlusion=np.zeros((1, count)),
            normals=normals,
            alpha=np.ones((1, count)),
            view_directions=np.broadcast_to(view, (1, count, 3)),
        )
        assert np.isfinite(radiance).all()
        assert (radiance >= 0).all()

    def test_occlusion_only_darkens(self, device, rng):
        lighting = smooth_light(device)
        surfaces = random_surfaces(rng)
        levels = [shade(lighting, **{**surfaces, "ambient_occlusion": np.full((9, 30), v)}) for v in (0, 0.3, 0.9, 1)]
        for darker, lighter in itertools.pairwise(levels):
            assert (darker <= lighter * (1 + 4 * FLOAT32)).all()
        assert levels[0].max() < 0.05 * levels[-1].max()
