"""What relighting costs and how near it comes to the truth: deferred in real time, path traced offline.

    python benchmarks/relight.py [--device cuda:0] [--data DIR] [--out results.json] [--parts PART ...] [--quick]

Parts: ``deferred``, ``path`` and ``moving`` time frames of 140,000 Gaussians; ``accuracy`` scores images of the walker
and the runner, with true materials on the true surface, and of the demo figure, whose materials are known at every
point; ``furnace`` and ``unbiased`` ask whether light is lost or added. ``--quick`` is the demo's capture, small: does
all of it run?

``--assets DIR`` has decomposed reconstructions, ``DIR/walker/asset.usda`` and so on, which are scored too.
``--pictures DIR`` gets a file of images for each subject, which ``relight_plot.py`` draws. Writes the JSON after every
row. A part that fails says so in its place; the program returns 1 then.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import record
from relight_accuracy import measure_accuracy
from relight_cost import measure_deferred, measure_moving, measure_path
from relight_energy import measure_furnace, measure_unbiased
from relight_scenes import FULL, ON_CPU, QUICK, Bench, Row
from timing import machine

from beam_warp.capture.capture import Capture
from beam_warp.demo.capture import write_demo_capture
from beam_warp.demo.lights import sunset
from beam_warp.device.arrays import resolve_device
from beam_warp.world.environment import EnvironmentMap

SKY = "sunrise"
"""The HDRI that figures stand under: its sun is small and bright."""

PARTS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "deferred": measure_deferred,
    "path": measure_path,
    "moving": measure_moving,
    "accuracy": measure_accuracy,
    "furnace": measure_furnace,
    "unbiased": measure_unbiased,
}


def measure(bench: Bench, *, only: Sequence[str] = (), keep: Callable[[Row], None] = lambda result: None) -> Row:
    """Run the parts; a part that fails says so in its place, beside what it had found.

    Args:
        bench: What they share.
        only: These parts only; all where empty.
        keep: Told everything so far, whenever there is more.
    """
    result: Row = {"machine": machine(bench.device), "failed": []}
    for name, part in PARTS.items():
        if only and name not in only:
            continue
        started = time.perf_counter()
        try:
            for state in part(bench):
                result[name] = state
                keep(result)
            result[name]["part_seconds"] = time.perf_counter() - started
        except Exception:
            result.setdefault(name, {})["failed"] = traceback.format_exc()
            result["failed"].append(name)
            bench.say(traceback.format_exc())
        keep(result)
        bench.say(f"{name}: {time.perf_counter() - started:.1f} s")
    return result


def markdown(result: Row) -> str:
    """Return the tables."""
    on_cpu = result["machine"]["device"] == "cpu"
    lines: list[str] = []
    for name, table in (
        ("deferred", deferred_table),
        ("path", path_table),
        ("moving", moving_table),
        ("accuracy", accuracy_tables),
        ("furnace", furnace_table),
        ("unbiased", unbiased_lines),
    ):
        part = result.get(name, {})
        if part and set(part) != {"failed"}:
            lines += table(part, on_cpu)
    for name in result.get("failed", []):
        lines.append(f"- {name} failed: {result[name]['failed'].strip().splitlines()[-1]}")
    return "\n".join(lines) + "\n"


def rows_of(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a table."""
    lines = ["", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows)]


def size_of(part: Row) -> str:
    """Return how large frames are, in words."""
    return f"{part['gaussians']:,} Gaussians, {part['size'][0]} x {part['size'][1]}"


def deferred_table(part: Row, on_cpu: bool) -> list[str]:
    """Return the cost of deferred frames; on the CPU relative to the first case but for that one's."""
    cases = part["cases"]
    lines = [f"\n### Deferred frames: {size_of(part)}"]
    first = next(iter(cases.values()), None)
    if on_cpu and first is not None:
        unit = first["whole"]["ms"]
        lines.append(f"\nOn the CPU {next(iter(cases))}: {1e-3 * unit:.2f} s a frame; all else relative to that.")
        head = ("", "whole frame", "shadow maps still", "Gaussians moved", "maps, G-buffer, shading")
        keys = ("whole", "still_maps", "moving")
        rows = [
            [
                name,
                *(f"{row[key]['ms'] / unit:.2f}" for key in keys),
                ", ".join(f"{ms / unit:.2f}" for ms in row["shares_ms"].values()),
            ]
            for name, row in cases.items()
        ]
        return lines + rows_of(head, rows) + reached_lines(part)
    head = (
        "",
        "whole frame [ms]",
        "FPS",
        "waited for [ms]",
        "maps still [FPS]",
        "moved [FPS]",
        "maps, G-buffer, shading [ms]",
    )
    rows = [
        [
            name,
            f"{row['whole']['ms']:.3f}",
            f"{row['whole']['fps']:.0f}",
            f"{row['whole']['latency_ms']:.3f}",
            f"{row['still_maps']['fps']:.0f}",
            f"{row['moving']['fps']:.0f}",
            ", ".join(f"{ms:.3f}" for ms in row["shares_ms"].values()),
        ]
        for name, row in cases.items()
    ]
    return lines + rows_of(head, rows) + reached_lines(part)


