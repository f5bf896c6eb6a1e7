"""Parts of a benchmark, one after the other: one that fails says so in its place, and the others are kept."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import record

Row = dict[str, Any]

STARTED = time.perf_counter()


def say(text: str) -> None:
    """Print a line to stderr, with the seconds since the program began."""
    print(f"{time.perf_counter() - STARTED:7.1f} s  {text}", file=sys.stderr, flush=True)


def once(part: Callable[[Any], Any]) -> Callable[[Any], Iterator[Any]]:
    """Return what `measure` takes, of a part that returns all it found."""
    return lambda bench: iter([part(bench)])


def measure(
    parts: Mapping[str, Callable[[Any], Iterator[Any]]],
    bench: Any,
    *,
    only: Sequence[str] = (),
    keep: Callable[[Row], None] = lambda result: None,
) -> Row:
    """Run parts and return what each found by its name, and under ``failed`` the names of those that failed.

    Args:
        parts: Each yields what it knows so far, whenever there is more.
        bench: What they share.
        only: These parts only; all where empty.
        keep: Told everything so far, whenever there is more.
    """
    result: Row = {"failed": []}
    for name in only or parts:
        started = time.perf_counter()
        try:
            for state in parts[name](bench):
                result[name] = state
                keep(result)
        except Exception as error:  # minutes on a lent device are not lost to what comes later
            traceback.print_exc()
            result.setdefault(name, {})["failed"] = f"{type(error).__name__}: {error}"
            result["failed"].append(name)
            keep(result)
        say(f"{name}: {time.perf_counter() - started:.1f} s")
    return result


def measure_all(
    parts: Mapping[str, Callable[[Any], Iterator[Any]]],
    bench: Any,
    arguments: Any,
    device: Any,
    only: Sequence[str] = (),
) -> int:
    """Run parts as `measure` does, write what they found as the program's result, and return its exit status."""
    return 1 if measure(parts, bench, only=only, keep=partial(record.write_result, arguments, device))["failed"] else 0
