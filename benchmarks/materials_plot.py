"""The materials benchmark as pictures: true geometry, what each idea brings, cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Row = Mapping[str, Any]

SHEET_WIDTH = 1900
"""Width of pictures of materials [pixel]."""

GROUPS = {"ladder": "C0", "one idea taken away": "C2", "image path": "C1"}


def draw_perfect(part: Row, path: Path) -> None:
    """Draw errors of light on every environment, and scores of materials."""
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, 3, figsize=(16, 5.4), layout="constrained")
    lights: dict[str, dict[str, list[float]]] = {}
    for row in part["captures"].values():
        for light, found in row["irradiance"].items():
            for way, errors in found["ways"].items():
                lights.setdefault(way, {}).setdefault(light, []).append(100.0 * errors["relative_rmse"])
    names = list(next(iter(lights.values())))
    width = 0.8 / len(lights)
    for number, (way, by_light) in enumerate(lights.items()):
        places = np.arange(len(names)) + width * (number - 0.5 * (len(lights) - 1))
        panels[0].bar(places, [np.mean(by_light[name]) for name in names], width, label=way)
    panels[0].set_xticks(range(len(names)), names)
    rays = next(iter(next(iter(part["captures"].values()))["irradiance"].values()))["rays"]
    panels[0].set(yscale="log", title=f"irradiance at {rays} rays, relative RMS error [%]")
    panels[0].legend(fontsize=8)
    for axes, channel, title in (
        (panels[1], "ambient_occlusion", "ambient occlusion"),
        (panels[2], "base_color", "base colour"),
    ):
        labels, values, colors = [], [], []
        for name, row in part["captures"].items():
            for entry in row["rows"]:
                labels.append(f"{name}: {entry['name']}")
                values.append(entry[channel]["true_coverage_psnr"])
                colors.append("C0" if entry["bounce"] else "C1")
        _bars(axes, labels if axes is panels[1] else [""] * len(labels), values, colors)
        axes.set(title=f"{title}, true coverage, PSNR [dB]", xlim=(0.9 * min(values), None))
    figure.suptitle("Gaussians sampled from the true surface; orange is direct light only")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_ablation(part: Row, path: Path) -> None:
    """Draw scores and scale of every row, a column of panels a measure and a row of them a capture."""
    from matplotlib import pyplot as plt

    captures = part["captures"]
    longest = max(len(capture["rows"]) for capture in captures.values())
    figure, panels = plt.subplots(
        len(captures), 4, figsize=(18, 1.2 + 0.27 * longest * len(captures)), layout="constrained", squeeze=False
    )
    for line, (name, capture) in zip(panels, captures.items(), strict=True):
        rows = [row for row in capture["rows"] if "base_color" in row]
        labels = [f"{row['group']}: {row['name']}" for row in rows]
        colors = [GROUPS[row["group"]] for row in rows]
        relit = [row.get("relit", {}).get("mean", {}).get("psnr", np.nan) for row in rows]
        for axes, title, values in (
            (line[0], "AO [dB]", [row["ambient_occlusion"]["psnr"] for row in rows]),
            (line[1], "base colour [dB]", [row["base_color"]["psnr"] for row in rows]),
            (line[2], "scale", [float(np.mean(row["base_color"]["scale"])) for row in rows]),
            (line[3], "relit, deferred [dB]", relit),
        ):
            _bars(axes, labels if axes is line[0] else [""] * len(labels), values, colors)
            axes.set_title(f"{name}: {title}", fontsize=10)
            axes.set_ylim(len(rows) - 0.4, -0.6)  # also where the last rows have no bar
            if np.isfinite(values).any():
                low, high = np.nanmin(values), np.nanmax(values)
                axes.set_xlim(low - 0.1 * (high - low) - 0.01, high + 0.12 * (high - low) + 0.01)
    figure.suptitle("One idea at a time, reconstructions; in the subject's box, unscaled")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_cost(part: Row, path: Path) -> None:
    """Draw the stages of one frame in every way."""
    from matplotlib import pyplot as plt

    ways = {name: row for name, row in part.items() if isinstance(row, Mapping) and "stages" in row}
    figure, axes = plt.subplots(figsize=(9, 0.6 + 0.55 * len(ways)), layout="constrained")
    stages = list(dict.fromkeys(stage for row in ways.values() for stage in row["stages"]))
    colors = plt.get_cmap("tab20").colors
    for place, row in enumerate(ways.values()):
        begin = 0.0
        for number, stage in enumerate(stages):
            seconds = row["stages"].get(stage, 0.0)
            axes.barh(place, seconds, left=begin, color=colors[number % 20])
            begin += seconds
        peak = row.get("peak_device_bytes")
        axes.text(begin, place, f" {begin:.3g} s" + (f", {peak / 2**30:.1f} GiB" if peak else ""), va="center")
    bars = [plt.Rectangle((0, 0), 1, 1, color=colors[k % 20]) for k in range(len(stages))]
    axes.legend(bars, stages, fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes.set_yticks(range(len(ways)), [f"{name}, {row['views']} views" for name, row in ways.items()])
    axes.invert_yaxis()
    axes.margins(x=0.25)
    width, height = part["scene"]["size"]
    axes.set(xlabel="seconds", title=f"One frame, {part['scene']['gaussians']:,} Gaussians, {width} x {height}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_sheet(sheet: Path, path: Path) -> None:
    """Write a sheet that the evaluation drew, smaller: it lies in the repository."""
    from PIL import Image

    with Image.open(sheet) as picture:
        small = picture.convert("RGB")
        small.thumbnail((SHEET_WIDTH, small.height))
        small.save(path)


def _bars(axes: Any, labels: Sequence[str], values: Sequence[float], colors: Sequence[str]) -> None:
    """Draw horizontal bars from the top, each with its value."""
    axes.barh(range(len(values)), values, color=colors)
    for place, value in enumerate(values):
        if not np.isfinite(value):
            continue
        axes.text(value, place, f" {value:.3g}", va="center", fontsize=7)
    axes.set_yticks(range(len(values)), labels, fontsize=7)
    axes.invert_yaxis()
    axes.margins(x=0.12)
