"""What pages say of estimators: samplers, densities, and the chart of error against time."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from tables import Row, Rows, figure, number, slug, step, table

from beam_warp.materials.pilot import RATE
from beam_warp.study.picture import write_image
from beam_warp.study.table import read_table

BALL_AND_FIGURE = "estimators_cpu.json", "estimators_figure_cpu.json"


@table("sampling_occlusion", *BALL_AND_FIGURE)
def sampling_occlusion(ball: Row, human: Row) -> Rows:
    """Ambient occlusion by sampler and rays."""
    rows: list[list[Any]] = [["rays", "ball on a floor by a wall", "worth", "figure", "worth"]]
    for on_ball, on_figure in zip(ball["occlusion"]["rows"], human["occlusion"]["rows"], strict=True):
        cells = [(f"{row['psnr_db']:.1f} dB", f"{row['worth_iid_rays']:.0f}") for row in (on_ball, on_figure)]
        rows.append([on_ball["name"], *cells[0], *cells[1]])
    return rows


@table("sampling_irradiance", *BALL_AND_FIGURE)
def sampling_irradiance(ball: Row, human: Row) -> Rows:
    """Relative error of irradiance by estimator, under every sky."""
    skies = [(name, sky) for name, result in (("ball", ball), ("figure", human)) for sky in result["skies"].values()]
    rows: list[list[Any]] = [["", *(f"{name}: {sky['peak_over_mean']:,.0f}" for name, sky in skies)]]
    for place, row in enumerate(skies[0][1]["rows"]):
        rows.append([row["name"], *(f"{sky['rows'][place]['relative_rmse']:.3f}" for _, sky in skies)])
    return rows


@table("economy_light", "economy_cpu.json")
def economy_light(result: Row) -> Rows:
    """Light by rays for each Gaussian and by target, on every subject."""
    rows: list[list[Any]] = [
        ["", "rays", "error", "the same for each", "mean error", "stopped by itself", "faster", "base colour"]
    ]
    for name, found in result["captures"].items():
        same, *others = (row for row in found["light"]["rows"] if "scores" in row)
        words = [f"{name}, {same['name']}", f"{same['rays']}", f"{100 * same['rmse']:.1f} %", ""]
        rows.append(
            [*words, f"{same['mean_in_standard_errors']:+.1f}", "", "", f"{same['scores']['base_color']:.2f} dB"]
        )
        errors = [math.log(row["rmse"]) for row in others]
        rays, faster = (
            float(np.interp(math.log(same["rmse"]), errors, [row[key] for row in others])) for key in ("rays", "faster")
        )
        rows.append(
            [f"{name}, at that error", f"{rays:.0f}", words[2], f"{same['rays']}", "", "", f"{faster:.2f} ×", ""]
        )
        for row, alone in zip(others, found["light"]["stopped"], strict=True):
            rows.append(
                [
                    f"{name}, {row['name'].replace('target', 'light_error')}",
                    f"{row['rays']:.0f}",
                    f"{100 * row['rmse']:.1f} %",
                    f"{row['equal_rays']:.0f}",
                    f"{row['mean_in_standard_errors']:+.1f}",
                    f"{alone['mean_in_standard_errors']:+.1f}",
                    f"{row['faster']:.2f} ×",
                    f"{row['scores']['base_color']:.2f} dB",
                ]
            )
    return rows


@table("economy_large", "economy_h200.json")
def economy_large(result: Row) -> Rows:
    """Light of large frames by the default target, beside as many rays for each."""
    rows: list[list[Any]] = [["", "Gaussians lit", "rays", "error", "the same for each", "faster", "base colour"]]
    for name, found in result["captures"].items():
        row = step(found["light"]["rows"], "target_0.05")
        same = next(each for each in found["light"]["rows"] if "scores" in each)
        lost = row["scores"]["base_color"] - same["scores"]["base_color"]
        cells = [f"{row['rays']:.0f}", f"{100 * row['rmse']:.1f} %", f"{row['equal_rays']:.0f}"]
        rows.append([name, f"{found['points']:,}", *cells, f"{row['faster']:.2f} ×", f"{lost:+.3f} dB"])
    return rows


@table("economy_occlusion", "economy_cpu.json")
def economy_occlusion(result: Row) -> Rows:
    """Occlusion by the same rule, on every subject."""
    rows: list[list[Any]] = [["rays (the same for each)", *result["captures"]]]
    targets = [row["name"] for row in next(iter(result["captures"].values()))["occlusion"] if "equal_rays" in row]
    for target in targets:
        found = [step(subject["occlusion"], slug(target)) for subject in result["captures"].values()]
        rows.append([target, *(f"{row['rays']:.0f} ({row['equal_rays']:.0f})" for row in found)])
    return rows


@table("economy_bounce", "economy_bounce_h200.json")
def economy_bounce(result: Row) -> Rows:
    """The bounce without rays, by as many for each, and by as many as it needs."""
    rows: list[list[Any]] = [["", "rays", "error", "the same for each", "mean error", "base colour"]]
    for name, found in result["captures"].items():
        none, same, needed = found["bounce"]
        for words, row in ((", without", none), (", as many each", same), (", as many as needed", needed)):
            equal = same["rays"] * (same["rmse"] / needed["rmse"]) ** (1.0 / RATE) if row is needed else None
            cells = [f"{row['rays']:.0f}", f"{100 * row['rmse']:.1f} %", "" if equal is None else f"{equal:.0f}"]
            color = f"{row['scores']['base_color']:.2f} dB"
            rows.append([name + words, *cells, f"{row['mean_in_standard_errors']:+.1f}", color])
    return rows


@table("economy_pilot", "economy_pilot_cpu.json")
def economy_pilot(result: Row) -> Rows:
    """What a pilot costs and saves."""
    rows: list[list[Any]] = [["", "frames", "s", "stated error"]]
    for name, found in result["pilot"].items():
        for row in found:
            cells = [f"{row['frames']} of {row['of']}", f"{row['seconds']:.1f}", f"{row['stated']:.3f}"]
            rows.append([f"{name}, {row['name']}", *cells])
    return rows


@table("economy_views", "economy_views_cpu.json")
def economy_views(result: Row) -> Rows:
    """Base colour and occlusion by all training views and by parts of them."""
    rows: list[list[Any]] = [["", "base colour", "occlusion", "changed", "by more than its error", "s (views)"]]
    for name, found in result["captures"].items():
        for row in found["views"]:
            scores = [f"{row[key]:.2f} dB" for key in ("base_color", "ambient_occlusion")]
            change = (
                [f"{row['change_median']:.2f}", f"{100 * row['beyond_error']:.0f} %"]
                if row["change_median"]
                else ["", ""]
            )
            seconds = f"{row['seconds']:.1f} ({row['evidence_seconds']:.1f})"
            rows.append([f"{name}, {row['name']}", *scores, *change, seconds])
    return rows


@number("sampling_bias", *BALL_AND_FIGURE)
def sampling_bias(ball: Row, human: Row) -> float:
    """The largest mean error of the default estimator and of MIS at 64 rays, in its standard errors."""
    return max(
        abs(step(sky["rows"], name)["bias_in_standard_errors"])
        for result in (ball, human)
        for sky in result["skies"].values()
        for name in ("product_ratio_owen_64", "mis_ratio_owen_64")
    )


@figure("estimators.webp", BALL_AND_FIGURE[0])
def estimators(result: Row, path: Path) -> None:
    """Draw error against rays, both logarithmic: one panel for occlusion, one a sky."""
    import matplotlib.pyplot as plt

    counts = result["curve_counts"]
    panels = {"occlusion": result["occlusion"], **result["skies"]}
    drawing, axes = plt.subplots(1, len(panels), figsize=(4.4 * len(panels), 4.6), layout="constrained")
    colors = {name: f"C{i}" for i, name in enumerate(dict.fromkeys(n for p in panels.values() for n in p["curves"]))}
    for axis, (name, panel) in zip(axes, panels.items(), strict=True):
        for label, errors in panel["curves"].items():
            axis.loglog(counts, errors, "o-", ms=3.5, label=label, color=colors[label])
        first = next(iter(panel["curves"].values()))[0]
        axis.loglog(counts, [first * math.sqrt(counts[0] / c) for c in counts], "--", color="0.6", label="1/√rays")
        peak = "" if name == "occlusion" else f", peak {panel['peak_over_mean']:g} × mean"
        axis.set_title(name + peak)
        axis.set_xlabel("rays a point")
        axis.set_xticks(counts, [str(c) for c in counts])
        axis.minorticks_off()
        axis.grid(True, which="both", alpha=0.25)
        axis.legend(fontsize=7)
    axes[0].set_ylabel("error (RMS; irradiance: relative)")
    drawing.savefig(path, dpi=110)
    plt.close(drawing)


@figure("chart_tracing.webp", "chart_tracing_cpu.json")
def chart_tracing(result: Row, path: Path) -> None:
    """Draw what the command draws."""
    with tempfile.TemporaryDirectory() as folder:
        rows = Path(folder) / "tracing.csv"
        rows.write_text("\n".join(result["table"]) + "\n", encoding="utf-8")
        write_image(read_table(rows), path)
