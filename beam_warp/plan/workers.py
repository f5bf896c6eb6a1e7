"""Who does the steps of a plan: this process, or processes of this machine; for others see `beam_warp.plan.cluster`.

All are driven in the same way: `Workers.start` gives one of them a task, `Workers.wait` returns what became of those
that were given. A process that ends costs its task a try and is replaced. Where the system can fork, one process, the
server, imports what the work needs, and the others are forks of it, so that they, and those that replace them, start at
once. The server never starts CUDA, which does not survive a fork.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import queue
import signal
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import connection, forkserver
from pathlib import Path
from typing import Any, Protocol

from beam_warp.digests import code_digest
from beam_warp.errors import BeamError, InvalidOptionError, OutputError
from beam_warp.jobs.listeners import NotedProgress, no_progress
from beam_warp.outputs import remove_leftovers, temporary_path
from beam_warp.plan.steps import Plan, Receipt, Task, Work, perform, worker_name

OUTSIDE_SIGNALS = (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM))
"""Signals that come from outside; the others a process owes to what it does."""

CAN_FORK = "forkserver" in multiprocessing.get_all_start_methods()
"""Whether there is a server that processes are forked from."""

UNKNOWN_END = 255
"""Exit code of a process that has outlived its server: nobody knows how it ended."""

IDLE = 0.25
"""Time without a task after which a process imports what it may need later [s]."""

PAUSES = tuple(0.001 * 2**count for count in range(12))
"""Times to wait before a process is started anew, since the server was killed meanwhile [s].

