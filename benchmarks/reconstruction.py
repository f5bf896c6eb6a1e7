"""Quality of a reconstruction, its loss over tracked frames, and its time.

    python benchmarks/reconstruction.py [--device cuda:0] [--data DIR] [--out results.json] [--only SECTION] [--quick]

Sections: ``walker`` scores the first and the last frame with truth, for ours and for others' settings, with drift in
every frame; ``gaussians`` and ``cameras`` vary the number of either on the first frame; ``large`` times the first and
the tracked frames of a capture of 24 views of 1920 x 1080, which is path traced first, and says what memory it takes;
``stability`` runs the captures on which reconstructions fail. ``--quick`` takes the demo's capture and few Gaussians.

Images are read before the clock starts; scores and meshes are made after it stops. A section that fails says so in its
place, and the program returns 1. Writes the JSON after each section, and tables to the terminal.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import record
from reconstruction_captures import write_large_capture
from reconstruction_contenders import Contender, ModelledFrame, follow, ours, rade_gs_like, reconstruct_stressed
from timing import machine

from beam_warp.capture.capture import Capture
from beam_warp.demo.capture import write_demo_capture
from beam_warp.device.arrays import resolve_device
from beam_warp.mesh.distances import SAMPLE_COUNT
from beam_warp.reconstruction.drift import tracking_drift
from beam_warp.reconstruction.scores import FrameScores, read_truth_mesh, score_frame, truth_frames
from beam_warp.stability.capture_cases import CAPTURE_CASES, TRACED_CASES
from beam_warp.stability.capture_cases.alterations import evenly, training_cameras, with_cameras
from beam_warp.stability.capture_cases.studio import StressStudio
from beam_warp.stability.captures import run_capture_case

Row = dict[str, Any]

Make = Callable[[str, int], Contender]
"""Makes a contender of a name, `OURS` or one of `OTHERS`, for a number of Gaussians."""

OURS = "ours"
RADE_GS_LIKE = "RaDe-GS-like settings"
OTHERS = (RADE_GS_LIKE,)

TARGETS = {
    "psnr": (37.0, "at least"),
    "whole_psnr": (37.0, "at least"),
    "normals_median_degrees": (6.0, "at most"),
    "chamfer_mm": (2.0, "at most"),
}
"""Targets of the first frame: PSNR in the subject's box, and of whole images."""

LARGEST_LOSS = {"psnr": 1.0, "chamfer_mm": 1.0}
"""Largest loss of the last frame."""

PAPER = {"psnr_20_cameras": 34.56, "psnr_30_cameras": 38.40}


@dataclass(frozen=True)
class Effort:
    """Amount that is measured.

    Attributes:
        gaussians: Gaussians of every measurement but the ablation over them.
        counts: Gaussians of that ablation.
        cameras: Cameras of the other one.
        large_gaussians: Gaussians of the capture at full resolution.
        large_size: Its images.
        large_views: Its training cameras.
        large_frames: Its frames.
        samples: Paths per pixel of what is path traced here.
        surface_samples: Points on each surface of a Chamfer distance.
        iterations: Of others' settings; None for theirs.
        fitting: Changes of our defaults.
    """

    gaussians: int
    counts: tuple[int, ...]
    cameras: tuple[int, ...]
    large_gaussians: int
    large_size: tuple[int, int]
    large_views: int
    large_frames: int
    samples: int
    surface_samples: int
    iterations: int | None
    fitting: Row


FULL = Effort(
    gaussians=140_000,
    counts=(20_000, 50_000, 100_000, 200_000, 300_000),
    cameras=(8, 12, 16, 24),
    large_gaussians=140_000,
    large_size=(1920, 1080),
    large_views=24,
    large_frames=4,
    samples=32,
    surface_samples=SAMPLE_COUNT,
    iterations=None,
    fitting={},
)
QUICK = Effort(
    gaussians=2_000,
    counts=(1_000, 2_000),
    cameras=(4, 8),
    large_gaussians=2_000,
    large_size=(96, 54),
    large_views=4,
    large_frames=2,
    samples=2,
    surface_samples=2_000,
    iterations=60,
    fitting={"color_iterations": 30, "normal_iterations": 30},
)


