"""The materials benchmark as pictures: true geometry, what each idea brings, cost, and what rows look like.

    python benchmarks/materials_plot.py [RESULT.json ...] [--pictures DIR] [--out docs/images]

Without files, draws what lies in ``results/materials_*.json``; parts that a result lacks are left out. Writes
``materials_perfect.png``, ``materials_ablation.png``, ``materials_cost.png`` and, from the strips that the benchmark
wrote beside its JSON, ``materials_rows.png``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent

Row = Mapping[str, Any]

WAYS = ("direct", "image path")
COLORS = {"direct": "C0", "image path": "C1"}
GROUPS = {"ladder": "C0", "one idea taken away": "C2", "image path": "C1"}


def draw_all(results: Sequence[Row], out: Path, pictures: Path | None = None) -> list[Path]:
    """Draw what the results have, a later result's part before an earlier one's; returns the files written."""
    parts = {name: part for result in results for name, part in result.items() if isinstance(part, dict)}
    device = device_name(results[-1])
    out.mkdir(parents=True, exist_ok=True)
    written = []
    if parts.get("perfect", {}).get("captures"):
        written.append(draw_perfect(parts["perfect"], device, out / "materials_perfect.png"))
    if parts.get("ablation", {}).get("captures"):
        written.append(draw_ablation(parts["ablation"], device, out / "materials_ablation.png"))
    if "direct" in parts.get("cost", {}).get("parts", {}):
        written.append(draw_cost(parts["cost"], device, out / "materials_cost.png"))
    if pictures is not None and pictures.is_dir():
        for name, rows in pictured(parts, pictures):
            written.append(draw_rows(rows, pictures, out / f"materials_rows_{name}.png"))
    return written


def draw_perfect(part: Row, device: str, path: Path) -> Path:
    """Draw errors of light on every environment, and scores against what was wanted."""
    plt = _pyplot()
    figure, panels = plt.subplots(1, 3, figsize=(16, 5.4), layout="constrained")
    wanted = part["targets"]
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
    panels[0].axhline(100.0 * wanted["irradiance_relative_rmse"], color="0.3", linestyle=":", label="wanted")
    panels[0].set_xticks(range(len(names)), names)
    rays = next(iter(next(iter(part["captures"].values()))["irradiance"].values()))["rays"]
    panels[0].set(yscale="log", title=f"irradiance at {rays} rays, relative RMS error [%]")
    panels[0].legend(fontsize=8)
    for axes, channel, title, lines in (
        (panels[1], "ambient_occlusion", "ambient occlusion", [wanted["ambient_occlusion_psnr"]]),
        (panels[2], "base_color", "base colour", [wanted["base_color_psnr_with_bounce"]]),
    ):
        labels, values, colors = [], [], []
        for name, row in part["captures"].items():
            for entry in row["rows"]:
                labels.append(f"{name}: {entry['name']}")
                values.append(entry[channel]["true_coverage_psnr"])
                colors.append("C0" if entry["bounce"] else "C1")
        _bars(axes, labels if axes is panels[1] else [""] * len(labels), values, colors)
        for line in lines:
            axes.axvline(line, color="0.3", linestyle=":")
        axes.set(title=f"{title}, true coverage, PSNR [dB]", xlim=(0.9 * min(values), None))
    figure.suptitle(f"Gaussians sampled from the true surface, {device}; orange is direct light only, dots are wanted")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def draw_ablation(part: Row, device: str, path: Path) -> Path:
    """Draw scores, scale, time and memory of every row, a column of panels a measure and a row of them a capture."""
    plt = _pyplot()
    captures = part["captures"]
    longest = max(len(capture["rows"]) for capture in captures.values())
    figure, panels = plt.subplots(
        len(captures), 5, figsize=(22, 1.2 + 0.27 * longest * len(captures)), layout="constrained", squeeze=False
    )
    wanted = part["targets"]
    for line, (name, capture) in zip(panels, captures.items(), strict=True):
        rows = [row for row in capture["rows"] if "base_color" in row]
        labels = [f"{row['group']}: {row['name']}" for row in rows]
        colors = [GROUPS[row["group"]] for row in rows]
        for axes, title, values, marks in (
            (line[0], "AO [dB]", [r["ambient_occlusion"]["psnr"] for r in rows], wanted["ambient_occlusion"][:1]),
            (line[1], "base colour [dB]", [r["base_color"]["psnr"] for r in rows], wanted["base_color"][:1]),
            (line[2], "scale", [float(np.mean(r["base_color"]["scale"])) for r in rows], wanted["scale"]),
            (line[3], "relit, traced [dB]", [_relit(r) for r in rows], wanted["relit"][:1]),
            (line[4], "seconds a frame", [r["seconds_per_frame"] for r in rows], []),
        ):
            _bars(axes, labels if axes is line[0] else [""] * len(labels), values, colors)
            for mark in marks:
                axes.axvline(mark, color="0.3", linestyle=":")
            axes.set_title(f"{name}: {title}", fontsize=10)
            if title.startswith("seconds"):
                axes.set_xscale("log")
            elif np.isfinite(values).any():
                low, high = np.nanmin(values), np.nanmax(values)
                axes.set_xlim(low - 0.1 * (high - low) - 0.01, high + 0.12 * (high - low) + 0.01)
    figure.suptitle(f"One idea at a time, reconstructions, {device}; in the subject's box, unscaled; dots are wanted")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _relit(row: Row) -> float:
    """Return the mean PSNR of path traced relighting over lights; NaN where a row was not relit.

    Results of before the path tracer have light gathered at every Gaussian, ``traced``, in its place.
    """
    relit = row.get("relit", {})
    return float(relit.get("path", relit.get("traced", {})).get("mean", {}).get("psnr", np.nan))


def draw_cost(part: Row, device: str, path: Path) -> Path:
    """Draw stages of a frame at the paper's scale, and how time grows."""
    plt = _pyplot()
    parts = part["parts"]
    figure, panels = plt.subplots(1, 4, figsize=(19, 5), layout="constrained", width_ratios=(1.7, 1, 1, 1))
    names = [name for name, row in parts.items() if "stages" in row]
    stages = list(dict.fromkeys(stage for name in names for stage in parts[name]["stages"]))
    colors = plt.get_cmap("tab20").colors
    for place, name in enumerate(names):
        begin = 0.0
        for number, stage in enumerate(stages):
            seconds = parts[name]["stages"].get(stage, 0.0)
            panels[0].barh(place, seconds, left=begin, color=colors[number % 20])
            begin += seconds
        peak = parts[name].get("peak_device_bytes")
        panels[0].text(begin, place, f" {begin:.3g} s" + (f", {peak / 2**30:.1f} GiB" if peak else ""), va="center")
        panels[0].plot([parts[name]["target_seconds"]] * 2, [place - 0.4, place + 0.4], color="0.2", linestyle=":")
    panels[0].legend(
        [plt.Rectangle((0, 0), 1, 1, color=colors[k % 20]) for k in range(len(stages))], stages, fontsize=7
    )
    panels[0].set_yticks(range(len(names)), names)
    panels[0].invert_yaxis()
    panels[0].margins(x=0.25)
    scene = parts["scene"]
    width, height = scene["size"]
    panels[0].set(
        xlabel="seconds; dots are wanted",
        title=f"{scene['gaussians']:,} Gaussians, {scene['views']} views of {width} x {height}",
    )
    for axes, across in zip(panels[1:], ("gaussians", "views", "rays"), strict=True):
        for way in WAYS:
            rows = [row for row in parts.get("series", {}).get(across, []) if row["way"] == way]
            if rows:
                axes.plot([r[across] for r in rows], [r["seconds"] for r in rows], "o-", color=COLORS[way], label=way)
        axes.set(xscale="log", yscale="log", xlabel=across.capitalize(), ylabel="seconds")
        axes.grid(True, which="both", alpha=0.25)
        if axes.get_legend_handles_labels()[0]:
            axes.legend()
    figure.suptitle(f"Cost of one frame, {device}")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def pictured(parts: Row, pictures: Path) -> Iterator[tuple[str, list[tuple[str, Path]]]]:
    """Yield for every capture its name, and captions and files of the truth and of every row that has a picture."""
    for part in ("perfect", "ablation"):
        for name, capture in parts.get(part, {}).get("captures", {}).items():
            rows = [("the truth", capture.get("truth_picture"))]
            rows += [(caption(row), row.get("picture")) for row in capture["rows"]]
            found = [(text, pictures / file) for text, file in rows if file and (pictures / file).exists()]
            if len(found) > 1:
                yield f"{part}_{name}", found


