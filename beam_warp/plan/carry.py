"""Carry a plan out: give steps to workers, judge what becomes of them, and tell whoever watches.

A step may fail twice and is then given up; it is reported, and the rest goes on, but for steps that are done once for
all. Who hangs, by the times that others took, is ended. Where a step fails, its inputs are read and compared with their
receipts: damaged ones are made again, and that is no failure of the step. An output that cannot be written ends the
whole job, which can be called again once there is room.
"""

from __future__ import annotations

import statistics
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from beam_warp.errors import BeamError, InvalidOptionError, OutputError, UnfinishedError
from beam_warp.jobs.listeners import NotedProgress, no_progress
from beam_warp.plan.schedule import Schedule, State
from beam_warp.plan.steps import (
    Plan,
    Receipt,
    Step,
    StoredFacts,
    Task,
    awaited_files,
    is_whole,
    receipt_path,
    version_of,
    worker_name,
    write_record,
)
from beam_warp.plan.workers import Outcome, Workers, clear

FOLDER, PLAN_NAME, STATE_NAME = "plan", "plan.json", "state.json"
"""Folder of what is known of a plan, in that of the job; its steps; and what became of them so far."""

STATE_PERIOD = 2.0
"""How often the state is written [s]."""

LATEST = 50
"""Steps of a stage whose times say how long the next one takes: the latest."""

LEAST_MEASURED = 3
"""Steps of a stage after which their times say how long others may take."""

NAMED = 5
"""Failures that an error names; the state has all."""


@dataclass(frozen=True)
class Patience:
    """How long a step may take before its worker is said to hang and is ended.

    Attributes:
        first: While few steps of its stage have been measured [s].
        least: Later, at least [s]: compiling kernels takes a minute.
        factor: Later, so many times the median of its stage.
    """

    first: float = 6.0 * 3600.0
    least: float = 300.0
    factor: float = 10.0


Watch = Callable[[Step, Receipt | None, str], None]
"""Called with a step that is done, its receipt and ""; or with one that was tried in vain, None and why."""


class Counted:
    """A watch that counts the steps of some stages for a listener."""

    def __init__(self, plan: Plan, names: Mapping[str, str], progress: NotedProgress) -> None:
        """Take what the listener calls each stage; stages without a name are not counted."""
        self._names = {stage: name for stage, name in names.items() if stage in plan.works}
        self._progress = progress
        self._open = {stage: {step.name for step in plan.steps if step.stage == stage} for stage in self._names}
        self._totals = {stage: len(steps) for stage, steps in self._open.items()}
        for stage, name in self._names.items():
            progress(name, 0, self._totals[stage])

    def __call__(self, step: Step, receipt: Receipt | None, error: str) -> None:
        """Count a step that is done; pass on what went wrong."""
        if step.stage in self._names:
            if receipt is not None:
                self._open[step.stage].discard(step.name)
            total = self._totals[step.stage]
            note = f"{step.name}: {error}" if receipt is None else str(receipt.facts.get("line", ""))
            self._progress(self._names[step.stage], total - len(self._open[step.stage]), total, note)


@dataclass(eq=False)
class _Running:
    worker: str
    since: float


@dataclass(eq=False)
class _Job:
    """The state of a plan that is carried out."""

    plan: Plan
    schedule: Schedule
    workers: Workers
    patience: Patience
    receipts: dict[str, Receipt] = field(default_factory=dict)
    running: dict[str, _Running] = field(default_factory=dict)
    following: dict[str, tuple[Step, ...]] = field(default_factory=dict)
    stages: dict[str, set[str]] = field(default_factory=dict)
    hung: set[str] = field(default_factory=set)
    errors: dict[str, list[str]] = field(default_factory=dict)
    raised: dict[str, Exception] = field(default_factory=dict)
    times: dict[str, deque[float]] = field(default_factory=dict)
    started: float = field(default_factory=time.time)
    written: float = 0.0


