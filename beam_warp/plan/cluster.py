"""Workers on the machines of a Ray cluster: an actor or more for each GPU, or one for each core of machines without.

Ray starts processes, notices when they or their machines end, and carries words; files go by the shared folder, and
that each step is done once is due to receipts and renames. Actors are replaced, not restarted: a new one may land on
another machine, and machines that join the cluster get theirs.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from beam_warp.errors import BeamError, InvalidOptionError, MissingPackageError
from beam_warp.plan.steps import Plan, Task, Work, worker_name
from beam_warp.plan.workers import Crew, Outcome, Terms, attempt, packed, unpacked

LOOK_PERIOD = 5.0
"""How often machines are counted [s]."""

CONNECT_PATIENCE = 10.0
"""Time within which a cluster must answer [s]."""

MOST_DEATHS = 8
"""Actors in a row that may end before they are ready: machines fail, but not all of them."""


def cluster_at(words: str, each: int = 1) -> Crew:
    """Return the workers of a cluster, ``ray`` for that of this machine or ``ray://HOST:PORT``, ``each`` on a GPU.

    Raises:
        InvalidOptionError: There is no address.
        MissingPackageError: Ray is not installed.
    """
    if words not in ("ray",) and (not words.startswith("ray://") or len(words) == len("ray://")):
        raise InvalidOptionError(f"workers must name a cluster as ray://HOST:PORT, got {words}. Add its address.")
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingPackageError(
            "workers of a cluster must be reached by Ray, got no such package. Install it: pip install "
            "beam-warp[cluster]."
        ) from error
    address = "auto" if words == "ray" else words
    return lambda plan, kind, progress: Cluster(ray, address, plan, kind, each)


def _require_open(address: str) -> None:
    """Try a cluster's port, for Ray tries for minutes.

    Raises:
        OSError: Nobody answers.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_PATIENCE).close()


class Cluster:
    """Actors of a Ray cluster."""

    def __init__(self, ray: Any, address: str, plan: Plan, kind: str, each: int = 1) -> None:
        """Connect, and ask for actors for each GPU, or one for each core.

        Args:
            ray: The package.
            address: Of the cluster.
            plan: What is to be done.
            kind: Kind of device that it is for.
            each: Actors that share a GPU.

        Raises:
            InvalidOptionError: There is no cluster, or the work cannot be sent to another process.
        """
        self.count = 0
        self._ray, self._kind, self._each = ray, kind, each if kind == "cuda" else 1
        try:
            _require_open(os.environ.get("RAY_ADDRESS", "") if address == "auto" else address)
            ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
        except Exception as error:
            reason = " ".join(str(error).split())[:200]
            raise InvalidOptionError(
                f"workers must name a Ray cluster that runs, got none at {address} ({reason}). Start it by ray start."
            ) from error
        self._terms = Terms.of(plan.folder, kind)
        self._packed = packed(plan.works, self._terms)
        needs = {"num_gpus": 1.0 / each} if kind == "cuda" else {"num_cpus": 1}
        self._actor = ray.remote(**needs, max_restarts=0, max_task_retries=0)(_Actor)
        self._members: list[_Member] = []
        self._looked = -LOOK_PERIOD
        self._deaths = 0
        self._most = len(plan.steps)
        self._grow()

    def idle(self) -> list[str]:
        """Return the names of the actors that have nothing to do and have said that they are ready."""
        return [member.name for member in self._members if member.is_ready and member.task is None]

    def start(self, name: str, task: Task) -> None:
        """Give a task to an idle actor."""
        member = next(member for member in self._members if member.is_ready and member.name == name)
        member.task, member.reply = task, member.actor.attempt.remote(task)

    def wait(self, seconds: float) -> list[Outcome]:
        """Return what was said, or lost, within a time."""
        self._grow()
        replies = {member.reply: member for member in self._members if member.reply is not None}
        if not replies:
            time.sleep(seconds)
            return []
        ready, _ = self._ray.wait(list(replies), num_returns=1, timeout=seconds)
        return [outcome for reply in ready for outcome in self._hear(replies[reply])]

    def end(self, name: str) -> None:
        """Kill the actor that does a step."""
        for member in self._members:
            if member.task is not None and member.task.step.name == name:
                self._ray.kill(member.actor)

    def now(self) -> float:
        """Return the time [s]."""
        return time.monotonic()

    def close(self) -> None:
        """Kill all actors, and leave the cluster."""
        for member in self._members:
            with suppress(Exception):
                self._ray.kill(member.actor)
        self._ray.shutdown()
        self._terms.withdraw()

    def _grow(self) -> None:
        """Ask for actors on machines that have joined."""
        if time.monotonic() - self._looked < LOOK_PERIOD:
            return
        self._looked = time.monotonic()
        there = int(self._ray.cluster_resources().get("GPU" if self._kind == "cuda" else "CPU", 0))
        self.count = min(self._each * there, self._most)
        if self.count == 0 and not self._members:
            what = "GPUs" if self._kind == "cuda" else "cores"
            raise InvalidOptionError(f"workers must be machines with {what}, got a cluster without. Add one to it.")
        self._members += [self._member() for _ in range(self.count - len(self._members))]

    def _member(self) -> _Member:
        actor = self._actor.remote(self._packed, self._kind)
        return _Member(actor, actor.prepare.remote())

    def _hear(self, member: _Member) -> list[Outcome]:
        """Take what an actor says; replace it if it is lost."""
        try:
            said = self._ray.get(member.reply)
        except self._ray.exceptions.RayError as error:
            self._deaths += not member.is_ready
            if self._deaths > MOST_DEATHS:
                reason = " ".join(str(error).split())[:200]
                raise InvalidOptionError(
                    f"workers must start, got {self._deaths} that ended before ({type(error).__name__}: {reason}). See "
                    "Ray's logs."
                ) from error
            self._members[self._members.index(member)] = self._member()
            if member.task is None:
                return []
            return [Outcome(member.task.step.name, member.name, lost=type(error).__name__)]
        member.reply = None
        if isinstance(said, BeamError):
            raise said
        if isinstance(said, Outcome):
            member.task = None
            return [said]
        member.name, member.is_ready, self._deaths = said, True, 0
        return []


class _Member:
    """An actor, what it was given, and what it is to say."""

    def __init__(self, actor: Any, reply: Any) -> None:
        self.actor, self.reply = actor, reply
        self.name, self.is_ready = "", False
        self.task: Task | None = None


class _Actor:
    """What runs in the cluster."""

    def __init__(self, content: bytes, kind: str) -> None:
        if kind == "cpu":
            os.environ["BEAM_WARP_THREADS"] = "1"  # it has been given one core
        self._content = content
        self._works: Mapping[str, Work] = {}

    def prepare(self) -> str | BeamError:
        try:
            self._works = unpacked(self._content)
        except BeamError as error:
            return error
        return worker_name()

    def attempt(self, task: Task) -> Outcome:
        return attempt(self._works, task)
