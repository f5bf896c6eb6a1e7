"""Plan of long work as data: steps from files to files, and the receipts that say of which input an output is.

A step is pure: the same input gives the same bytes. It writes its outputs under temporary names and renames them; its
receipt is written last. The receipt holds the key of all that the step depends on, and size, time and digest of every
output. So a step is done if its receipt has the right key and its outputs are whole. Whatever was killed in between is
done again, to the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any, Protocol

from beam_warp.digests import content_digest
from beam_warp.errors import MissingFileError
from beam_warp.jobs.listeners import NotedProgress
from beam_warp.outputs import replacing

RECEIPTS = "steps"
"""Folder of the receipts, in that of the work."""

PATIENCE = 30.0
"""Time after which a file that another machine wrote must be visible here [s]; NFS caches names for 30 s at most."""


class Rank(IntEnum):
    """Which of several steps is done first: the highest, so that frames are finished before others are begun."""

    KEY_FRAME = 0
    TRACKED_FRAME = 1
    MATERIALS = 2
    PREVIEW = 3
    SHARED = 4


@dataclass(frozen=True)
class Step:
    """A piece of work that is done as a whole, by one worker.

    Attributes:
        name: Unique in its plan, and a name that a file can have.
        stage: Kind of step; steps of a stage take about as long.
        frame: Number of the frame that it is about; None for what is done once for all, without which nothing goes on.
        inputs: Names of the steps whose outputs it reads.
        rank: Steps of a higher rank are done first; see `Rank`.
    """

    name: str
    stage: str
    frame: int | None = None
    inputs: tuple[str, ...] = ()
    rank: int = Rank.KEY_FRAME


class Work(Protocol):
    """What the steps of some stages do. An object is pickled and sent to every worker once; each keeps its own caches.

    Attributes:
        folder: Folder that outputs and receipts are in; shared by all workers.
    """

    folder: Path

    @property
    def later(self) -> tuple[str, ...]:
        """Modules that some steps need, and that take long to import: whoever has time does that ahead, in a thread.

        None may bring OpenUSD along, see `beam_warp.converters.clips`.
        """
        ...

    def common(self) -> str:
        """Return all that every step depends on: the code, the kind of device, the options."""
        ...

    def digest(self, step: Step) -> str:
        """Return the digest of what a step reads beside the outputs of other steps."""
        ...

    def outputs(self, step: Step) -> tuple[Path, ...]:
        """Return the files that a step writes."""
        ...

    def do(self, task: Task, progress: NotedProgress) -> Mapping[str, Any]:
        """Write the outputs of a step, each under a temporary name first; return JSON-able facts for its receipt."""
        ...


@dataclass(frozen=True)
class Plan:
    """A graph of steps.

    Attributes:
        folder: Folder of the job; its state is written to ``folder/plan``.
        steps: All steps; inputs may stand in any order.
        works: What does the steps of each stage.
    """

    folder: Path
    steps: tuple[Step, ...]
    works: Mapping[str, Work]

    def with_steps_of(self, other: Plan) -> Plan:
        """Return a plan of the steps of both, in the folder of this one."""
        return Plan(self.folder, (*self.steps, *other.steps), {**self.works, **other.works})


@dataclass(frozen=True)
class Receipt:
    """Proof of a step that was done.

    Attributes:
        key: Key of all that it depends on.
        version: Digest of what all steps of its work depend on; see `version_of`.
        outputs: Size [byte], time of change [ns] and digest of each output, by its name in the folder of the work.
        seconds: How long it took.
        worker: Machine and process that did it.
        ended: When it was done [s since 1970].
        facts: What the work said of it, JSON-able.
        is_kept: Whether it was found done; not stored.
    """

    key: str
    version: str
    outputs: Mapping[str, tuple[int, int, str]]
    seconds: float
    worker: str
    ended: float
    facts: Mapping[str, Any] = field(default_factory=dict)
    is_kept: bool = False


@dataclass(frozen=True)
class Task:
    """A step as a worker gets it.

    Attributes:
        step: What to do.
        keys: Keys of its inputs, in their order.
        awaited: Path and size [byte] of every file of its inputs, which may become visible late.
        following: Steps that are likely to come next, whose input may be read ahead; none where nobody knows.
        facts: What the receipts of its inputs say, in their order.
    """

    step: Step
    keys: tuple[str, ...] = ()
    awaited: tuple[tuple[str, int], ...] = ()
    following: tuple[Step, ...] = ()
    facts: tuple[Mapping[str, Any], ...] = ()


class StoredFacts(Mapping[str, Any]):
    """Facts of a receipt, read from its file whenever they are asked for: memory does not grow by what steps say."""

    def __init__(self, folder: Path, name: str, key: str) -> None:
        """Take the folder of the work, the name of the step and the key of its receipt."""
        self._place, self._key = (folder, name), key

    def __getitem__(self, name: str) -> Any:
        """Return a fact."""
        return self._read()[name]

    def __iter__(self) -> Iterator[str]:
        """Return the names of all facts."""
        return iter(self._read())

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._read())

    def _read(self) -> Mapping[str, Any]:
        """Read the receipt, which another machine's writer may make visible late."""
        end = time.monotonic() + PATIENCE
        while (receipt := read_receipt(*self._place)) is None or receipt.key != self._key:
            if time.monotonic() >= end:
                raise MissingFileError(
                    f"receipt must stay where it was written, got no such one at {receipt_path(*self._place)}. "
                    "Call again: the step is then done anew."
                )
            time.sleep(0.1)
        return receipt.facts


