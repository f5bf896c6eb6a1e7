"""``beam chart``: what a setting costs against how wrong it is, on the user's own data and device."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, subcommand

from beam_warp.checks import require_package
from beam_warp.cli.charts.flags import (
    AllCharts,
    ChartFlags,
    DeliveryChart,
    MaterialsChart,
    ReconstructChart,
    RenderChart,
    TracingChart,
)
from beam_warp.cli.common.console import print_json, progress
from beam_warp.errors import InvalidOptionError
from beam_warp.jobs.store import make_folders
from beam_warp.study.page import write_page
from beam_warp.study.picture import write_image
from beam_warp.study.table import Settings, Table, read_table

Charted = TracingChart | MaterialsChart | ReconstructChart | RenderChart | DeliveryChart


@dataclass(frozen=True)
class Chart:
    """Measure error against cost on your own data and device, and mark the settings that no other beats in both."""

    study: Annotated[
        Annotated[TracingChart, subcommand("tracing", prefix_name=False)]
        | Annotated[MaterialsChart, subcommand("materials", prefix_name=False)]
        | Annotated[ReconstructChart, subcommand("reconstruct", prefix_name=False)]
        | Annotated[RenderChart, subcommand("render", prefix_name=False)]
        | Annotated[DeliveryChart, subcommand("delivery", prefix_name=False)]
        | Annotated[AllCharts, subcommand("all", prefix_name=False)],
        OmitArgPrefixes,
    ]


def chart(command: Chart) -> int:
    """Measure or read tables, draw them, and say what is on the frontiers."""
    args = command.study
    for package in ("matplotlib", "plotly"):
        require_package(package)
    charts = _charts(args) if isinstance(args, AllCharts) else [args]
    tables = [_draw(each) for each in charts]
    page = args.out / "chart.html"
    if isinstance(args, AllCharts):
        write_page([table for table, _ in tables], page)
    if args.json:
        said = [_summary(table, skipped, args.out) for table, skipped in tables]
        print_json({"charts": said, "page": str(page)} if isinstance(args, AllCharts) else said[0])
    elif not args.quiet:
        for table, skipped in tables:
            _say(table, skipped, args.out)
    return 0


def _charts(args: AllCharts) -> list[Charted]:
    """Return the charts that an asset and a capture allow.

    Raises:
        InvalidOptionError: There is neither, or a table is to be drawn again.
    """
    if args.from_csv is not None:
        raise InvalidOptionError(f"from-csv must be left out for all charts, got {args.from_csv}. Draw that one alone.")
    if args.asset is None and args.capture is None:
        raise InvalidOptionError("asset or capture must be given for all charts, got neither. Name what is measured.")
    shared: dict[str, Any] = {field.name: getattr(args, field.name) for field in fields(ChartFlags)}
    lit, found = {**shared, "environment": args.environment}, list[Charted]()
    if args.asset is not None:
        found += [kind(**lit, asset=args.asset) for kind in (RenderChart, DeliveryChart)]
        found.append(TracingChart(**lit, scene=args.asset))
    if args.capture is not None:
        found.append(ReconstructChart(**shared, capture=args.capture))
        if args.asset is not None or (args.capture / "truth").is_dir():
            found.append(MaterialsChart(**lit, asset=args.asset, capture=args.capture))
    return found


def _draw(args: Charted) -> tuple[Table, list[Settings]]:
    """Measure or read a table, and draw it."""
    names = ("scene", "asset", "capture", "environment")
    given = [str(path) for name in names if (path := getattr(args, name, None)) is not None]
    if args.from_csv is not None and given:
        what = "a scene" if isinstance(args, TracingChart) else "an asset, a capture"
        raise InvalidOptionError(
            f"from-csv must be given without {what} or an environment, got {given[0]} too: it measures nothing. "
            "Drop one of them."
        )
    skipped: list[Settings] = []
    if args.from_csv is not None:
        table = read_table(args.from_csv)
        make_folders(args.out)
    else:
        from beam_warp.cli.charts.measures import measured  # help and drawing do without Warp

        with progress(args.quiet or args.json) as report:
            table, skipped = measured(args, report)
    image, page = _files(table, args.out)
    write_image(table, image)
    write_page([table], page)
    return table, skipped


def _files(table: Table, out: Path) -> tuple[Path, Path]:
    name = table.subject.name
    return out / f"{name}.png", out / f"{name}.html"


def _summary(table: Table, skipped: list[Settings], out: Path) -> dict[str, Any]:
    """Return what was found, JSON-able."""
    return {
        "title": table.subject.title,
        "notes": dict(table.subject.notes),
        "measured": len(table.rows),
        "planned": table.subject.planned,
        "skipped": [dict(settings) for settings in skipped],
        "frontier": {
            metric.name: [
                {**row.settings, "cost": row.cost.value, "error": row.errors[metric.name].value}
                for row in table.frontier(metric)
            ]
            for metric in table.subject.metrics
            if not metric.by
        },
        "files": [str(path) for path in _files(table, out)],
    }


def _say(table: Table, skipped: list[Settings], out: Path) -> None:
    """Print the frontier and what was left out."""
    subject, (image, page) = table.subject, _files(table, out)
    cost = f"{'time' if subject.cost_unit == 's' else 'size'} [{subject.cost_unit}]"
    print(subject.title)
    for metric in subject.metrics:
        frontier = table.frontier(metric)
        if not frontier:
            continue
        print(f"\n{metric.title}: the frontier\n{cost:>10} {'error':>10}  settings")
        for row in frontier:
            print(f"{row.cost.value:10.3g} {row.errors[metric.name].value:10.3g}  {subject.label(row.settings)}")
    print(f"\n{len(table.rows):,} of {subject.planned:,} planned settings measured; look at {image} and {page}")
    if "Plan" in subject.notes:
        print(f"plan: {subject.notes['Plan']}")
    if skipped:
        names = "; ".join(subject.label(settings) for settings in skipped[:3])
        more = f"; and {len(skipped) - 3:,} more" if len(skipped) > 3 else ""
        print(f"skipped for the budget: {names}{more}. Call again to go on with them.", file=sys.stderr)