def reached_lines(part: Row) -> list[str]:
    """Return which targets are met."""
    found = part.get("reached") or {}
    return ["", *(f"- {name} {part['targets'][name]:g}: {verdict(ok)}" for name, ok in found.items())]


def verdict(reached: bool) -> str:
    """Return whether a target is met, in a word."""
    return "reached" if reached else "missed"


def path_table(part: Row, on_cpu: bool) -> list[str]:
    """Return rates of the path tracer."""
    first = next(iter(part["cases"].values()), None)
    unit = first["samples_per_second"] if on_cpu and first is not None else 1e6
    what = "relative" if on_cpu else "Msample/s"
    head = ("", f"{what}, whole image", f"{what}, covered pixels", "covered", "made ready [s]", "first pass [s]")
    rows = [
        [
            name,
            f"{row['samples_per_second'] / unit:.2f}",
            f"{row['covered_samples_per_second'] / unit:.2f}",
            f"{row['covered']:.0%}",
            *(["", ""] if on_cpu else [f"{row['prepare_seconds']:.3f}", f"{row['first_pass_seconds']:.3f}"]),
        ]
        for name, row in part["cases"].items()
    ]
    lines = [f"\n### Path tracing: {size_of(part)}, {part['bounces']} bounces", *rows_of(head, rows)]
    if first is not None and first["reached"] is not None:
        wanted = part["targets"]["path_samples_per_second"] / 1e6
        lines += ["", f"- {wanted:g} Msample/s of the whole image: {verdict(first['reached'])}"]
    return lines


def moving_table(part: Row, on_cpu: bool) -> list[str]:
    """Return the cost of frames with new geometry each; on the CPU relative to the first case's."""
    cases = part["cases"]
    first = next(iter(cases.values()), None)
    unit, what = (first["refit"]["ms"], "relative") if on_cpu and first is not None else (1.0, "ms")
    trees = ", ".join(f"{tree} {row['ms'] / unit:.3f}" for tree, row in part["trees"].items())
    lines = [f"\n### New geometry in every frame: {size_of(part)}", f"\nHierarchy alone [{what}]: {trees}"]
    head = ["", f"arrays [{what}]", f"deferred [{what}]", f"with refit [{what}]", f"with rebuild [{what}]"]
    rows = []
    for name, row in cases.items():
        cells = [f"{row[key]['ms'] / unit:.3f}" for key in ("arrays", "deferred", "refit", "fast")]
        if not on_cpu:
            cells[2:] = [f"{row[key]['ms']:.3f} ({row[key]['fps']:.0f} FPS)" for key in ("refit", "fast")]
        rows.append([name, *cells])
    lines += rows_of(head, rows)
    if "path_start_ms" in part and not on_cpu:
        lines.append(f"\nPath tracer, a new frame made ready: {part['path_start_ms']['ms']:.1f} ms")
    return lines


def accuracy_tables(part: Row, on_cpu: bool) -> list[str]:
    """Return scores of every subject under every light."""
    lines: list[str] = []
    head = (
        "light",
        "way",
        "PSNR [dB] / SSIM",
        "solid [dB]",
        "true coverage [dB]",
        "against path traced [dB]",
        *(() if on_cpu else ("ms",)),
    )
    for name, subject in part["subjects"].items():
        width, height = subject["size"]
        lines.append(
            f"\n### {name}: {subject['gaussians']:,} Gaussians, {subject['views']} views of {width} x {height}"
        )
        rows = []
        for light, found in subject["lights"].items():
            for row in found["rows"]:
                other = row["against_path"]
                cells = [light, f"{row['method']}, {row['setting']}", f"{row['psnr']:.2f} / {row['ssim']:.4f}"]
                cells += [f"{row['solid_psnr']:.2f}", f"{row['true_coverage_psnr']:.2f}"]
                cells.append("" if other is None else f"{other['psnr']:.2f}")
                rows.append(cells if on_cpu else [*cells, f"{row['ms']:.2f}"])
        lines += rows_of(head, rows)
        if "decomposed" not in name:
            lines += ["", *perfect_lines(subject, part["target_psnr"])]
    return lines


def perfect_lines(subject: Row, target: float) -> list[str]:
    """Return whether path tracing is as near to the truth as it should be where geometry and materials are true."""
    lines = []
    for light, found in subject["lights"].items():
        best = max(row["psnr"] for row in found["rows"] if row["method"] == "path traced")
        lines.append(f"- {light}: path traced {best:.2f} dB, {target:g} wanted: {verdict(best >= target)}")
    return lines


