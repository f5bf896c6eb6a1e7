"""Who does the steps of a plan: this process, processes of this machine (`beam_warp.plan.processes`), or those of a
cluster (`beam_warp.plan.cluster`).

All are driven in the same way: `Workers.start` gives one of them a task, `Workers.wait` returns what became of those
that were given.
"""

from __future__ import annotations

import os
import pickle
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from beam_warp.digests import code_digest
from beam_warp.errors import InvalidOptionError, OutputError
from beam_warp.jobs.listeners import NotedProgress, no_progress
from beam_warp.outputs import remove_leftovers, temporary_path
from beam_warp.plan.steps import Plan, Receipt, Task, Work, perform, worker_name


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Attributes:
        name: Name of its step.
        worker: Who had it.
        receipt: Its receipt, if it is done.
        error: What it raised, if it failed.
        lost: How its worker ended, if it did.
        is_own_fault: Whether the worker ended by what it did, rather than from outside.
    """

    name: str
    worker: str
    receipt: Receipt | None = None
    error: Exception | None = None
    lost: str = ""
    is_own_fault: bool = False


class Workers(Protocol):
    """Workers that do steps.

    Attributes:
        count: How many there are, or are to be.
    """

    count: int

    def idle(self) -> list[str]:
        """Return the names of those who could be given a task."""
        ...

    def start(self, name: str, task: Task) -> None:
        """Give a task to an idle worker."""
        ...

    def wait(self, seconds: float) -> list[Outcome]:
        """Return what became of some tasks, after at most a time [s].

        Raises:
            BeamError: No worker can do such work: the message says why.
        """
        ...

    def end(self, name: str) -> None:
        """End the worker that does a step; `wait` then says that it is lost."""
        ...

    def now(self) -> float:
        """Return the time on the workers' clock [s]."""
        ...

    def close(self) -> None:
        """End all workers."""
        ...


class InProcess:
    """This process does every step, one after the other. It cannot survive a step that ends it, nor end one."""

    count = 1

    def __init__(self, works: Mapping[str, Work], progress: NotedProgress) -> None:
        """Take what is done, and who is told how far it is."""
        self._works, self._progress = works, progress
        self._task: Task | None = None

    def idle(self) -> list[str]:
        """Return this process, unless a task is to be done."""
        return [worker_name()] if self._task is None else []

    def start(self, name: str, task: Task) -> None:
        """Take a task, which `wait` does."""
        self._task = task

    def wait(self, seconds: float) -> list[Outcome]:
        """Do the task."""
        task, self._task = self._task, None
        if task is None:
            return []
        try:
            return [Outcome(task.step.name, worker_name(), perform(self._works, task, self._progress))]
        except Exception as error:
            return [Outcome(task.step.name, worker_name(), error=error)]

    def end(self, name: str) -> None:
        """Do nothing: whoever asks is the one."""

    def now(self) -> float:
        """Return the time [s]."""
        return time.monotonic()

    def close(self) -> None:
        """Do nothing."""


Crew = Callable[[Plan, str, NotedProgress], Workers]
"""Called with a plan, the kind of device that it is for, and who hears how far a step is; returns the workers."""


def in_process(plan: Plan, device: str, progress: NotedProgress) -> Workers:
    """Return this process as the only worker."""
    return InProcess(plan.works, progress)


@dataclass(frozen=True)
class Terms:
    """What a worker must have, to give the bytes that this process would.

    Attributes:
        folder: Folder that it must see.
        token: Name of a file in it, whose existence proves that.
        device: Kind of device, "cuda" or "cpu"; empty for work without one.
        code: Digest of the code.
    """

    folder: str
    token: str
    device: str
    code: str

    @classmethod
    def of(cls, folder: Path, device: str) -> Terms:
        """Return what workers must have for work in a folder; the folder's token is made."""
        token = temporary_path(folder / "shared")
        token.touch()
        return cls(str(folder), token.name, device, code_digest())

    def withdraw(self) -> None:
        """Remove the token."""
        (Path(self.folder) / self.token).unlink(missing_ok=True)

    def require(self) -> None:
        """Refuse a worker that lacks something; it calls this itself.

        Raises:
            InvalidOptionError: The message says what.
        """
        said = f"on {worker_name().split(':')[0]}"
        if (here := code_digest()) != self.code:
            raise InvalidOptionError(
                f"workers must run this version of beam-warp, got other code {said} ({here[:8]}, not {self.code[:8]}). "
                "Install the same there."
            )
        if self.device == "cuda":
            import warp as wp

            if not wp.is_cuda_available():
                raise InvalidOptionError(f"workers must have a GPU, got none {said}. Add one, or use --device cpu.")
        try:
            wait_for_token(Path(self.folder) / self.token)
        except OSError:
            raise OutputError(
                f"out must be a folder that all workers share, got {self.folder}, which is another or none {said}. "
                "Choose one on a shared disk."
            ) from None


def wait_for_token(path: Path, patience: float = 5.0) -> None:
    """Wait until an empty file is visible.

    Raises:
        OSError: It is not, after a time [s].
    """
    end = time.monotonic() + patience
    while True:
        try:
            os.scandir(path.parent).close()
            path.stat()
            return
        except OSError:
            if time.monotonic() >= end:
                raise
            time.sleep(0.1)


def packed(works: Mapping[str, Work], terms: Terms) -> bytes:
    """Return what a worker is sent first.

    Raises:
        InvalidOptionError: The work cannot be sent to another process.
    """
    try:
        return pickle.dumps((terms, pickle.dumps(dict(works))))
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise InvalidOptionError(
            f"work must be picklable to be sent to other processes, got {error}. Pass paths, or use one process."
        ) from error


def unpacked(content: bytes) -> dict[str, Work]:
    """Return what a worker does, once it is known to have all that is needed; what others here left is removed.

    Raises:
        BeamError: It lacks something.
    """
    terms, work = pickle.loads(content)
    terms.require()
    try:
        works = pickle.loads(work)
    except Exception as error:
        raise InvalidOptionError(
            f"workers must be able to do such work, got {type(error).__name__} ({error}) on {worker_name()}. "
            "Install the same packages there."
        ) from error
    clear(works)
    return works


def clear(works: Mapping[str, Work]) -> None:
    """Remove what processes of this machine that have ended left half written."""
    for folder in {work.folder for work in works.values()}:
        remove_leftovers(folder, *filter(Path.is_dir, folder.iterdir()))


def attempt(works: Mapping[str, Work], task: Task, progress: NotedProgress = no_progress) -> Outcome:
    """Do a task, and return what became of it in a form that can be sent."""
    try:
        return Outcome(task.step.name, worker_name(), perform(works, task, progress))
    except Exception as error:
        return Outcome(task.step.name, worker_name(), error=sendable(error))


def sendable(error: Exception) -> Exception:
    """Return an error that can be pickled, with its traceback as a note."""
    text = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    error.__traceback__ = error.__cause__ = error.__context__ = None
    error.add_note(text)
    return error
