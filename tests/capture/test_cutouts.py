"""Cut-outs: rings without light and moved masks, on discs whose coverage is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from support.discs import SUBJECT, cut_out, disc

from beam_warp.capture.cutouts import Ring, ring_of, taken_in


@pytest.mark.parametrize("is_straight", [False, True])
@pytest.mark.parametrize("pixels", [1.0, 1.5, 2.0])
def test_a_ring_is_as_wide_as_what_the_subject_does_not_touch(pixels, is_straight):
    """A disc touches two thirds of a pixel beyond its outline in the mean, of which little covers less than a tenth."""
    touched = 2.0 / np.pi
    ring = ring_of(cut_out(pixels, is_straight=is_straight))
    assert pixels - touched - 0.1 < ring.width < pixels - (0.4 if is_straight else 0.2)
    assert (ring.dim > 0.25) is not is_straight


@settings(max_examples=20, deadline=None)
@given(st.floats(14.0, 34.0), st.tuples(*[st.floats(40.0, 55.0)] * 2), st.floats(-2.0, 0.0), st.floats(0.0, 2.0))
def test_a_mask_that_is_not_too_large_has_no_ring(radius, center, pixels, softness):
    view = cut_out(pixels, radius=radius, center=center)
    soft = gaussian_filter(view.alpha, softness)
    assert ring_of(cut_out(0.0, alpha=soft, coverage=soft)).width < 0.05


def test_darkness_of_the_subject_is_no_ring():
    rows = np.arange(96)[:, None, None]
    half = np.where(rows < 48, SUBJECT, 1e-3 * SUBJECT)
    assert ring_of(cut_out(0.0, color=half)).width < 0.1
    assert ring_of(cut_out(0.0, color=0.0 * SUBJECT)) == Ring()
    nothing = cut_out(0.0, alpha=np.zeros((96, 96), np.float32))
    assert ring_of(nothing) == Ring()


@pytest.mark.parametrize("is_straight", [False, True])
@pytest.mark.parametrize("pixels", [-1.0, 1.0, 2.0])
def test_a_view_is_moved_with_its_colour(pixels, is_straight):
    view, true = cut_out(pixels, is_straight=is_straight), disc()
    found = taken_in(view, pixels)
    assert np.abs(found.alpha - true).sum() < 0.2 * np.abs(view.alpha - true).sum()
    if pixels > 0.0 and not is_straight:
        assert found.color is view.color  # it has the true coverage
    else:
        np.testing.assert_allclose(found.color, found.alpha[..., None] * SUBJECT, atol=1e-6)
    assert found.is_recut
    assert taken_in(view, 0.0) is view
    assert not view.is_recut
