"""Parts of a benchmark, one after the other: one that fails says so in its place, and the others are kept."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

Row = dict[str, Any]


def measure(
    parts: Mapping[str, Callable[[Any], Iterator[Row]]],
    bench: Any,
    *,
    only: Sequence[str] = (),
    keep: Callable[[Row], None] = lambda result: None,
) -> Row:
    """Run parts and return what each found by its name, and under ``failed`` the names of those that failed.

    Args:
        parts: Each yields what it knows so far, whenever there is more.
        bench: What they share; its ``say`` hears how long each took.
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
            result[name]["part_seconds"] = time.perf_counter() - started
        except Exception:
            result.setdefault(name, {})["failed"] = traceback.format_exc()
            result["failed"].append(name)
            bench.say(traceback.format_exc())
        keep(result)
        bench.say(f"{name}: {time.perf_counter() - started:.1f} s")
    return result
