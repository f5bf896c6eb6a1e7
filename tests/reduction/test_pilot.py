"""What a device can do: how many Gaussians it draws so fast, and how many steps of a refit fit into a time."""

from types import SimpleNamespace
from typing import Any

import pytest

from beam_warp.errors import InvalidOptionError
from beam_warp.reduction import pilot
from beam_warp.reduction.pilot import MOST_STEPS, PILOT_STEPS, fast_enough, steps_within
from beam_warp.study.targets import TIME_MARGIN


class Device:
    """Draws in a millisecond and 0.1 us a Gaussian, and refits in 0.2 s and 5 ms a step: assets are their numbers."""

    original = 100_000

    def __init__(self):
        self.now = 0.0

    def seconds(self, asset, trials):
        return 1e-3 + 1e-7 * asset

    def candidate(self, count, steps):
        self.now += 0.2 * (steps == PILOT_STEPS[0]) + 5e-3 * steps
        return count


@pytest.mark.parametrize(("fps", "count"), [(100.0, (1e-2 / TIME_MARGIN - 1e-3) / 1e-7), (50.0, 100_000)])
def test_as_many_gaussians_as_are_drawn_so_often(fps, count):
    device: Any = Device()
    assert fast_enough(fps, device, [], device.candidate, 100_000) == pytest.approx(count, abs=2)


def test_what_one_gaussian_does_not_reach_is_refused_with_what_it_does():
    device: Any = Device()
    with pytest.raises(InvalidOptionError, match="target-fps must be attainable, got 900: the nearest is") as refused:
        fast_enough(900.0, device, [], device.candidate, 100_000)
    offered = float(str(refused.value).split("nearest is ")[1].split(",")[0])
    assert fast_enough(offered, device, [], device.candidate, 100_000) >= 1
    with pytest.raises(InvalidOptionError):
        fast_enough(1.02 * offered, device, [], device.candidate, 100_000)


class TestSteps:
    @pytest.fixture
    def clocked(self, monkeypatch):
        made: Any = Device()
        monkeypatch.setattr(pilot, "time", SimpleNamespace(perf_counter=lambda: made.now))
        return made

    def steps(self, clocked, seconds):
        return steps_within(seconds, 2.0, clocked, [], clocked.candidate, 20_000, 200)

    def test_they_fill_the_time_but_for_a_margin(self, clocked):
        steps = self.steps(clocked, 20.0)
        drawing = 200 * (clocked.seconds(20_000, []) + clocked.seconds(100_000, []))
        assert 2.0 + clocked.now + TIME_MARGIN * (5e-3 * steps + drawing) == pytest.approx(20.0, abs=0.02)

    def test_more_than_bring_anything_are_not_taken(self, clocked):
        assert self.steps(clocked, 1e6) == MOST_STEPS

    def test_a_time_without_room_is_refused_with_the_nearest_that_has_some(self, clocked):
        with pytest.raises(InvalidOptionError, match="target-seconds must be attainable") as refused:
            self.steps(clocked, 3.0)
        nearest = float(str(refused.value).split("nearest is ")[1].split(",")[0])
        assert self.steps(clocked, nearest) >= 0
        with pytest.raises(InvalidOptionError):
            self.steps(clocked, nearest - 0.2)
