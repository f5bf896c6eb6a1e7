"""Directions by sky times cosine without memory at the point: map, density, and that nothing that arrives is missed."""

import numpy as np
import pytest
import warp as wp
from support.estimates import LARGEST_Z, require_density
from support.kernel_runs import run_kernel
from support.split_sum import sunny_sky, texels_of

from beam_warp.kernels.light.environment_sampling import radiance_over_pdf
from beam_warp.kernels.light.product_tree import (
    ProductTree,
    square_to_product_tree,
    square_to_product_tree_pdf,
    total_weight,
)
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.world.environment import EnvironmentMap

NORMALS = np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [-0.48, 0.6, -0.64]], np.float32)


@wp.kernel
def draw_kernel(
    tree: ProductTree,
    normal: wp.vec3,
    squares: wp.array[wp.vec2],
    out_direction: wp.array[wp.vec3],
    out_radiance: wp.array[wp.vec3],
    out_pdfs: wp.array[wp.vec2],
):
    i = wp.tid()
    total = total_weight(tree, normal)
    drawn = square_to_product_tree(tree, normal, total, squares[i][0], squares[i][1])
    out_direction[i] = drawn.direction
    out_radiance[i] = radiance_over_pdf(drawn)
    out_pdfs[i] = wp.vec2(drawn.pdf, square_to_product_tree_pdf(tree, normal, total, drawn.direction))


@wp.kernel
def density_kernel(tree: ProductTree, normal: wp.vec3, directions: wp.array[wp.vec3], out: wp.array[float]):
    i = wp.tid()
    out[i] = square_to_product_tree_pdf(tree, normal, total_weight(tree, normal), directions[i])


def draw(device, sky, normal, count, seed=0):
    squares = np.random.default_rng(seed).uniform(size=(count, 2)).astype(np.float32)
    inputs = [PreparedEnvironment(sky, device).product_tree, wp.vec3(*normal.tolist()), (squares, wp.vec2)]
    return run_kernel(draw_kernel, count, inputs, (wp.vec3, wp.vec3, wp.vec2), device)


def density(device, sky, normal):
    directions = sky.directions().reshape(-1, 3)
    inputs = [PreparedEnvironment(sky, device).product_tree, wp.vec3(*normal.tolist()), (directions, wp.vec3)]
    (found,) = run_kernel(density_kernel, len(directions), inputs, [float], device)
    return found.reshape(sky.height, sky.width).astype(np.float64)


@pytest.mark.parametrize("normal", NORMALS[:3])
def test_density_integrates_to_one(device, normal):
    sky = sunny_sky()
    # groups whose bound is above 0 and whose blocks' are not draw nothing: that share is missing, and must be small
    total = (density(device, sky, normal) * sky.solid_angles()).sum()
    assert total <= 1.0 + 1e-5
    assert total > 0.97


def test_density_is_positive_wherever_light_arrives(device):
    sky = sunny_sky()
    for normal in NORMALS:
        arriving = (sky.directions() @ normal > 0.0) & (sky.radiance.sum(-1) > 0.0)
        assert (density(device, sky, normal)[arriving] > 0.0).all()


def test_draws_follow_the_density(device):
    """Counts of draws in the blocks of the map against the density's, by the chi-squared test."""
    rng = np.random.default_rng(2)
    sky = EnvironmentMap(rng.gamma(0.4, 1.0, (32, 64, 3)).astype(np.float32))
    count = 20_000
    direction, _, pdfs = draw(device, sky, NORMALS[0], count)
    drawn = pdfs[:, 0] > 0.0
    rows, columns = texels_of(direction[drawn], 16)
    counts = np.bincount(rows * 32 + columns, minlength=512)
    share = (density(device, sky, NORMALS[0]) * sky.solid_angles()).reshape(16, 2, 32, 2).sum(axis=(1, 3))
    require_density(np.append(counts, (~drawn).sum()), np.append(share, 1.0 - share.sum()), least=5.0)


def test_draws_know_their_density(device):
    direction, _, pdfs = draw(device, sunny_sky(), NORMALS[0], 4096)
    drawn = pdfs[:, 0] > 0.0
    assert np.allclose(np.linalg.norm(direction[drawn], axis=1), 1.0, atol=1e-5)
    # rounding may carry a direction over a texel's edge, never far
    same = np.isclose(pdfs[drawn, 0], pdfs[drawn, 1], rtol=1e-4)
    assert same.mean() > 0.99


def test_irradiance_is_right_on_average(device):
    sky = sunny_sky()
    for normal in NORMALS[:3]:
        direction, radiance, _ = draw(device, sky, normal, 20_000)
        values = (radiance * np.maximum(direction @ normal, 0.0)[:, None]).mean(axis=1).astype(np.float64)
        weight = np.maximum(sky.directions() @ normal, 0.0) * sky.solid_angles()
        exact = (sky.radiance.mean(axis=-1) * weight).sum()
        # texels at the horizon are cut by it, which the sum over their middles ignores: half a texel of the dim sky
        allowance = 0.5 * 2.0 * (np.pi / 64) ** 2
        assert abs(values.mean() - exact) < LARGEST_Z * values.std() / np.sqrt(len(values)) + allowance


def test_a_black_sky_draws_nothing(device):
    _, radiance, pdfs = draw(device, EnvironmentMap.constant((0.0, 0.0, 0.0)), NORMALS[0], 64)
    assert not radiance.any()
    assert not pdfs.any()
