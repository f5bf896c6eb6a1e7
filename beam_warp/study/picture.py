"""A study's table as one picture: error against cost with the frontier marked, and a list of its settings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from beam_warp.checks import require_package
from beam_warp.errors import InvalidOptionError
from beam_warp.image.files import replacing
from beam_warp.study.table import Axis, Metric, Row, Table

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Told apart with every common colour blindness (Okabe and Ito 2008)."""

MARKERS = ("o", "^", "s", "D", "v", "P", "X")
LINES = ("-", "--", ":", "-.")
GREY = "#555555"
GOLD = "#FFC20A"
WIDTH = 12.0
RESOLUTION = 130
NUMBER_SIZE = 9.0

MOST_COLUMNS = 7
"""Factors that the list of the frontier has room for."""

LEGEND_ROW = 0.048
"""Height of a row of the legend, in heights of the axes."""

HIDDEN_ABOVE = 10.0
"""Errors above this many times the largest of the frontier are cut off, and counted: they would squeeze the rest."""


def encoded(table: Table, name: str, values: Sequence[str], rows: Sequence[Row]) -> dict[Any, str]:
    """Return what stands for each level of an axis that occurs in rows; a level keeps its own as others go.

    The last of the values stands for rows that the axis does not apply to.
    """
    if not name:
        return {None: values[0]}
    axis = table.subject.axis(name)
    present = {row.settings.get(name) for row in rows}
    found: dict[Any, str] = {level: values[k % len(values)] for k, level in enumerate(axis.levels) if level in present}
    return found | {None: values[-1]} if None in present or not found else found


def lines_of(table: Table, rows: Sequence[Row]) -> list[list[Row]]:
    """Return the rows that differ in the ladder only, each group in the ladder's order."""
    ladder = table.subject.axis(table.subject.ladder)
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = tuple(row.settings.get(axis.name) for axis in table.subject.axes if axis is not ladder)
        groups.setdefault(key, []).append(row)
    order: dict[Any, int] = {level: k for k, level in enumerate(ladder.levels)}
    return [sorted(group, key=lambda row: order.get(row.settings.get(ladder.name), -1)) for group in groups.values()]


def varying_axes(table: Table, rows: Sequence[Row]) -> list[Axis]:
    """Return the axes that take more than one level in rows."""
    return [axis for axis in table.subject.axes if len({row.settings.get(axis.name) for row in rows}) > 1]


def with_unit(title: str, unit: str) -> str:
    """Return a title followed by its unit, if it has one."""
    return f"{title} [{unit}]" if unit else title


def significant(value: float) -> str:
    """Return a number with three significant digits, as people write it."""
    if value == 0.0 or not 1e-3 <= abs(value) < 1e5:
        return f"{value:.2e}" if value else "0"
    return f"{value:,.{max(0, 2 - math.floor(math.log10(abs(value))))}f}"


