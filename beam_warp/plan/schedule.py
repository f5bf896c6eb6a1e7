"""Which step is next: steps whose inputs are done, those that finish frames before those that start them.

Frames of a segment follow each other. So with more workers than segments in work, the next frame of a segment comes
first, and the other workers finish what it leaves.

A step that fails is tried once more, and is then given up: what needs it is left undone, and the rest goes on. A step
whose worker ended is no failure at first, for machines and processes are killed for reasons of their own. A step whose
output was found damaged is done again, and what needs it waits.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable
from enum import Enum

from beam_warp.errors import InvalidOptionError
from beam_warp.plan.steps import Rank, Step

FAILURES = 2
"""A step that failed so often is given up."""

LOSSES = 10
"""A step that lost its worker so often is given up: it is likely the reason."""

REPEATS = 3
"""A step is done again so often because its output is damaged; then it is given up, for the disk is unreliable."""

LIKELY = 4
"""Steps that a worker is told may follow: frames are few, and what waits for a rig is all of them."""


class State(Enum):
    """What became of a step so far; its value is its word for people."""

    WAITING = "waiting"
    READY = "ready"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    LEFT = "left out"


IN_WORK = (State.READY, State.RUNNING)

CHAINED: dict[int, tuple[State, ...]] = {Rank.KEY_FRAME: (State.RUNNING,), Rank.TRACKED_FRAME: IN_WORK}
"""States in which a frame stands for its segment, which is in work."""


class Schedule:
    """The state of every step of a plan.

    Attributes:
        steps: By name.
        states: By name.
        counts: How many steps are in each state.
        workers: How many work at a time.
    """

    def __init__(self, steps: Iterable[Step], workers: int = 1) -> None:
        """Start with nothing done, for so many workers.

        Raises:
            InvalidOptionError: A step's name is not its own, or an input is none of the steps.
        """
        given, self.workers = tuple(steps), workers
        self.steps = {step.name: step for step in given}
        absent = [name for step in given for name in step.inputs if name not in self.steps]
        if absent or len(self.steps) < len(given):
            raise InvalidOptionError(
                "steps must have names of their own and inputs among them, got "
                f"{absent[0] if absent else 'a name twice'}. Mend the plan."
            )
        self.states = dict.fromkeys(self.steps, State.WAITING)
        self.counts = {state: len(given) if state is State.WAITING else 0 for state in State}
        self._order = {step.name: (-1 if step.frame is None else step.frame, place) for place, step in enumerate(given)}
        self._dependents: dict[str, list[str]] = {name: [] for name in self.steps}
        self._open = {step.name: len(set(step.inputs)) for step in given}
        self._tries: dict[tuple[str, str], int] = {}
        self._ready: dict[int, list[tuple[tuple[int, int], str]]] = {}
        self._segments = 0
        for step in given:
            for name in set(step.inputs):
                self._dependents[name].append(step.name)
        for name, count in self._open.items():
            if count == 0:
                self._enqueue(name)

    @property
    def is_over(self) -> bool:
        """Whether nothing can be done any more."""
        return not any(self.counts[state] for state in IN_WORK)

    def next(self) -> Step | None:
        """Take the step to be done next; None where all that is left waits for others."""
        first = self.first()
        return None if first is None else self.take(first)

    def take(self, first: Step, preferred: Iterable[Step] = ()) -> Step:
        """Take the most urgent step, or another one that is as urgent.

        Args:
            first: What `first` returns.
            preferred: Steps that the worker has read ahead for.
        """
        ahead = (step for step in preferred if self.states[step.name] is State.READY and step.rank == first.rank)
        step = next(ahead, first)
        self._set(step.name, State.RUNNING)
        return step

    def likely_after(self, step: Step) -> tuple[Step, ...]:
        """Return the steps that are likely to follow a running one: what waits for it alone, and one of the others."""
        freed = [self.steps[name] for name in self._dependents[step.name] if self._open[name] == 1]
        other = self.first()
        found = freed if other is None else [*freed, other]
        return tuple(sorted(found, key=lambda it: (-self._urgency(it), self._order[it.name]))[:LIKELY])

    def first(self) -> Step | None:
        """Return the most urgent step that is ready; None where there is none."""
        firsts = []
        for heap in self._ready.values():
            while heap and self.states[heap[0][1]] is not State.READY:
                heapq.heappop(heap)
            firsts += [self.steps[name] for _, name in heap[:1]]
        return max(firsts, key=lambda step: self._urgency(step), default=None)

    def _urgency(self, step: Step) -> float:
        """Return what steps are taken by, the highest first: their rank, but for chains that may not wait."""
        return math.inf if step.rank == Rank.TRACKED_FRAME and self._segments < self.workers else step.rank

    def done(self, name: str) -> None:
        """Note that a step is done."""
        if self.states[name] is State.DONE:
            return
        self._set(name, State.DONE)
        for dependent in self._dependents[name]:
            self._open[dependent] -= 1
            if self._open[dependent] == 0 and self.states[dependent] is State.WAITING:
                self._enqueue(dependent)

    def failed(self, name: str, *, is_final: bool = False) -> bool:
        """Note that a step failed; return whether it is given up."""
        return self._try_again(name, "failures", 1 if is_final else FAILURES)

    def lost(self, name: str) -> bool:
        """Note that a step's worker ended; return whether it is given up."""
        return self._try_again(name, "losses", LOSSES)

    def again(self, name: str) -> bool:
        """Note that a step's output is damaged, so that it is to be done again; return whether it is given up."""
        if self.states[name] is State.DONE:
            for dependent in self._dependents[name]:
                self._open[dependent] += 1
                if self.states[dependent] is State.READY:
                    self._set(dependent, State.WAITING)
            return self._try_again(name, "repeats", REPEATS + 1)
        return False

    def wait(self, name: str) -> None:
        """Put a step that ran back, to be done when its inputs are."""
        self._set(name, State.WAITING)
        if self._open[name] == 0:
            self._enqueue(name)

    def _try_again(self, name: str, what: str, limit: int) -> bool:
        self._tries[name, what] = self._tries.get((name, what), 0) + 1
        if self._tries[name, what] < limit:
            self.wait(name)
            return False
        self._set(name, State.FAILED)
        self._leave_out(name)
        return True

    def _leave_out(self, name: str) -> None:
        """Give up what needs a step."""
        open_names = [name]
        while open_names:
            for dependent in self._dependents[open_names.pop()]:
                if self.states[dependent] in (State.WAITING, State.READY):
                    self._set(dependent, State.LEFT)
                    open_names.append(dependent)

    def _enqueue(self, name: str) -> None:
        self._set(name, State.READY)
        heapq.heappush(self._ready.setdefault(self.steps[name].rank, []), (self._order[name], name))

    def _set(self, name: str, state: State) -> None:
        before = self.states[name]
        self.counts[before] -= 1
        self.counts[state] += 1
        counted = CHAINED.get(self.steps[name].rank, ())
        self._segments += (state in counted) - (before in counted)
        self.states[name] = state