def furnace_table(part: Row, on_cpu: bool) -> list[str]:
    """Return errors of white surfaces in a white furnace."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in part["rows"]:
        found.setdefault((row["shape"], row["renderer"]), []).append(row)
    roughness = [row["roughness"] for row in next(iter(found.values()), [])]
    head = ("", *(f"roughness {value:g}" for value in roughness))
    rows = [
        [f"{shape}, {name}", *(f"{100.0 * row['mean_error']:+.2f} %" for row in entries)]
        for (shape, name), entries in found.items()
    ]
    lines = ["\n### White furnace: mean error", *rows_of(head, rows), ""]
    return [
        *lines,
        *(
            f"- {shape}, {name}, within {part['target']:.0%}: {verdict(all(row['reached'] for row in entries))}"
            for (shape, name), entries in found.items()
        ),
    ]


def unbiased_lines(part: Row, on_cpu: bool) -> list[str]:
    """Return what z-scores say."""
    few, more = part["samples"]
    return [
        f"\n### {part['seeds'][0]} images of {few} samples against {part['seeds'][1]} of {more}",
        "",
        f"- {part['pixels']:,} pixels: mean z {part['mean']:+.4f}, {part['mean_in_standard_errors']:+.2f} of its "
        f"standard errors; root mean square {part['root_mean_square']:.3f}",
        f"- largest |z| {part['largest']:.2f}, by chance {part['largest_by_chance']:.2f}",
        f"- |z| > 3: {part['beyond']:.2%} of the pixels, by chance {part['beyond_by_chance']:.2%}",
        f"- sum over the image: {100.0 * part['relative_bias']:+.3f} %, standard error "
        f"{100.0 * part['relative_bias_standard_error']:.3f} %",
    ]


def read_sky(data: Path) -> EnvironmentMap:
    """Return the HDRI of the data folder; the demo's sunset where there is none."""
    path = data / "hdri" / f"{SKY}.hdr"
    return EnvironmentMap.read(path) if path.exists() else sunset()


def find_assets(folder: Path | None, names: Sequence[str]) -> dict[str, Path]:
    """Return the assets of a folder, by the name of their capture."""
    if folder is None:
        return {}
    return {name: folder / name / "asset.usda" for name in names if (folder / name / "asset.usda").exists()}


def quick_bench(folder: Path, device: Any, say: Callable[[str], None]) -> Bench:
    """Return a bench that runs in no time, on the demo's capture."""
    capture = write_demo_capture(
        folder / "demo",
        camera_count=1,
        test_camera_count=2,
        size=48,
        samples=4,
        frame_count=1,
        relit={"sunset": sunset()},
        device=str(device),
    )
    return bench_of_capture(capture, device, say)


def bench_of_capture(capture: Capture, device: Any, say: Callable[[str], None]) -> Bench:
    """Return a quick bench of one capture."""
    return Bench({"demo": capture}, {}, sunset(), QUICK, device, None, say)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("BEAM_DATA", "../shared/data")))
    parser.add_argument("--captures", nargs="+", default=["walker", "runner"], help="names there, or folders")
    parser.add_argument("--assets", type=Path, metavar="DIR", help="decomposed reconstructions, NAME/asset.usda")
    parser.add_argument("--gaussians", type=int, help="other than by default, everywhere")
    record.add_arguments(parser)
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="images of every subject, for relight_plot.py")
    parser.add_argument("--parts", nargs="+", default=(), choices=PARTS, metavar="PART", help="these parts only")
    parser.add_argument("--quick", action="store_true", help="the demo's capture, small: does all of it run?")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    started = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - started:7.1f} s  {text}", file=sys.stderr, flush=True)

    keep = partial(record.write_result, arguments, device)

    with tempfile.TemporaryDirectory() as folder:
        if arguments.quick:
            bench = replace(quick_bench(Path(folder), device, say), pictures=arguments.pictures)
        else:
            captures = {}
            for word in arguments.captures:
                path = Path(word) if Path(word).is_dir() else arguments.data / "captures" / word
                captures[path.name] = Capture.read(path)
            effort = FULL if device.is_cuda else ON_CPU
            if arguments.gaussians:
                effort = replace(effort, gaussians=arguments.gaussians, perfect_gaussians=arguments.gaussians)
            assets = find_assets(arguments.assets, list(captures))
            sky = read_sky(arguments.data)
            bench = Bench(captures, assets, sky, effort, device, arguments.pictures, say)
        result = measure(bench, only=arguments.parts, keep=keep)
    print(markdown(result), end="")
    return 1 if result["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
