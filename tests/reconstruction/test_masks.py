"""Masks of cut-outs: offsets that views agree on, on discs whose coverage is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.discs import RADIUS, SIDE, SUBJECT, disc

from beam_warp.capture.mattes import MaskOffset
from beam_warp.capture.views import CapturedView
from beam_warp.reconstruction.masks import agreed_offsets, largest_offset, moved_view, relative_offset
from beam_warp.world.camera import Camera

CAMERA = Camera(SIDE, SIDE, 100.0, 100.0, 48.0, 48.0, np.eye(4))


def cut_out(pixels):
    """A disc with a mask that is too large by so much; there is no light beyond either."""
    mask = disc(RADIUS + pixels)
    return CapturedView(name="a", camera=CAMERA, color=np.minimum(mask, disc())[..., None] * SUBJECT, alpha=mask)


@pytest.mark.parametrize("pixels", [-1.0, -0.4, 0.0, 0.4, 1.0])
def test_an_offset_against_what_is_drawn_is_found(pixels):
    found = relative_offset(disc(RADIUS + pixels), disc())
    assert found.pixels == pytest.approx(pixels, abs=0.05)
    assert relative_offset(np.zeros((9, 9), np.float32), np.zeros((9, 9))) is None


@pytest.mark.parametrize("pixels", [-1.0, 0.0, 0.5, 1.0])
def test_a_ring_without_light_bounds_the_offset(pixels):
    assert largest_offset(cut_out(pixels)).pixels == pytest.approx(max(pixels, 0.0), abs=0.05)


@given(
    st.lists(st.floats(-2.0, 2.0), min_size=8, max_size=30),
    st.floats(-1.0, 1.0),
    st.integers(0, 29),
    st.floats(0.0, 2.0),
)
def test_what_all_have_in_common_follows_from_the_bounds(true, drift, which, largest):
    """Where a fifth of the masks reach beyond the subject, or are exact, the common offset is theirs."""
    true = np.array(true)
    true[np.arange(len(true)) % 3 == which % 3] = largest
    relative = [MaskOffset(value - drift, 0.01) for value in true]
    bounds = [MaskOffset(max(value, 0.0), 0.03) for value in true]
    found = [offset.pixels for offset in agreed_offsets(relative, bounds)]
    np.testing.assert_allclose(found, true, atol=1e-9)
    assert agreed_offsets([None, *relative], [None, *bounds])[0] is None
    unbounded = agreed_offsets(relative, [None] * len(relative))
    assert [offset.pixels for offset in unbounded] == [offset.pixels for offset in relative]


@pytest.mark.parametrize("pixels", [-1.0, 1.0])
def test_a_view_is_moved_with_its_colour(pixels):
    given_view, true = cut_out(pixels), disc()
    found = moved_view(given_view, pixels)
    assert np.abs(found.alpha - true).sum() < 0.2 * np.abs(given_view.alpha - true).sum()
    np.testing.assert_allclose(found.color, found.alpha[..., None] * SUBJECT, atol=0.01)  # 0.99 is solid
    assert moved_view(given_view, 0.0) is given_view
