"""What the page on reducing says of reduced assets beside their rivals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tables import Row, Rows, cell, figure, table

REDUCE = "reduce_h200.json"


def told_apart(rows: Iterable[Row], key: str) -> list[Any]:
    """Return the values of a key, in the order in which they come."""
    return list(dict.fromkeys(row[key] for row in rows))


@table("reduce_sizes", REDUCE)
def sizes(result: Row) -> Rows:
    """Return PSNR against the original and loss against the truth of every contender, by asset."""
    head = ["asset", "kept", "by", "PSNR [dB]", "loss [dB]", "refitted: PSNR [dB]", "loss [dB]", "counted loss [dB]"]
    rows: list[list[Any]] = [head]
    found_rows = result["sizes"]["rows"]
    assets = told_apart(found_rows, "asset")
    for row in sorted(found_rows, key=lambda row: (assets.index(row["asset"]), -row["share"])):
        if "refit" in row:
            numbers = (("bare", "psnr", ".1f"), ("bare", "truth_loss", ".2f"), ("refit", "psnr", ".1f"))
            numbers = (*numbers, ("refit", "truth_loss", ".2f"), ("refit", "loss", ".2f"))
            found = [cell(row[part].get(name), form) for part, name, form in numbers]
            rows.append([row["asset"], f"{row['share']:.0%}", row["contender"], *found])
    return rows


@table("reduce_certified", REDUCE)
def certified(result: Row) -> Rows:
    """Return whole calls: seconds, what they state, and what fresh draws say."""
    rows: list[list[Any]] = [["asset", "asked", "Gaussians", "seconds", "bound [dB]", "stated for", "held in"]]
    for row in result["certified"]["rows"]:
        if "bound" in row:
            ((name, value),) = row["target"].items()
            asked = f"`--{name.replace('_', '-')} {value:g}`" if name == "max_loss" else f"`--{name} {value}`"
            kept = f"{row['gaussians']:,} ({row['gaussians'] / row['of']:.0%})"
            cells = [f"{row['seconds']:.0f}", cell(row["bound"], ".2f")]
            rows.append([row["asset"], asked, kept, *cells, f"{row['share_stated']:.1%}", f"{row['within']:.1%}"])
    return rows


@table("keyed_takes", "keys_cpu.json")
def keyed(result: Row) -> Rows:
    """Return takes with a time sample at every frame and with keys: size, samples, errors, losses."""
    arrays = {"positions": "positions", "orientations": "turns", "normals": "normals", "ambient_occlusion": "occlusion"}
    head = ["take", "Gaussians", "error scale", "KB a frame", *arrays.values(), "of the bound"]
    rows: list[list[Any]] = [[*head, "counted loss [dB]", "measured loss [dB]", "written [s a frame]"]]
    for name in ("dance", "calm", "walk"):
        found = result.get(name, {"rows": []})
        for row in found["rows"]:
            scale = "every frame" if row["factor"] is None else f"{row['factor']:g}"
            samples = [str(row["samples"][array]) for array in arrays]
            # Bounds of keys are root mean squares: those of what is spread evenly within the bounds of a container.
            most = f"{math.sqrt(3.0) * max(row['of_bound'].values()):.2f}" if "of_bound" in row else ""
            counted = f"{row['counted_mean']:.2f}, {row['counted_worst']:.2f}"
            numbers = [cell(row["loss"], ".2f"), cell(row["write_seconds_a_frame"], ".2f")]
            first = [name, f"{found['gaussians']:,}", scale, cell(row["kb_a_frame"], ".0f"), *samples, most]
            rows.append([*first, counted, *numbers])
    return rows


@figure("reducing.webp", REDUCE)
def draw_sizes(result: Row, path: Path) -> None:
    """Show the PSNR of every contender by asset: bare as outlines, refitted as bars."""
    import matplotlib.pyplot as plt

    rows = result["sizes"]["rows"]
    assets, shares, names = (told_apart(rows, key) for key in ("asset", "share", "contender"))
    drawing, axes = plt.subplots(1, len(shares), figsize=(9.0, 2.9), sharey=True, layout="constrained", squeeze=False)
    for axis, share in zip(axes[0], shares, strict=True):
        for place, name in enumerate(names):
            some = [row for row in rows if (row["share"], row["contender"]) == (share, name) and "refit" in row]
            at = [assets.index(row["asset"]) + 0.16 * (place - 0.5 * (len(names) - 1)) for row in some]
            axis.bar(at, [row["refit"]["psnr"] for row in some], 0.14, color=f"C{place}", label=name)
            axis.bar(at, [row["bare"]["psnr"] for row in some], 0.14, color="none", edgecolor="black", linewidth=0.6)
        axis.set_xticks(range(len(assets)), assets)
        axis.set_title(f"{share:.0%} of the Gaussians", fontsize=10)
        axis.set_ylim(15.0)
    axes[0, 0].set_ylabel("PSNR against the original [dB]")
    drawing.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(names), fontsize=8)
    drawing.savefig(path, dpi=110)
    plt.close(drawing)
