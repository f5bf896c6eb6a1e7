"""The raster benchmark as two pictures: how time grows with Gaussians and pixels, and which stages take it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from raster_stages import BACKWARD, FORWARD, REST
from tracing_plot import short_number

PARTS = {"forward": "forwards", "training": "forwards and backwards"}
"""Timed parts in growth rows, and their titles."""

COLORS = [f"C{number}" for number in (0, 1, 2, 3, 4, 5, 6, 9)]
"""Colours of stages in their order; greys are left to the rest."""


class Way(NamedTuple):
    """One way to draw, as a line: its name in the results, the clock it is read from, and how it looks."""

    name: str
    clock: str
    label: str
    color: str
    style: str


ON_CUDA = (
    Way("ours graph", "wall_ms", "CUDA graph", "C0", "-"),
    Way("ours redraw", "wall_ms", "launched by the host", "C0", ":"),
    Way("gsplat", "wall_ms", "gsplat", "C1", "-"),
)
ON_CPU = (
    Way("ours redraw", "wall_two_threads_ms", "two threads", "C2", "-"),
    Way("ours redraw", "wall_ms", "one thread", "C2", ":"),
)


def draw_growth(results: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw time over Gaussians and over pixels, forwards and with the way back.

    Args:
        results: What ``raster.py`` writes as JSON; those without growth rows are left out.
        path: PNG to write.
    """
    from matplotlib import pyplot as plt

    results = [result for result in results if _measured(result, "growth")]
    figure, panels = plt.subplots(2, 2, figsize=(12, 8.5), layout="constrained")
    for row, (part, called) in zip(panels, PARTS.items(), strict=True):
        for axes, series in zip(row, ("gaussians", "pixels"), strict=True):
            for result in results:
                for way in ON_CPU if result["measured"]["machine"]["device"] == "cpu" else ON_CUDA:
                    _draw_line(axes, result["growth"][series], series, part, way, device_name(result))
            sizes = [f"{device_name(result)} {_still(result['growth'][series], series)}" for result in results]
            axes.set(ylabel="time [ms]", xlabel=_axis_label(series))
            axes.set_title(f"{called}: {'; '.join(sizes)}", fontsize=10)
            _log_axes(axes)
    panels[0, 0].legend()
    figure.suptitle(
        "11 channels, depth, median depth and alpha of a figure; lines are medians, areas ranges of repeats"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_stages(results: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw each stage's part of a frame, a bar a device and direction.

    Args:
        results: What ``raster.py`` writes as JSON; those without stages are left out.
        path: PNG to write.
    """
    from matplotlib import pyplot as plt

    bars = [bar for result in results if _measured(result, "stages") for bar in _stage_bars(result)]
    figure, panels = plt.subplots(2, 1, figsize=(12, 2.5 + 0.55 * len(bars)), layout="constrained")
    for axes, way, order in zip(panels, ("forward", "backward"), (FORWARD, BACKWARD), strict=True):
        for place, (_, part) in enumerate(bars):
            begin = 0.0
            total = sum(part[way]["ms"].values())
            for number, stage in enumerate((*order, REST)):
                width = 100.0 * part[way]["ms"].get(stage, 0.0) / total
                color = "0.8" if stage == REST else COLORS[number]
                axes.barh(place, width, left=begin, color=color, label=stage if not place else None)
                if width > 6.0:
                    text = _plain(part[way]["ms"][stage])
                    axes.text(begin + 0.5 * width, place, text, ha="center", va="center", color="white", fontsize=8)
                begin += width
        names = [f"{label}\n{_plain(part[way]['total_ms'])} ms" for label, part in bars]
        axes.set_yticks(range(len(bars)), names, fontsize=8)
        axes.invert_yaxis()
        axes.set(xlim=(0.0, 100.0), xlabel="part of the time [%]; numbers in bars are ms", title=f"{way}s")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def device_name(result: Mapping[str, Any]) -> str:
    """Return how a result's device is called in a legend."""
    machine = result["measured"]["machine"]
    return "CPU" if machine["device"] == "cpu" else machine["device"].removeprefix("NVIDIA ")


def _stage_bars(result: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the label of each case and its stages; of the CPU's those of two threads."""
    scene = result["stages"]["scene"]
    for case, part in result["stages"].items():
        if isinstance(part, dict) and "forward" in part and not case.endswith(", 1 threads"):
            case = case.replace(", 2 threads", " (two threads)")
            yield (
                f"{device_name(result)}: {case}, {scene['splats'] // 1000}k at {scene['width']} x {scene['height']}",
                part,
            )


def _measured(result: Mapping[str, Any], section: str) -> bool:
    """Return whether a section is there and did not fail."""
    return section in result and "failed" not in result[section]


def _draw_line(axes: Any, rows: Sequence[Mapping[str, Any]], series: str, part: str, way: Way, device: str) -> None:
    """Draw medians as a line and ranges as an area; nothing where nothing was measured."""
    points = []
    for row in rows:
        entry = row["ms"].get(f"{way.name}, {part}", {}).get(way.clock)
        if entry is not None:
            across = row["splats"] if series == "gaussians" else row["width"] * row["height"]
            points.append((across, entry["median"], entry["lowest"], entry["highest"]))
    if not points:
        return
    x, middle, low, high = zip(*sorted(points), strict=True)
    axes.plot(x, middle, way.style, color=way.color, marker="o", markersize=5, label=f"{device}, {way.label}")
    axes.fill_between(x, low, high, color=way.color, alpha=0.12, linewidth=0)


def _still(rows: Sequence[Mapping[str, Any]], series: str) -> str:
    """Return what is the same in all rows."""
    row = rows[0]
    if series == "gaussians":
        return f"{row['width']} x {row['height']}"
    return f"{row['splats'] // 1000}k Gaussians"


def _axis_label(series: str) -> str:
    return "Gaussians" if series == "gaussians" else "pixels"


def _log_axes(axes: Any) -> None:
    """Make both axes logarithmic, with plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set(xscale="log", yscale="log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda number, _: short_number(number)))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda number, _: f"{number:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="major", alpha=0.4)
    axes.grid(True, which="minor", alpha=0.12)


def _plain(number: float) -> str:
    """Return three digits, or all of a larger number's."""
    return f"{number:.3g}" if number < 1000.0 else f"{number:.0f}"
