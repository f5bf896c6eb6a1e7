"""Terms on Gaussians: closed forms, float64 differences, masks, accumulation, threads, refusals."""

import numpy as np
import pytest
import warp as wp

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.reconstruction.regularizers import (
    AnisotropyLoss,
    FlatnessLoss,
    OpacityEntropyLoss,
    OpacityLoss,
    SizeLoss,
)

EPSILON = 2.0**-24

GRADIENT = 1e-5
"""Relative 2-norm of a gradient's error; float32 needs some five roundings, 3e-7, of it."""


def value(loss):
    return float(loss.numpy()[0])


def relative_error(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def vectors(array, device):
    return wp.array(array, dtype=wp.vec3, device=device)


def floats(array, device):
    return wp.array(np.asarray(array, np.float32), dtype=float, device=device)


def flatness(scales, spacings, mask):
    return (mask * scales.min(axis=1) / spacings).mean()


def anisotropy(scales, limit, mask):
    ordered = np.sort(scales, axis=1)
    return (mask * np.maximum(ordered[:, 2] / ordered[:, 1] - limit, 0.0)).mean()


def size(scales, low, high, mask, mean):
    ratio = scales.max(axis=1) / mean
    return (mask * (np.maximum(ratio - high, 0.0) + np.maximum(low - ratio, 0.0))).mean()


def entropy(opacities, mask):
    return (mask * (-opacities * np.log(opacities) - (1.0 - opacities) * np.log(1.0 - opacities))).mean()


def differences(function, x, step=1e-7):
    """Central differences, relative to each element's own size."""
    gradient = np.zeros_like(x)
    for index in np.ndindex(x.shape):
        h = step * abs(x[index])
        up, down = x.copy(), x.copy()
        up[index] += h
        down[index] -= h
        gradient[index] = (function(up) - function(down)) / (2.0 * h)
    return gradient


def random_scales(rng, count):
    """Log-normal, as float32 holds them; no two of a Gaussian's within 1e-3 of each other."""
    scales = np.exp(rng.normal(-4.0, 1.0, (count, 3))).astype(np.float32).astype(float)
    close = np.diff(np.sort(scales, axis=1), axis=1).min(axis=1) < 1e-3 * scales.max(axis=1)
    scales[close] = [0.01, 0.02, 0.08]
    return scales.astype(np.float32).astype(float)


class TestClosedForms:
    def test_flatness(self, device):
        gradient = wp.zeros(2, dtype=wp.vec3, device=device)
        loss = FlatnessLoss(2, device=device)
        scales = vectors([[3.0, 1.0, 2.0], [4.0, 8.0, 4.0]], device)
        assert value(loss(scales, floats([2.0, 8.0], device), weight=4.0, gradient=gradient)) == 4.0 * (0.5 + 0.5) / 2.0
        np.testing.assert_array_equal(gradient.numpy(), [[0.0, 1.0, 0.0], [0.25, 0.0, 0.0]])

    def test_anisotropy(self, device):
        gradient = wp.zeros(3, dtype=wp.vec3, device=device)
        scales = vectors([[1.0, 1.0, 0.0], [8.0, 2.0, 1.0], [1.0, 3.0, 1.5]], device)  # a disc, a needle, just free
        found = AnisotropyLoss(3, device=device)(scales, limit=2.0, weight=3.0, gradient=gradient)
        assert value(found) == 2.0
        np.testing.assert_array_equal(gradient.numpy(), [[0.0, 0.0, 0.0], [0.5, -2.0, 0.0], [0.0, 0.0, 0.0]])

    def test_size(self, device):
        gradient = wp.zeros(4, dtype=wp.vec3, device=device)
        scales = vectors([[1.0, 0.5, 0.5], [1.0, 0.9, 0.1], [13.0, 2.0, 1.0], [1.0, 0.2, 0.2]], device)  # mean 4
        found = SizeLoss(4, device=device)(scales, low=0.5, high=3.0, weight=4.0, gradient=gradient)
        assert value(found) == pytest.approx(0.25 + 3 * 0.25)
        expected = np.zeros((4, 3))
        expected[[0, 1, 3], 0] = -0.25
        expected[2, 0] = 0.25
        np.testing.assert_array_equal(gradient.numpy(), expected)

    def test_opacity(self, device):
        gradient = wp.zeros(4, dtype=float, device=device)
        found = OpacityLoss(4, device=device)(floats([0.0, 0.25, 0.5, 1.0], device), weight=2.0, gradient=gradient)
        assert value(found) == 2.0 * 1.75 / 4.0
        np.testing.assert_array_equal(gradient.numpy(), np.full(4, 0.5))

    def test_entropy(self, device):
        gradient = wp.zeros(4, dtype=float, device=device)
        found = OpacityEntropyLoss(4, device=device)(floats([0.0, 0.5, 0.5, 1.0], device), gradient=gradient)
        assert value(found) == pytest.approx(0.5 * np.log(2.0), rel=1e-6)
        # At 0 and 1 the slope is that at 1e-4, where 1 - 1e-4 is rounded to 6e-8 of the 1e-4 that it leaves.
        steep = np.log(9999.0) / 4.0
        np.testing.assert_allclose(gradient.numpy(), [steep, 0.0, 0.0, -steep], rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("count", [1, 255, 257, 1500])
class TestDifferences:
    def test_scales(self, device, rng, count):
        scales = random_scales(rng, count)
        mask = rng.random(count).astype(np.float32).astype(float)
        mask[:: max(count // 7, 2)] = 0.0
        if count == 1:
            mask[0] = 0.5
        spacings = np.exp(rng.normal(-4.0, 0.3, count)).astype(np.float32).astype(float)
        mean = (mask * scales.max(axis=1)).sum() / mask.sum()
        on_device, counted = vectors(scales, device), floats(mask, device)
        near = floats(spacings, device)
        cases = (
            (
                lambda g: FlatnessLoss(count, device=device)(on_device, near, weight=2.0, mask=counted, gradient=g),
                lambda s: 2.0 * flatness(s, spacings, mask),
            ),
            (
                lambda g: AnisotropyLoss(count, device=device)(on_device, limit=1.5, mask=counted, gradient=g),
                lambda s: anisotropy(s, 1.5, mask),
            ),
            (
                lambda g: SizeLoss(count, device=device)(on_device, low=0.6, high=1.2, mask=counted, gradient=g),
                lambda s: size(s, 0.6, 1.2, mask, mean),
            ),
        )
        for call, reference in cases:
            gradient = wp.zeros(count, dtype=wp.vec3, device=device)
            expected = reference(scales)
            # A quotient, a product and a difference of ratios of up to a few times the limit.
            assert value(call(gradient)) == pytest.approx(expected, rel=32 * EPSILON, abs=32 * EPSILON)
            slopes = differences(reference, scales)
            if np.any(slopes):
                assert relative_error(gradient.numpy(), slopes) < GRADIENT
            else:
                assert not gradient.numpy().any()

    def test_entropy(self, device, rng, count):
        opacities = rng.uniform(0.01, 0.99, count).astype(np.float32).astype(float)
        mask = rng.uniform(0.1, 1.0, count).astype(np.float32).astype(float)
        gradient = wp.zeros(count, dtype=float, device=device)
        term = OpacityEntropyLoss(count, device=device)
        found = term(floats(opacities, device), weight=3.0, mask=floats(mask, device), gradient=gradient)
        assert value(found) == pytest.approx(3.0 * entropy(opacities, mask), rel=32 * EPSILON)
        slopes = 3.0 * mask * np.log((1.0 - opacities) / opacities) / count
        assert relative_error(gradient.numpy(), slopes) < GRADIENT
        numeric = differences(lambda o: 3.0 * entropy(o, mask), opacities, 1e-5)
        assert relative_error(slopes, numeric) < 1e-5


class TestProperties:
    def test_gradients_add_up_and_rows_of_floats_will_do(self, device, rng):
        scales = random_scales(rng, 50).astype(np.float32)
        once = wp.zeros((50, 3), dtype=float, device=device)
        term = AnisotropyLoss(50, device=device)
        first = value(term(scales, limit=1.2, gradient=once))
        added = wp.full(50, wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device=device)
        assert value(term(vectors(scales, device), limit=1.2, gradient=added)) == first
        np.testing.assert_allclose(added.numpy(), 1.0 + once.numpy(), rtol=0, atol=2.0 * EPSILON * 10.0)

    def test_what_is_masked_is_not_read(self, device):
        broken = vectors([[np.nan, 1.0, 1.0], [4.0, 1.0, 1.0]], device)
        mask, gradient = floats([0.0, 1.0], device), wp.zeros(2, dtype=wp.vec3, device=device)
        assert value(AnisotropyLoss(2, device=device)(broken, limit=3.0, mask=mask, gradient=gradient)) == 0.5
        assert value(FlatnessLoss(2, device=device)(broken, floats([0.0, 1.0], device), mask=mask)) == 0.5
        assert value(SizeLoss(2, device=device)(broken, mask=mask, gradient=gradient)) == 0.0
        assert np.isfinite(gradient.numpy()).all()
        hidden = floats([np.nan, 1.0], device)
        assert value(OpacityLoss(2, device=device)(hidden, mask=mask)) == 0.5

    def test_no_dependence_on_units(self, device, rng):
        scales = random_scales(rng, 100)
        spacings = np.full(100, 0.02)
        for factor in (1.0, 1024.0):  # a power of 2: the same digits
            s, d = vectors(scales * factor, device), floats(spacings * factor, device)
            found = [
                value(FlatnessLoss(100, device=device)(s, d)),
                value(AnisotropyLoss(100, device=device)(s)),
                value(SizeLoss(100, device=device)(s)),
            ]
            if factor == 1.0:
                kept = found
        assert found == kept

    def test_threads_make_no_difference(self, monkeypatch, rng):
        scales = random_scales(rng, 20_000)
        found = []
        for threads in ("1", "3"):
            monkeypatch.setenv("BEAM_WARP_THREADS", threads)
            gradient = wp.zeros(20_000, dtype=wp.vec3, device="cpu")
            term = SizeLoss(20_000, device="cpu")(vectors(scales, "cpu"), low=0.8, high=1.1, gradient=gradient)
            found.append((value(term), gradient.numpy()))
        assert found[0][0] == found[1][0]
        np.testing.assert_array_equal(found[0][1], found[1][1])


class TestRefusals:
    def test_arrays_and_options(self):
        with pytest.raises(InvalidOptionError, match="count must be"):
            OpacityLoss(0, device="cpu")
        scales = wp.zeros(3, dtype=wp.vec3, device="cpu")
        with pytest.raises(InvalidArrayError, match="scales must be"):
            AnisotropyLoss(2, device="cpu")(scales)
        with pytest.raises(InvalidArrayError, match="gradient must be"):
            AnisotropyLoss(3, device="cpu")(scales, gradient=wp.zeros(3, dtype=float, device="cpu"))
        with pytest.raises(InvalidOptionError, match="limit must be"):
            AnisotropyLoss(3, device="cpu")(scales, limit=0.5)
        with pytest.raises(InvalidOptionError, match="weight must be"):
            OpacityLoss(3, device="cpu")(np.zeros(3), weight=-1.0)
        with pytest.raises(InvalidOptionError, match="low must be"):
            SizeLoss(3, device="cpu")(scales, low=2.0)
