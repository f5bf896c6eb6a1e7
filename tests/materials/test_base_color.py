"""What base colour is given where it cannot be measured, and why it says that it could not."""

import numpy as np
import pytest
from support.color_evidence import color_evidence
from support.shapes import aligned

from beam_warp.materials.base_color import SATURATED_PART, fill_from_neighbors, solve_base_color
from beam_warp.world.gaussians import Observability


def evidence(count, **changes):
    """Evidence of one frame on a base colour of one half, by ten equally good views."""
    made = color_evidence(count, numerator=5.0, denominator=10.0, observed=2.5, irradiance=np.pi, views=10.0)
    for name, rows in changes.items():
        for row, value in rows.items():
            getattr(made, name)[row] = value
    return made


NOTHING = {"numerator": {2: 0.0}, "denominator": {2: 0.0}, "observed": {2: 0.0}}
"""No view of the third Gaussian counts."""


@pytest.mark.parametrize(
    ("why", "flags"),
    [
        (NOTHING, Observability.UNSEEN | Observability.FILLED),
        (NOTHING | {"unseen": {2: 1.0}}, Observability.UNSEEN | Observability.FILLED),
        (NOTHING | {"saturated": {2: 1.0}, "facing": {2: 0.0}}, Observability.SATURATED | Observability.FILLED),
        (NOTHING | {"facing": {2: 0.0}}, Observability.GRAZING | Observability.FILLED),
        (NOTHING | {"irradiance": {2: 0.001}}, Observability.UNLIT | Observability.FILLED),
        ({"facing": {2: 0.001}}, Observability.GRAZING),
        ({"saturated": {2: SATURATED_PART + 0.1}}, Observability.SATURATED),
    ],
)
def test_what_is_without_evidence_says_why(why, flags):
    """Cut pixels leave no view, and none that faces the surface; that is neither want of light nor a grazing view."""
    line = aligned(np.arange(5)[:, None] * [1.0, 0.0, 0.0], 1.0, 1.0, normal_confidence=np.ones(5))
    solved = solve_base_color(line, evidence(5, **why), np.pi)
    assert solved.observability.tolist() == [0, 0, int(flags), 0, 0]
    np.testing.assert_allclose(solved.base_color, 0.5)


def test_error_of_what_is_filled_grows_with_distance():
    """Values rise by a tenth a metre: filled d metres beyond their end, they are off by d tenths, and say so at least.

    Pairs are no farther apart than the line is long, so that beyond that the error stays.
    """
    known, beyond = 40, np.arange(1, 21)
    positions = np.zeros((known + len(beyond), 3), np.float32)
    positions[:, 0] = np.concatenate([np.arange(known), known - 1 + beyond])
    values = 0.1 * positions[:, :1].astype(np.float64)
    missing = np.arange(len(positions)) >= known
    filled, error = fill_from_neighbors(positions, values, np.zeros_like(values), missing)
    assert (np.diff(error[missing, 0]) >= -1e-12).all()
    # Of the pairs that share a group the root mean square is taken: it may fall short of the farthest by a group.
    assert (error[missing, 0] > 0.1 * beyond - 0.1).all()
    assert (np.abs(filled - values)[missing, 0] < 2.0 * error[missing, 0]).all()
    np.testing.assert_array_equal(filled[~missing], values[~missing])
    assert not error[~missing].any()


def test_error_of_what_is_filled_among_its_like_is_theirs():
    """Where nothing varies, nothing is added to the neighbours' own error."""
    positions = np.random.default_rng(0).uniform(size=(600, 3)).astype(np.float32)
    values, errors = np.full((600, 3), 0.4), np.full((600, 3), 0.02)
    filled, error = fill_from_neighbors(positions, values, errors, np.arange(600) % 7 == 0)
    np.testing.assert_allclose(filled, 0.4)
    np.testing.assert_allclose(error, 0.02)


@pytest.mark.parametrize("known", [0, 1, 2])
def test_few_neighbors(known):
    positions = np.arange(12, dtype=np.float32).reshape(4, 3)
    values, errors = np.full((4, 2), 0.3), np.full((4, 2), 0.1)
    filled, error = fill_from_neighbors(positions, values, errors, np.arange(4) >= known)
    np.testing.assert_allclose(filled, 0.3)
    np.testing.assert_allclose(error, 0.1)
