"""Directions by sky times cosine, with weights of blocks at the point or of a tree: map, density, nothing missed."""

from collections import namedtuple

import numpy as np
import pytest
import warp as wp
from reference.latlong import lookup
from reference.light_sampling import product_to_square, square_to_product_pdf
from support.estimates import LARGEST_Z, require_density
from support.kernel_runs import run_kernel
from support.split_sum import sunny_sky, texels_of

from beam_warp.kernels.light.environment_sampling import radiance_over_pdf
from beam_warp.kernels.light.product_sampling import (
    EnvironmentBlocks,
    launch_accumulate_block_weights,
    square_to_product,
)
from beam_warp.kernels.light.product_tree import (
    ProductTree,
    square_to_product_tree,
    square_to_product_tree_pdf,
    total_weight,
)
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.light.sampled import suited_height
from beam_warp.world.environment import EnvironmentMap

NORMALS = np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [-0.48, 0.6, -0.64]], np.float32)


@wp.kernel
def draw_from_blocks_kernel(
    blocks: EnvironmentBlocks,
    cumulative: wp.array2d[float],
    squares: wp.array[wp.vec2],
    out_direction: wp.array[wp.vec3],
    out_radiance: wp.array[wp.vec3],
    out_back: wp.array[wp.vec2],
):
    i = wp.tid()
    drawn = square_to_product(blocks, cumulative, 0, squares[i][0], squares[i][1])
    out_direction[i] = drawn.direction
    out_radiance[i] = radiance_over_pdf(drawn)
    out_back[i] = product_to_square(blocks, cumulative, 0, drawn.direction)


@wp.kernel
def density_of_blocks_kernel(
    blocks: EnvironmentBlocks, cumulative: wp.array2d[float], directions: wp.array[wp.vec3], out: wp.array[float]
):
    i = wp.tid()
    out[i] = square_to_product_pdf(blocks, cumulative, 0, directions[i])


