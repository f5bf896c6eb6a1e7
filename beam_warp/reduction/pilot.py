"""What Gaussians cost on this device: how many are drawn so fast, and how many steps of a refit fit into a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from beam_warp.errors import InvalidOptionError
from beam_warp.evaluate.relit import RelitComparison
from beam_warp.evaluate.trials import Trial
from beam_warp.study.targets import TIME_MARGIN, fitted
from beam_warp.world.gaussians import GaussianSequence

SHARES = (1.0, 0.25, 0.0625)
"""Shares of all Gaussians whose images are timed."""

PILOT_STEPS = (8, 40)
"""Steps of the two refits that tell what a step takes; the first one compiles what is not compiled yet."""

MOST_STEPS = 6000
"""Steps of a refit that a time may choose: rates fall over all of them, and more hardly bring anything."""

Candidate = Callable[[int, int], GaussianSequence]
"""Makes the asset of so many Gaussians by so many steps of a refit."""


def images_a_second(comparison: RelitComparison, asset: GaussianSequence, trials: Sequence[Trial]) -> float:
    """Return how many images of an asset are drawn a second, under lights and cameras that change."""
    return 1.0 / comparison.seconds(asset, trials)


def fast_enough(
    fps: float, comparison: RelitComparison, trials: Sequence[Trial], candidate: Candidate, count: int
) -> int:
    """Return the most Gaussians that are drawn so often a second, by the times of some numbers of them.

    Args:
        fps: Images a second.
        comparison: Draws.
        trials: What is drawn.
        candidate: Makes reduced assets.
        count: Gaussians of the original.

    Raises:
        InvalidOptionError: One alone takes longer.
    """
    counts = [max(1, round(share * count)) for share in SHARES]
    times = [1.0 / images_a_second(comparison, candidate(some, 0), trials) for some in counts]
    always, each = fitted([[1.0, some] for some in counts], times)
    most = (1.0 / (TIME_MARGIN * fps) - always) / max(float(each), 1e-15)
    if not most >= 1.0:
        nearest = np.floor(100.0 / (TIME_MARGIN * (always + each))) / 100.0
        raise InvalidOptionError(
            f"target-fps must be attainable, got {fps:g}: the nearest is {nearest:g}, by one Gaussian. Ask for "
            "that, or for a smaller height."
        )
    return int(min(most, count))


def steps_within(
    seconds: float,
    spent: float,
    comparison: RelitComparison,
    trials: Sequence[Trial],
    candidate: Candidate,
    count: int,
    draws: int,
) -> int:
    """Return how many steps of a refit fit into a time, in which draws are compared as well.

    Args:
        seconds: Longest time of the whole call [s].
        spent: What has passed of it [s].
        comparison: Compares.
        trials: Some draws, by which their time is told.
        candidate: Makes reduced assets.
        count: Gaussians that are left.
        draws: How many draws will be compared.

    Raises:
        InvalidOptionError: Not even an asset that is not refitted is done in time.
    """
    began, marks = time.perf_counter(), []
    for steps in PILOT_STEPS:
        made = candidate(count, steps)
        marks.append(time.perf_counter())
    step = max(marks[1] - marks[0], 1e-6) / PILOT_STEPS[1]
    drawing = draws * (comparison.seconds(made, trials) + comparison.seconds(comparison.original, trials))
    spent += time.perf_counter() - began
    steps = (seconds - spent) / (TIME_MARGIN * step) - drawing / step
    if not steps >= 0.0:
        nearest = np.ceil(10.0 * (spent + TIME_MARGIN * drawing)) / 10.0
        raise InvalidOptionError(
            f"target-seconds must be attainable, got {seconds:g}: the nearest is {nearest:g}, without a refit. Ask for "
            "that, or compare fewer pairs."
        )
    return int(min(steps, MOST_STEPS))
