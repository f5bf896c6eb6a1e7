"""Bernoulli acceptance: right on average, independent between seeds, rays and Gaussians, on every path of tracing."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy import stats
from support.estimates import LARGEST_Z, SIGNIFICANCE, require_zero_mean
from support.kernel_runs import run_kernel
from support.shapes import aligned, along_x, random_cloud, random_rays

from beam_warp import Scene, visibility
from beam_warp.kernels.common.sampling import hash_combine
from beam_warp.kernels.trace.occluders import sampled_hit
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.trace.reference import visibility_reference
from beam_warp.trace.transmittance import TraceOptions

SEEDS = 256

PATHS = {
    "batch": TraceOptions(acceptance="bernoulli"),
    "batch, never stopped": TraceOptions(acceptance="bernoulli", stop=0.0),
    "entry": TraceOptions(acceptance="bernoulli", front="entry"),
}
"""Batches of rays by the default rules have a kernel of their own under the wide tree; other rules have another."""


@pytest.fixture(params=PATHS)
def options(request):
    return PATHS[request.param]


def on_x(opacities):
    return aligned(np.arange(len(opacities))[:, None] * [1.0, 0.0, 0.0], opacities)


def require_chi_square(squares, degrees):
    """A sum of squared standard normals, tested to both sides: neither too far off nor suspiciously close."""
    low, high = stats.chi2.ppf([SIGNIFICANCE / 2.0, 1.0 - SIGNIFICANCE / 2.0], degrees)
    assert low <= squares <= high


def test_the_mean_over_seeds_is_the_product(device, options, rng):
    """Each ray's count of open seeds is binomial with its own V; rays are independent, so that squares add up."""
    cloud, rays = random_cloud(rng, 300, scale=(-2.0, 0.4), opacity=(0.05, 1.0)), random_rays(rng, 400)
    scene = Scene.from_gaussians(cloud, device)
    truth = visibility_reference(cloud, *rays, front=options.front)
    drawn = np.array([visibility(scene, *rays, options=options, seed=seed) for seed in range(SEEDS)])
    assert set(np.unique(drawn)) == {0.0, 1.0}
    require_zero_mean(drawn - truth)  # one mean a seed
    clear, shut = truth > 1.0 - 1e-12, truth < 1e-12
    assert (drawn[:, clear] == 1.0).all()
    assert not drawn[:, shut].any()
    between = (truth > 0.05) & (truth < 0.95)  # where the binomial is near a normal
    assert between.sum() > 100
    z = (drawn.mean(0) - truth)[between] / np.sqrt(truth * (1.0 - truth) / SEEDS)[between]
    require_chi_square(np.sum(z**2), between.sum())


@pytest.mark.parametrize("options", ["batch", "entry"], indirect=True)
@pytest.mark.parametrize("opacities", [(0.5,), (0.1, 0.2, 0.3), (1 / 250,) * 100], ids=len)
def test_equal_rays_draw_independently(device, options, opacities):
    """A batch of one ray, many times: the mean is the product, which tells Gaussians that draw alike from others."""
    count = 20_000
    scene = Scene.from_gaussians(on_x(opacities), device)
    truth = np.prod(1.0 - np.asarray(opacities))
    sigma = np.sqrt(truth * (1.0 - truth) / count)
    drawn = np.array([visibility(scene, *along_x(count=count), options=options, seed=seed) for seed in range(20)])
    z = (drawn.mean(1) - truth) / sigma
    assert np.abs(z).max() < stats.norm.isf(SIGNIFICANCE / 2.0 / 20)  # the largest of 20
    require_chi_square(np.sum(z**2), 20)
    # Neighbouring rays, and the same ray of neighbouring seeds, are uncorrelated.
    noise = (drawn - truth) / np.sqrt(truth * (1.0 - truth))
    for one, other in ((noise[:, 1:], noise[:, :-1]), (noise[1:], noise[:-1])):
        assert abs(np.mean(one * other)) * np.sqrt(one.size) < LARGEST_Z


