"""The relighting benchmark as pictures: speed against accuracy, and deferred beside path traced beside the truth.

    python benchmarks/relight_plot.py [RESULT.json ...] [--pictures DIR] [--out docs/images]

Without files, draws what lies in ``results/relight_*.json``; parts that a result lacks are left out. Writes
``relight_speed_accuracy.png`` and, from the images that the benchmark wrote (``relight.py --pictures``),
``relight_comparison.png``.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.image.color import linear_to_srgb

HERE = Path(__file__).parent

Row = Mapping[str, Any]

COLORS = {"deferred": "C0", "per Gaussian": "C2", "path traced": "C1"}
MARKERS = ("o", "s", "^", "D", "v", "P")

LIGHT_NAMES = ("studio", "low sun")
"""What the first light of a subject is, and the second."""

COMPARED = ("walker", "runner")
"""Subjects side by side, if they are there; else all."""

SHOWN_LIGHT = "sunrise"
"""Light of the compared pictures, if it is there; else the last light is shown."""

GAIN = 4.0
"""Factor by which differences are brightened."""

LARGEST_FILE = 150_000
"""Largest size of a picture [byte]: it lies in the repository."""

RESOLUTIONS = (130, 115, 100, 90, 80, 70, 60, 50)
"""Dots per inch, tried one after the other."""


def draw_all(results: Sequence[Row], out: Path, pictures: Path | None = None) -> list[Path]:
    """Draw what the results have, a later result's subjects before an earlier one's; returns the files written."""
    subjects: dict[str, Row] = {}
    for result in results:
        subjects |= result.get("accuracy", {}).get("subjects", {})
    out.mkdir(parents=True, exist_ok=True)
    written = []
    if any(subject["lights"] for subject in subjects.values()):
        written.append(draw_speed(subjects, device_name(results[-1]), out / "relight_speed_accuracy.png"))
    shown = {name: subject for name, subject in subjects.items() if subject.get("picture")}
    if pictures is not None and shown:
        chosen = {name: shown[name] for name in COMPARED if name in shown} or shown
        written.append(draw_comparison(chosen, pictures, out / "relight_comparison.png"))
    return written


def draw_speed(subjects: Mapping[str, Row], device: str, path: Path) -> Path:
    """Draw milliseconds of an image against how near it comes to the truth: a panel for each subject."""
    plt = _pyplot()
    columns = min(3, len(subjects) + 1)
    lines = -(-(len(subjects) + 1) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(3.6 * columns, 2.9 * lines), layout="constrained", squeeze=False, sharey=True
    )
    handles: dict[str, Any] = {}
    for axis, (name, subject) in zip(axes.flat, subjects.items(), strict=False):
        for number, found in enumerate(subject["lights"].values()):
            for method, color in COLORS.items():
                rows = sorted((row for row in found["rows"] if row["method"] == method), key=lambda row: row["ms"])
                label = f"{method}, {LIGHT_NAMES[number % 2]}"
                (handles[label],) = axis.plot(
                    [row["ms"] for row in rows],
                    [row["psnr"] for row in rows],
                    marker=MARKERS[number % len(MARKERS)],
                    markersize=4,
                    color=color,
                    linestyle="-" if number == 0 else "--",
                    label=label,
                )
                for row in rows if number == 0 else ():
                    axis.annotate(
                        row["setting"].removesuffix(" samples"),
                        (row["ms"], row["psnr"]),
                        textcoords="offset points",
                        xytext=(2, -9),
                        fontsize=6,
                    )
        kind = "" if "decomposed" in name or name == "demo figure" else ", true materials"
        axis.set(xscale="log", xlabel=f"ms per image on {device}", title=f"{name}{kind}")
        axis.title.set_fontsize(9)
        axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("PSNR in the box [dB]")
    for axis in axes.flat[len(subjects) :]:
        axis.set_axis_off()
    axes.flat[-1].legend(handles=list(handles.values()), loc="center", fontsize=8, frameon=False)
    save_small(figure, path)
    plt.close(figure)
    return path


def draw_comparison(subjects: Mapping[str, Row], pictures: Path, path: Path) -> Path:
    """Draw deferred, path traced, truth and what the first two differ by, a row a subject."""
    plt = _pyplot()
    loaded = []
    for name, subject in subjects.items():
        light = SHOWN_LIGHT if SHOWN_LIGHT in subject["lights"] else list(subject["lights"])[-1]
        with np.load(pictures / subject["picture"]) as kept:
            images = [shown_color(kept[f"{light}_{kind}"]) for kind in ("deferred", "path", "truth")]
        loaded.append((name, light, subject["lights"][light], images))
    heights = [2.2 * images[0].shape[0] / images[0].shape[1] + 0.45 for *_, images in loaded]
    figure, axes = plt.subplots(
        len(loaded), 4, figsize=(8.8, sum(heights)), height_ratios=heights, layout="constrained", squeeze=False
    )
    for line, (name, light, found, images) in zip(axes, loaded, strict=True):
        rows = {(row["method"], row["setting"]): row for row in found["rows"]}
        deferred = rows["deferred", found["shown"]["deferred"]]
        path_row = rows["path traced", found["shown"]["path"]]
        difference = np.clip(0.5 + 0.5 * GAIN * (images[0] - images[1]), 0.0, 1.0)
        captions = (
            f"deferred, {deferred['setting']}\n{deferred['view_psnr'][0]:.1f} dB",
            f"path traced, {path_row['setting']}\n{path_row['view_psnr'][0]:.1f} dB",
            f"truth: {name}, {light}",
            f"deferred - path traced, x {GAIN:g}\n{deferred['against_path']['view_psnr'][0]:.1f} dB",
        )
        for axis, image, caption in zip(line, [*images, difference], captions, strict=True):
            axis.set_axis_off()
            axis.imshow(image, interpolation="none")
            axis.set_title(caption, fontsize=7)
    save_small(figure, path)
    plt.close(figure)
    return path


def shown_color(image: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return scene-linear radiance, multiplied by alpha, on black as it is compared: sRGB in [0, 1]."""
    return linear_to_srgb(np.clip(image.astype(np.float64), 0.0, 1.0))


def save_small(figure: Any, path: Path) -> None:
    """Write a figure with a palette, at the best resolution that keeps the file below `LARGEST_FILE`."""
    from PIL import Image

    for resolution in RESOLUTIONS:
        drawn, packed = io.BytesIO(), io.BytesIO()
        figure.savefig(drawn, dpi=resolution)
        with Image.open(drawn) as picture:
            picture.convert("RGB").quantize(256).save(packed, format="PNG", optimize=True)
        if packed.tell() <= LARGEST_FILE:
            break
    path.write_bytes(packed.getvalue())


def device_name(result: Row) -> str:
    """Return how a result's device is called."""
    machine = result["machine"]
    return "the CPU" if machine["device"] == "cpu" else machine["device"].removeprefix("NVIDIA ")


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="*", default=sorted((HERE / "results").glob("relight_*.json")))
    parser.add_argument("--pictures", type=Path, help="folder of the subjects' images")
    parser.add_argument("--out", type=Path, default=HERE.parent / "docs" / "images")
    arguments = parser.parse_args()
    results = [json.loads(path.read_text(encoding="utf-8")) for path in arguments.results]
    if not results:
        parser.error("there must be a result to draw, got none; run relight.py --out first")
    for path in draw_all(results, arguments.out, arguments.pictures):
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
