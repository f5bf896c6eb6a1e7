"""Scores in closed form, and the protocol: box, black, sRGB, unscaled."""

import numpy as np
import pytest

from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import linear_to_srgb
from beam_warp.image.metrics import bounding_box, compare, least_squares_scale, mean_scores, psnr, ssim


def test_psnr_of_a_known_error():
    assert psnr(np.full((4, 4), 0.6), np.full((4, 4), 0.5)) == pytest.approx(20.0)
    assert psnr(np.zeros((4, 4)), np.zeros((4, 4))) == pytest.approx(120.0)
    mask = np.zeros((4, 4), bool)
    mask[0, 0] = True
    image = np.ones((4, 4))
    image[0, 0] = 0.1
    assert psnr(image, np.zeros((4, 4)), mask) == pytest.approx(20.0)


def test_ssim_of_equal_and_of_opposite_images(rng):
    image = rng.random((32, 32))
    assert ssim(image, image) == pytest.approx(1.0)
    assert ssim(image, 1.0 - image) < 0.0


def test_box_is_the_subjects():
    alpha = np.zeros((10, 12))
    alpha[2:5, 3:9] = 1.0
    assert bounding_box(alpha) == (slice(2, 5), slice(3, 9))
    with pytest.raises(InvalidArrayError, match=r"alpha must show a subject, got none above 0\.5"):
        bounding_box(np.zeros((4, 4)))


def test_protocol_composites_on_black_and_encodes(rng):
    truth_alpha = np.zeros((20, 20))
    truth_alpha[4:16, 4:16] = 1.0
    truth, image = rng.random((20, 20, 3)), rng.random((20, 20, 3))
    alpha = np.full((20, 20), 0.5)
    score = compare(image, truth, alpha=alpha, truth_alpha=truth_alpha, is_color=True, premultiplied=False)
    a = linear_to_srgb(image)[4:16, 4:16] * 0.5
    b = linear_to_srgb(truth)[4:16, 4:16]
    assert score.psnr == pytest.approx(psnr(a, b))
    solid = truth_alpha > 0.999
    assert score.solid_psnr == pytest.approx(psnr(0.5 * linear_to_srgb(image), linear_to_srgb(truth), solid))
    assert mean_scores({"x": [score, score]})["x"]["psnr"] == pytest.approx(score.psnr)


def test_scale_is_that_of_least_squares(rng):
    truth = rng.random((8, 8, 3))
    scale = least_squares_scale(truth / np.array([2.0, 1.0, 0.5]), truth, np.ones((8, 8), bool))
    assert scale == pytest.approx([2.0, 1.0, 0.5])