def test_each_pair_of_gaussians_draws_independently(device, options):
    """Ray k meets a pair of its own; over many pairs of rows the mean is that of independent draws."""
    rng, count = np.random.default_rng(3), 4000
    positions = np.concatenate(
        [np.column_stack([np.full(count, x), np.arange(count), np.zeros(count)]) for x in (0, 1)]
    )
    order = rng.permutation(2 * count)
    cloud = aligned(positions[order], 0.5)
    origins = np.column_stack([np.full(count, -1.0), np.arange(count), np.zeros(count)])
    directions = np.tile([1.0, 0.0, 0.0], (count, 1))
    scene = Scene.from_gaussians(cloud, device)
    drawn = np.array([visibility(scene, origins, directions, options=options, seed=seed) for seed in range(16)])
    require_zero_mean(drawn.T - 0.25)  # one mean a pair
    z = (drawn.mean(0) - 0.25) / np.sqrt(0.25 * 0.75 / 16)
    # The square of a standardised binomial's mean has variance 2 + (1 / pq - 6) / n: a normal sum over 4,000 pairs.
    spread = np.sqrt((2.0 + (1.0 / (0.25 * 0.75) - 6.0) / 16) / count)
    assert abs(np.mean(z**2) - 1.0) < LARGEST_Z * spread


def test_seeds_decide_the_bits(device, options, rng):
    cloud, rays = random_cloud(rng, 300, scale=(-2.0, 0.4)), random_rays(rng, 500)
    scene = Scene.from_gaussians(cloud, device)
    one, again, other = (visibility(scene, *rays, options=options, seed=seed) for seed in (7, 7, 8))
    assert np.array_equal(one, again)
    assert 0.05 < (one != other).mean() < 0.5


@pytest.mark.parametrize("seed", [0, 2**31, 2**32 - 1])
def test_every_seed_is_taken(device, options, seed):
    scene = Scene.from_gaussians(on_x([0.5]), device)
    drawn = visibility(scene, *along_x(count=10_000), options=options, seed=seed)
    assert abs(drawn.mean() - 0.5) < LARGEST_Z * 0.5 / np.sqrt(10_000)


@wp.kernel
def sample_hits_kernel(
    occluders: Any,
    settings: TraceSettings,
    origin: wp.vec3,
    direction: wp.vec3,
    t_max: float,
    seed: wp.uint32,
    out_index: wp.array[int],
):
    i = wp.tid()
    stream = hash_combine(seed, wp.uint32(i))
    out_index[i] = sampled_hit(occluders, settings, origin - occluders.origin, direction, t_max, stream)


@pytest.mark.parametrize("front", ["peak", "entry"])
@pytest.mark.parametrize("limit", ["none", "t_max", "mesh"])
def test_sampled_hits_follow_alpha_times_the_transmittance_before(device, front, limit):
    """Indices of hits on one ray, counted over streams, against the weights of blending: a chi-square test."""
    rng, count = np.random.default_rng(11), 50_000
    opacities, places = rng.uniform(0.05, 0.5, 10), rng.permutation(10)
    cloud = on_x(opacities).with_arrays(positions=places[:, None] * [1.0, 0.0, 0.0])
    reach = 3e38 if limit == "none" else 8.5  # from -2: places up to 6
    plate = None
    if limit == "mesh":
        vertices = [[6.5, -9.0, -9.0], [6.5, 9.0, -9.0], [6.5, 0.0, 9.0]]
        plate, reach = SimpleNamespace(vertices=vertices, faces=[[0, 1, 2]]), 3e38
    scene = Scene.from_gaussians(cloud, device, mesh=plate)
    settings = TraceOptions(front=front).settings(scene)
    inputs = [scene.occluders, settings, wp.vec3(-2.0, 0.0, 0.0), wp.vec3(1.0, 0.0, 0.0), reach, wp.uint32(5)]
    (drawn,) = run_kernel(sample_hits_kernel, count, inputs, [int], device)
    order = [k for k in np.argsort(places) if limit == "none" or places[k] <= 6]
    weights = np.zeros(11)  # the last for none
    passed = 1.0
    for k in order:
        weights[k], passed = passed * opacities[k], passed * (1.0 - opacities[k])
    weights[-1] = passed
    found = np.bincount(np.where(drawn < 0, 10, drawn), minlength=11)
    assert not found[weights == 0.0].any()
    expected = count * weights[weights > 0.0]
    assert expected.min() > 100.0
    require_chi_square(np.sum((found[weights > 0.0] - expected) ** 2 / expected), len(expected) - 1)
