"""Settings chosen by targets: known models of cost and error, and what must hold for every ladder."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beam_warp.errors import InvalidOptionError
from beam_warp.study.targets import (
    ERROR_MARGIN,
    TIME_MARGIN,
    Rung,
    Target,
    cheapest,
    climbed,
    fitted,
    in_words,
    outcome,
)


def rung(rays, seconds=None, error=None):
    """Return a rung whose error falls as 1/sqrt(rays) and whose time grows with rays."""
    return Rung(
        settings={"samples": rays},
        seconds=1.0 + 0.01 * rays if seconds is None else seconds,
        frame_seconds=0.01 * rays,
        error=1.0 / math.sqrt(rays) if error is None else error,
    )


LADDER = [rung(4**k) for k in range(1, 7)]


@pytest.mark.parametrize(
    ("target", "rays"),
    [
        ({"error": 0.5 * ERROR_MARGIN}, 4),  # met exactly
        ({"error": 0.2}, 64),  # 1/8 with its margin; 1/4 is too much
        ({"seconds": 4.0}, 64),  # the most exact within 4 s: 1.64 s and its margin, while 256 rays take 3.56 s
        ({"fps": 1.0 / TIME_MARGIN / 0.17}, 16),
        ({"error": 0.2, "seconds": 4.0}, 64),
        ({"error": 0.3, "seconds": 1e9}, 16),
    ],
)
def test_of_a_known_model_the_cheapest_is_taken(target, rays):
    assert cheapest(LADDER, Target(**target)).settings == {"samples": rays}


@pytest.mark.parametrize(
    ("target", "says"),
    [
        ({"error": 1e-3}, "target-error must be attainable, got 0.001: the nearest is 0.018, by samples 4096. Ask for"),
        ({"seconds": 0.5}, "target-seconds must be attainable, got 0.5: the nearest is 1.4, by samples 4."),
        ({"fps": 1e3}, "target-fps must be attainable, got 1000: the nearest is 19, by samples 4."),
        ({"error": 0.1, "seconds": 1.0}, "target-error and target-seconds must be attainable together, got 0.1 and 1"),
    ],
)
def test_what_cannot_be_reached_is_refused_with_the_nearest_that_can(target, says):
    with pytest.raises(InvalidOptionError, match=r"attainable") as caught:
        cheapest(LADDER, Target(**target))
    assert says in str(caught.value)


numbers = st.floats(1e-3, 1e3)
ladders = st.lists(st.builds(rung, st.integers(1, 4096), numbers, numbers), min_size=1, max_size=8)


@given(ladders, numbers, st.floats(1.0, 100.0))
def test_a_looser_target_never_costs_or_errs_more(rungs, asked, looser):
    for name, paid in (("error", "seconds"), ("seconds", "error")):
        try:
            strict = cheapest(rungs, Target(**{name: asked}))
        except InvalidOptionError:
            continue
        assert getattr(cheapest(rungs, Target(**{name: looser * asked})), paid) <= getattr(strict, paid)


@given(ladders, numbers, numbers)
def test_what_is_offered_can_be_had(rungs, error, seconds):
    """The nearest target that a refusal names is not refused."""
    try:
        cheapest(rungs, Target(error=error, seconds=seconds))
    except InvalidOptionError as refusal:
        offered = str(refusal).partition("the nearest is ")[2].partition(",")[0].split(" and ")
        assert cheapest(rungs, Target(error=float(offered[0]), seconds=float(offered[1]))) in rungs


def test_a_climb_ends_where_the_target_is_met_or_time_is_up():
    measured = []

    def measure(settings):
        measured.append(settings["samples"])
        return rung(settings["samples"])

    ladder = [each.settings for each in LADDER]
    climbed(ladder, measure, Target(error=0.2))
    assert measured == [4, 16, 64]
    measured.clear()
    assert len(climbed(ladder, measure, Target(seconds=4.0))) == 4  # 256 rays take too long
    assert len(climbed(ladder, measure, Target(error=1e-6))) == 6
    clock = iter(range(0, 1000, 5))  # measuring takes 5 s, and the next rung perhaps 15
    found = climbed(ladder, measure, Target(seconds=60.0), lambda: next(clock))
    assert [each.settings["samples"] for each in found] == [4, 16]
    assert found[0].spent == found[1].spent == 20.0


def test_without_known_errors_the_costliest_that_fits_is_taken():
    unknown = [rung(4**k, error=math.nan) for k in range(1, 7)]
    assert cheapest(unknown, Target(seconds=4.0)).settings == {"samples": 64}
    with pytest.raises(InvalidOptionError):
        cheapest(unknown, Target(error=1.0))


def test_models_are_found_again():
    rays = np.array([8.0, 32.0, 128.0])
    np.testing.assert_allclose(fitted(np.stack([np.ones(3), rays], axis=1), 2.0 + 0.1 * rays), [2.0, 0.1])
    np.testing.assert_allclose(fitted(np.stack([np.ones(3), 1.0 / rays], axis=1), 1e-4 + 0.3 / rays), [1e-4, 0.3])
    assert (fitted([[1.0, 8.0], [1.0, 32.0]], [5.0, 4.0]) >= 0.0).all()  # time does not fall with rays


def test_reports_say_what_was_asked_and_reached():
    said = outcome(Target(error=0.2, seconds=9.0), rung(64), {"error": 0.13, "seconds": 10.0, "fps": None})
    assert (said["asked"], said["chosen"], said["met"]) == ({"error": 0.2, "seconds": 9.0}, {"samples": 64}, False)
    assert in_words(said) == "target MISSED: error 0.2, reached 0.13; seconds 9, reached 10, by samples 64"
    assert outcome(Target(error=0.2), rung(64), {"error": 0.13})["met"]
    assert not outcome(Target(error=0.2), rung(64), {"error": None})["met"]
    with pytest.raises(InvalidOptionError, match=r"target-error must be a number in .* got nan"):
        Target(error=math.nan)