def write_image(table: Table, path: Path) -> None:
    """Draw a table as a PNG.

    Raises:
        InvalidOptionError: matplotlib is not installed, or the table has no rows.
        OutputError: The file cannot be written.
    """
    require_package("matplotlib")
    if not table.rows:
        raise InvalidOptionError("table must have at least one row, got none. Measure something first.")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    subject = table.subject
    metrics = [metric for metric in subject.metrics if table.rows_of(metric)]
    curves = [metric for metric in metrics if not metric.by]
    effects = [metric for metric in metrics if metric.by and len(varying(table, metric)) > 1]
    longest = max((len(table.frontier(metric)) for metric in curves), default=0)
    list_height = 0.55 + 0.215 * (longest + 1)
    notes = note_lines(table, curves + effects)
    heights = [
        0.75,
        6.0 if curves else 0.0,
        list_height if curves else 0.0,
        2.0 if effects else 0.0,
        0.3 + 0.185 * len(notes),
    ]
    total = sum(heights)
    figure = Figure(figsize=(WIDTH, total), facecolor="white")
    FigureCanvasAgg(figure)

    def place(row: int, column: int, columns: int, margins: tuple[float, float, float, float]) -> list[float]:
        """Return an axes rectangle in a row of the page; margins are left, right, bottom, top in inches."""
        left, right, bottom, top = margins
        width = WIDTH / columns
        low = total - sum(heights[: row + 1])
        return [
            (column * width + left) / WIDTH,
            (low + bottom) / total,
            (width - left - right) / WIDTH,
            (heights[row] - bottom - top) / total,
        ]

    figure.text(0.2 / WIDTH, 1.0 - 0.28 / total, subject.title, fontsize=13.5, fontweight="bold", va="center")
    state = f"{len(table.rows):,} settings measured"
    if subject.planned > len(table.rows):
        state += f" of {subject.planned:,} planned"
    figure.text(
        0.2 / WIDTH,
        1.0 - 0.55 / total,
        f"Lower left is better. Numbered: the Pareto frontier, which no other setting beats in both. {state}.",
        fontsize=10,
        color=GREY,
        va="center",
    )
    for column, metric in enumerate(curves):
        axes = figure.add_axes(place(1, column, len(curves), (0.75, 0.15, 0.55, 1.25)))  # type: ignore[arg-type]
        draw_curves(axes, table, metric)
        listing = figure.add_axes(place(2, column, len(curves), (0.2, 0.1, 0.0, 0.25)))  # type: ignore[arg-type]
        draw_frontier_list(listing, table, metric, longest)
    for column, metric in enumerate(effects):
        axes = figure.add_axes(place(3, column, len(effects), (2.6, 0.35, 0.45, 0.35)))  # type: ignore[arg-type]
        draw_effect(axes, table, metric)
    for number, line in enumerate(notes):
        figure.text(0.2 / WIDTH, (heights[4] - 0.1 - 0.185 * number) / total, line, fontsize=8.2, color=GREY, va="top")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=RESOLUTION, format="png")


def varying(table: Table, metric: Metric) -> list[Row]:
    """Return one row for each level of a metric that belongs to levels alone."""
    first: dict[Any, Row] = {}
    for row in table.rows_of(metric):
        first.setdefault(row.settings.get(metric.by), row)
    levels = table.subject.axis(metric.by).levels
    return [first[level] for level in levels if level in first]


def note_lines(table: Table, metrics: Sequence[Metric]) -> list[str]:
    """Return the notes, wrapped to the width of the page."""
    from textwrap import wrap

    texts = [f"{title}: {text}" for title, text in table.subject.notes.items()]
    texts += [f"{metric.title}: {metric.sentence}" for metric in metrics if metric.sentence]
    return [line for text in texts for line in wrap(text, 190, subsequent_indent="    ")]


