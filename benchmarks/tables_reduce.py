"""What the page on reducing says of reduced assets beside their rivals."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tables import Row, Rows, cell, figure, table

REDUCE = "reduce_cpu.json"


def means(result: Row, share: float, contender: str, part: str, number: str) -> float | None:
    """Return a number of a contender, the mean over assets; None where it could not be measured."""
    rows = [row for row in result["sizes"]["rows"] if (row["share"], row["contender"]) == (share, contender)]
    found = [row[part][number] for row in rows if part in row]
    return sum(found) / len(found) if found else None


def told_apart(rows: Iterable[Row], key: str) -> list[Any]:
    """Return the values of a key, in the order in which they come."""
    return list(dict.fromkeys(row[key] for row in rows))


@table("reduce_sizes", REDUCE)
def sizes(result: Row) -> Rows:
    """Return PSNR against the original and loss of every contender, the mean over assets."""
    rows: list[list[Any]] = [["kept", "by", "PSNR [dB]", "loss [dB]", "refitted: PSNR [dB]", "loss [dB]", "95 % below"]]
    for share in told_apart(result["sizes"]["rows"], "share"):
        for contender in told_apart(result["sizes"]["rows"], "contender"):
            numbers = (("bare", "psnr", ".1f"), ("bare", "loss", ".2f"), ("refit", "psnr", ".1f"))
            numbers = (*numbers, ("refit", "loss", ".2f"), ("refit", "loss_95", ".2f"))
            found = [cell(means(result, share, contender, part, name), form) for part, name, form in numbers]
            rows.append([f"{share:.0%}", contender, *found])
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
        axis.set_ylim(10.0)
    axes[0, 0].set_ylabel("PSNR against the original [dB]")
    drawing.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(names), fontsize=8)
    drawing.savefig(path, dpi=110)
    plt.close(drawing)