def caption(row: Row) -> str:
    """Return what stands over a row's picture."""
    if "base_color" not in row:
        return str(row["name"])
    scores = f"{row['ambient_occlusion']['psnr']:.1f}, {row['base_color']['psnr']:.1f} dB, {row['seconds']:.2g} s"
    return f"{row.get('group', '')}\n{row['name']}\n{scores}".strip()


def draw_rows(rows: Sequence[tuple[str, Path]], pictures: Path, path: Path, columns: int = 7) -> Path:
    """Draw strips of ambient occlusion and base colour in a grid."""
    plt = _pyplot()
    images = [plt.imread(file) for _, file in rows]
    lines = -(-len(rows) // columns)
    height, width = images[0].shape[:2]
    figure, panels = plt.subplots(
        lines,
        columns,
        figsize=(2.6 * columns, (2.6 * height / width + 0.7) * lines),
        layout="constrained",
        squeeze=False,
    )
    for axes in panels.flat:
        axes.set_axis_off()
    for axes, image, (text, _) in zip(panels.flat, images, rows, strict=False):
        axes.imshow(image)
        axes.set_title(text, fontsize=6.5)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def device_name(result: Row) -> str:
    """Return how a result's device is called."""
    machine = result["machine"]
    return "CPU" if machine["device"] == "cpu" else machine["device"].removeprefix("NVIDIA ")


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


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="*", default=sorted((HERE / "results").glob("materials_*.json")))
    parser.add_argument("--pictures", type=Path, help="folder of the rows' strips")
    parser.add_argument("--out", type=Path, default=HERE.parent / "docs" / "images")
    arguments = parser.parse_args()
    results = [json.loads(path.read_text(encoding="utf-8")) for path in arguments.results]
    if not results:
        parser.error("there must be a result to draw, got none; run materials.py --out first")
    for path in draw_all(results, arguments.out, arguments.pictures):
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
