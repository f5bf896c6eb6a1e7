"""What workers make of a take: ``beam run`` of 24 cameras of 1080p by one process, several on a GPU, or one on each.

    python benchmarks/workers.py [--quick] [--parts PART] [--frames N --segment-length N] [--workers WORD ...] --out R

``start``: how long a tiny take needs until its first step begins, and in all, kernels compiled before. ``capture``: how
long the capture walker takes in all, six frames of 24 views of 320 pixels, all options as they are. ``take``:
The take shows a few moments of `beam_warp.demo.capture` over and over. A first run of few small views compiles kernels.
For each way of working: the seconds of each kind of step; the time before the first one, from the first one to the end
of the last, and after it; frames an hour of one GPU, and the efficiency of GPUs against the first way, both by the time
from the first step to the last, for a take is long; the most memory that a process had; and whether the results are the
same bytes. Cameras, masks and exposures are kept, for they are looked at once in a take; segments are cut, for they are
so short here that seams would cost more than in a take (``--seam-frames``).
"""

from __future__ import annotations

import functools
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import record
from parts import measure, say
from timing import spread

from beam_warp.demo.capture import DANCE_SECONDS, FRAMES_PER_SECOND, demo_figure_for, dome_cameras, write_capture
from beam_warp.demo.lights import studio
from beam_warp.device.arrays import resolve_device
from beam_warp.plan.crew import AUTO, GPUS, SHARING, visible_gpus
from beam_warp.plan.standing import look
from beam_warp.plan.steps import Rank

Row = dict[str, Any]

BEAM = (sys.executable, "-P", "-c", "from beam_warp.cli.entry import beam; raise SystemExit(beam())")
STARTS, RUNS = 5, 2
"""How often tiny takes, and a capture, are run."""

KEPT = ("--cameras", "keep", "--masks", "keep", "--exposures", "keep", "--quiet")


@dataclass
class Bench:
    """The take, and by whom it is worked on.

    Attributes:
        frames: Of the take.
        segment: Frames of a segment.
        drawn: Moments that are path traced.
        cameras: Around the figure.
        width: Of an image [pixel].
        height: Of an image [pixel].
        gaussians: Of a frame.
        workers: What ``--workers`` is given, one run each.
        seam: Frames in which segments overlap.
        more: Further words of the command.
    """

    frames: int
    segment: int
    drawn: int
    workers: tuple[str, ...]
    seam: int = 0
    cameras: int = 24
    width: int = 1920
    height: int = 1080
    gaussians: int = 140_000
    more: tuple[str, ...] = ()
    place: Path = field(default_factory=Path)
    data: Path = field(default_factory=Path)

    def capture(self, name: str, cameras: int, width: int, height: int, frames: int) -> Path:
        """Path trace a capture, and name its moments over and over."""
        folder = self.place / name
        figure = demo_figure_for(height)
        meshes = [figure.at(moment / (FRAMES_PER_SECOND * DANCE_SECONDS)) for moment in range(self.drawn)]
        dome = dome_cameras([mesh.vertices for mesh in meshes], cameras, 0, width, height)
        write_capture(folder, meshes, dome, studio(), samples=4)
        file = folder / "transforms.json"
        content = json.loads(file.read_text(encoding="utf-8"))
        drawn = {moment: [it for it in content["frames"] if it["frame"] == moment] for moment in range(self.drawn)}
        content["frames"] = [{**it, "frame": k} for k in range(frames) for it in drawn[k % self.drawn]]
        file.write_text(json.dumps(content), encoding="utf-8")
        return folder

    def run(self, capture: Path, workers: str, gaussians: int) -> Row:
        """Run the command, and return what its receipts and its report say."""
        out = self.place / f"{capture.name} by {workers}"
        size = ("--gaussians", str(gaussians), "--segment-length", str(self.segment), "--seam-frames", str(self.seam))
        command = [*BEAM, "run", str(capture), *size, "--workers", workers, "--out", str(out), *KEPT, *self.more]
        began = time.time()
        subprocess.run(command, check=True)
        ended = time.time()
        standing = look(out)
        receipts = standing.receipts.values()
        first = min(receipt.ended - receipt.seconds for receipt in receipts)
        last = max(receipt.ended for receipt in receipts)
        each, _, place = workers.rpartition("@")
        count = int(each or 1) * len(visible_gpus()) if place == GPUS else SHARING if workers == AUTO else int(workers)
        gpus = 1 if workers == AUTO else max(min(count, len(visible_gpus())), 1)
        times = dict[str, list[float]]()
        for step in standing.steps:
            kind = "key frame" if step.rank == Rank.KEY_FRAME else step.stage
            times.setdefault(kind, []).append(standing.receipts[step.name].seconds)
        report = json.loads((out / "report.json").read_text(encoding="utf-8"))
        return {
            "name": workers,
            "workers": count,
            "gpus": gpus,
            "out": out,
            "before": first - began,
            "working": last - first,
            "after": ended - last,
            "busy": sum(receipt.seconds for receipt in receipts) / (count * (last - first)),
            "frames_per_hour_a_gpu": self.frames * 3600.0 / (last - first) / gpus,
            "steps": {stage: {"count": len(each), "median": statistics.median(each)} for stage, each in times.items()},
            "seconds": report["seconds"],
            "peak_bytes": 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss,
        }


