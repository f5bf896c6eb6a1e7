"""Quality of decomposed materials, the gain of each idea, and the cost at the paper's scale.

    python benchmarks/materials.py --parts evaluation --out results.json [--device cuda:0] [--data DIR] [--quick]

Parts: ``evaluation`` decomposes reconstructions by the direct path and by the paper's preset with either denoiser, and
scores and relights what comes out; ``roughness`` scores roughness of one frame and of all, and its stated errors;
``ablation`` goes from the paper's recipe to ours one idea at a time, then without each idea alone, then over the image
path's own settings; ``perfect`` decomposes Gaussians sampled from the true surface: light at 64 rays on every HDRI,
occlusion, base colour with and without the bounce; ``cost`` times both paths on 140,000 Gaussians and 81 views of
3840 x 2160 that lie in memory decoded, and how that grows: it is the only part whose seconds count, and must run alone.
``--quick`` is the demo's capture, small: does all of it run?

Reconstructions are given with ``--assets DIR``, as reconstruction.py ``--keep`` writes them, or made here
(``--gaussians``). ``--keep DIR`` keeps what the direct path makes as DIR/NAME/asset.usda, for relight.py to relight;
``--pictures DIR`` gets a sheet of it. Writes the JSON after every row, so that a kill loses little. A part that fails
says so in its place; the program returns 1 then.
"""

from __future__ import annotations

import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import record
from device_memory import peak_memory
from materials_bench import FULL, Bench, quick_bench, read_lights
from materials_contenders import AblationRow, Subject, Unavailable, ablation_rows, seen_normals
from materials_cost import measure_cost
from materials_evaluation import measure_evaluation, measure_roughness, subject_of
from materials_perfect import measure_perfect
from materials_truth import TruthViews, row_of
from parts import Row, measure_all, say

from beam_warp.capture.capture import Capture
from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.relighters import deferred_relighter


def measure_ablation(bench: Bench) -> Iterator[Row]:
    """Yield the ablation so far of every reconstruction."""
    result: Row = {"captures": {}}
    rows = ablation_rows(high=bench.effort.high)
    for name, capture in bench.captures.items():
        subject = subject_of(bench, name)
        truth = TruthViews(capture, subject.frames[0].number, subject.raster, bench.effort.samples, str(bench.device))
        part: Row = {
            "gaussians": len(subject.frames[0].cloud),
            "frames": [frame.number for frame in subject.frames],
            "rows": [],
        }
        result["captures"][name] = part
        warm, normals = subject.small(), seen_normals(subject)
        for row in rows:
            entry = {"group": row.group, "name": row.name, **measure_row(row, subject, warm, truth, normals)}
            if "base_color" in entry:
                say(f"{name}, {row.group}, {row.name}: {row_of(entry)}, {entry['seconds']:.2f} s")
            else:
                say(f"{name}, {row.group}, {row.name}: {entry.get('unavailable') or entry.get('failed')}")
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
        scores["relit"] = truth.score_relit(cloud, found, deferred_relighter)
    return {"seconds": sum(done.seconds.values()), "frames": done.frames, "notes": list(done.notes), **memory, **scores}


def measure_scale(bench: Bench) -> Iterator[Row]:
    """Yield what it costs so far."""
    capture = next(iter(bench.captures.values()))
    result: Row = {}
    for name, part in measure_cost(capture, bench.light_of(capture), bench.effort.scale, bench.device):
        result[name] = part
        yield result


PARTS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "evaluation": measure_evaluation,
    "roughness": measure_roughness,
    "ablation": measure_ablation,
    "perfect": measure_perfect,
    "cost": measure_scale,
}


def main() -> int:
    parser = record.parser(__doc__, device=True, data=True, quick="the demo's capture, small", parts=PARTS)
    parser.add_argument("--captures", nargs="+", default=["walker", "runner", "robot"], help="names there")
    parser.add_argument("--assets", type=Path, metavar="DIR", help="reconstructions, NAME/gaussians.usda")
    parser.add_argument("--gaussians", type=int, default=140_000, help="of reconstructions that are made here")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="the direct path's assets, DIR/NAME/asset.usda")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="evaluated assets as materials_NAME.png")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    with tempfile.TemporaryDirectory() as folder:
        if arguments.quick:
            bench = quick_bench(Path(folder), device)
        else:
            bench = Bench(
                captures={name: Capture.read(arguments.data / "captures" / name) for name in arguments.captures},
                lights=read_lights(arguments.data),
                assets=arguments.assets,
                effort=replace(FULL, gaussians=arguments.gaussians),
                device=device,
                folder=Path(folder),
            )
        bench = replace(bench, keep=arguments.keep, pictures=arguments.pictures)
        return measure_all(PARTS, bench, arguments, device, arguments.parts)


if __name__ == "__main__":
    sys.exit(main())