@dataclass(frozen=True)
class Bench:
    """Arguments that all sections share.

    Attributes:
        capture: The capture with truth.
        effort: Amount that is measured.
        make: Makes contenders.
        device: Where they run.
        say: Hears what is being done.
    """

    capture: Capture
    effort: Effort
    make: Make
    device: Any
    say: Callable[[str], None]

    def scored(self, contender: Contender, modelled: ModelledFrame, capture: Capture | None = None) -> Row:
        """Return the scores of a frame that has truth, its surface included, beside what it cost."""
        chosen = capture or self.capture
        seeing = [record.camera for record in chosen.select(split="train", frames=[modelled.frame])]
        scores: FrameScores = score_frame(
            modelled.cloud,
            chosen.select(split="test", frames=[modelled.frame]),
            contender.mesh(modelled.cloud, seeing),
            truth_mesh=read_truth_mesh(chosen, modelled.frame),
            seeing=seeing,
            options=contender.options,
            samples=modelled.samples,
            sample_count=self.effort.surface_samples,
            device=self.device.alias,
        )
        return {
            "frame": modelled.frame,
            "gaussians": len(modelled.cloud),
            "seconds": round(modelled.seconds, 3),
            **scores.as_dict(),
        }

    def first_frame(self, capture: Capture, contender: Contender) -> Row:
        """Return the scores of the first frame with truth of a capture."""
        frame = truth_frames(capture)[0]
        return self.scored(contender, next(follow(contender, capture, [frame], self.device, self.say)), capture)


def measure_walker(bench: Bench) -> Row:
    """Score the first and last frame with truth of every contender, and drift between them."""
    capture = bench.capture
    known = truth_frames(capture)
    frames = [frame for frame in capture.frames if known[0] <= frame <= known[-1]]
    meshes = [read_truth_mesh(capture, frame) for frame in frames]
    seeing = [record.camera for record in capture.select(split="train", frames=frames[:1])]
    found: Row = {"paper": PAPER, "targets": {name: value for name, (value, _) in TARGETS.items()}, "contenders": {}}
    for name in (OURS, *OTHERS):
        contender = bench.make(name, bench.effort.gaussians)
        modelled = list(follow(contender, capture, frames, bench.device, bench.say))
        rows = [bench.scored(contender, entry) for entry in modelled if entry.frame in (known[0], known[-1])]
        drift = tracking_drift(
            (entry.cloud for entry in modelled),
            (mesh.vertices for mesh in meshes),
            meshes[0].faces,
            cameras=seeing,
            device=bench.device.alias,
        )
        found["contenders"][name] = {
            "frames": rows,
            "seconds": [round(entry.seconds, 3) for entry in modelled],
            "training_psnr": [round(entry.report["psnr"], 3) for entry in modelled],
            "lost": [entry.report.get("lost", "") for entry in modelled],
            "drift": [{"frame": frame, **row.as_dict()} for frame, row in zip(frames, drift, strict=True)],
            "reached": reached(rows),
        }
    return found


def reached(rows: Sequence[Row]) -> Row:
    """Return which of the targets the first frame reaches, and whether the last one is no worse than it may be."""

    def value(row: Row, name: str) -> float:
        return float(row["surface"][name] if name == "chamfer_mm" else row[name])

    # Phrased so that NaN fails.
    found = {
        name: bool(value(rows[0], name) >= wanted if sense == "at least" else value(rows[0], name) <= wanted)
        for name, (wanted, sense) in TARGETS.items()
    }
    losses = {
        "psnr": value(rows[0], "psnr") - value(rows[-1], "psnr"),
        "chamfer_mm": value(rows[-1], "chamfer_mm") - value(rows[0], "chamfer_mm"),
    }
    return found | {f"{name} after tracking": bool(losses[name] <= most) for name, most in LARGEST_LOSS.items()}