@wp.kernel
def draw_from_tree_kernel(
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
def density_of_tree_kernel(tree: ProductTree, normal: wp.vec3, directions: wp.array[wp.vec3], out: wp.array[float]):
    i = wp.tid()
    out[i] = square_to_product_tree_pdf(tree, normal, total_weight(tree, normal), directions[i])


def inputs_of_blocks(device, sky, normal):
    blocks = PreparedEnvironment(sky, device).blocks
    normals = wp.array(normal[None], dtype=wp.vec3, device=device)
    cumulative = wp.empty((1, 512), dtype=float, device=device)
    launch_accumulate_block_weights(len(normals), blocks, normals, cumulative, device)
    return [blocks, cumulative]


def inputs_of_tree(device, sky, normal):
    return [PreparedEnvironment(sky, device).product_tree, wp.vec3(*normal.tolist())]


Way = namedtuple("Way", "inputs, draw_kernel, density_kernel, least_total")

BLOCKS = Way(inputs_of_blocks, draw_from_blocks_kernel, density_of_blocks_kernel, 1.0 - 1e-5)
TREE = Way(inputs_of_tree, draw_from_tree_kernel, density_of_tree_kernel, 0.97)
"""Groups whose bound is above 0 and whose blocks' are not draw nothing: that share is missing, and must be small."""

both_ways = pytest.mark.parametrize("way", [BLOCKS, TREE], ids=["blocks", "tree"])


def draw(way, device, sky, normal, squares):
    """Directions, their radiance over density, and what the kernel says of them besides."""
    inputs = [*way.inputs(device, sky, normal), (squares, wp.vec2)]
    return run_kernel(way.draw_kernel, len(squares), inputs, (wp.vec3, wp.vec3, wp.vec2), device)


def probabilities(way, device, sky, normal):
    """Share of the draws in each texel, from the density at its middle."""
    directions = sky.directions().reshape(-1, 3)
    inputs = [*way.inputs(device, sky, normal), (directions, wp.vec3)]
    (density,) = run_kernel(way.density_kernel, len(directions), inputs, [float], device)
    return density.reshape(sky.height, sky.width).astype(np.float64) * sky.solid_angles()


def random_squares(rng, count):
    return rng.random((count, 2)).astype(np.float32)


@both_ways
class TestBothWays:
    @pytest.mark.parametrize("normal", NORMALS[:3])
    def test_density_integrates_to_one(self, device, way, normal):
        total = probabilities(way, device, sunny_sky(), normal).sum()
        assert way.least_total < total <= 1.0 + 1e-5

    def test_density_is_positive_wherever_light_arrives(self, device, way):
        sky = sunny_sky()
        for normal in NORMALS:
            arriving = (sky.directions() @ normal > 0.0) & (sky.radiance.sum(-1) > 0.0)
            assert (probabilities(way, device, sky, normal)[arriving] > 0.0).all()

    @pytest.mark.parametrize("sunny", [False, True])
    def test_draws_follow_the_density(self, device, rng, way, sunny):
        """Directions within float rounding of a texel's edge may land next door: texels that expect little are one."""
        sky = sunny_sky(32) if sunny else EnvironmentMap(rng.gamma(0.4, 1.0, (32, 64, 3)).astype(np.float32))
        directions, _, _ = draw(way, device, sky, NORMALS[0], random_squares(rng, 40_000))
        drawn = directions.any(axis=1)
        row, column = texels_of(directions[drawn], 32)
        counts = np.bincount(row * 64 + column, minlength=32 * 64)
        mass = probabilities(way, device, sky, NORMALS[0])
        require_density(np.append(counts, (~drawn).sum()), np.append(mass, 1.0 - mass.sum()), least=10.0)

    def test_irradiance_is_right_on_average(self, device, rng, way):
        sky = sunny_sky()
        for normal in NORMALS[:3]:
            directions, radiance, _ = draw(way, device, sky, normal, random_squares(rng, 20_000))
            values = (radiance * np.maximum(directions @ normal, 0.0)[:, None]).astype(np.float64)
            weight = np.maximum(sky.directions() @ normal, 0.0) * sky.solid_angles()
            exact = (sky.radiance * weight[..., None]).sum((0, 1))
            # texels at the horizon are cut by it, which the sum over their middles ignores: half a texel of the dim sky
            allowance = 0.5 * 2.0 * (np.pi / 64) ** 2
            assert (np.abs(values.mean(0) - exact) < LARGEST_Z * values.std(0) / np.sqrt(20_000) + allowance).all()
            if way is BLOCKS and normal[0] > 0.0:  # cosine sampling of this sun has about 30 times the mean
                assert (values.std(0) < 0.8 * exact).all()

    def test_darkness_draws_nothing(self, device, way):
        black = EnvironmentMap.constant((0.0, 0.0, 0.0), height=32)
        directions, radiance, _ = draw(way, device, black, NORMALS[0], np.zeros((4, 2), np.float32))
        assert not directions.any()
        assert not radiance.any()


def test_blocks_invert(device, rng):
    """Rebuilt from float32 directions: the square is only as fine as they are, magnified by the density."""
    squares, sky = random_squares(rng, 5000), sunny_sky(32)
    directions, _, back = draw(BLOCKS, device, sky, NORMALS[0], squares)
    assert 0.1 < (lookup(sky, directions).mean(-1) > 100.0).mean() < 0.9
    # A texel is pi / 32 wide, and a direction's rounding 1e-7 of it 1e-6; the map spends up to 1 on the sun's.
    # Directions within rounding of an edge go back through the texel next door: fewer than 1 in 200.
    assert (np.abs(back - squares).max(axis=1) < 1e-4).mean() > 0.995


def test_draws_from_the_tree_know_their_density(device, rng):
    directions, _, pdfs = draw(TREE, device, sunny_sky(), NORMALS[0], random_squares(rng, 4096))
    drawn = pdfs[:, 0] > 0.0
    assert np.allclose(np.linalg.norm(directions[drawn], axis=1), 1.0, atol=1e-5)
    # rounding may carry a direction over a texel's edge, never far
    assert np.isclose(pdfs[drawn, 0], pdfs[drawn, 1], rtol=1e-4).mean() > 0.99
    _, _, none = draw(TREE, device, EnvironmentMap.constant((0.0, 0.0, 0.0)), NORMALS[0], random_squares(rng, 64))
    assert not none.any()


@pytest.mark.parametrize(("height", "suited"), [(4, 32), (32, 32), (50, 48), (512, 512), (2048, 512)])
def test_any_map_is_fitted_to_blocks(height, suited):
    assert suited_height(height) == suited
