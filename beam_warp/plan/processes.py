"""Processes of this machine that do the steps of a plan, and what they say meanwhile.

A process that ends costs its task a try and is replaced. Where the system can fork, one process, the server, imports
what the work needs, and the others are forks of it, so that they, and those that replace them, start at once. The
server never starts CUDA, which does not survive a fork.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import queue
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import connection, forkserver
from typing import Any

from beam_warp.errors import BeamError, InvalidOptionError
from beam_warp.jobs.listeners import NotedProgress, no_progress
from beam_warp.plan.steps import Task, Work, worker_name
from beam_warp.plan.workers import Outcome, Terms, attempt, packed, unpacked

OUTSIDE_SIGNALS = (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM))
"""Signals that come from outside; the others a process owes to what it does."""

CAN_FORK = "forkserver" in multiprocessing.get_all_start_methods()
"""Whether there is a server that processes are forked from."""

UNKNOWN_END = 255
"""Exit code of a process that has outlived its server: nobody knows how it ended."""

IDLE = 0.25
"""Time without a task after which a process imports what it may need later [s]."""

SPEAKING = 0.2
"""Least time between two words of a process on how far its step is [s]."""

PAUSES = tuple(0.001 * 2**count for count in range(12))
"""Times to wait before a process is started anew, since the server was killed meanwhile [s].

A server that is being killed refuses at once, but counts as running until the system has taken it down.
"""


@dataclass(frozen=True)
class StepProgress:
    """How far a process is within a step: what `NotedProgress` takes."""

    stage: str
    done: int
    total: int
    note: str


@dataclass(frozen=True)
class Compilation:
    """What a process has compiled, and whether it still does: what `CompilationListener` takes."""

    module_count: int = 0
    seconds: float = 0.0
    is_running: bool = False


def serve(modules: Sequence[str]) -> None:
    """Start the server that processes are forked from, unless it runs; it imports modules while the caller goes on."""
    if CAN_FORK and modules:
        forkserver.set_forkserver_preload(list(modules))
        forkserver.ensure_running()


class Processes:
    """Processes of this machine, one for each entry of ``settings``; one that ends is replaced."""

    def __init__(
        self,
        works: Mapping[str, Work],
        terms: Terms,
        settings: Sequence[Mapping[str, str]],
        progress: NotedProgress = no_progress,
    ) -> None:
        """Start the processes.

        Args:
            works: What does the steps of each stage; picklable.
            terms: What each must have.
            settings: Environment variables of each.
            progress: Told how far steps are: of each stage, the process that spoke of it first.

        Raises:
            InvalidOptionError: The work cannot be sent to another process.
        """
        self.count = len(settings)
        self._terms, self._progress = terms, progress
        self._speakers: dict[str, _Member] = {}
        self._context = multiprocessing.get_context("forkserver" if CAN_FORK else "spawn")
        self._packed = packed(works, terms)
        self._can_hide_main = b"__main__" not in self._packed  # a pickle names the module of all that it holds
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
            with _main_hidden() if self._can_hide_main else nullcontext():
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
        if isinstance(said, StepProgress):
            if self._speakers.setdefault(said.stage, member) is member:
                self._progress(**vars(said))
        elif isinstance(said, Compilation):
            member.compilation = said
            self._tell_of_compilation()
        elif said is not None:
            self._done(member)
            return [said]
        else:
            member.is_ready = True
        return []

    def _done(self, member: _Member) -> None:
        """Let others speak of the stages of a process that has done its task, or has ended."""
        member.task = None
        self._speakers = {stage: speaker for stage, speaker in self._speakers.items() if speaker is not member}

    def _tell_of_compilation(self) -> None:
        from beam_warp.device.compilation import tell_of_compilation

        found = [member.compilation for member in self._members]
        count, seconds = sum(it.module_count for it in found), sum(it.seconds for it in found)
        tell_of_compilation(count, seconds, is_running=any(it.is_running for it in found))

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
        if member.compilation.is_running:
            self._tell_of_compilation()
        task = member.task
        self._done(member)
        return [] if task is None else [Outcome(task.step.name, member.name, lost=_ended(code), is_own_fault=own)]


@dataclass(eq=False)
class _Member:
    """A process, the link to it, and what it was given."""

    process: Any
    link: Any
    setting: Mapping[str, str]
    task: Task | None = None
    is_ready: bool = False
    compilation: Compilation = Compilation()

    @property
    def name(self) -> str:
        return f"{worker_name().split(':')[0]}:{self.process.pid}"


@contextmanager
def _main_hidden() -> Iterator[None]:
    """Let processes start without running the caller's script once more: nothing that they do is defined in it.

    A script that calls for work where it is imported would call for it again in every process.
    """
    main = sys.modules["__main__"]
    held = {name: vars(main)[name] for name in ("__file__", "__spec__") if name in vars(main)}
    vars(main).update(dict.fromkeys(held))
    try:
        yield
    finally:
        vars(main).update(held)


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
    voice = _Voice(link)
    gc.freeze()  # what the server has imported is never garbage, and need not be looked at again and again
    gc.set_threshold(5_000)  # as in a command's own process
    later = [name for work in works.values() for name in work.later]
    with voice.compilation_told() if pickle.loads(content)[0].device else nullcontext():
        while True:
            try:
                task = tasks.get(timeout=IDLE if later else None)
            except queue.Empty:
                with suppress(ImportError):  # the step that needs it says so
                    import_module(later.pop())
            else:
                voice.say(attempt(works, task, voice.progress))


class _Voice:
    """What a process says to the driver, from whichever thread."""

    def __init__(self, link: Any) -> None:
        self._link, self._lock, self._latest = link, threading.Lock(), 0.0

    def say(self, word: Outcome | StepProgress | Compilation) -> None:
        """Say something; a driver that has ended hears nothing, and `_listen` notices."""
        with self._lock, suppress(OSError):
            self._link.send(word)

    def progress(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Say how far a step is, now and then and at its end; a `NotedProgress`."""
        if done >= total or time.monotonic() - self._latest >= SPEAKING:
            self._latest = time.monotonic()
            self.say(StepProgress(stage, done, total, note))

    def compilation_told(self) -> AbstractContextManager[None]:
        """Say what is compiled within."""
        from beam_warp.device.compilation import compilation_heard

        def told(module_count: int, seconds: float, *, is_running: bool) -> None:
            self.say(Compilation(module_count, seconds, is_running))

        return compilation_heard(told)


def _listen(link: Any, tasks: queue.SimpleQueue[Any]) -> None:
    """Take tasks; without a driver, end at once, whatever is being done: another one may do it anew."""
    try:
        while True:
            tasks.put(link.recv())
    except (EOFError, OSError):
        os._exit(1)
