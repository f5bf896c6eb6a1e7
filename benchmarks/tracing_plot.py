"""The growth rows of the tracing benchmark as one picture: time, build, memory and error."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from beam_warp.kernels.common.constants import TRANSMITTANCE_STOP

LABELS = {
    "wide product": "ours",
    "wide fast product": "ours, fast build",
    "wide": "quality build",
    "wide fast": "fast build",
}


def draw_growth(result: dict[str, Any], path: Path) -> None:
    """Draw median time per ray over count, overlap and opacity, and build time, memory and error over the count.

    Args:
        result: What ``tracing.py`` writes as JSON; its ``growth`` holds the rows, with overlaps and opacities.
        path: PNG to write.
    """
    from matplotlib import pyplot as plt

    rows = result["growth"]
    counts = [row for row in rows if row["overlap"] == 1.0 and row["opacity"] == 0.9]
    size = next(row["gaussians"] for row in rows if row["overlap"] != 1.0)
    sweep = [row for row in rows if row["gaussians"] == size]
    overlaps = [row for row in sweep if row["opacity"] == 0.9]
    opacities = [row for row in sweep if row["overlap"] == 1.0]
    figure, panels = plt.subplots(2, 3, figsize=(15, 8.5), layout="constrained")
    (by_count, by_overlap, by_opacity), (building, memory, error) = panels
    of_size = f"{size:,} Gaussians"
    _draw(by_count, counts, "gaussians", "contenders", lambda row, v: v["nanoseconds_per_ray"]["median"])
    _draw(by_overlap, overlaps, "overlap", "contenders", lambda row, v: v["nanoseconds_per_ray"]["median"])
    _draw(by_opacity, opacities, "opacity", "contenders", lambda row, v: v["nanoseconds_per_ray"]["median"])
    _draw(building, counts, "gaussians", "scenes", lambda row, v: v["build_ms"]["median"])
    _draw(memory, counts, "gaussians", "scenes", lambda row, v: v["bytes_per_gaussian"] * row["gaussians"] / 2**20)
    _draw(error, counts, "gaussians", "contenders", lambda row, v: v["largest_error"])
    error.axhline(TRANSMITTANCE_STOP, color="0.4", linestyle=":", label="the stop")
    for axes, title, across, up in (
        (by_count, "overlap 1, opacity 0.9", "Gaussians", "time per ray [ns]"),
        (by_overlap, f"{of_size}, opacity 0.9", "overlap: standard deviation / spacing", "time per ray [ns]"),
        (by_opacity, f"{of_size}, overlap 1", "opacity", "time per ray [ns]"),
        (building, "scene from arrays in host memory", "Gaussians", "build time [ms]"),
        (memory, "scene held on the device", "Gaussians", "memory [MiB]"),
        (error, "largest error against float64", "Gaussians", "|V - V float64|"),
    ):
        axes.set(title=title, xlabel=across, ylabel=up)
        axes.grid(True, which="both", alpha=0.25)
    for axes in (by_overlap, building, error):  # colours mean the same in the whole row
        axes.legend()
    device = result["measured"]["machine"]["device"]
    figure.suptitle(f"Visibility of cosine rays on a torus of Gaussians: {device}, median wall-clock time")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw(axes: Any, rows: list[dict[str, Any]], key: str, group: str, value: Callable[[Any, Any], float]) -> None:
    """Draw one line for each entry of a group; both axes logarithmic with plain numbers at the rows' values."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    rows = sorted(rows, key=lambda row: row[key])
    x = [row[key] for row in rows]
    for order, name in enumerate(rows[0][group]):
        # Later lines are thinner, so that equal ones stay visible under each other.
        heights = [value(row, row[group][name]) for row in rows]
        axes.plot(
            x, heights, marker="o", linewidth=max(1.0, 3.5 - 0.6 * order), markersize=5, label=LABELS.get(name, name)
        )
    axes.set(xscale="log", yscale="log")
    plain = FuncFormatter(lambda number, _: f"{number:,.6g}" if number >= 1e-3 else f"{number:.0e}")
    axes.set_xticks(x, [short_number(number) for number in x])
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(plain)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_locator(NullLocator())


def short_number(number: float) -> str:
    """Return 140000 as 140k and 4000000 as 4M."""
    for unit, letter in ((1e6, "M"), (1e3, "k")):
        if number >= unit:
            return f"{number / unit:g}{letter}"
    return f"{number:g}"
