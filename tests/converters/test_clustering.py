"""Codebooks and palettes against closed forms: what is kept exactly, and how small the error gets."""

import numpy as np
from scipy.spatial import cKDTree

from beam_warp.converters.sog.clustering import codebook, nearest_codes, palette


def mean_square(values, size=256):
    codes = codebook(values, size)
    return float(np.mean((codes[nearest_codes(codes, values)].astype(np.float64) - values) ** 2))


def test_few_numbers_are_kept():
    values = np.random.default_rng(0).permutation(np.repeat(np.linspace(-3.0, 5.0, 256), 7)).astype(np.float32)
    codes = codebook(values)
    assert np.array_equal(codes, np.unique(values))
    assert np.array_equal(codes[nearest_codes(codes, values)], values)
    assert np.array_equal(codebook(np.array([2.5])), np.full(256, 2.5))
    assert np.array_equal(codebook(np.empty(0)), np.zeros(256))


def test_the_error_is_that_of_the_best_codes():
    even = (np.arange(2**17) + 0.5) / 2**17
    assert mean_square(even) <= 1.001 / (12 * 256**2)  # steps of 1 / 256
    rng = np.random.default_rng(0)
    normal = rng.normal(size=2**18)  # Panter and Dite: (∫ p^(1/3))^3 / 12 K^2 in the limit of many codes
    least = np.sqrt(3) * np.pi / 2
    assert mean_square(normal) <= least / 256**2
    far = np.concatenate([normal, np.full(99, -30.0)])  # flat Gaussians, whose log scales take one code
    assert mean_square(far) <= least / 255**2


def test_every_code_is_the_nearest():
    rng = np.random.default_rng(3)
    values = rng.standard_cauchy(5000)
    codes = codebook(values, 20)
    assert (np.diff(codes) > 0).all()
    got = np.abs(codes[nearest_codes(codes, values)] - values)
    assert np.array_equal(got, np.abs(codes[:, None] - values).min(axis=0))


def test_a_palette_of_groups_that_lie_apart_is_their_centres():
    rng = np.random.default_rng(1)
    centers = 100.0 * rng.normal(size=(40, 9))
    vectors = np.repeat(centers, 30, axis=0).astype(np.float32)
    entries, labels = palette(vectors, 200)
    assert entries.shape == (200, 9)
    # A mean of 30 equal float32 vectors, of size up to 400, is off by a few roundings of their sum.
    assert np.abs(entries[labels] - vectors).max() <= 30 * np.finfo(np.float32).eps * 400


def test_few_vectors_are_kept():
    vectors = np.random.default_rng(0).normal(size=(64, 24)).astype(np.float32)
    entries, labels = palette(vectors, 64)
    assert np.array_equal(entries[labels], vectors)
    same = np.zeros((1000, 24), np.float32)
    entries, labels = palette(same, 64)
    assert np.array_equal(entries[labels], same)
    assert len(entries) == 64


def test_a_palette_is_nearly_as_good_as_one_without_groups():
    rng = np.random.default_rng(2)
    vectors = (rng.normal(size=(6000, 4)) @ rng.normal(size=(4, 24))).astype(np.float32)
    entries, labels = palette(vectors, 1024)
    assert np.array_equal(labels, palette(vectors.copy(), 1024)[1])
    error = np.sqrt(np.mean((entries[labels] - vectors) ** 2))
    best, _ = cKDTree(entries).query(vectors)
    assert error <= 1.05 * np.sqrt(np.mean(best**2) / 24)  # of all entries, not of the own group alone
    samples = vectors[rng.choice(len(vectors), 1024, replace=False)]
    nearest, _ = cKDTree(samples).query(vectors)
    assert error < 0.95 * np.sqrt(np.mean(nearest**2) / 24)  # Gaussians taken at random, a sixth of which are exact


def test_equal_vectors_among_many_share_one_entry():
    """Nine of ten Gaussians without view-dependent colour: their group must not be compared with entries of its own."""
    vectors = np.random.default_rng(4).normal(size=(10_000, 45)).astype(np.float32)
    vectors[:9_000] = 0.0
    entries, labels = palette(vectors, 1024)
    assert len(np.unique(labels[:9_000])) == 1
    assert not entries[labels[0]].any()
    assert len(np.unique(labels[9_000:])) > 500