def draw_curves(axes: Any, table: Table, metric: Metric) -> None:
    """Draw error against cost, both logarithmic, one line for each ladder."""
    subject = table.subject
    rows = [row for row in table.rows_of(metric) if row.errors[metric.name].value > 0.0 and row.cost.value > 0.0]
    colors = encoded(table, metric.color, COLORS, rows)
    markers = encoded(table, metric.marker, MARKERS, rows)
    strokes = encoded(table, metric.line, LINES, rows)
    for group in lines_of(table, rows):
        settings = group[0].settings
        color = colors[settings.get(metric.color)]
        errors = [row.errors[metric.name] for row in group]
        axes.errorbar(
            [row.cost.value for row in group],
            [error.value for error in errors],
            yerr=[
                [error.value - max(error.low, 0.05 * error.value) for error in errors],
                [error.high - error.value for error in errors],
            ],
            xerr=[[row.cost.value - row.cost.low for row in group], [row.cost.high - row.cost.value for row in group]],
            color=color,
            marker=markers[settings.get(metric.marker)],
            linestyle=strokes[settings.get(metric.line)],
            linewidth=1.0,
            markersize=4.5,
            elinewidth=0.7,
            alpha=0.3 if table.is_apart(group[0], metric) else 0.85,
        )
    if rows:
        axes.set_xscale("log")
        axes.set_yscale("log")
    draw_frontier(axes, table, metric)
    if metric.floor > 0.0 and rows and min(row.errors[metric.name].value for row in rows) < 30.0 * metric.floor:
        axes.axhline(metric.floor, color=GREY, linewidth=0.8, linestyle=(0, (1, 2)))
        axes.annotate(
            "error of the reference",
            (0.99, metric.floor),
            xycoords=("axes fraction", "data"),
            xytext=(0, 2),
            textcoords="offset points",
            ha="right",
            fontsize=8,
            color=GREY,
        )
    lost = len(table.rows_of(metric)) - len(rows)
    remarks = [f"{lost} settings without error are not drawn"] if lost else []
    worst = max((row.errors[metric.name].value for row in table.frontier(metric)), default=math.inf)
    above = sum(row.errors[metric.name].value > HIDDEN_ABOVE * worst for row in rows)
    if above and worst > 0.0:
        axes.set_ylim(top=HIDDEN_ABOVE * worst)
        remarks.append(f"{above} settings with larger errors lie above")
    remark = f"   ({'; '.join(remarks)})" if remarks else ""
    axes.set_xlabel(with_unit(subject.cost, subject.cost_unit) + remark, fontsize=10)
    axes.set_ylabel(with_unit(metric.title, metric.unit), fontsize=10)
    axes.set_title(metric.title, fontsize=11.5, loc="left", fontweight="bold", y=1.0 + 4.4 * LEGEND_ROW)
    axes.tick_params(labelsize=9)
    axes.grid(True, which="major", color="#dddddd", linewidth=0.7)
    axes.grid(True, which="minor", color="#f0f0f0", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    draw_legend(axes, table, metric, colors, markers, strokes)


def draw_frontier(axes: Any, table: Table, metric: Metric) -> None:
    """Draw the frontier as steps behind the curves, and number its settings."""
    frontier = [row for row in table.frontier(metric) if row.errors[metric.name].value > 0.0 and row.cost.value > 0.0]
    if not frontier:
        return
    costs = [row.cost.value for row in frontier]
    errors = [row.errors[metric.name].value for row in frontier]
    axes.step(costs, errors, where="post", color=GOLD, linewidth=6.0, alpha=0.45, zorder=0, solid_capstyle="round")
    axes.plot(
        costs, errors, "o", markersize=10.5, markerfacecolor="none", markeredgecolor="black", linewidth=0, zorder=5
    )
    places = axes.transData.transform(list(zip(costs, errors, strict=True))) * (72.0 / axes.figure.dpi)
    below = -math.inf, -math.inf
    for number, (cost, error, place) in enumerate(zip(costs, errors, places, strict=True), start=1):
        # Below and left, where nothing is; above and right where the last number is too near
        crowded = math.dist(place, below) < 1.3 * NUMBER_SIZE
        if not crowded:
            below = tuple(place)
        axes.annotate(
            str(number),
            (cost, error),
            xytext=(6, 6) if crowded else (-6, -6),
            textcoords="offset points",
            ha="left" if crowded else "right",
            va="bottom" if crowded else "top",
            fontsize=NUMBER_SIZE,
            fontweight="bold",
            zorder=6,
        )


def draw_legend(axes: Any, table: Table, metric: Metric, colors: Any, markers: Any, strokes: Any) -> None:
    """Say over the axes what colours, markers and lines mean, one row each, and what the frontier looks like."""
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D

    subject = table.subject
    rows = [[Line2D([], [], label="Pareto frontier", color=GOLD, linewidth=6.0, alpha=0.6, solid_capstyle="butt")]]
    if any(table.is_apart(row, metric) for row in table.rows_of(metric)):
        text = f"faint: other levels of {subject.axis(metric.apart).title}, with truths of their own"
        rows[0].append(Line2D([], [], color=next(iter(colors.values())), alpha=0.3, marker="o", label=text))
    for name, meaning in ((metric.line, strokes), (metric.marker, markers), (metric.color, colors)):
        if not name or len(meaning) < 2:
            continue
        axis = subject.axis(name)
        row = [Line2D([], [], linewidth=0, label=f"{axis.title}:")]
        for level, value in meaning.items():
            if meaning is colors:
                line = Line2D([], [], color=value, linewidth=3.0, solid_capstyle="butt")
            elif meaning is markers:
                line = Line2D([], [], color=GREY, marker=value, linewidth=0)
            else:
                line = Line2D([], [], color=GREY, linestyle=value)
            line.set_label("does not apply" if level is None else axis.label(level))
            row.append(line)
        rows.append(row)
    for number, row in enumerate(rows):
        # A row above the other; the first entry of a row is its title, and needs no handle
        legend = Legend(
            axes,
            row,
            [str(line.get_label()) for line in row],
            loc="lower left",
            bbox_to_anchor=(-0.02, 1.0 + LEGEND_ROW * number),
            ncols=len(row),
            fontsize=8.8,
            frameon=False,
            borderpad=0.0,
            columnspacing=1.2,
            handlelength=1.8,
        )
        axes.add_artist(legend)


def draw_frontier_list(axes: Any, table: Table, metric: Metric, longest: int) -> None:
    """List the frontier's settings with their cost and error."""
    axes.set_axis_off()
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(longest + 1.0, -0.5)
    frontier = table.frontier(metric)
    rivals = [row for row in table.rows_of(metric) if not table.is_apart(row, metric)]
    columns = varying_axes(table, rivals)
    if len(columns) > MOST_COLUMNS:
        # Of many factors only those that tell the listed settings apart; one that does not apply to some is no reason
        columns = [axis for axis in columns if len({row.settings.get(axis.name) for row in frontier} - {None}) > 1]
    header = [
        "",
        *(axis.title for axis in columns),
        with_unit("Cost", table.subject.cost_unit),
        with_unit("Error", metric.unit),
    ]
    lines = [
        [
            str(number),
            *(str(row.settings.get(axis.name, "")) for axis in columns),
            significant(row.cost.value),
            significant(row.errors[metric.name].value),
        ]
        for number, row in enumerate(frontier, start=1)
    ]
    widths = [max(map(len, column)) + 2.5 for column in zip(header, *lines, strict=True)]
    place = 0.0
    numeric = {0, len(header) - 2, len(header) - 1}
    for index, (title, width) in enumerate(zip(header, widths, strict=True)):
        share = width / sum(widths)
        right = index in numeric or (lines and all(line[index].isdecimal() for line in lines))
        x = place + share * 0.8 if right else place
        for row, text in enumerate([title, *(line[index] for line in lines)]):
            axes.text(
                x,
                row,
                text,
                fontsize=8.6,
                ha="right" if right else "left",
                va="center",
                color=GREY if row == 0 else "black",
                fontweight="bold" if index == 0 else "normal",
            )
        place += share
    axes.plot([0.0, 1.0], [0.5, 0.5], color="#cccccc", linewidth=0.8)


def draw_effect(axes: Any, table: Table, metric: Metric) -> None:
    """Draw an error that belongs to the levels of one axis, one line a level."""
    axis = table.subject.axis(metric.by)
    rows = varying(table, metric)
    errors = [row.errors[metric.name] for row in rows]
    places = range(len(rows))
    axes.barh(
        places,
        [error.value for error in errors],
        xerr=[[error.value - error.low for error in errors], [error.high - error.value for error in errors]],
        color="#56B4E9",
        ecolor="black",
        height=0.6,
        error_kw={"linewidth": 1.0},
    )
    for place, error in zip(places, errors, strict=True):
        axes.annotate(
            significant(error.value),
            (error.high, place),
            xytext=(5, 0),
            textcoords="offset points",
            fontsize=9,
            va="center",
        )
    axes.set_yticks(list(places), [axis.label(row.settings[metric.by]) for row in rows], fontsize=9.5)
    axes.set_ylabel(axis.title, fontsize=10)
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.12 * max([error.high for error in errors] + [1e-12]))
    axes.set_title(metric.title, fontsize=11, loc="left", fontweight="bold")
    axes.tick_params(labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)