def measure_gaussians(bench: Bench) -> Row:
    """Score the first frame with more and more Gaussians."""
    return {"rows": [bench.first_frame(bench.capture, bench.make(OURS, count)) for count in bench.effort.counts]}


def measure_cameras(bench: Bench) -> Row:
    """Score the first frame seen by more and more cameras."""
    names = training_cameras(bench.capture)
    rows = []
    for count in bench.effort.cameras:
        if count <= len(names):
            fewer = with_cameras(bench.capture, evenly(names, count))
            rows.append({"cameras": count, **bench.first_frame(fewer, bench.make(OURS, bench.effort.gaussians))})
    # What counts of the surface is what those cameras see: fewer cameras are judged by less of it.
    return {"rows": rows}


def measure_large(bench: Bench) -> Row:
    """Time frames of a capture at full resolution, and say what memory each takes."""
    effort = bench.effort
    frames = bench.capture.frames[: effort.large_frames]
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        width, height = effort.large_size
        capture = write_large_capture(
            Path(folder) / "capture",
            bench.capture,
            frames=frames,
            camera_count=effort.large_views,
            width=width,
            height=height,
            samples=effort.samples,
            subdivisions=2 if width > 960 else 0,
            device=bench.device.alias,
        )
        bench.say(f"path traced in {time.perf_counter() - started:.1f} s")
        found: Row = {
            "views": effort.large_views,
            "width": width,
            "height": height,
            "seconds_to_path_trace": round(time.perf_counter() - started, 1),
            "frames": [],
        }
        contender = bench.make(OURS, effort.large_gaussians)
        for modelled in follow(contender, capture, capture.frames, bench.device, bench.say):
            found["frames"].append(
                {
                    "frame": modelled.frame,
                    "gaussians": len(modelled.cloud),
                    "seconds": round(modelled.seconds, 3),
                    **memory(bench.device),
                    **score_frame(
                        modelled.cloud,
                        capture.select(split="test", frames=[modelled.frame]),
                        options=contender.options,
                        samples=modelled.samples,
                        device=bench.device.alias,
                    ).as_dict(),
                }
            )
        return found


