"""Sample sets and maps: exact stratification, agreement with an independent Sobol', densities by chi-square."""

import itertools

import numpy as np
import pytest
import warp as wp
from reference.light_sampling import cosine_hemisphere_to_square
from scipy import stats
from scipy.stats import qmc
from support.estimates import SIGNIFICANCE
from support.kernel_runs import run_kernel

from beam_warp.kernels.common.sampling import (
    SampleSet,
    draw_square,
    sobol_second_dimension,
    square_to_cosine_hemisphere,
    square_to_cosine_hemisphere_pdf,
    stream_of,
)
from beam_warp.kernels.common.spread import Spread, add_term, variance_of_sum
from beam_warp.trace.sampling import SAMPLERS, sample_set, squarest_grid
from beam_warp.world.environment import EnvironmentMap


@wp.kernel
def plain_sobol_kernel(out: wp.array[wp.uint32]):
    i = wp.tid()
    out[i] = sobol_second_dimension(wp.uint32(i))


@wp.kernel
def draw_square_kernel(samples: SampleSet, out: wp.array2d[wp.vec2], out_slot: wp.array2d[int]):
    point, index = wp.tid()
    at = draw_square(samples, index, stream_of(wp.uint32(7), wp.uint32(0), wp.uint32(point)))
    out[point, index] = wp.vec2(at.u, at.v)
    out_slot[point, index] = at.slot


@wp.kernel
def spread_kernel(terms: wp.array2d[float], paired: int, out: wp.array[float]):
    i = wp.tid()
    spread = Spread()
    spread.paired = paired
    for k in range(terms.shape[1]):
        spread = add_term(spread, terms[i, k])
    out[i] = variance_of_sum(spread)


@wp.kernel
def cosine_round_trip_kernel(squares: wp.array[wp.vec2], out: wp.array[wp.vec2], out_direction: wp.array[wp.vec3]):
    i = wp.tid()
    direction = square_to_cosine_hemisphere(squares[i][0], squares[i][1])
    out_direction[i] = direction
    out[i] = cosine_hemisphere_to_square(direction)


@wp.kernel
def cosine_pdf_kernel(directions: wp.array[wp.vec3], out: wp.array[float]):
    i = wp.tid()
    out[i] = square_to_cosine_hemisphere_pdf(directions[i])


def draw_sets(device, sampler, points, count):
    inputs = [sample_set(sampler, count)]
    squares, slots = run_kernel(draw_square_kernel, (points, count), inputs, (wp.vec2, int), device)
    return squares.astype(np.float64), slots


def variance_of_sums(device, terms, paired):
    return run_kernel(spread_kernel, len(terms), [(terms, float), int(paired)], [float], device)[0]


def test_second_dimension_is_sobols(device):
    (found,) = run_kernel(plain_sobol_kernel, 256, [], [wp.uint32], device)
    expected = qmc.Sobol(2, scramble=False, bits=32).random(256)[:, 1] * 2.0**32
    index = np.arange(256)
    assert np.array_equal(found[index ^ (index >> 1)], expected.astype(np.uint32))  # scipy walks in Gray code


@pytest.mark.parametrize("count", [2, 8, 64, 128])
def test_each_stratum_holds_one_point(device, count):
    points, cells = draw_sets(device, "owen", 50, count)
    assert (np.sort(cells, axis=1) == np.arange(count)).all()
    assert ((points >= 0.0) & (points < 1.0)).all()
    # not only the squarest grid: every elementary interval of a (0,2)-sequence
    bits = count.bit_length() - 1
    for a in range(bits + 1):
        cell = np.floor(points[..., 0] * 2**a) * 2 ** (bits - a) + np.floor(points[..., 1] * 2 ** (bits - a))
        assert (np.sort(cell, axis=1) == np.arange(count)).all()


@pytest.mark.parametrize(
    ("count", "grid"), [(1, (1, 1)), (12, (3, 4)), (49, (7, 7)), (50, (5, 10)), (64, (8, 8)), (61, (1, 61))]
)
def test_stratified_sets_fill_the_squarest_grid(device, count, grid):
    assert squarest_grid(count) == grid
    points, slots = draw_sets(device, "stratified", 40, count)
    # a coordinate within float32 rounding of a cell's edge may read as the neighbour's
    shifted = np.clip(points, 2.0**-23, None)
    cell = np.floor(shifted * grid * (1.0 - 2.0**-23)).astype(int)
    rows = np.where(cell[..., 0] % 2 == 0, cell[..., 1], grid[1] - 1 - cell[..., 1])
    assert ((cell[..., 0] * grid[1] + rows == slots).mean(axis=1) > 0.999).all()
    assert (np.sort(slots, axis=1) == np.arange(count)).all()
    # one after the other in the order of slots, cells share an edge
    steps = np.abs(np.diff(cell, axis=1)).sum(axis=2)
    assert (steps == 1).all()


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("count", [1, 16, 30])
def test_points_of_every_sampler_are_uniform(device, sampler, count):
    """Each point of a set over many streams: uniform in the square, or, one of each stratum together."""
    points, _ = draw_sets(device, sampler, 4000, count)
    assert ((points >= 0.0) & (points < 1.0)).all()
    one_each = points[np.arange(4000), np.arange(4000) % count]
    for axis in range(2):
        assert stats.kstest(one_each[:, axis], "uniform").pvalue > SIGNIFICANCE
    counts = np.histogram2d(one_each[:, 0], one_each[:, 1], bins=8, range=[[0, 1], [0, 1]])[0]
    assert stats.chisquare(counts.ravel()).pvalue > SIGNIFICANCE


