"""``beam stability``: scenes on which ray tracers fail, on this machine's devices."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from beam_warp.cli.console import print_json, progress
from beam_warp.errors import OutputError

if TYPE_CHECKING:
    from beam_warp.stability_report import StabilityResult


@dataclass(frozen=True)
class Stability:
    """Trace scenes on which ray tracers fail, compare every ray with float64, and say what was detected and done.

    Exit code 1 if a ray is off by more than rounding explains. One page for several devices: run it on each with
    --json, and on the last with --beside.

    Example: beam stability --out stability.md
    """

    out: Annotated[Path | None, arg(metavar="FILE", help="Also write the results as a Markdown page.")] = None
    beside: Annotated[
        tuple[Path, ...], arg(metavar="FILE", help="Results of other devices, as --json printed them, for the page.")
    ] = ()
    large: Annotated[bool, arg(help="Also the scenes that take minutes and gigabytes.")] = False
    device: Annotated[str | None, arg(help="cpu, cuda:0, …; the first GPU by default, if there is one.")] = None
    quiet: Annotated[bool, arg(help="Print nothing but errors.")] = False
    json: Annotated[bool, arg(help="Print the results as JSON.")] = False


def stability(args: Stability) -> int:
    """Run the suite, print its table, and return 1 if a verdict is bad."""
    if args.out is not None and not args.out.parent.is_dir():
        raise OutputError(f"out must be in a folder that exists, got {args.out.parent}. Create it first.")

    from beam_warp.analytic_occlusion import SHAPES, measure_shapes
    from beam_warp.stability import run_cases
    from beam_warp.stability_report import StabilityResult, read_result, write_page
    from beam_warp.stress_cases import CASES

    others = [read_result(path) for path in args.beside]
    cases = [case for case in CASES if args.large or not case.large]
    with progress(args.quiet or args.json) as report:
        result = StabilityResult(
            tuple(run_cases(cases, args.device, progress=lambda done, total: report("cases", done, total))),
            tuple(measure_shapes(SHAPES, args.device, progress=lambda done, total: report("shapes", done, total))),
        )
    if args.out is not None:
        joined = result
        for other in others:
            joined = joined.joined(other)
        write_page(args.out, joined, "beam stability --large" if args.large else "beam stability")
    if args.json:
        print_json(result.as_dict())
    elif not args.quiet:
        _print_tables(result)
        if args.out is not None:
            print(f"wrote {args.out}")
    for line in _faults(result):
        print(line, file=sys.stderr)
    return 0 if result.passed else 1


def _faults(result: StabilityResult) -> list[str]:
    """Return one line for each bad verdict."""
    lines = [
        f"failed: {outcome.case} on {outcome.device}, {outcome.hierarchy}: {'; '.join(outcome.faults)}"
        for outcome in result.outcomes
        if not outcome.passed
    ]
    return lines + [
        f"failed: {o.shape} at spacing {o.spacing:g} on {o.device}, {o.backend}: {o.largest_z:.1f} standard errors"
        for o in result.occlusion
        if not o.passed
    ]


def _print_tables(result: StabilityResult) -> None:
    """Print one row a case, the worst of its hierarchies, and one a shape."""
    from rich.console import Console
    from rich.table import Table

    from beam_warp.stability_report import allowed_by, devices_of

    console = Console(width=None if sys.stdout.isatty() else 200)
    device = ", ".join(devices_of(result.outcomes))
    titles = ("case", "did", "detected", "done", "allowed", "error", "verdict")
    table = Table(*titles, title=f"stress cases on {device}")
    for name in dict.fromkeys(outcome.case for outcome in result.outcomes):
        rows = [outcome for outcome in result.outcomes if outcome.case == name]
        failed = ", ".join(outcome.hierarchy for outcome in rows if not outcome.passed)
        table.add_row(
            name,
            rows[0].did,
            rows[0].detected,
            rows[0].done,
            allowed_by(rows[0]),
            f"{max(outcome.error for outcome in rows):.1e}",
            f"[red]failed: {failed}[/red]" if failed else "ok",
        )
    console.print(table)
    titles = ("shape", "spacing", "backend", "smooth", "tiled", "discretisation", "estimate", "largest z", "verdict")
    table = Table(*titles, title=f"ambient occlusion on {device}")
    for o in result.occlusion:
        table.add_row(
            o.shape,
            f"{o.spacing:g}",
            o.backend,
            *(f"{value:.4f}" for value in (o.closed_form, o.quadrature, o.discretisation, o.estimate)),
            f"{o.largest_z:.2f}",
            "ok" if o.passed else "[red]failed[/red]",
        )
    console.print(table)