def carry_out(
    plan: Plan, workers: Workers, watch: Watch = no_progress, patience: Patience | None = None
) -> dict[str, Receipt]:
    """Do every step of a plan that is not done.

    Args:
        plan: The steps.
        workers: Who does them; they are ended in any case.
        watch: Called after each step.
        patience: How long steps may take.

    Returns:
        The receipts of all steps, by name; their facts are read from files when they are asked for.

    Raises:
        UnfinishedError: Several steps failed, or one by a mistake of the program; all others that can be are done.
        OutputError: An output cannot be written.
        BeamError: A step failed for a reason that is the caller's to mend, or no worker can do such work.
    """
    job = _Job(plan, Schedule(plan.steps), workers, patience or Patience())
    try:
        folder = plan.folder / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        clear(plan.works)
        write_record(folder / PLAN_NAME, _as_record(plan))
        while not job.schedule.is_over:
            _hand_out(job)
            _write_state(job)
            for outcome in workers.wait(_pause(job)):
                _take(job, outcome, watch)
            _end_who_hang(job)
    finally:
        workers.close()
        clear(plan.works)
        _write_state(job, is_last=True)
    _require_whole(job)
    return job.receipts


def _as_record(plan: Plan) -> dict[str, Any]:
    """Return a plan, JSON-able: its steps, and the folder and version of each stage's work."""
    works = {
        stage: [work.folder.relative_to(plan.folder).as_posix(), version_of(work)] for stage, work in plan.works.items()
    }
    return {"steps": [[*vars(step).values()] for step in plan.steps], "works": works}


def _hand_out(job: _Job) -> None:
    """Give steps to idle workers."""
    job.schedule.workers, idle = job.workers.count, job.workers.idle()  # in a cluster, the count changes
    while idle and (first := job.schedule.first()) is not None:
        worker = max(idle, key=partial(_is_ready_for, job, first))
        idle.remove(worker)
        step = job.schedule.take(first, job.following.get(worker, ()))
        job.stages.setdefault(worker, set()).add(step.stage)
        following = job.following[worker] = job.schedule.likely_after(step)
        inputs = [(_folder(job, name), job.receipts[name]) for name in step.inputs]
        awaited = tuple(entry for folder, receipt in inputs for entry in awaited_files(folder, receipt))
        keys, facts = (tuple(getattr(receipt, name) for _, receipt in inputs) for name in ("key", "facts"))
        task = Task(step, keys, awaited, following, facts)
        job.running[step.name] = _Running(worker, job.workers.now())
        job.workers.start(worker, task)


def _is_ready_for(job: _Job, step: Step, worker: str) -> tuple[bool, bool]:
    """Return whether a worker has loaded what steps of a stage need, and whether it has read ahead for this one."""
    return step.stage in job.stages.get(worker, ()), step in job.following.get(worker, ())


def _take(job: _Job, outcome: Outcome, watch: Watch) -> None:
    """Judge what became of a step."""
    name, step = outcome.name, job.schedule.steps[outcome.name]
    del job.running[name]
    if outcome.receipt is not None:
        stored = StoredFacts(_folder(job, name), name, outcome.receipt.key)
        job.receipts[name] = replace(outcome.receipt, facts=stored)
        if not outcome.receipt.is_kept:
            job.times.setdefault(step.stage, deque(maxlen=LATEST)).append(outcome.receipt.seconds)
        job.errors.pop(name, None)
        job.schedule.done(name)
        watch(step, outcome.receipt, "")
        return
    if isinstance(outcome.error, OutputError):
        raise outcome.error
    words = _note(job, outcome)
    if outcome.error is not None and _make_inputs_again(job, step):
        job.schedule.wait(name)
    elif outcome.error is not None or outcome.is_own_fault or name in job.hung:
        is_final = job.schedule.failed(name, is_final=isinstance(outcome.error, InvalidOptionError))
        if is_final and step.frame is None:
            raise outcome.error or UnfinishedError(_failure(step, words))
    elif job.schedule.lost(name) and step.frame is None:
        raise UnfinishedError(_failure(step, words))
    job.hung.discard(name)
    watch(step, None, words)


