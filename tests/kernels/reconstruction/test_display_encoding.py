"""Display encoding: the sRGB curve and its knee, means of samples, gradients, strided images."""

import numpy as np
import pytest
import warp as wp
from support.float32 import EPSILON
from support.kernel_runs import upload_floats as upload
from support.moving_ball import block_means

from beam_warp.image.color import linear_to_srgb
from beam_warp.kernels.reconstruction.display_encoding import (
    behind_samples,
    launch_add_sample_gradients,
    launch_average,
)

KNEE = 0.0031308

ROUNDINGS = 32
"""A power of values down to 0.003 multiplies a logarithm of at most 6: 8 roundings of it, and some of mean and line."""


def strided(array, device, columns=7):
    """Upload an image as some channels of wider rows, as a rasteriser has it."""
    wide = np.full((*array.shape[:2], columns), np.nan, np.float32)
    wide[..., 2 : 2 + array.shape[2]] = array
    return upload(wide, device)[:, :, 2 : 2 + array.shape[2]]


def means(samples, factor):
    return block_means(samples.astype(np.float64), factor)


def averaged(samples, factor, device, bring=upload, *, is_color=True):
    shape = (samples.shape[0] // factor, samples.shape[1] // factor, samples.shape[2])
    out = wp.zeros(shape, dtype=float, device=device)
    launch_average(bring(samples, device), factor, is_color, out, device)
    return out.numpy()


def slopes(values):
    return np.where(values > KNEE, 1.055 / 2.4 * np.maximum(values, KNEE) ** (1.0 / 2.4 - 1.0), 12.92)


def test_the_knee_is_no_step(device):
    """The standard's rounded constants leave a step of 3e-8 there, less than a float's digits at 0.04."""
    values = np.float32(KNEE) * (1.0 + np.float32(2e-7) * np.arange(-8, 9, dtype=np.float32))
    found = averaged(values[None, :, None], 1, device)[0, :, 0]
    assert (np.abs(np.diff(found)) <= 12.92 * np.diff(values).max() + ROUNDINGS * EPSILON * 0.0405).all()
    np.testing.assert_allclose(found, linear_to_srgb(values.astype(np.float64)), rtol=ROUNDINGS * EPSILON)


@pytest.mark.parametrize("bring", [upload, strided])
@pytest.mark.parametrize("factor", [1, 4])
@pytest.mark.parametrize("size", [(1, 9), (33, 35)])
class TestImages:
    def test_encoding_is_of_the_mean(self, device, rng, size, factor, bring):
        """A pixel half black, half white is encoded 0.5, not the mean of encoded 0 and 1."""
        samples = rng.gamma(0.5, 0.5, (size[0] * factor, size[1] * factor, 3)).astype(np.float32)
        expected = linear_to_srgb(means(samples, factor))
        np.testing.assert_allclose(averaged(samples, factor, device, bring), expected, rtol=ROUNDINGS * EPSILON)

    def test_what_is_behind_shows_through(self, device, rng, size, factor, bring):
        """Means of colour and alpha lie before one colour a pixel; gradients reach both."""
        fine = (size[0] * factor, size[1] * factor)
        samples = rng.gamma(0.5, 0.5, (*fine, 3)).astype(np.float32)
        alpha = rng.uniform(size=(*fine, 1)).astype(np.float32)
        color, upstream = (
            rng.uniform(size=(*size, 3)).astype(np.float32),
            rng.normal(size=(*size, 3)).astype(np.float32),
        )
        values = means(samples, factor) + (1.0 - means(alpha, factor)) * color
        behind = behind_samples(upload(color, device), bring(alpha, device))
        out, to_samples, to_alpha = (
            wp.zeros(shape, dtype=float, device=device) for shape in (color.shape, (*fine, 3), (*fine, 1))
        )
        launch_average(bring(samples, device), factor, True, out, device, behind)
        np.testing.assert_allclose(out.numpy(), linear_to_srgb(values), rtol=2 * ROUNDINGS * EPSILON)
        given = bring(samples, device), factor, True, upload(upstream, device), to_samples, device, behind, to_alpha
        launch_add_sample_gradients(*given)
        share = slopes(values) * upstream / factor**2
        for found, expected in ((to_samples, share), (to_alpha, -(share * color).sum(axis=-1, keepdims=True))):
            expected = expected.repeat(factor, axis=0).repeat(factor, axis=1)
            np.testing.assert_allclose(found.numpy(), expected, rtol=1e-4, atol=1e-5 * np.abs(share).max())

    def test_average(self, device, rng, size, factor, bring):
        samples = rng.uniform(size=(size[0] * factor, size[1] * factor, 1)).astype(np.float32)
        found = averaged(samples, factor, device, bring, is_color=False)
        np.testing.assert_allclose(found, means(samples, factor), rtol=(factor**2 + 1) * EPSILON)

    def test_gradients(self, device, rng, size, factor, bring):
        """The slope at the mean, shared by its samples, and added to what is there."""
        fine = (size[0] * factor, size[1] * factor, 3)
        samples = rng.gamma(0.5, 0.5, fine).astype(np.float32)
        upstream, before = rng.normal(size=(*size, 3)).astype(np.float32), rng.normal(size=fine).astype(np.float32)
        values = means(samples, factor)
        upstream[np.abs(values / KNEE - 1.0) < 1e-5] = 0.0  # which side of the knee a mean is on, float32 may not see
        for is_color, slope in ((True, slopes(values)), (False, np.ones_like(values))):
            out = bring(before, device)
            launch_add_sample_gradients(bring(samples, device), factor, is_color, upload(upstream, device), out, device)
            share = (slope * upstream / factor**2).repeat(factor, axis=0).repeat(factor, axis=1)
            bound = ROUNDINGS * EPSILON * np.abs(share) + 2 * EPSILON * (np.abs(share) + np.abs(before))
            assert (np.abs(out.numpy() - (before + share)) <= bound).all()
