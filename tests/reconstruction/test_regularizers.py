"""Terms on Gaussians: closed forms, float64 differences, accumulation, units, refusals."""

import numpy as np
import pytest
import warp as wp

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.reconstruction.regularizers import AnisotropyLoss, OpacityLoss

EPSILON = 2.0**-24

GRADIENT = 1e-5
"""Relative 2-norm of a gradient's error; float32 needs some five roundings, 3e-7, of it."""


def value(loss):
    return float(loss.numpy()[0])


def vectors(array, device):
    return wp.array(array, dtype=wp.vec3, device=device)


def floats(array, device):
    return wp.array(np.asarray(array, np.float32), dtype=float, device=device)


def anisotropy(scales):
    ordered = np.sort(scales, axis=1)
    return np.maximum(ordered[:, 2] / ordered[:, 1] - AnisotropyLoss.LIMIT, 0.0).mean()


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


def test_anisotropy_in_closed_form(device):
    gradient = wp.zeros(3, dtype=wp.vec3, device=device)
    scales = vectors([[1.0, 1.0, 0.0], [10.0, 2.0, 1.0], [1.0, 3.0, 1.0]], device)  # a disc, a needle, just free
    found = AnisotropyLoss(3, device=device)(scales, weight=3.0, gradient=gradient)
    assert value(found) == 2.0
    np.testing.assert_array_equal(gradient.numpy(), [[0.0, 0.0, 0.0], [0.5, -2.5, 0.0], [0.0, 0.0, 0.0]])


def test_opacity_in_closed_form(device):
    gradient = wp.zeros(4, dtype=float, device=device)
    found = OpacityLoss(4, device=device)(floats([0.0, 0.25, 0.5, 1.0], device), weight=2.0, gradient=gradient)
    assert value(found) == 2.0 * 1.75 / 4.0
    np.testing.assert_array_equal(gradient.numpy(), np.full(4, 0.5))


@pytest.mark.parametrize("count", [255, 257])
def test_anisotropy_against_float64_differences(device, rng, count):
    scales = random_scales(rng, count)
    gradient = wp.zeros(count, dtype=wp.vec3, device=device)
    found = value(AnisotropyLoss(count, device=device)(vectors(scales, device), gradient=gradient))
    # A quotient and a difference of ratios of up to a few times the limit.
    assert found == pytest.approx(anisotropy(scales), rel=32 * EPSILON, abs=32 * EPSILON)
    slopes = differences(anisotropy, scales)
    assert np.linalg.norm(gradient.numpy() - slopes) < GRADIENT * np.linalg.norm(slopes)


def test_gradients_add_up_and_rows_of_floats_will_do(device, rng):
    scales = random_scales(rng, 50).astype(np.float32)
    once = wp.zeros((50, 3), dtype=float, device=device)
    term = AnisotropyLoss(50, device=device)
    first = value(term(scales, gradient=once))
    added = wp.full(50, wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device=device)
    assert value(term(vectors(scales, device), gradient=added)) == first
    np.testing.assert_allclose(added.numpy(), 1.0 + once.numpy(), rtol=0, atol=2.0 * EPSILON * 10.0)


def test_no_dependence_on_units(device, rng):
    scales = random_scales(rng, 100)
    small, large = (value(AnisotropyLoss(100, device=device)(vectors(scales * f, device))) for f in (1.0, 1024.0))
    assert small == large  # a power of 2: the same digits


def test_refusals():
    with pytest.raises(InvalidOptionError, match="count must be"):
        OpacityLoss(0, device="cpu")
    scales = wp.zeros(3, dtype=wp.vec3, device="cpu")
    with pytest.raises(InvalidArrayError, match="scales must be"):
        AnisotropyLoss(2, device="cpu")(scales)
    with pytest.raises(InvalidArrayError, match="gradient must be"):
        AnisotropyLoss(3, device="cpu")(scales, gradient=wp.zeros(3, dtype=float, device="cpu"))
    with pytest.raises(InvalidOptionError, match="weight must be"):
        OpacityLoss(3, device="cpu")(np.zeros(3), weight=-1.0)
