"""Settings that follow from a target: the cheapest that meets it by what a pilot measured, and what was reached then.

A pilot is a small run of the job itself. It makes rungs: settings, with what they are predicted to take and to err by.
Nothing here knows what is chosen: each command brings its ladder of settings and a function that measures one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_number
from beam_warp.errors import InvalidOptionError
from beam_warp.study.table import Settings

TIME_MARGIN = 1.3
"""A job may take this many times what its pilot predicts: a range of repeats on a machine that is not busy."""

ERROR_MARGIN = 1.1
"""A job may err by this many times what its pilot predicts: other frames, other pixels, other samples."""

GROWTH = 3.0
"""The next rung of a ladder may take this many times as long to measure as the last one."""

PILOT_PART = 0.4
"""Part of the time asked for that a pilot may take where no error is asked."""

MET = 1.0 + 1e-9
"""Ratio of what is reached to what is asked that still counts as met: offers are rounded numbers."""

DIGITS = 2
"""Digits of what is offered instead of a target that cannot be reached."""


@dataclass(frozen=True, kw_only=True)
class Rung:
    """A setting and what is predicted of it.

    Attributes:
        settings: The setting.
        seconds: Time of the job [s].
        frame_seconds: Time of a frame [s].
        error: Error of the result, in the command's own unit; NaN where it is not known.
        spent: Time that was spent before the job, on the pilot above all [s].
    """

    settings: Settings
    seconds: float
    frame_seconds: float
    error: float = math.nan
    spent: float = 0.0

    def predicted(self, *, time_margin: float = 1.0, error_margin: float = 1.0) -> dict[str, float]:
        """Return what is predicted, by the names of a target, times margins."""
        return {
            "error": error_margin * self.error,
            "seconds": self.spent + time_margin * self.seconds,
            "fps": 1.0 / max(time_margin * self.frame_seconds, 1e-12),
        }

    def surely(self) -> dict[str, float]:
        """Return what is predicted with a margin."""
        return self.predicted(time_margin=TIME_MARGIN, error_margin=ERROR_MARGIN)


@dataclass(frozen=True, kw_only=True)
class Target:
    """What is asked of a result; None for what is not asked.

    Attributes:
        error: Largest error, in the command's own unit.
        seconds: Longest time of the whole job [s].
        fps: Least frames a second, what is done once left out.

    Raises:
        InvalidOptionError: A number is not positive.
    """

    error: float | None = None
    seconds: float | None = None
    fps: float | None = None

    def __post_init__(self) -> None:
        """Check every number once."""
        for name, value in self.asked().items():
            require_number(f"target-{name}", value, 1e-9, 1e9)

    def asked(self) -> dict[str, float]:
        """Return what is asked, by name."""
        given = ((field.name, getattr(self, field.name)) for field in fields(self))
        return {name: value for name, value in given if value is not None}

    def excess(self, found: Mapping[str, float]) -> float:
        """Return by how many times the worst of what was found misses what is asked; at most 1 where all is met."""
        ratios = [found[name] / asked if name != "fps" else asked / found[name] for name, asked in self.asked().items()]
        return math.inf if np.isnan(ratios).any() else max(ratios, default=0.0)

    def meets(self, rung: Rung) -> bool:
        """Return whether a rung is predicted to meet the target, with a margin."""
        return self.excess(rung.surely()) <= MET


def cheapest(rungs: Sequence[Rung], target: Target) -> Rung:
    """Return the cheapest rung that meets a target; where no error is asked, the most exact that meets the others.

    So a looser error never costs more, and a longer time never errs more. Where errors are not known, the last rung
    is taken for the most exact.

    Raises:
        InvalidOptionError: None meets it; the message has the nearest target that one does.
    """
    meeting = [rung for rung in rungs if target.meets(rung)]
    if not meeting:
        raise unattainable(min(rungs, key=lambda rung: target.excess(rung.surely())), target)
    if target.error is None:
        known = not any(math.isnan(rung.error) for rung in rungs)
        return min(meeting, key=lambda rung: (rung.error, rung.seconds)) if known else meeting[-1]
    return min(meeting, key=lambda rung: (rung.seconds, rung.error))


def unattainable(nearest: Rung, target: Target) -> InvalidOptionError:
    """Return the refusal of a target, with what can be asked instead: what the nearest rung surely reaches.

    The next call pilots anew, and may take longer by the same margin as its job.
    """
    asked, sure = target.asked(), replace(nearest, spent=TIME_MARGIN * nearest.spent).surely()
    offered = {
        name: value if target.excess({**asked, name: sure[name]}) <= MET else _rounded(sure[name], up=name != "fps")
        for name, value in asked.items()
    }
    names = " and ".join(f"target-{name}" for name in asked)
    together = " together" if len(asked) > 1 else ""
    by = ", ".join(f"{name} {level}" for name, level in nearest.settings.items())
    return InvalidOptionError(
        f"{names} must be attainable{together}, got {_listed(asked)}: the nearest is {_listed(offered)}, by {by}. "
        "Ask for that."
    )


def _listed(values: Mapping[str, float]) -> str:
    return " and ".join(f"{value:g}" for value in values.values())


def _rounded(value: float, *, up: bool) -> float:
    """Return a value with few digits that is no harder to reach."""
    step = 10.0 ** (math.floor(math.log10(value)) - DIGITS + 1) if 0.0 < value < math.inf else 1.0
    return float(f"{(math.ceil if up else math.floor)(value / step) * step:.12g}") if math.isfinite(value) else value


def climbed(
    ladder: Iterable[Settings],
    measure: Callable[[Settings], Rung],
    target: Target,
    elapsed: Callable[[], float] = lambda: 0.0,
    growth: float = GROWTH,
) -> list[Rung]:
    """Measure a ladder from its cheapest setting up, as far as a target needs and its time allows.

    The climb ends at the first rung that meets the target if an error is asked, at one that takes too long, and where
    measuring another would take more than a pilot's part of the time, or with an error, more than there is.

    Args:
        ladder: Settings, the cheapest first.
        measure: Measures one.
        target: What is asked.
        elapsed: Returns the time since the command began [s].
        growth: How many times as long as the last rung the next one may take to measure.
    """
    others = Target(seconds=target.seconds, fps=target.fps)
    found: list[Rung] = []
    for settings in ladder:
        before = elapsed()
        found.append(measure(settings))
        now = elapsed()
        last = replace(found[-1], spent=now)
        if not others.meets(last) or (target.error is not None and target.meets(last)):
            break
        part = PILOT_PART if target.error is None else 1.0
        if target.seconds is not None and now + growth * (now - before) > part * target.seconds:
            break
    spent = elapsed()
    return [replace(rung, spent=spent) for rung in found]


def fitted(features: ArrayLike, values: ArrayLike) -> NDArray[np.float64]:
    """Return the coefficients of a linear model of costs, none negative, of least relative errors.

    Args:
        features: What costs in each measurement, such as 1 and the number of rays, ``(M, F)``.
        values: The measured costs, ``(M,)``; seconds, or squares of errors whose noise falls as 1 / rays.

    Source: Lawson and Hanson 1974.
    """
    from scipy.optimize import nnls  # which few commands need

    rows, costs = np.asarray(features, np.float64), np.maximum(np.asarray(values, np.float64), 1e-30)
    scales = np.maximum(np.abs(rows).max(axis=0), 1e-300)
    return nnls(rows / scales / costs[:, None], np.ones(len(costs)))[0] / scales


def outcome(target: Target, chosen: Rung, reached: Mapping[str, float | None]) -> dict[str, Any]:
    """Return what a report says of a target, JSON-able: asked, chosen, predicted, reached, and whether it was met.

    Args:
        target: What was asked.
        chosen: The setting and what was predicted of it.
        reached: What came out; None for what could not be measured.
    """
    predicted = chosen.predicted()
    known = {name: math.nan if reached.get(name) is None else reached[name] for name in target.asked()}
    return {
        "asked": target.asked(),
        "chosen": dict(chosen.settings),
        "predicted": {name: value if math.isfinite(value) else None for name, value in predicted.items()},
        "reached": {name: reached.get(name) for name in predicted},
        "met": target.excess({name: float(value) for name, value in known.items() if value is not None}) <= MET,
    }


def in_words(said: Mapping[str, Any]) -> str:
    """Return an `outcome` in a line."""
    chosen = ", ".join(f"{name} {level}" for name, level in said["chosen"].items())
    reached = {name: "unknown" if value is None else f"{value:.3g}" for name, value in said["reached"].items()}
    parts = [f"{name} {asked:g}, reached {reached[name]}" for name, asked in said["asked"].items()]
    return f"target {'met' if said['met'] else 'MISSED'}: {'; '.join(parts)}, by {chosen}"
