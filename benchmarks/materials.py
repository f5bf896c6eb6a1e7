"""Quality of decomposed materials, the gain of each idea, and the cost at the paper's scale.

    python benchmarks/materials.py [--device cuda:0] [--data DIR] [--out results.json] [--parts PART ...] [--quick]

Parts: ``perfect`` decomposes Gaussians sampled from the true surface: occlusion, light at 64 rays on every HDRI, base
colour with and without the bounce; ``ablation`` decomposes reconstructions, from the paper's recipe to ours one idea at
a time, then without each idea alone, then the image path's own settings; ``cost`` times both paths on 140,000 Gaussians
and 81 views of 3840 x 2160 that lie in memory decoded, and how that grows. ``--quick`` is the demo's capture, small:
does all of it run?

Reconstructions are given with ``--assets NAME=PATH``, or made here (``--gaussians``). Writes the JSON after every row,
so that a kill loses little. ``--pictures DIR`` gets a strip of every row, occlusion and base colour of the first
test view; ``materials_plot.py`` draws all of it. A part that fails says so in its place; the program returns 1 then.
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

import numpy as np
import record
from device_memory import peak_memory
from materials_bench import FULL, TARGETS, Bench, quick_bench, read_lights
from materials_contenders import AblationRow, Subject, SubjectFrame, Unavailable, ablation_rows, seen_normals
from materials_cost import PAPER, Scale, measure_cost
from materials_perfect import measure_perfect
from materials_truth import Row, TruthViews, row_of
from reconstruction_contenders import follow, ours
from timing import machine

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.relighters import RELIGHTERS
from beam_warp.raster.records import RasterOptions
from beam_warp.world.axes import change_axes

PUBLISHED = {
    "BEAM, its own synthetic humans": {
        "ambient_occlusion": [25.32, 0.924],
        "base_color": [21.47, 0.906],
        "relit": [26.57, 0.895],
    }
}
"""PSNR [dB] and SSIM that the paper states; other data."""


def measure_ablation(bench: Bench) -> Iterator[Row]:
    """Yield the ablation so far of every reconstruction."""
    result: Row = {"targets": TARGETS["reconstructed"], "published": PUBLISHED, "captures": {}}
    rows = ablation_rows(high=bench.effort.high, steps=bench.effort.adam_steps)
    for name, capture in bench.captures.items():
        subject, made = reconstruction(bench, name, capture)
        truth = TruthViews(capture, subject.frames[0].number, subject.raster, bench.effort.samples, str(bench.device))
        part: Row = {
            **made,
            "gaussians": len(subject.frames[0].cloud),
            "frames": [frame.number for frame in subject.frames],
            "truth_picture": bench.picture(truth, subject.frames[0].cloud, None, "ablation", name, "truth"),
            "rows": [],
        }
        result["captures"][name] = part
        warm, normals = subject.small(), seen_normals(subject)
        for row in rows:
            entry = {"group": row.group, "name": row.name, **measure_row(row, subject, warm, truth, normals)}
            if "found" in entry:
                found = entry.pop("found")
                entry["picture"] = bench.picture(
                    truth, subject.frames[0].cloud, found, "ablation", name, row.group, row.name
                )
                bench.say(f"{name}, {row.group}, {row.name}: {row_of(entry)}, {entry['seconds']:.2f} s")
            else:
                bench.say(f"{name}, {row.group}, {row.name}: {entry.get('unavailable') or entry.get('failed')}")
            part["rows"].append(entry)
            yield result


def measure_row(row: AblationRow, subject: Subject, warm: Subject, truth: TruthViews, normals: Any) -> Row:
    """Return scores, seconds by stage and memory of a row; why not, where it cannot be run.

    Rows of the ladder are relit too; ``normals`` are for those that bring none.
    """
    try:
        row.warm(warm)  # compiles what this row is the first to need
        with peak_memory(subject.device) as memory:
            done = row.method(subject)
    except Unavailable as error:
        return {"unavailable": str(error)}
    except Exception:
        return {"failed": traceback.format_exc()}
    cloud = subject.frames[0].cloud
    scores = truth.score(cloud, done.materials)
    if row.group == "ladder":
        found = done.materials if done.materials.normals is not None else replace(done.materials, normals=normals)
        scores["relit"] = {name: truth.score_relit(cloud, found, make) for name, make in RELIGHTERS.items()}
    return {
        "seconds": sum(done.seconds.values()),
        "seconds_per_frame": sum(done.seconds.values()) / done.frames,
        "stages": done.seconds,
        "frames": done.frames,
        "notes": list(done.notes),
        **memory,
        **scores,
        "found": done.materials,
    }


def reconstruction(bench: Bench, name: str, capture: Capture) -> tuple[Subject, Row]:
    """Return a reconstruction that was given, or make one."""
    light = bench.light_of(capture)
    limit = bench.effort.frames
    if name in bench.assets:
        sequence = converters.read(bench.assets[name])
        stated = sequence.metadata.get("capture_frames", "").split()
        numbers = [int(word) for word in stated] or list(capture.frames[: len(sequence)])
        chosen = list(range(min(len(sequence), limit)))
        clouds = [change_axes(sequence[index], "rfu") for index in chosen]
        raster = RasterOptions.from_metadata(sequence.metadata)
        made: Row = {"asset": str(bench.assets[name])}
        numbers = [numbers[index] for index in chosen]
    else:
        contender = ours(bench.gaussians, str(bench.device), **(bench.effort.fitting or {}))
        numbers = list(capture.frames[:limit])
        modelled = list(follow(contender, capture, numbers, bench.device, bench.say))
        clouds = [change_axes(frame.cloud, "rfu") for frame in modelled]
        raster = contender.options or RasterOptions()
        made = {"reconstruction_seconds": [frame.seconds for frame in modelled]}
    frames = [
        SubjectFrame(number, cloud, [r.view() for r in capture.select(split="train", frames=[number])])
        for number, cloud in zip(numbers, clouds, strict=True)
    ]
    kept = [frame for frame in frames if len(frame.cloud) == len(frames[0].cloud)]
    return Subject(name, kept, raster, light, bench.device), made


def measure_scale(bench: Bench) -> Iterator[Row]:
    """Yield what it costs so far."""
    capture = next(iter(bench.captures.values()))
    result: Row = {"paper": PAPER, "parts": {}}
    for name, part in measure_cost(capture, bench.light_of(capture), bench.effort.scale, bench.device, bench.say):
        result["parts"][name] = part
        yield result


PARTS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "perfect": measure_perfect,
    "cost": measure_scale,
    "ablation": measure_ablation,
}


def measure(bench: Bench, *, only: Sequence[str] = (), keep: Callable[[Row], None] = lambda result: None) -> Row:
    """Run the parts; a part that fails says so in its place, beside what it had found.

    Args:
        bench: What they share.
        only: These parts only; all where empty.
        keep: Told everything so far, whenever there is more.
    """
    result: Row = {
        "machine": machine(bench.device),
        "gaussians": {"perfect": bench.effort.perfect_gaussians, "cost": bench.effort.scale.gaussians},
        "failed": [],
    }
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
    lines: list[str] = []
    for name, row in result.get("perfect", {}).get("captures", {}).items():
        lines += [f"\n### {name}, {row['gaussians']:,} Gaussians on the true surface\n"]
        rays = next(iter(row["irradiance"].values()))["rays"]
        lines += [f"| light | error at {rays} rays: at each point | of the mean | cosine, iid |", "|---|---|---|---|"]
        for light, found in row["irradiance"].items():
            ways = found["ways"]
            cells = [f"{ways['product, ratio, Owen'][key]:.4f}" for key in ("relative_rmse", "rmse_over_mean")]
            cells.append(f"{ways['cosine, iid']['relative_rmse']:.4f}")
            lines.append(f"| {light} | " + " | ".join(cells) + " |")
        lines += ["", *_table(row["rows"], true_coverage=True)]
    for name, part in result.get("ablation", {}).get("captures", {}).items():
        lines += [f"\n### {name}, {part['gaussians']:,} reconstructed Gaussians\n", *_table(part["rows"])]
    parts = result.get("cost", {}).get("parts", {})
    for name in ("direct", "image path"):
        if "seconds" in parts.get(name, {}):
            row = parts[name]
            stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in row["stages"].items())
            peak = f"{row['peak_device_bytes'] / 2**30:.1f} GiB" if "peak_device_bytes" in row else "not on CUDA"
            lines.append(f"- {name}: {row['seconds']:.2f} s ({stages}), peak {peak}")
    failed = [f"- {name}: {result[name]['failed'].splitlines()[-1]}" for name in result.get("failed", [])]
    return "\n".join([*lines, *failed]) + "\n"


def _table(rows: Sequence[Row], *, true_coverage: bool = False) -> list[str]:
    """Return rows as a table of scores, time and memory."""
    extra = " AO, base colour with true coverage [dB] |" if true_coverage else ""
    lines = [
        f"| | AO [dB] / SSIM | base colour [dB] / SSIM | scale |{extra} s | GiB |",
        "|" + "---|" * (7 if true_coverage else 6),
    ]
    for row in rows:
        if "base_color" not in row:
            why = row.get("unavailable") or row.get("failed", "").strip().splitlines()[-1]
            lines.append(f"| {row['name']} | {why} |" + " |" * (5 if true_coverage else 4))
            continue
        color, openness = row["base_color"], row["ambient_occlusion"]
        cells = [
            row["name"],
            f"{openness['psnr']:.2f} / {openness['ssim']:.3f}",
            f"{color['psnr']:.2f} / {color['ssim']:.3f}",
            f"{np.mean(color['scale']):.3f}",
        ]
        if true_coverage:
            cells.append(f"{openness['true_coverage_psnr']:.2f}, {color['true_coverage_psnr']:.2f}")
        cells.append(f"{row['seconds']:.2f}")
        cells.append(f"{row['peak_device_bytes'] / 2**30:.2f}" if "peak_device_bytes" in row else "")
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("BEAM_DATA", "../shared/data")))
    parser.add_argument("--captures", nargs="+", default=["walker", "runner"], help="names there, or folders")
    parser.add_argument("--assets", nargs="*", default=[], metavar="NAME=PATH", help="reconstructions of captures")
    parser.add_argument("--gaussians", type=int, default=140_000, help="of reconstructions that are made here")
    parser.add_argument("--perfect-gaussians", type=int, help="other than by default")
    parser.add_argument("--scale", type=float, default=1.0, help="of the cost's images and views, to try it")
    record.add_arguments(parser)
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="pictures of every row")
    parser.add_argument("--parts", nargs="+", default=(), choices=PARTS, metavar="PART", help="these parts only")
    parser.add_argument("--quick", action="store_true", help="the demo's capture, small: does all of it run?")
    parser.add_argument("--plot", type=Path, metavar="DIR", help="also draw materials_plot.py's pictures there")
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
            effort = FULL
            if arguments.perfect_gaussians:
                effort = replace(effort, perfect_gaussians=arguments.perfect_gaussians)
            if arguments.scale != 1.0:
                effort = replace(effort, scale=shrunk(effort.scale, arguments.scale))
            assets = {name: Path(path) for name, path in (word.split("=", 1) for word in arguments.assets)}
            bench = Bench(
                captures,
                read_lights(arguments.data),
                assets,
                arguments.gaussians,
                effort,
                device,
                arguments.pictures,
                say,
            )
        result = measure(bench, only=arguments.parts, keep=keep)
    print(markdown(result), end="")
    if arguments.plot is not None:
        from materials_plot import draw_all

        draw_all([result], arguments.plot, arguments.pictures)
    return 1 if result["failed"] else 0


def shrunk(scale: Scale, factor: float) -> Scale:
    """Return a smaller scale: of images, views and Gaussians."""

    def less(count: int, least: int = 1) -> int:
        return max(least, round(count * factor))

    return replace(
        scale,
        gaussians=less(scale.gaussians, 100),
        views=less(scale.views, 2),
        size=(less(scale.size[0], 16), less(scale.size[1], 16)),
        counts=tuple(less(count, 100) for count in scale.counts),
        view_counts=tuple(sorted({less(count) for count in scale.view_counts})),
        series_views=less(scale.series_views, 2),
    )


if __name__ == "__main__":
    sys.exit(main())