def perform(works: Mapping[str, Work], task: Task, progress: NotedProgress) -> Receipt:
    """Do a step, unless it is done.

    Raises:
        MissingFileError: An input does not become visible.
        Exception: Whatever the work raises.
    """
    step, work = task.step, works[task.step.stage]
    wait_for(task.awaited)
    key = _key(work.common(), step, work.digest(step), task.keys)
    kept = read_receipt(work.folder, step.name)
    if kept is not None and kept.key == key and is_whole(work.folder, kept):
        return Receipt(**{**vars(kept), "is_kept": True})
    started = time.perf_counter()
    facts = work.do(task, progress)
    seconds = time.perf_counter() - started
    outputs = {path.relative_to(work.folder).as_posix(): _state(path) for path in work.outputs(step)}
    receipt = Receipt(key, version_of(work), outputs, seconds, worker_name(), time.time(), facts)
    path = receipt_path(work.folder, step.name)
    path.parent.mkdir(exist_ok=True)
    write_record(path, {name: value for name, value in asdict(receipt).items() if name != "is_kept"})
    return receipt


def worker_name() -> str:
    """Return what receipts call this process."""
    return f"{platform.node()}:{os.getpid()}"


def version_of(work: Work) -> str:
    """Return the digest of the code and the options of a work."""
    return hashlib.blake2b(work.common().encode(), digest_size=8).hexdigest()


def _key(common: str, step: Step, digest: str, keys: Iterable[str]) -> str:
    text = json.dumps([common, step.stage, step.frame, digest, *keys])
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _state(path: Path) -> tuple[int, int, str]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns, content_digest(path, {})[1]


def receipt_path(folder: Path, name: str) -> Path:
    """Return where the receipt of a step is, given the folder of its work."""
    return folder / RECEIPTS / f"{name}.json"


def read_receipt(folder: Path, name: str) -> Receipt | None:
    """Return the receipt of a step; None if there is none, or a damaged one."""
    try:
        content = json.loads(receipt_path(folder, name).read_text(encoding="utf-8"))
        outputs = {str(name): (int(size), int(when), str(it)) for name, (size, when, it) in content["outputs"].items()}
        return Receipt(**{**content, "outputs": outputs})
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def is_whole(folder: Path, receipt: Receipt, *, is_read: bool = False) -> bool:
    """Return whether all outputs are as they were when a step was done.

    Args:
        folder: Folder of the step's work.
        receipt: Its receipt.
        is_read: Read all of them; else only those that have changed since, by their times.
    """
    for name, (size, when, digest) in receipt.outputs.items():
        path = folder / name
        try:
            status = path.stat()
            same = status.st_size == size and (
                (status.st_mtime_ns == when and not is_read) or content_digest(path, {})[1] == digest
            )
        except (OSError, MissingFileError):
            return False
        if not same:
            return False
    return True


def awaited_files(folder: Path, receipt: Receipt) -> list[tuple[str, int]]:
    """Return path and size of the outputs of a step, for `wait_for`."""
    return [(str(folder / name), size) for name, (size, _, _) in receipt.outputs.items()]


def wait_for(awaited: Iterable[tuple[str, int]], patience: float = PATIENCE) -> None:
    """Wait until files are visible in full: network file systems show the writes of other machines late.

    Args:
        awaited: Path and size [byte] of each.
        patience: Longest wait for all of them [s].

    Raises:
        MissingFileError: One is not there by then, or of another size.
    """
    end = time.monotonic() + patience
    for name, size in awaited:
        path = Path(name)
        while not _has_size(path, size):
            if time.monotonic() >= end:
                raise MissingFileError(
                    f"output of an earlier step must be visible to all workers, got none of {size} bytes at {path}. "
                    "Choose a folder that all machines share."
                )
            time.sleep(0.1)


def _has_size(path: Path, size: int) -> bool:
    try:
        if path.stat().st_size == size:
            return True
        with os.scandir(path.parent):  # reading a folder makes network file systems look again
            return False
    except OSError:
        return False


def write_record(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file whole or not at all.

    Raises:
        OutputError: It cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content) + "\n", encoding="utf-8")
