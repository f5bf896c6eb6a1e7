"""Moments of images: frames by their numbers, and times between them at another rate, pace and length."""

import numpy as np
import pytest

from beam_warp.errors import InvalidOptionError
from beam_warp.stage.frame_times import FrameTimes, frame_times


@pytest.mark.parametrize(
    ("words", "numbers"),
    [
        (None, range(10)),
        ("0:10", range(10)),
        (":", range(10)),
        ("2:5", range(2, 5)),
        (":3", range(3)),
        ("8:", range(8, 10)),
        ("-3:", range(7, 10)),
        ("-3:-1", range(7, 9)),
        ("1:9:3", (1, 4, 7)),
        ("::4", (0, 4, 8)),
    ],
)
def test_frames_by_number(words, numbers):
    found = frame_times(10, 25.0, frames=words)
    assert found.numbers == tuple(numbers)
    assert found.times == tuple(number / 25.0 for number in numbers)


def test_a_step_keeps_the_pace():
    assert frame_times(10, 30.0, frames="::3").rate == 10.0
    assert frame_times(10, 30.0).rate == 30.0


def test_another_rate_shows_the_same_time():
    found = frame_times(30, 30.0, fps=60.0)
    assert (found.numbers, found.rate) == (tuple(range(60)), 60.0)
    np.testing.assert_allclose(found.times, np.arange(60) / 60.0)
    assert len(frame_times(30, 30.0, fps=24.0).numbers) == 24


def test_slower_takes_longer():
    found = frame_times(30, 30.0, speed=0.25)
    assert len(found.numbers) == 120
    np.testing.assert_allclose(found.times, np.arange(120) / 120.0)  # the film's second 3.97 shows the second 0.99


def test_seconds_may_be_longer_than_the_frames():
    found = frame_times(1, 30.0, seconds=2.0, fps=10.0)
    assert found == FrameTimes(tuple(range(20)), tuple(n / 10.0 for n in range(20)), 10.0)
    np.testing.assert_allclose(frame_times(30, 30.0, frames="15:", seconds=1.0, fps=2.0).times, [0.5, 1.0])
    assert frame_times(30, 30.0, seconds=0.001).numbers == (0,)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"frames": "0:11"}, "frames must be some of the 10 that there are, 0:10, got 0:11"),
        ({"frames": "-11:"}, "frames must be some of the 10"),
        ({"frames": "5:5"}, "frames must be some of the 10"),
        ({"frames": "5"}, "frames must be A:B or A:B:STEP, got 5"),
        ({"frames": "0:4:0"}, "frames must be A:B or A:B:STEP"),
        ({"frames": "0:4:-1"}, "frames must be A:B or A:B:STEP"),
        ({"frames": "a:b"}, "frames must be A:B or A:B:STEP"),
        ({"frames": "0:9:2", "fps": 10.0}, "frames must have no step with seconds, fps or speed, got 0:9:2"),
        ({"fps": 0.0}, "fps must be a number in"),
        ({"speed": np.nan}, "speed must be a number in"),
        ({"seconds": -1.0}, "seconds must be a number in"),
        ({"seconds": 1e6, "fps": 60.0}, "seconds must hold at most 1000000 images, got 60000000"),
    ],
)
def test_refusals(given, message):
    with pytest.raises(InvalidOptionError, match=message):
        frame_times(10, 30.0, **given)
