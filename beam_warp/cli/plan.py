"""``beam plan``: how far a long job is, from the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from beam_warp.checks import require_count
from beam_warp.cli.common.console import escaped, print_json
from beam_warp.cli.common.flags import Json

if TYPE_CHECKING:
    from beam_warp.plan.standing import Standing


@dataclass(frozen=True)
class ShowPlan:
    """Say how far a job of `beam run` or `beam reconstruct` is: what is done, running, left and given up.

    The job may be running, stopped or done; nothing is changed. The estimate takes the times of steps that are done,
    and hands the rest out as the job would.

    Example: beam plan walker

    Example: beam plan walker --workers 8 --html walker.html
    """

    job: Annotated[Positional[Path], arg(metavar="OUT", help="Folder of the job.")]
    workers: Annotated[int | None, arg(metavar="N", help="Estimate for so many workers; else for those it has.")] = None
    html: Annotated[Path | None, arg(metavar="FILE", help="Also write a page: frames, times, errors, previews.")] = None
    json: Json = False


def plan(args: ShowPlan) -> int:
    """Look at the plan and say what was found."""
    from beam_warp.plan.page import write_page
    from beam_warp.plan.standing import look

    if args.workers is not None:
        require_count("workers", args.workers, 1)
    standing = look(args.job)
    if args.html is not None:
        write_page(standing, args.html)
    if args.json:
        print_json(standing.as_dict())
        return 0
    for line in lines_of(standing, args.workers):
        print(escaped(line))
    return 0


def lines_of(standing: Standing, workers: int | None) -> list[str]:
    """Return in lines how far a plan is."""
    from beam_warp.plan.page import in_words, left_in_words

    width = max(10, *map(len, standing.stages))
    lines = [f"{'stage':{width}} {'done':>13} {'running':>8} {'failed':>7} {'each':>9}"]
    for stage, found in standing.stages.items():
        done = f"{found.done:,}/{found.total:,}"
        lines.append(f"{stage:{width}} {done:>13} {found.running:8} {found.given_up:7} {in_words(found.seconds):>9}")
    lines += [f"{name}: {worker}, {in_words(age)}" for name, (worker, age) in standing.running.items()]
    lines += [f"{name}: {words[-1]}" for name, words in standing.errors.items()]
    return [*lines, left_in_words(standing, workers)]