A server that is being killed refuses at once, but counts as running until the system has taken it down.
"""


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


def serve(modules: Sequence[str]) -> None:
    """Start the server that processes are forked from, unless it runs; it imports modules while the caller goes on."""
    if CAN_FORK and modules:
        forkserver.set_forkserver_preload(list(modules))
        forkserver.ensure_running()


class Processes:
    """Processes of this machine, one for each entry of ``settings``; one that ends is replaced."""

    def __init__(self, works: Mapping[str, Work], terms: Terms, settings: Sequence[Mapping[str, str]]) -> None:
        """Start the processes.

        Args:
            works: What does the steps of each stage; picklable.
            terms: What each must have.
            settings: Environment variables of each.

        Raises:
            InvalidOptionError: The work cannot be sent to another process.
        """
        self.count = len(settings)
        self._terms = terms
        self._context = multiprocessing.get_context("forkserver" if CAN_FORK else "spawn")
        self._packed = packed(works, terms)
        serve(_modules_of(works))
        self._members = [self._member(setting) for setting in settings]

    def idle(self) -> list[str]:
        """Return the names of those that have nothing to do and have said that they are ready."""
        return [member.name for member in self._members if member.is_ready and member.task is None]

    def start(self, name: str, task: Task) -> None:
        """Give a task to an idle process."""
        member = next(member for member in self._members if member.name == name)
        member.task = task
        with suppress(OSError):  # it has ended; `wait` finds out
            member.link.send(task)

    def wait(self, seconds: float) -> list[Outcome]:
        """Return what was said, or ended, within a time."""
        found: list[Outcome] = []
        links = {member.link: member for member in self._members}
        for link in connection.wait(list(links), seconds):
            found += self._hear(links[link])
        return found

    def end(self, name: str) -> None:
        """Kill the process that does a step."""
        for member in self._members:
            if member.task is not None and member.task.step.name == name:
                with suppress(ProcessLookupError):  # `Process.kill` takes who has outlived the server for ended
                    os.kill(member.process.pid, OUTSIDE_SIGNALS[1])

    def now(self) -> float:
        """Return the time [s]."""
        return time.monotonic()

    def close(self) -> None:
        """Kill all processes."""
        for member in self._members:
            member.process.kill()
        for member in self._members:
            member.process.join()
            member.link.close()
        self._terms.withdraw()

    def processes(self) -> list[int]:
        """Return the numbers of the processes that live, for tests that kill some."""
        return [member.process.pid or 0 for member in self._members if member.process.is_alive()]

    def _member(self, setting: Mapping[str, str], pauses: Sequence[float] = PAUSES) -> _Member:
        here, there = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(there, {**os.environ, **setting}), daemon=True)
        try:
            process.start()
        except (EOFError, OSError):  # the server was killed
            if not pauses:
                raise
            time.sleep(pauses[0])
            return self._member(setting, pauses[1:])
        there.close()
        with suppress(OSError):
            here.send_bytes(self._packed)
        return _Member(process, here, setting)

    def _hear(self, member: _Member) -> list[Outcome]:
        """Take what a process says; replace it if it has ended."""
        try:
            said = member.link.recv()
        except (EOFError, OSError, pickle.UnpicklingError):
            return self._replace(member)
        if isinstance(said, BeamError):  # it cannot do such work, and neither can another one in its place
            raise said
        if said is not None:
            member.task = None
            return [said]
        member.is_ready = True
        return []

    def _replace(self, member: _Member) -> list[Outcome]:
        member.process.kill()
        member.process.join()
        member.link.close()
        self._members[self._members.index(member)] = self._member(member.setting)
        code = member.process.exitcode or 0
        own = code != UNKNOWN_END and -code not in OUTSIDE_SIGNALS
        if own and not member.is_ready:
            raise InvalidOptionError(
                f"workers must start, got one that ended at once ({_ended(code)}). Try --workers 1 to see why."
            )
        if member.task is None:
            return []
        return [Outcome(member.task.step.name, member.name, lost=_ended(code), is_own_fault=own)]


@dataclass(eq=False)
class _Member:
    """A process, the link to it, and what it was given."""

    process: Any
    link: Any
    setting: Mapping[str, str]
    task: Task | None = None
    is_ready: bool = False

    @property
    def name(self) -> str:
        return f"{worker_name().split(':')[0]}:{self.process.pid}"


def _modules_of(works: Mapping[str, Work]) -> list[str]:
    """Return the names of the modules that works, and what they hold, are defined in."""
    held = [it for work in works.values() for it in (work, *vars(work).values())]
    return sorted({type(it).__module__ for it in held} - {"__main__"})


def _ended(code: int) -> str:
    """Return in words how a process ended, given its exit code."""
    if code < 0:
        with suppress(ValueError):
            return f"killed by {signal.Signals(-code).name}"
    return f"exit code {code}"


def _serve(link: Any, setting: Mapping[str, str]) -> None:
    """Do what the driver asks until it ends, in its environment; the first message is the work."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver hears it, and ends this process
    os.environ.clear()
    os.environ.update(setting)
    tasks: queue.SimpleQueue[Any] = queue.SimpleQueue()
    content = link.recv_bytes()
    threading.Thread(target=_listen, args=(link, tasks), daemon=True).start()
    try:
        works = unpacked(content)
    except BeamError as error:
        link.send(error)
        return
    link.send(None)
    gc.freeze()  # what the server has imported is never garbage, and need not be looked at again and again
    gc.set_threshold(5_000)  # as in a command's own process
    later = [name for work in works.values() for name in work.later]
    while True:
        try:
            task = tasks.get(timeout=IDLE if later else None)
        except queue.Empty:
            with suppress(ImportError):  # the step that needs it says so
                import_module(later.pop())
        else:
            link.send(attempt(works, task))


def _listen(link: Any, tasks: queue.SimpleQueue[Any]) -> None:
    """Take tasks; without a driver, end at once, whatever is being done: another one may do it anew."""
    try:
        while True:
            tasks.put(link.recv())
    except (EOFError, OSError):
        os._exit(1)


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


def attempt(works: Mapping[str, Work], task: Task) -> Outcome:
    """Do a task, and return what became of it in a form that can be sent."""
    try:
        return Outcome(task.step.name, worker_name(), perform(works, task, no_progress))
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
