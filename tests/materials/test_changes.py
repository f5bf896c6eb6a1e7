"""One base colour for all frames unless they disagree: level, power and what errors that are stated too small do."""

import numpy as np
import pytest
from scipy import stats
from support.color_evidence import color_evidence

from beam_warp.materials.base_color import BaseColor
from beam_warp.materials.changes import FALSE_DISCOVERIES, ChangeTest, with_changes

COUNT, FRAMES = 4000, 8
VIEWS = 1e6


def evidence(colors, error, *, stated=None, unseen=None):
    """Evidence of one frame whose least-squares solution is ``colors``, give or take ``stated``."""
    said = np.broadcast_to(error if stated is None else stated, (len(colors),))
    # so many views that their scatter is known: said^2 of the mean
    observed = colors**2 + VIEWS * (said**2)[:, None]
    hidden = 0.0 if unseen is None else unseen
    return color_evidence(len(colors), numerator=colors, denominator=1.0, observed=observed, views=VIEWS, unseen=hidden)


def frames_of(rng, truth, error, **said):
    return [evidence(np.clip(t + rng.normal(0.0, error, t.shape), 0.02, 0.98), error, **said) for t in truth]


def outcome(frames):
    test = ChangeTest()
    for frame in frames:
        test.add(frame)
    return test.result()


@pytest.mark.parametrize(("stated", "dispersion"), [(0.03, 1.0), (0.01, 9.0)])
def test_constant_colour_is_left_constant_whatever_error_is_stated(rng, stated, dispersion):
    truth = np.tile(rng.uniform(0.3, 0.7, (1, COUNT, 3)), (FRAMES, 1, 1))
    found = outcome(frames_of(rng, truth, 0.03, stated=stated))
    # no true change: any discovery is false, and there is one at all with a probability of the level
    assert found.changing.sum() <= 1
    # the median of COUNT chi-squared variables of 21 degrees is known to about 0.5 %
    assert found.dispersion == pytest.approx(dispersion, rel=0.03)


def test_changes_are_found_and_followed(rng):
    truth = np.tile(rng.uniform(0.3, 0.7, (1, COUNT, 3)), (FRAMES, 1, 1))
    truth[:, :200] += 0.2 * np.sin(np.arange(FRAMES))[:, None, None]
    frames = frames_of(rng, truth, 0.03)
    found = outcome(frames)
    assert found.changing[:200].all()
    assert found.changing[200:].sum() <= max(3, 10 * FALSE_DISCOVERIES * 200)
    color, error = found.frame_color(frames[2])
    off = (color - truth[2])[:200]
    assert np.sqrt((off**2).mean()) < 1.1 * 0.03
    assert 0.8 < np.sqrt((off**2).mean()) / error[:200].mean() < 1.25
    np.testing.assert_allclose(color[found.changing == 0], found.mean[found.changing == 0])


@pytest.mark.parametrize(("chance", "found"), [(0.8, 200), (1.2, 0)])
def test_chances_are_judged_by_their_rank(chance, found):
    """200 Gaussians of 4,000 differ from frame to frame, all by as much, and the others not at all.

    Benjamini and Hochberg's limit of the 200th smallest chance is the level times 200 / 4,000. A single chance would
    pass below the level, and by Bonferroni's limit none would.
    """
    error, channels = 0.05, 3
    # Two frames at mean +- d have Q = 2 (d / error)^2 by channel, of one degree of freedom each.
    q = stats.chi2.isf(chance * FALSE_DISCOVERIES * 200 / COUNT, channels)
    apart = np.where(np.arange(COUNT) < 200, error * np.sqrt(q / channels / 2.0), 0.0)[:, None] * np.ones(channels)
    changing = outcome([evidence(0.5 + apart, error), evidence(0.5 - apart, error)]).changing
    assert changing[:200].sum() == found
    assert not changing[200:].any()


def test_frames_that_do_not_see_a_gaussian_do_not_count(rng):
    truth = np.tile(rng.uniform(0.3, 0.7, (1, COUNT, 3)), (FRAMES, 1, 1))
    hidden = np.zeros(COUNT, bool)
    hidden[:500] = True
    frames = frames_of(rng, truth, 0.03)
    frames[3] = evidence(np.where(hidden[:, None], 0.0, truth[3]), 0.03, unseen=hidden)
    found = outcome(frames)
    assert not found.changing.any()
    np.testing.assert_allclose(found.frame_color(frames[3])[0][:500], found.mean[:500])


def test_what_no_surface_is_counts_as_black_or_white(rng):
    """Light that is stated too dim takes least squares beyond white: by how much is no change of colour."""
    colors = rng.uniform(-0.2, 1.2, (FRAMES, COUNT, 3))
    found, cut = (
        outcome([evidence(frame, 0.03) for frame in frames]) for frames in (colors, np.clip(colors, 0.0, 1.0))
    )
    np.testing.assert_allclose(found.mean, cut.mean, rtol=1e-3)
    np.testing.assert_allclose(found.dispersion, cut.dispersion, rtol=1e-3)


def test_a_single_frame_says_nothing(rng):
    found = outcome(frames_of(rng, rng.uniform(0.3, 0.7, (1, 50, 3)), 0.03))
    assert not found.changing.any()
    assert found.dispersion == 1.0


def test_only_what_changes_gets_a_colour_of_its_own(rng):
    truth = np.tile(rng.uniform(0.3, 0.7, (1, COUNT, 3)), (FRAMES, 1, 1))
    truth[:, 0] = np.linspace(0.1, 0.9, FRAMES)[:, None]
    frames = frames_of(rng, truth, 0.02)
    found = outcome(frames)
    constant = BaseColor(
        np.full((COUNT, 3), 0.5, np.float32), np.full((COUNT, 3), 0.1, np.float32), np.zeros(COUNT, np.uint8), 0.0
    )
    first, last = (with_changes(constant, found, frames[k]) for k in (0, -1))
    assert np.abs(first.base_color[0] - 0.1).max() < 0.1
    assert np.abs(last.base_color[0] - 0.9).max() < 0.1
    rest = ~found.changing
    assert (first.base_color[rest] == 0.5).all()
    assert (last.base_color[rest] == 0.5).all()