def _note(job: _Job, outcome: Outcome) -> str:
    """Keep an error, with its traceback in a file of its own; return it in a line."""
    error, name = outcome.error, outcome.name
    if error is not None:
        words = str(error) if isinstance(error, BeamError) else f"{type(error).__name__}: {error}"
        told = getattr(error, "__notes__", None) or traceback.format_exception(error)
        text = "\n".join([words, *told])
        (job.plan.folder / FOLDER / f"{name}.txt").write_text(text + "\n", encoding="utf-8")
        job.raised[name] = error
    elif name in job.hung:
        words = f"took more than {_limit(job, job.schedule.steps[name]):.0f} s and was ended"
    else:
        words = f"its worker {outcome.worker} ended ({outcome.lost})"
    job.errors.setdefault(name, []).append(words)
    return words


def _failure(step: Step, words: str) -> str:
    return f"{step.name} must be done before all else, got: {words}. Mend the cause and call again."


def _make_inputs_again(job: _Job, step: Step) -> bool:
    """Have damaged inputs of a step that failed made again; return whether there were any."""
    damaged = [name for name in step.inputs if not _is_sound(job, name)]
    for name in damaged:
        receipt_path(_folder(job, name), name).unlink(missing_ok=True)
        job.errors.setdefault(name, []).append("its output was damaged or gone, and is made again")
        job.schedule.again(name)
    return bool(damaged)


def _is_sound(job: _Job, name: str) -> bool:
    return is_whole(_folder(job, name), job.receipts[name], is_read=True)


def _folder(job: _Job, name: str) -> Path:
    return job.plan.works[job.schedule.steps[name].stage].folder


def _pause(job: _Job) -> float:
    """Return how long to wait for workers [s]."""
    return min(STATE_PERIOD, job.patience.least, job.patience.first) / 4.0 if job.running else 0.05


def _limit(job: _Job, step: Step) -> float:
    """Return how long a step may take [s]."""
    times = job.times.get(step.stage, ())
    if len(times) < LEAST_MEASURED:
        return job.patience.first
    return max(job.patience.least, job.patience.factor * statistics.median(times))


def _end_who_hang(job: _Job) -> None:
    now = job.workers.now()
    for name, running in job.running.items():
        if name not in job.hung and now - running.since > _limit(job, job.schedule.steps[name]):
            job.hung.add(name)
            job.workers.end(name)


def _write_state(job: _Job, *, is_last: bool = False) -> None:
    """Write what became of the steps so far, now and then."""
    if not is_last and time.monotonic() - job.written < STATE_PERIOD:
        return
    job.written = time.monotonic()
    ages = {name: job.workers.now() - running.since for name, running in job.running.items()}
    state = {
        "driver": worker_name(),
        "started": job.started,
        "written": time.time(),
        "is_over": is_last,
        "workers": job.workers.count,
        "running": {} if is_last else {name: [job.running[name].worker, age] for name, age in ages.items()},
        "errors": job.errors,
        "given_up": [name for name, state in job.schedule.states.items() if state is State.FAILED],
    }
    with suppress(OutputError):  # what is wrong with the disk, the next output says
        write_record(job.plan.folder / FOLDER / STATE_NAME, state)


def _require_whole(job: _Job) -> None:
    """Refuse to go on where steps are missing, and say which."""
    failed = [name for name, state in job.schedule.states.items() if state is State.FAILED]
    if not failed:
        return
    first = job.raised.get(failed[0])
    if len(failed) == 1 and isinstance(first, BeamError):
        raise first
    named = "; ".join(f"{name}: {job.errors[name][-1]}" for name in failed[:NAMED])
    more = f"; and {len(failed) - NAMED} more" if len(failed) > NAMED else ""
    raise UnfinishedError(
        f"steps must be done for a result, got {len(failed)} of {len(job.schedule.steps)} that failed twice ({named}"
        f"{more}). Mend the cause or leave these frames out, and call again: all others are kept. "
        f"See {job.plan.folder / FOLDER}."
    ) from first