def memory(device: Any) -> Row:
    """Return the most memory of this process so far, and what is taken of the device now [bytes]."""
    found: Row = {"peak_host_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}
    return found | ({"device_bytes": device.total_memory - device.free_memory} if device.is_cuda else {})


def measure_stability(bench: Bench) -> Row:
    """Reconstruct the captures on which reconstructions fail: of this capture and, path traced, of the demo figure."""
    effort = bench.effort
    reconstruct = reconstruct_stressed(bench.make(OURS, effort.gaussians), bench.device.alias)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        given = StressStudio(Path(folder), given=bench.capture, device=bench.device.alias)
        drawn = StressStudio(
            Path(folder),
            camera_count=len(training_cameras(bench.capture)),
            size=bench.capture.records[0].camera.height,
            samples=effort.samples,
            device=bench.device.alias,
        )
        for studio, traced in ((given, False), (drawn, True)):
            cases = [case for case in CAPTURE_CASES if (case in TRACED_CASES) is traced]
            for case in cases:
                outcome = run_capture_case(reconstruct, studio, case)
                bench.say(f"{outcome.case}: {'; '.join(outcome.faults) or 'ok'}")
                rows.append(outcome.as_dict())
    return {"rows": rows, "passed": all(row["passed"] for row in rows)}


SECTIONS: dict[str, Callable[[Bench], Row]] = {
    "walker": measure_walker,
    "gaussians": measure_gaussians,
    "cameras": measure_cameras,
    "large": measure_large,
    "stability": measure_stability,
}


def measure(bench: Bench, *, only: Sequence[str] = (), keep: Callable[[Row], None] = lambda result: None) -> Row:
    """Return everything that is measured, for JSON; ``keep`` gets each state."""
    result: Row = {"machine": machine(bench.device), "failed": []}
    for name, run in SECTIONS.items():
        if only and name not in only:
            continue
        bench.say(name)
        started = time.perf_counter()
        try:
            result[name] = {**run(bench), "section_seconds": round(time.perf_counter() - started, 1)}
        except Exception as error:  # minutes on a lent device are not lost to what comes later
            traceback.print_exc()
            result[name] = {"failed": f"{type(error).__name__}: {error}"}
            result["failed"].append(name)
        keep(result)
    return result


def markdown(result: Row) -> str:
    """Return the tables that a person reads first."""
    lines = [f"{result['machine']['device']} ({result['machine']['processor']}), commit {result['commit']}"]
    lines += [f"\n{name} failed: {result[name]['failed']}" for name in result["failed"]]
    heads = "PSNR [dB] | solid | SSIM | normals, median [°] | Chamfer [mm] | Gaussians | seconds |"
    measured = {name: part for name, part in result.items() if isinstance(part, dict) and "failed" not in part}
    tables: dict[str, list[tuple[str, Row]]] = {}
    for name, part in measured.get("walker", {}).get("contenders", {}).items():
        tables[name] = [(f"frame {row['frame']}", row) for row in part["frames"]]
    for section, label in (("gaussians", "gaussians"), ("cameras", "cameras")):
        tables[section] = [(f"{row[label]:,} {label}", row) for row in measured.get(section, {}).get("rows", [])]
    tables["large"] = [(f"frame {row['frame']}", row) for row in measured.get("large", {}).get("frames", [])]
    for title, rows in tables.items():
        if rows:
            lines += ["", f"| {title} | {heads}", "|---" * 8 + "|", *(_line(label, row) for label, row in rows)]
    for name, part in measured.get("walker", {}).get("contenders", {}).items():
        last = part["drift"][-1]["vertices"]
        lines.append(f"\n{name}: drift per vertex at the end {last['mean_mm']:.2f} mm; reached: {part['reached']}")
    for row in measured.get("stability", {}).get("rows", []):
        lines.append(f"- {row['case']}: {'; '.join(row['faults']) or 'ok'} ({', '.join(row['detected']) or 'nothing'})")
    return "\n".join(lines) + "\n"


def _line(label: str, row: Row) -> str:
    """Return one line of a table."""
    shown = (
        (row["psnr"], ".2f"),
        (row["solid_psnr"], ".2f"),
        (row["ssim"], ".4f"),
        (row.get("normals_median_degrees"), ".2f"),
        (row.get("surface", {}).get("chamfer_mm"), ".2f"),
        (row["gaussians"], ",d"),
        (row["seconds"], ".1f"),
    )
    return f"| {label} | " + " | ".join("" if value is None else format(value, form) for value, form in shown) + " |"


def maker(effort: Effort, device: str) -> Make:
    """Return what makes the package's own contenders."""

    def make(name: str, count: int) -> Contender:
        if name == RADE_GS_LIKE:
            return rade_gs_like(count, device, effort.iterations)
        return ours(count, device, **effort.fitting)

    return make


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("BEAM_DATA", "../shared/data")))
    parser.add_argument("--gaussians", type=int, help="other than by default")
    record.add_arguments(parser)
    parser.add_argument(
        "--only", nargs="+", default=(), choices=SECTIONS, metavar="SECTION", help="these sections only"
    )
    parser.add_argument("--quick", action="store_true", help="the demo's capture, small: does all of it run?")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    effort = QUICK if arguments.quick else FULL
    if arguments.gaussians:
        effort = replace(effort, gaussians=arguments.gaussians)
    keep = partial(record.write_result, arguments, device)

    with tempfile.TemporaryDirectory() as folder:
        if arguments.quick:
            capture = write_demo_capture(
                Path(folder) / "demo", camera_count=8, size=64, samples=4, frame_count=4, device=arguments.device
            )
        else:
            capture = Capture.read(arguments.data / "captures" / "walker")
        say = lambda text: print(text, file=sys.stderr, flush=True)  # noqa: E731
        bench = Bench(capture, effort, maker(effort, arguments.device), device, say)
        result = measure(bench, only=arguments.only, keep=keep)
    print(markdown(result), end="")
    return 1 if result["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
