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

import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import record
from materials_bench import quick_capture
from parts import Row, measure_all
from relight_accuracy import measure_accuracy, measure_shadows
from relight_cost import measure_deferred, measure_moving, measure_path
from relight_energy import measure_consistent, measure_furnace
from relight_scenes import FULL, ON_CPU, QUICK, Bench

from beam_warp.capture.capture import Capture
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


def quick_bench(folder: Path, device: Any) -> Bench:
    """Return a bench that runs in no time, on the demo's capture."""
    sizes = {"camera_count": 1, "test_camera_count": 2, "size": 48, "frame_count": 1}
    return bench_of_capture(quick_capture(folder, device, **sizes), device)


def bench_of_capture(capture: Capture, device: Any) -> Bench:
    """Return a quick bench of one capture."""
    return Bench({"demo": capture}, {}, sunset(), QUICK, device, None)


def main() -> int:
    parser = record.parser(__doc__, device=True, data=True, quick="the demo's capture, small", parts=PARTS)
    parser.add_argument("--captures", nargs="+", default=["walker", "runner", "robot"], help="names there")
    parser.add_argument("--assets", type=Path, metavar="DIR", help="decomposed reconstructions, NAME/asset.usda")
    parser.add_argument("--gaussians", type=int, help="other than by default, everywhere")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="images of the captures, as relight.npz")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    with tempfile.TemporaryDirectory() as folder:
        if arguments.quick:
            bench = quick_bench(Path(folder), device)
        else:
            captures = {name: Capture.read(arguments.data / "captures" / name) for name in arguments.captures}
            effort = FULL if device.is_cuda else ON_CPU
            if arguments.gaussians:
                effort = replace(effort, gaussians=arguments.gaussians, perfect_gaussians=arguments.gaussians)
            bench = Bench(captures, {}, read_sky(arguments.data), effort, device, None)
        assets = find_assets(arguments.assets, list(bench.captures))
        bench = replace(bench, assets=assets, pictures=arguments.pictures)
        return measure_all(PARTS, bench, arguments, device, arguments.parts)


if __name__ == "__main__":
    sys.exit(main())
