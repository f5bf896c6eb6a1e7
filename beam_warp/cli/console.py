"""How every command talks: errors as one line, progress only where somebody watches, JSON on request."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from beam_warp.errors import BeamError


def run_command(command: Callable[[], int]) -> int:
    """Run a command; a caller's mistake becomes one line on stderr and exit code 2, never a traceback."""
    try:
        return command()
    except BeamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 0


def print_json(value: Any) -> None:
    """Print one machine-readable result."""
    json.dump(value, sys.stdout, indent=2, sort_keys=True, allow_nan=False)
    print()


ProgressCallback = Callable[[str, int, int], None]
"""Called with (stage, done, total) as work goes on."""


@contextmanager
def progress(quiet: bool) -> Iterator[ProgressCallback]:
    """Show stages with rate and time left on a terminal; do nothing when quiet or not a terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda stage, done, total: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        tasks: dict[str, Any] = {}

        def update(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total, rate="")
            task = next(t for t in bars.tasks if t.id == tasks[stage])
            rate = f"{task.speed:,.1f}/s" if task.speed else ""
            bars.update(tasks[stage], completed=done, total=total, rate=rate)

        yield update
