"""``beam stability``: what tracing, reconstruction, materials and relighting fail on, on this machine."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from beam_warp.cli.common.console import print_json, progress
from beam_warp.cli.common.flags import Device, Json, Quiet
from beam_warp.errors import OutputError
from beam_warp.jobs.listeners import NotedProgress

if TYPE_CHECKING:
    from beam_warp.stability.page import StabilityResult


@dataclass(frozen=True)
class Stability:
    """Trace, reconstruct, decompose and relight what others fail on; tell what was found and what came out.

    Every ray is compared with float64. Exit code 1 if one is off by more than rounding explains, if a capture was
    reconstructed badly, or materials measured badly, and nothing was said, or if a relit image is not what closed
    forms say. One page for several devices: run it on each with --json, and on the last with --beside.

    Example: beam stability --out stability.md
    """

    only: Annotated[
        Literal["tracing", "reconstruction", "materials", "relighting"] | None,
        arg(help="Only one of them; a page that is there keeps the others."),
    ] = None
    out: Annotated[Path | None, arg(metavar="FILE", help="Also write the results as a Markdown page.")] = None
    beside: Annotated[
        tuple[Path, ...], arg(metavar="FILE", help="Results of other devices, as --json printed them, for the page.")
    ] = ()
    large: Annotated[bool, arg(help="Also scenes of minutes and gigabytes; larger captures, for GPUs.")] = False
    device: Device = None
    quiet: Quiet = False
    json: Json = False


def stability(args: Stability) -> int:
    """Run the suite, print its table, and return 1 if a verdict is bad."""
    if args.out is not None and not args.out.parent.is_dir():
        raise OutputError(f"out must be in a folder that exists, got {args.out.parent}. Create it first.")

    from beam_warp.stability.page import StabilityResult, read_result, write_page

    others = [read_result(path) for path in args.beside]
    result = StabilityResult()
    with progress(args.quiet or args.json) as report:
        parts = {"tracing": _trace, "reconstruction": _reconstruct, "materials": _decompose, "relighting": _relight}
        for part, run in parts.items():
            if args.only in (None, part):
                result = result.joined(run(args, report))
    result = result.measured_now()
    if args.out is not None:
        write_page(
            args.out,
            reduce(StabilityResult.joined, others, result),
            "beam stability --large" if args.large else "beam stability",
        )
    if args.json:
        print_json(result.as_dict())
    elif not args.quiet:
        _print_tables(result)
        if args.out is not None:
            print(f"wrote {args.out}")
    for line in _faults(result):
        print(line, file=sys.stderr)
    return 0 if result.passed else 1


def _trace(args: Stability, report: NotedProgress) -> StabilityResult:
    """Trace the scenes and the shapes."""
    from beam_warp.stability.analytic_occlusion import SHAPES, measure_refinements
    from beam_warp.stability.page import StabilityResult
    from beam_warp.stability.suite import run_suite
    from beam_warp.stability.tracing import run_case
    from beam_warp.stability.tracing_cases import CASES

    cases = [case for case in CASES if args.large or not case.large]
    return StabilityResult(
        tuple(run_suite(cases, partial(run_case, device=args.device), partial(report, "cases"))),
        tuple(run_suite(SHAPES, partial(measure_refinements, device=args.device), partial(report, "shapes"))),
    )


def _reconstruct(args: Stability, report: NotedProgress) -> StabilityResult:
    """Reconstruct the captures."""
    from beam_warp.stability.capture_cases import CAPTURE_CASES
    from beam_warp.stability.captures import run_capture_case
    from beam_warp.stability.page import StabilityResult
    from beam_warp.stability.reconstruct import LARGE, QUICK, reconstructing
    from beam_warp.stability.suite import run_suite

    effort = LARGE if args.large else QUICK
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        reconstruct, studio = reconstructing(effort.steps(args.device), place), effort.studio(place, args.device)
        cases = [case for case in CAPTURE_CASES if args.large or not case.large]
        outcomes = run_suite(
            cases, lambda case: [run_capture_case(reconstruct, studio, case)], partial(report, "captures")
        )
        return StabilityResult(captures=tuple(outcomes))


def _decompose(args: Stability, report: NotedProgress) -> StabilityResult:
    """Measure materials."""
    from beam_warp.stability.material_cases import MATERIAL_CASES, MaterialStudio
    from beam_warp.stability.materials import Bench, run_material_case
    from beam_warp.stability.page import StabilityResult
    from beam_warp.stability.suite import run_suite

    bench = Bench(MaterialStudio(args.device))
    outcomes = run_suite(MATERIAL_CASES, lambda case: [run_material_case(bench, case)], partial(report, "materials"))
    return StabilityResult(materials=tuple(outcomes))


def _relight(args: Stability, report: NotedProgress) -> StabilityResult:
    """Render subjects and lights with both renderers."""
    from beam_warp.stability.page import StabilityResult
    from beam_warp.stability.relighting import RelightingBench, run_both_renderers
    from beam_warp.stability.relighting_cases import RELIGHTING_CASES
    from beam_warp.stability.suite import run_suite

    cases = [case for case in RELIGHTING_CASES if args.large or not case.large]
    run = partial(run_both_renderers, RelightingBench(device=args.device))
    outcomes = run_suite(cases, run, partial(report, "relighting"))
    return StabilityResult(relighting=tuple(outcomes))


def _faults(result: StabilityResult) -> list[str]:
    """Return one line for each bad verdict."""
    named = [
        *((outcome, f", {outcome.hierarchy}") for outcome in result.cases),
        *((outcome, "") for outcome in (*result.captures, *result.materials)),
        *((outcome, f", {outcome.renderer}") for outcome in result.relighting),
    ]
    lines = [
        f"failed: {outcome.case} on {outcome.device}{how}: {'; '.join(outcome.faults)}"
        for outcome, how in named
        if not outcome.passed
    ]
    return lines + [
        f"failed: {o.shape} at spacing {o.spacing:g} on {o.device}: {o.largest_z:.1f} standard errors"
        for o in result.occlusion
        if not o.passed
    ]


def _print_tables(result: StabilityResult) -> None:
    """Print a table of every part that was run; how others fail is on the page."""
    from beam_warp.stability import captures, materials, relighting

    if result.cases:
        _print_tracing(result)
    if result.captures:
        rows = [(o, captures.cells(o, result.captures)) for o in result.captures]
        _print_table("stress captures", (captures.TITLES[0], *captures.TITLES[3:]), rows)
    if result.materials:
        rows = [(o, materials.cells(o)) for o in result.materials]
        _print_table("materials", (materials.TITLES[0], *materials.TITLES[3:]), rows)
    if result.relighting:
        cells = ((o, relighting.cells(o)) for o in result.relighting)
        rows = [(o, (renderer, measured, verdict)) for o, (renderer, measured, _, verdict) in cells]
        titles = (relighting.TITLES[0], *relighting.TITLES[3:5], relighting.TITLES[-1])
        _print_table("relighting", titles, rows)


def _print_table(name: str, titles: Sequence[str], rows: Sequence[tuple[Any, Sequence[str]]]) -> None:
    """Print one row for each outcome: its case, and its cells, of which the last one is the verdict."""
    from rich.console import Console
    from rich.table import Table

    from beam_warp.stability.page import devices_of

    table = Table(*titles, title=f"{name} on {', '.join(devices_of([outcome for outcome, _ in rows]))}")
    for outcome, (*found, verdict) in rows:
        table.add_row(outcome.case, *found, verdict if outcome.passed else f"[red]{verdict}[/red]")
    Console(width=None if sys.stdout.isatty() else 200).print(table)


def _print_tracing(result: StabilityResult) -> None:
    """Print one row a case, the worst of its hierarchies, and one a shape."""
    from rich.console import Console
    from rich.table import Table

    from beam_warp.stability.page import allowed_by, devices_of

    console = Console(width=None if sys.stdout.isatty() else 200)
    device = ", ".join(devices_of(result.cases))
    titles = ("case", "did", "detected", "done", "allowed", "error", "verdict")
    table = Table(*titles, title=f"stress cases on {device}")
    for name in dict.fromkeys(outcome.case for outcome in result.cases):
        rows = [outcome for outcome in result.cases if outcome.case == name]
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
    titles = ("shape", "spacing", "smooth", "tiled", "discretisation", "estimate", "largest z", "verdict")
    table = Table(*titles, title=f"ambient occlusion on {device}")
    for o in result.occlusion:
        table.add_row(
            o.shape,
            f"{o.spacing:g}",
            *(f"{value:.4f}" for value in (o.closed_form, o.quadrature, o.discretisation, o.estimate)),
            f"{o.largest_z:.2f}",
            "ok" if o.passed else "[red]failed[/red]",
        )
    console.print(table)
