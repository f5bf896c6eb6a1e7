"""Parts that the suites share: a case, its outcome, and how cases are run one after the other."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Generic, TypeVar

import numpy as np

from beam_warp.errors import BeamError
from beam_warp.jobs.listeners import CountProgress, no_progress
from beam_warp.world.gaussians import GaussianCloud

Case = TypeVar("Case")
Result = TypeVar("Result")
Row = TypeVar("Row")
Stress = TypeVar("Stress")
RecordType = TypeVar("RecordType", bound="OutcomeRecord")


@dataclass(frozen=True)
class StabilityCase(Generic[Stress]):
    """A case by name, how others fail on it, and how it is made.

    Attributes:
        name: Short and unique.
        fails: How a program without precautions fails.
        must: What is asked of this one; empty where a suite asks the same of every case.
        build: Makes what is run, the same each time; from a studio where the suite has one.
        large: Whether it needs minutes or gigabytes, and is run on request only.
    """

    name: str
    fails: str
    must: str
    build: Callable[..., Stress]
    large: bool = False


def stability_case(
    name: str, fails: str, must: str, *, large: bool = False
) -> Callable[[Callable[..., Stress]], StabilityCase[Stress]]:
    """Make a case of the function below it."""
    return lambda build: StabilityCase(name, fails, must, build, large)


def together(*clouds: GaussianCloud) -> GaussianCloud:
    """Return all Gaussians as one cloud; arrays and colour space are those that the first one has."""
    arrays = [cloud.arrays() for cloud in clouds]
    return replace(clouds[0], **{name: np.concatenate([part[name] for part in arrays]) for name in arrays[0]})


class OutcomeRecord:
    """A dataclass that is written as JSON and read back, with a verdict."""

    @property
    def passed(self) -> bool:
        """Whether the verdict is good."""
        raise NotImplementedError

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record."""
        return asdict(self) | {"passed": self.passed}  # type: ignore[call-overload]

    @classmethod
    def from_dict(cls: type[RecordType], record: Mapping[str, Any]) -> RecordType:
        """Return what `as_dict` gave, whose tuples JSON has made lists."""
        values = {entry.name: record[entry.name] for entry in fields(cls)}  # type: ignore[arg-type]
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})


@dataclass(frozen=True, kw_only=True)
class CaseOutcome(OutcomeRecord):
    """The outcome of one case.

    Attributes:
        case: Name of the case.
        device: Warp device.
        faults: Reasons why the case fails; empty if it passes.
        seconds: Time of what the suite tries.
    """

    case: str
    device: str
    faults: tuple[str, ...] = ()
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether the case has no fault."""
        return not self.faults

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record."""
        return super().as_dict() | {"seconds": round(self.seconds, 3)}


@dataclass(frozen=True)
class Attempt(Generic[Result]):
    """What came of an attempt: a result, a refusal or a crash.

    Attributes:
        result: The result; None after a refusal or crash.
        refused: The error by which the input was refused; empty if it was not.
        faults: The refusal or crash, in words; empty if there is a result.
        seconds: Time that it took.
    """

    result: Result | None
    refused: str
    faults: tuple[str, ...]
    seconds: float


def attempt(work: Callable[[], Result]) -> Attempt[Result]:
    """Do some work, and say what came of it: a crash is a finding of a suite, whose other cases are still to be run."""
    start = time.perf_counter()
    result, refused, fault = None, "", ""
    try:
        result = work()
    except BeamError as error:
        refused, fault = str(error), f"refused: {error}"
    except Exception as error:
        fault = f"ended with {type(error).__name__}: {error}"
    return Attempt(result, refused, (fault,) if fault else (), time.perf_counter() - start)


def run_suite(
    cases: Sequence[Case], run: Callable[[Case], Iterable[Row]], progress: CountProgress = no_progress
) -> Iterator[Row]:
    """Run case after case.

    Args:
        cases: Cases of one suite.
        run: Runs one, and returns its outcomes.
        progress: Called with (cases done, cases in all).
    """
    for done, case in enumerate(cases, start=1):
        yield from run(case)
        progress(done, len(cases))
