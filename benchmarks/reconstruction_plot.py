"""The reconstruction benchmark as one picture: quality over Gaussians and over cameras, frames over time, drift.

    python benchmarks/reconstruction_plot.py [RESULT.json ...] [--out docs/images]

Without files, draws what lies in ``results/reconstruction_*.json``. Writes ``reconstruction.png``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent

Row = Mapping[str, Any]

MEASURES: tuple[tuple[str, Callable[[Row], float], float | None], ...] = (
    ("PSNR of novel views, in the box [dB]", lambda row: row["psnr"], 37.0),
    ("normals, median error [°]", lambda row: row["normals_median_degrees"], 6.0),
    ("Chamfer distance [mm]", lambda row: row["surface"]["chamfer_mm"], 2.0),
)
"""Curves drawn over either ablation: a title, the value, and what was wanted."""


def draw(results: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw both ablations, the times of full-resolution frames, and drift.

    Args:
        results: What ``reconstruction.py`` writes as JSON; what a result lacks is left out.
        path: PNG to write.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(3, 3, figsize=(15, 12), layout="constrained")
    for result in results:
        name = _device_name(result)
        for row, (section, across) in zip(panels, (("gaussians", "gaussians"), ("cameras", "cameras")), strict=False):
            rows = _rows(result, section)
            for axes, (_, value, _) in zip(row, MEASURES, strict=True):
                axes.plot([r[across] for r in rows], [value(r) for r in rows], "o-", label=name)
            whole = [r["whole_psnr"] for r in rows]
            row[0].plot([r[across] for r in rows], whole, "s--", color="C0", alpha=0.5, label="of whole images")
        _draw_times(panels[2, 0], result, name)
        _draw_drift(panels[2, 1], result, name)
        _draw_contenders(panels[2, 2], result, name)
    for row, across in zip(panels, ("Gaussians", "cameras"), strict=False):
        for axes, (title, _, wanted) in zip(row, MEASURES, strict=True):
            axes.axhline(wanted, color="0.4", linestyle=":", label="wanted")
            axes.set(title=title, xlabel=across)
            if across == "Gaussians":
                axes.set_xscale("log")
                counts = sorted({r["gaussians"] for result in results for r in _rows(result, "gaussians")})
                axes.set_xticks(counts, [f"{count // 1000}k" if count >= 1000 else str(count) for count in counts])
                axes.set_xticks([], minor=True)
    panels[2, 0].set(title="time of a frame at full resolution [s]", xlabel="frame", ylim=(0.0, None))
    panels[2, 1].set(title="drift per vertex against the true surface, mean [mm]", xlabel="frame")
    panels[2, 2].set(title="PSNR of novel views by frame, in the box [dB]", xlabel="frame")
    for axes in panels[2]:
        axes.xaxis.get_major_locator().set_params(integer=True)
    for axes in panels.flat:
        axes.grid(True, which="both", alpha=0.25)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_times(axes: Any, result: Row, name: str) -> None:
    """Draw seconds of each frame of the large capture, and what was wanted of the first and of the others."""
    rows = _rows(result, "large", "frames")
    if rows:
        axes.plot([row["frame"] for row in rows], [row["seconds"] for row in rows], "o-", label=name)
        axes.axhline(30.0, color="0.4", linestyle=":", label="wanted of the first frame")
        axes.axhline(10.0, color="0.7", linestyle=":", label="wanted of a tracked one")


def _draw_drift(axes: Any, result: Row, name: str) -> None:
    """Draw drift per vertex of every contender."""
    for contender, part in _contenders(result).items():
        rows = part["drift"]
        means = [row["vertices"]["mean_mm"] for row in rows]
        axes.plot([row["frame"] for row in rows], means, "o-", label=f"{contender}, {name}")


def _draw_contenders(axes: Any, result: Row, name: str) -> None:
    """Draw the PSNR of every contender's scored frames."""
    for contender, part in _contenders(result).items():
        rows = part["frames"]
        axes.plot([row["frame"] for row in rows], [row["psnr"] for row in rows], "o-", label=f"{contender}, {name}")


def _contenders(result: Row) -> Mapping[str, Any]:
    return result.get("walker", {}).get("contenders", {})


def _rows(result: Row, section: str, key: str = "rows") -> Sequence[Row]:
    """Return the rows of a section; none where it is not there or failed."""
    return result.get(section, {}).get(key, [])


def _device_name(result: Row) -> str:
    machine = result["machine"]
    return "CPU" if machine["device"] == "cpu" else machine["device"].removeprefix("NVIDIA ")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="*", type=Path)
    parser.add_argument("--out", type=Path, default=HERE.parent / "docs" / "images")
    arguments = parser.parse_args()
    paths = arguments.results or sorted((HERE / "results").glob("reconstruction_*.json"))
    if not paths:
        parser.error("there are no results: run reconstruction.py --out first")
    results = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    draw(
        [result for result in results if result["benchmark"] == "reconstruction"], arguments.out / "reconstruction.png"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
