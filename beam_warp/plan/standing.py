"""How far a plan is: what is done, running, left and given up, and how long the rest will take."""

from __future__ import annotations

import heapq
import json
import statistics
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from beam_warp.errors import InvalidOptionError
from beam_warp.outputs import is_alive
from beam_warp.plan.carry import FOLDER, PLAN_NAME, STATE_NAME
from beam_warp.plan.schedule import Schedule
from beam_warp.plan.steps import Receipt, Step, is_whole, read_receipt, worker_name

SILENCE = 15.0
"""Time without a word after which who drives a plan on another machine is taken for gone [s]."""


@dataclass(frozen=True)
class Standing:
    """How far a plan is.

    Attributes:
        steps: All steps.
        folders: Folder of each stage's work.
        receipts: Of the steps that are done, by name.
        running: Who works on a step, and for how long [s], by its name.
        errors: What went wrong with steps that are not done, by name.
        given_up: Names of the steps that failed for good.
        workers: How many there are, or were.
        is_live: Whether somebody drives the plan now.
    """

    steps: tuple[Step, ...]
    folders: Mapping[str, Path]
    receipts: Mapping[str, Receipt]
    running: Mapping[str, tuple[str, float]]
    errors: Mapping[str, tuple[str, ...]]
    given_up: tuple[str, ...]
    workers: int
    is_live: bool

    @cached_property
    def stages(self) -> dict[str, StageStanding]:
        """How far each stage is, in the order of the plan."""
        found = {}
        for stage in dict.fromkeys(step.stage for step in self.steps):
            names = [step.name for step in self.steps if step.stage == stage]
            times = [self.receipts[name].seconds for name in names if name in self.receipts]
            found[stage] = StageStanding(
                total=len(names),
                done=len(times),
                running=sum(name in self.running for name in names),
                given_up=sum(name in self.given_up for name in names),
                seconds=statistics.median(times) if times else None,
            )
        return found

    def seconds_left(self, workers: int | None = None) -> float | None:
        """Return how long so many workers need for the rest [s]; None where a stage has not been measured."""
        times = {stage: standing.seconds for stage, standing in self.stages.items()}
        if any(times[step.stage] is None for step in self.steps if step.name not in self.receipts):
            return None
        known = {stage: seconds or 0.0 for stage, seconds in times.items()}
        return simulated(self.steps, self.receipts, known, workers or self.workers or 1)

    def as_dict(self) -> dict[str, Any]:
        """Return what a program needs to know, JSON-able."""
        return {
            "stages": {stage: vars(standing) for stage, standing in self.stages.items()},
            "running": {name: {"worker": worker, "seconds": age} for name, (worker, age) in self.running.items()},
            "errors": {name: list(words) for name, words in self.errors.items()},
            "given_up": list(self.given_up),
            "workers": self.workers,
            "is_live": self.is_live,
            "seconds_left": self.seconds_left(),
        }


@dataclass(frozen=True)
class StageStanding:
    """How far a stage is.

    Attributes:
        total: Its steps.
        done: Those that are done.
        running: Those that are worked on.
        given_up: Those that failed for good.
        seconds: Median time of a step [s]; None before the first.
    """

    total: int
    done: int
    running: int
    given_up: int
    seconds: float | None


def look(folder: Path) -> Standing:
    """Return how far the plan of a job is, while it is carried out or after; nothing is changed.

    Raises:
        InvalidOptionError: There is no plan.
    """
    place = folder / FOLDER
    try:
        content = json.loads((place / PLAN_NAME).read_text(encoding="utf-8"))
        steps = tuple(
            Step(name, stage, frame, tuple(inputs), rank) for name, stage, frame, inputs, rank in content["steps"]
        )
        works = {stage: (folder / where, version) for stage, (where, version) in content["works"].items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InvalidOptionError(
            f"out must be the folder of a job that was begun, got {folder}, whose {FOLDER}/{PLAN_NAME} "
            f"{'is not there' if isinstance(error, OSError) else 'is damaged'}. Begin one with beam run."
        ) from error
    state = _state(place / STATE_NAME)
    silent = time.time() - state.get("written", 0.0)
    is_live = not state.get("is_over", True) and _is_driven(str(state.get("driver", "")), silent)
    receipts = {}
    for step in steps:
        where, version = works[step.stage]
        receipt = read_receipt(where, step.name)
        if receipt is not None and receipt.version == version and is_whole(where, receipt):
            receipts[step.name] = receipt
    return Standing(
        steps,
        {stage: where for stage, (where, _) in works.items()},
        receipts,
        {name: (who, age + silent) for name, (who, age) in state.get("running", {}).items() if is_live},
        {name: tuple(words) for name, words in state.get("errors", {}).items() if name not in receipts},
        tuple(name for name in state.get("given_up", ()) if name not in receipts),
        int(state.get("workers", 1)),
        is_live,
    )


def _is_driven(driver: str, silent: float) -> bool:
    """Return whether a process still carries a plan out, which said so some time ago [s]."""
    machine, _, number = driver.rpartition(":")
    if machine == worker_name().rpartition(":")[0] and number.isdecimal():
        return is_alive(int(number))
    return abs(silent) < SILENCE


def _state(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}


def simulated(steps: Iterable[Step], done: Iterable[str], seconds: Mapping[str, float], workers: int) -> float:
    """Return how long a plan takes [s], by the schedule that carries it out.

    Args:
        steps: All steps.
        done: Names of those that are done.
        seconds: How long a step takes, by its stage [s].
        workers: How many work at a time.
    """
    schedule, kept = Schedule(steps, workers), set(done)
    now, running = 0.0, list[tuple[float, str]]()
    while not schedule.is_over:
        while len(running) < workers and (step := schedule.next()) is not None:
            if step.name in kept:
                schedule.done(step.name)
            else:
                heapq.heappush(running, (now + seconds[step.stage], step.name))
        if running:
            now, name = heapq.heappop(running)
            schedule.done(name)
    return now