def contents(out: Path) -> dict[str, bytes]:
    """Return every byte that a run promises: all but times and words of the plan."""
    files = (
        path for path in out.rglob("*") if path.is_file() and path.suffix != ".json" and path.parent.name != "plan"
    )
    return {str(path.relative_to(out)): path.read_bytes() for path in files}


def take(bench: Bench) -> Iterator[Row]:
    """Work on the take in each way, and compare."""
    began = time.perf_counter()
    capture = bench.capture("take", bench.cameras, bench.width, bench.height, bench.frames)
    say(f"capture: {time.perf_counter() - began:.1f} s")
    bench.run(bench.capture("warm", 8, 128, 128, 2), "1", 2000)
    say(f"warm: {time.perf_counter() - began:.1f} s")
    rows: list[Row] = []
    first: dict[str, bytes] = {}
    for workers in bench.workers:
        row = bench.run(capture, workers, bench.gaussians)
        made = contents(row.pop("out"))
        if rows:
            row["efficiency"] = rows[0]["working"] * rows[0]["gpus"] / (row["working"] * row["gpus"])
            row["differing_files"] = sorted(k for k in first.keys() | made.keys() if first.get(k) != made.get(k))
        first = first or made
        rows.append(row)
        say(json.dumps(row))
        size = {"frames": bench.frames, "segment": bench.segment, "seam": bench.seam, "cameras": bench.cameras}
        yield {**size, "width": bench.width, "height": bench.height, "gaussians": bench.gaussians, "rows": rows}


def start(bench: Bench) -> Iterator[Row]:
    """Start again and again: two frames of few small views, in two segments."""
    tiny = replace(bench, segment=1, frames=2, more=("--preset", "draft"))
    capture, rows = tiny.capture("tiny", 6, 48, 48, 2), list[Row]()
    for workers in tiny.workers:
        runs = list[Row]()
        for _ in range(1 + STARTS):  # the first one compiles
            runs.append(tiny.run(capture, workers, 300))
            shutil.rmtree(runs[-1]["out"])
        times = {name: spread(np.array([run[name] for run in runs[1:]])) for name in ("before", "working", "after")}
        whole = spread(np.array([sum(run[name] for name in times) for run in runs[1:]]))
        rows.append({"name": workers, "workers": runs[0]["workers"], **times, "whole": whole})
        say(json.dumps(rows[-1]))
        yield {"rows": rows}


def capture(bench: Bench) -> Iterator[Row]:
    """Run the command on a capture as it is, in each way, after a run that compiles."""
    folder, rows = bench.data / "captures" / "walker", list[Row]()

    def seconds(workers: str) -> float:
        began = time.perf_counter()
        out = bench.place / "walker"
        subprocess.run([*BEAM, "run", str(folder), "--workers", workers, "--out", str(out), "--quiet"], check=True)
        shutil.rmtree(out)
        return time.perf_counter() - began

    seconds(bench.workers[0])
    for workers in bench.workers:
        rows.append({"name": workers, "whole": spread(np.array([seconds(workers) for _ in range(RUNS)]))})
        say(json.dumps(rows[-1]))
        yield {"rows": rows}


PARTS = {"start": start, "take": take, "capture": capture}


def main() -> None:
    """Measure, and write the result after every run."""
    parser = record.parser(__doc__, data=True, quick="small images, to see whether it runs", parts=PARTS)
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--segment-length", type=int, default=3)
    parser.add_argument("--seam-frames", type=int, default=0)
    parser.add_argument("--drawn", type=int, default=2, help="moments that are path traced")
    parser.add_argument("--workers", nargs="+", default=["1", "gpus"], help="as beam run has it, one run each")
    arguments = parser.parse_args()
    sizes = arguments.frames, arguments.segment_length, arguments.drawn
    bench = Bench(*sizes, tuple(arguments.workers), arguments.seam_frames)
    if arguments.quick:
        bench = Bench(4, 2, 1, ("1", "2"), 0, 8, 64, 48, 500, ("--device", "cpu", "--preset", "draft"))
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    keep = functools.partial(record.write_result, arguments, resolve_device(None))
    with tempfile.TemporaryDirectory() as name:
        bench.place, bench.data = Path(name), arguments.data
        measure(PARTS, bench, only=arguments.parts, keep=keep)


if __name__ == "__main__":
    main()
