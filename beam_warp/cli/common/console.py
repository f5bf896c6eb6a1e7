"""What every command prints: errors as one line, progress where somebody watches, JSON on request."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from beam_warp.cli.common.pages import flags_of
from beam_warp.errors import BeamError
from beam_warp.jobs.listeners import NotedProgress


def run_command(command: Callable[[], int], record: type | None = None) -> int:
    """Run a command; a caller's mistake becomes one line on stderr and exit code 2, never a traceback.

    Args:
        command: What runs, and returns the exit code.
        record: Dataclass of its options, by which errors name them.
    """
    try:
        with options_named(record):
            return command()
    except BeamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as error:
        print(f"stopped: {error}" if str(error) else "stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 0


SHORTER = {"sample-count": "samples", "frames-per-second": "fps", "vertical-fov": "fov"}
"""Arguments of the library whose options have shorter names."""


@contextmanager
def options_named(record: type | None) -> Iterator[None]:
    """Let errors speak of options (``--source-axes``) where the library names its arguments (``source_axes``).

    Only what an error is about is replaced: the words before "must".
    """
    try:
        yield
    except BeamError as error:
        subject, must, rest = str(error).partition(" must ")
        if record is not None and must:
            flags = {field.replace("_", "-"): flag for field, flag in flags_of(record).items()}
            flags |= {name: f"--{option}" for name, option in SHORTER.items() if option in flags}
            words = re.split(r"(, | and )", subject.replace("_", "-"))
            if set(words[::2]) <= set(flags):
                error.args = ("".join(flags.get(word, word) for word in words) + must + rest,)
        raise


def print_json(value: Any) -> None:
    """Print one machine-readable result."""
    json.dump(value, sys.stdout, indent=2, sort_keys=True, allow_nan=False)
    print()


def print_notes(notes: Iterable[str], warnings: Iterable[str] = ()) -> None:
    """Print on stderr what a user should know, beside the results."""
    for line in (*(f"note: {note}" for note in notes), *(f"warning: {warning}" for warning in warnings)):
        print(line, file=sys.stderr)


SPEED_PERIOD = 600.0
"""Time over which rates and times left are averaged, so that a step of a minute still counts [s]."""

COMPILING = "compiling kernels (first run on this machine)"
"""Stage that is shown while Warp compiles; a warm cache never shows it."""


def rate_in_words(steps_per_second: float | None) -> str:
    """Return a rate as ``12.3/s``, or as ``8.0 s each`` where a step takes longer than a second."""
    if not steps_per_second:
        return ""
    return f"{steps_per_second:,.1f}/s" if steps_per_second >= 1.0 else f"{1.0 / steps_per_second:,.1f} s each"


@contextmanager
def progress(quiet: bool, *, compiles: bool = True) -> Iterator[NotedProgress]:
    """Show stages with rate and time left on a terminal; nothing when quiet or elsewhere.

    Args:
        quiet: Show nothing.
        compiles: Also show compilation of kernels. False for a command without kernels, so that Warp is not imported.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda stage, done, total, note="": None
        return
    from rich import progress as rich
    from rich.console import Console

    columns = (
        *("{task.description}", rich.BarColumn(), rich.MofNCompleteColumn(), "{task.fields[rate]}"),
        *(rich.TimeElapsedColumn(), rich.TimeRemainingColumn(), "{task.fields[note]}"),
    )
    console = Console(stderr=True)
    with rich.Progress(*columns, console=console, transient=True, speed_estimate_period=SPEED_PERIOD) as bars:
        tasks: dict[str, Any] = {}

        def update(stage: str, done: int, total: int | None, note: str = "") -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total, rate="", note="")
            task = next(t for t in bars.tasks if t.id == tasks[stage])
            if done < task.completed:
                bars.reset(tasks[stage])
            bars.update(tasks[stage], completed=done, total=total, rate=rate_in_words(task.speed), note=note)

        def compiling(module_count: int, seconds: float, *, is_running: bool) -> None:
            update(COMPILING, module_count, None, f"{module_count} module{'s'[: module_count > 1]}, {seconds:.0f} s")
            bars.update(tasks[COMPILING], visible=is_running)

        if not compiles:
            yield update
            return
        from beam_warp.device.compilation import compilation_heard

        with compilation_heard(compiling):
            yield update