def test_independent_points_are_independent(device):
    """Within a set, and of the same number in neighbouring sets: pairs of coordinates fill the square evenly."""
    points, _ = draw_sets(device, "iid", 2000, 32)
    pairs = {
        "next x": (points[:, :-1, 0], points[:, 1:, 0]),
        "next y": (points[:, :-1, 1], points[:, 1:, 1]),
        "x, y": (points[..., 0], points[..., 1]),
        "next set": (points[:-1, :, 0], points[1:, :, 0]),
        "next set across": (points[:-1, :, 0], points[1:, :, 1]),
    }
    for name, (a, b) in pairs.items():
        counts = np.histogram2d(a.ravel(), b.ravel(), bins=16, range=[[0, 1], [0, 1]])[0]
        assert stats.chisquare(counts.ravel()).pvalue > SIGNIFICANCE, name


class TestSpread:
    def test_independent_terms(self, device, rng):
        terms = rng.normal(5.0, 2.0, (100, 33)).astype(np.float32)
        expected = 33 * terms.astype(np.float64).var(axis=1, ddof=1)
        # Welford's recurrence: a few roundings of the squares a term
        np.testing.assert_allclose(variance_of_sums(device, terms, False), expected, rtol=33 * 4 * 2.0**-24)

    @pytest.mark.parametrize("count", [2, 3, 8, 9])
    def test_collapsed_strata(self, device, rng, count):
        """Groups of two, the last of three if the count is odd: m / (m - 1) times the squared deviations of each."""
        terms = rng.normal(5.0, 2.0, (100, count)).astype(np.float32)
        expected = np.zeros(100)
        edges = [*range(0, count - 1 - count % 2, 2), count]
        for begin, end in itertools.pairwise(edges):
            group = terms[:, begin:end].astype(np.float64)
            expected += (end - begin) * group.var(axis=1, ddof=1)
        # squares of differences of numbers near 5: rounding 5 * 2^-24 against differences, and cancellation of three
        np.testing.assert_allclose(variance_of_sums(device, terms, True), expected, rtol=1e-5, atol=1e-4)

    def test_one_term_has_none(self, device):
        assert variance_of_sums(device, np.ones((1, 1), np.float32), True)[0] == 0.0


def test_scrambled_estimates_are_unbiased_and_beat_independent_samples(device):
    points, _ = draw_sets(device, "owen", 2000, 64)
    values = np.exp(points[..., 0] * points[..., 1])  # integral over the square: sum 1 / (n! (n + 1)^2)
    truth = sum(1.0 / (float(np.prod(np.arange(1, n + 1))) * (n + 1) ** 2) for n in range(20))
    means = values.mean(axis=1)
    z = (means.mean() - truth) / (means.std(ddof=1) / np.sqrt(len(means)))
    assert abs(z) < stats.norm.isf(SIGNIFICANCE / 2)
    assert means.std() < 0.15 * values.std() / np.sqrt(64)


def test_cosine_map_inverts_and_has_its_density(device, rng):
    squares = rng.random((20_000, 2)).astype(np.float32)
    back, d = run_kernel(cosine_round_trip_kernel, len(squares), [(squares, wp.vec2)], (wp.vec2, wp.vec3), device)
    # the square's corners map to the rim, where the inverse divides float32 noise by the radius: 1e-5
    assert np.abs(back - squares).max() < 1e-5
    assert np.abs(np.linalg.norm(d, axis=1) - 1.0).max() < 1e-6
    # cos^2 and azimuth are uniform and independent under the cosine density
    phi = np.arctan2(d[:, 1], d[:, 0]) / (2.0 * np.pi) + 0.5
    counts = np.histogram2d(d[:, 2] ** 2, phi, bins=10, range=[[0, 1], [0, 1]])[0]
    assert stats.chisquare(counts.ravel()).pvalue > SIGNIFICANCE


def test_cosine_density_integrates_to_one(device):
    """A sum over midpoints of a fine lat-long grid, which the equator does not cut: exact to second order."""
    sphere = EnvironmentMap.constant((1.0, 1.0, 1.0), height=256)
    directions = sphere.directions().reshape(-1, 3).astype(np.float32)
    (density,) = run_kernel(cosine_pdf_kernel, len(directions), [(directions, wp.vec3)], [float], device)
    density = density.astype(np.float64)
    assert (density * sphere.solid_angles().ravel()).sum() == pytest.approx(1.0, abs=(np.pi / 256) ** 2)
    assert not density[directions[:, 2] < 0.0].any()
