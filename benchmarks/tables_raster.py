"""Tables and figures of the rasteriser, from results of ``raster.py`` and ``raster_gradients.py``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from raster_plot import draw_growth, draw_stages
from tables import Row, Rows, cell, figure, number, table

H200, CPU, NEWER = "raster_h200.json", "raster_cpu.json", "raster_gsplat16_h200.json"
SHARED, ACCURACY, SIZES = "raster_checkpoints_h200.json", "raster_accuracy_h200.json", "raster_sizes_h200.json"

CASES = ("RGB and depth", "11 channels and depth")
PARTS = {"forward": "forwards", "training": "forwards and backwards"}

UNSTABLE = 1e3
"""Relative effect of a rounding of the inputs from which on a derivative is 0 but for rounding."""


def times(result: Row, case: str, contender: str) -> tuple[str, str]:
    """Return the time of a contender from idle to idle, and that of its kernels alone [ms]."""
    entry = result["peer"]["cases"][case]["ms"].get(contender, {})
    return cell(entry.get("wall_ms"), ".2f"), cell(entry.get("kernel_ms"), ".2f")


@table("raster_speed", H200, NEWER)
@table("results_raster", H200, NEWER)
def speed(result: Row, newer: Row) -> Rows:
    """Return frames of ours and of both versions of gsplat."""
    rows = [
        ["ms: from idle to idle (kernels alone)", "CUDA graph", "launched one by one", "gsplat 1.5.3", "gsplat 1.6.0"]
    ]
    for part, called in PARTS.items():
        for case in CASES:
            cells = [times(result, case, f"{way}, {part}") for way in ("ours graph", "ours redraw", "gsplat")]
            cells.append(times(newer, case, f"gsplat, {part}"))
            rows.append([f"{case}, {called}", *("; ".join(filter(None, pair)) for pair in cells)])
    inference = times(newer, CASES[0], "gsplat, inference, RGB alone")
    rows.append(["RGB alone, forwards, its renderer for inference", "", "", "", "; ".join(filter(None, inference))])
    return rows


@table("raster_accuracy", ACCURACY, CPU)
def accuracy(result: Row, on_cpu: Row) -> Rows:
    """Return errors against float64 brute force."""
    asked = {
        "channels, figure": ("figure", "channels"),
        "channels, cube": ("cube", "channels"),
        "exact depth to the largest response [m], figure": ("figure", "exact"),
        "plane depth to the largest response [m], figure": ("figure", "plane"),
    }
    rows = [["error against float64 brute force: median, 99 %, largest", *map(frame_of, (result, on_cpu))]]
    for name, (scene, what) in asked.items():
        cells = []
        for found in (result, on_cpu):
            variants = found["variants"][scene]["variants"]
            errors = variants["plane" if what == "channels" else what]["errors"]
            gap = errors["channels" if what == "channels" else "depth_to_largest_response_m"]
            cells.append(", ".join(f"{gap[end]:.1e}" for end in ("median", "p99", "largest")))
        rows.append([name, *cells])
    return rows


def frame_of(result: Row) -> str:
    """Return the device and size of a result's frames."""
    scene, machine = result["variants"]["figure"]["scene"], result["measured"]["machine"]
    device = "CPU" if machine["device"] == "cpu" else machine["device"]
    return f"{device}, {scene['width']} × {scene['height']}"


@table("raster_sizes", SIZES)
def sizes(result: Row) -> Rows:
    """Return frames over the number of Gaussians."""
    rows = [["Gaussians", "pairs", "forward [ms]", "backward [ms]"]]
    for entry in result["sizes"]["rows"]:
        parts = (cell(entry[part]["device_ms"], ".3f") for part in ("forward", "backward"))
        rows.append([f"{entry['scene']['splats']:,}", f"{entry['pairs']:,}", *parts])
    return rows


@table("raster_frames", ACCURACY, CPU)
def frames(result: Row, on_cpu: Row) -> Rows:
    """Return frames of all channels; on the CPU in units of its first row."""
    there, here = result["frames"]["ms"], on_cpu["frames"]["ms"]
    unit = here["plane, forward"]["process_ms"]["median"]
    rows = [[f"{result['frames']['channels']} channels, both depths", "H200 [ms]", "one CPU core, relative"]]
    for name, entry in there.items():
        rows.append([name, cell(entry["device_ms"], ".2f"), cell(here[name]["process_ms"], ".2f", factor=1.0 / unit)])
    return rows


@table("raster_checkpoints", SHARED)
def checkpoints(result: Row) -> Rows:
    """Return the time of the way back, lists whole and shared out."""
    rows = [
        ["scene", "pairs", "forward [ms]", "with checkpoints", "backward", "with checkpoints", "gradients differ by"]
    ]
    for entry in result["checkpoints"]["rows"]:
        scene = entry["scene"]
        name = f"{scene['name']}, {scene['width']} × {scene['height']}"
        ways = [entry[part][way]["device_ms"] for part in ("forward", "backward") for way in ("whole", "shared")]
        times = (cell(way, ".2f") for way in ways)
        rows.append([name, f"{entry['pairs']:,}", *times, f"{max(entry['gradients'].values()):.0e}"])
    return rows


@table("raster_gradients", "raster_gradients_h200.json", "raster_gradients_cpu.json")
def gradients(result: Row, on_cpu: Row) -> Rows:
    """Return the largest error of every scene, over arrays and kinds of depth."""
    rows = [["scene", "error, H200", "error, CPU", "one rounding of the inputs"]]
    for scene in dict.fromkeys(row["scene"] for row in result["rows"]):
        found = [largest(each, scene, "error") for each in (result, on_cpu)]
        values = (*found, largest(on_cpu, scene, "one_rounding"))
        rows.append([scene, *(f"{value:.1e}" if 0.0 < value < 1.0 else f"{value:.1f}" for value in values)])
    return rows


def largest(result: Row, scene: str, what: str) -> float:
    """Return the largest error of a scene's derivatives, of those that are not 0 but for rounding."""
    stable = [
        row[what][array]
        for row in result["rows"]
        if row["scene"] == scene
        for array in row[what]
        if row["one_rounding"][array] < UNSTABLE
    ]
    return max(stable, default=0.0)


@number("raster_compositing_share", ACCURACY)
def compositing_share(result: Row) -> str:
    """Return the share of compositing in a forward and a backward pass of RGB [%]."""
    stages = result["stages"]["RGB and depth"]
    shares = (stages["forward"]["share"]["composite"], stages["backward"]["share"]["composite adjoint"])
    return " and ".join(f"{100.0 * share:.0f} %" for share in shares)


@figure("raster_growth.webp", H200)
def growth(result: Any, path: Path) -> None:
    """Draw time over Gaussians and over pixels."""
    draw_growth([result], path)


@figure("raster_stages.webp", ACCURACY, CPU)
def stages(result: Any, on_cpu: Any, path: Path) -> None:
    """Draw the stages of a frame."""
    draw_stages([result, on_cpu], path)
