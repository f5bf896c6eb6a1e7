"""Masks of cut-outs: offsets by rings and by what views agree on, on balls and discs whose coverage is known."""

from dataclasses import replace

import numpy as np
import pytest
from support.discs import RADIUS, cut_out, disc
from support.moving_ball import ball_views
from support.moving_ball import rig as cameras_around

from beam_warp.capture.cutouts import Ring, ring_of
from beam_warp.reconstruction import masks
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.masks import mend_masks, relative_offset, ring_offsets
from beam_warp.stability.flaws.mattes import offset_coverage

NAMES = [f"c{k}" for k in range(8)]
OPTIONS = FitOptions.of_preset("draft", gaussian_count=1_000)


def cut(view, pixels):
    """A view as a cut-out whose mask is off by so much: straight colour where the subject is, and nothing elsewhere."""
    coverage = view.alpha.astype(np.float64)
    straight = np.where(coverage[..., None] > 0.0, view.color / np.maximum(coverage, 1e-6)[..., None], 0.0)
    alpha = offset_coverage(coverage, pixels).astype(np.float32)
    return replace(view, alpha=alpha, color=(straight * alpha[..., None]).astype(np.float32))


@pytest.mark.parametrize("is_straight", [False, True])
@pytest.mark.parametrize("pixels", [0.75, 1.0, 1.6, 2.4])
def test_rings_say_how_far_masks_are_off(pixels, is_straight):
    (found,) = ring_offsets([ring_of(cut_out(pixels, is_straight=is_straight))])
    assert found == pytest.approx(pixels, abs=masks.RING_ERROR)


def test_no_ring_says_nothing():
    found = ring_offsets([Ring(), Ring(masks.LEAST_RING, 0.5), Ring(1.0, 0.0), Ring(9.0, 0.0)])
    np.testing.assert_array_equal(np.isnan(found), [True, True, False, False])
    assert found[3] == 3.0


@pytest.mark.parametrize("pixels", [-1.0, -0.4, 0.0, 0.4, 1.0])
def test_an_offset_against_what_is_drawn_is_found(pixels):
    assert relative_offset(disc(RADIUS + pixels), disc()) == pytest.approx(pixels, abs=0.05)
    assert np.isnan(relative_offset(np.zeros((9, 9), np.float32), np.zeros((9, 9), np.float32)))


def test_exact_masks_stay_and_cost_no_fit(monkeypatch):
    monkeypatch.setattr(masks, "Fitter", None)
    views = ball_views(cameras_around(8, 80))
    assert not mend_masks(NAMES, views, OPTIONS, device="cpu").offsets
    without = [replace(view, alpha=None) for view in views]
    assert not mend_masks(NAMES, without, OPTIONS, device="cpu").offsets


def test_masks_that_are_all_too_large_need_no_fit(monkeypatch):
    monkeypatch.setattr(masks, "Fitter", None)
    views = [cut(view, 1.0) for view in ball_views(cameras_around(8, 80))]
    found = mend_masks(NAMES, views, OPTIONS, device="cpu").offsets
    assert list(found) == NAMES
    assert [offset.pixels for offset in found.values()] == pytest.approx([1.0] * 8, abs=0.15)


def test_masks_that_are_too_small_are_found_by_the_others(device):
    true = np.array([1.0, -1.0, 1.0, 0.0, -1.0, 1.0, 0.0, 1.0])
    views = [cut(*pair) for pair in zip(ball_views(cameras_around(8, 80)), true, strict=True)]
    found = mend_masks(NAMES, views, OPTIONS, device=device).offsets
    offsets = np.array([found[name].pixels if name in found else 0.0 for name in NAMES])
    assert np.abs(offsets - true).max() < 0.35
    assert mend_masks(NAMES, views, OPTIONS, device=device).offsets == found


@pytest.mark.slow
def test_masks_of_a_capture_are_found(device, walker_views, rng):
    true = rng.permutation(np.where(np.arange(len(walker_views)) % 2, 1.0, -1.0))
    views = [cut(*pair) for pair in zip(walker_views, true, strict=True)]
    names = [f"c{k}" for k in range(len(views))]
    found = mend_masks(names, views, FitOptions.of_preset("draft", gaussian_count=8_000), device=device).offsets
    assert list(found) == names
    assert np.abs([found[name].pixels for name in names] - true).max() < 0.3


def test_noise_asks_nothing_of_a_short_fit(device, monkeypatch):
    """Steps that look for masks are too few to learn noise: nothing is left out of them, nor held even."""
    heard = []

    def noted(views, start, options, device):
        heard.append((options.dropout, options.total_variation))
        raise InterruptedError

    monkeypatch.setattr(masks, "Fitter", noted)
    with pytest.raises(InterruptedError):
        masks._shown_offsets(ball_views(cameras_around(4)), FitOptions(), device)
    assert heard == [(0.0, 0.0)]
