"""What relighting costs and how near it comes to the truth: deferred in real time, path traced offline.

    python benchmarks/relight.py --parts PART ... --out results.json [--device cuda:0] [--data DIR] [--quick]

Parts: ``deferred``, ``path`` and ``moving`` time frames of 140,000 Gaussians at 1920 x 1080; ``accuracy`` scores and
times images of captures, with true materials on the true surface, and of the demo figure, whose materials are known at
every point; ``shadows`` scores decomposed reconstructions (``--assets DIR``: DIR/walker/asset.usda and so on) by the
number of shadow maps and bounces; ``furnace`` and ``consistent`` ask whether light is lost or added. Only the first
four time anything and must run alone. ``--quick`` is the demo's capture, small: does all of it run?

``--pictures DIR`` gets images of the captures, which tables.py draws. Writes the JSON after every row. A part that
fails says so in its place; the program returns 1 then.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import record
from parts import Row, measure
from relight_accuracy import measure_accuracy, measure_shadows
from relight_cost import measure_deferred, measure_moving, measure_path
from relight_energy import measure_consistent, measure_furnace
from relight_scenes import FULL, ON_CPU, QUICK, Bench

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
    "shadows": measure_shadows,
    "furnace": measure_furnace,
    "consistent": measure_consistent,
}


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
    parser.add_argument("--captures", nargs="+", default=["walker", "runner", "robot"], help="names there")
    parser.add_argument("--assets", type=Path, metavar="DIR", help="decomposed reconstructions, NAME/asset.usda")
    parser.add_argument("--gaussians", type=int, help="other than by default, everywhere")
    record.add_arguments(parser)
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="images of the captures, as relight.npz")
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
            bench = quick_bench(Path(folder), device, say)
        else:
            captures = {name: Capture.read(arguments.data / "captures" / name) for name in arguments.captures}
            effort = FULL if device.is_cuda else ON_CPU
            if arguments.gaussians:
                effort = replace(effort, gaussians=arguments.gaussians, perfect_gaussians=arguments.gaussians)
            bench = Bench(captures, {}, read_sky(arguments.data), effort, device, None, say)
        assets = find_assets(arguments.assets, list(bench.captures))
        bench = replace(bench, assets=assets, pictures=arguments.pictures)
        result = measure(PARTS, bench, only=arguments.parts, keep=keep)
    return 1 if result["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
