"""The growth rows of the tracing benchmark as one picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

LABELS = {"wide product": "beam-warp, wide", "warp product": "beam-warp, wp.Bvh"}


def draw_growth(result: dict[str, Any], path: Path) -> None:
    """Draw time per ray, build time and memory over the count, and time per ray over overlap and opacity."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rows = result["growth"]
    counts = [row for row in rows if row["overlap"] == 1.0 and row["opacity"] == 0.9]
    size = max((row["gaussians"] for row in rows if row["overlap"] != 1.0), default=counts[-1]["gaussians"])
    sweep = [row for row in rows if row["gaussians"] == size]
    figure, ((rays, builds), (overlaps, opacities)) = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    for axes, chosen, key, label in (
        (rays, counts, "gaussians", "Gaussians"),
        (overlaps, [r for r in sweep if r["opacity"] == 0.9], "overlap", "overlap (standard deviation / spacing)"),
        (opacities, [r for r in sweep if r["overlap"] == 1.0], "opacity", "opacity"),
    ):
        ordered = sorted(chosen, key=lambda row, key=key: row[key])
        x = [row[key] for row in ordered]
        for name in ordered[0]["contenders"]:
            axes.loglog(
                x,
                [row["contenders"][name]["nanoseconds_per_ray"] for row in ordered],
                marker="o",
                label=LABELS.get(name, name),
            )
        axes.set_xlabel(label)
        axes.set_ylabel("time per ray [ns]")
        if len(x) < 5:
            axes.set_xticks(x, [f"{value:,g}" for value in x], minor=False)
            axes.set_xticks([], minor=True)
    overlaps.set_title(f"{size:,} Gaussians, opacity 0.9")
    opacities.set_title(f"{size:,} Gaussians, overlap 1")
    rays.set_title("overlap 1, opacity 0.9")
    x = [row["gaussians"] for row in counts]
    memory = builds.twinx()
    for name, line in zip(counts[0]["scenes"], ("-", "--"), strict=False):
        builds.loglog(
            x, [1e3 * r["scenes"][name]["build_seconds"] for r in counts], "C0" + line, marker="o", label=name
        )
        memory.loglog(
            x, [r["scenes"][name]["bytes_per_gaussian"] * r["gaussians"] / 2**20 for r in counts], "C1" + line
        )
    builds.set_title("building from arrays in host memory")
    builds.set_xlabel("Gaussians")
    builds.set_ylabel("build time [ms]", color="C0")
    memory.set_ylabel("memory [MiB]", color="C1")
    builds.legend(title="backend")
    rays.legend()
    for axes in (rays, builds, overlaps, opacities):
        axes.grid(True, which="both", alpha=0.25)
    figure.suptitle(f"Tracing on {result['machine']['device']} ({result['machine']['processor']})")
    figure.savefig(path, dpi=120)
    plt.close(figure)
