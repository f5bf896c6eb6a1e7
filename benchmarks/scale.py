"""How long takes scale: the plan of a take, carried out by simulated workers, and what is left to do at the end.

    python benchmarks/scale.py [--quick] [--parts PART] --out result.json

- ``constants``: seconds of a step by stage, while as many processes share a GPU as make most frames an hour (`WORKED`);
  and of writing an asset, measured here on one core, of clouds in which everything varies: surveying a frame, its part
  of a clip, and what is left at the end.
- ``takes``: the plan that ``beam run`` makes of 18,000 frames, handed out by the schedule that carries it out.
- ``check``: a take of steps that sleep, carried out by processes of this machine, beside its simulation.

Steps that are made once take no time in ``takes``.
"""

from __future__ import annotations

import functools
import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import record
from parts import measure, say

from beam_warp.converters.clips import ClipWork
from beam_warp.decomposition.frames import ReconstructedFrames
from beam_warp.decomposition.options import RunOptions
from beam_warp.decomposition.work import MaterialWork
from beam_warp.device.arrays import resolve_device
from beam_warp.jobs.listeners import no_progress
from beam_warp.outputs import replacing
from beam_warp.plan.carry import carry_out
from beam_warp.plan.crew import crew_of
from beam_warp.plan.standing import simulated
from beam_warp.plan.steps import Plan, Receipt, Step, Task
from beam_warp.plan.workers import InProcess
from beam_warp.reconstruction.frames.plan import FramePlan, plan_segments
from beam_warp.reconstruction.job import ReconstructionWork, ReconstructOptions
from beam_warp.schema.clips import CLIP_FRAMES
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence

Row = dict[str, Any]

WORKED = "workers_h200.json"
MEASURED = {"key_frame": "key frame", "tracked_frame": "frame", "materials": "materials", "preview": "preview"}
"""Kinds of steps in that result, by the names that they have here."""

ASSETS = ("gaussians", "asset")
"""Assets that a take becomes: what was reconstructed, and what can be relit. Both are charged as the larger one."""

FADED = 2.0
"""Gaussians of a frame where two segments overlap, over those of one."""

FRAMES, GPUS, SEGMENTS = 18_000, (1, 2, 8, 64, 256, 1024), (30, 120)


@dataclass
class Bench:
    """Sizes of what is measured.

    Attributes:
        frames: Of the take that is simulated.
        count: Gaussians of the asset that is written.
        written: Frames of it.
        nap: How long a second of a step takes in ``check`` [s].
    """

    frames: int = FRAMES
    count: int = 140_000
    written: int = 90
    nap: float = 0.5

    @functools.cached_property
    def written_frame(self) -> Row:
        """Seconds of the processor, and bytes, of a frame of an asset; and seconds of what is left at the end."""
        clouds = [_random_cloud(self.count, seed) for seed in range(3)]
        sequence = GaussianSequence(
            frame_count=self.written,
            read_frame=lambda index: clouds[index % len(clouds)],
            frames_per_second=30.0,
            constant=frozenset(),
            topology="perFrame",
            metadata={},
        )
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            clips = ClipWork(folder, "asset", lambda: sequence, [()] * self.written, range(self.written))
            plan, spent, began = clips.plan(), dict[str, float](), time.process_time()

            def count(step: Step, receipt: Receipt | None, error: str) -> None:
                nonlocal began
                spent[step.stage] = spent.get(step.stage, 0.0) + time.process_time() - began
                began = time.process_time()

            receipts = carry_out(plan, InProcess(plan.works, no_progress), count)
            began = time.process_time()
            layers = clips.write(
                sequence, folder / "asset.usda", {name: receipt.facts for name, receipt in receipts.items()}
            )
            return {
                "survey": spent["asset-survey"] / self.written,
                "clip": spent["asset-clip"] / self.written,
                "end": spent["asset-whole"] + time.process_time() - began,
                "bytes": sum(layer.stat().st_size for layer in layers) / self.written,
            }


def _random_cloud(count: int, seed: int) -> GaussianCloud:
    """Return a cloud with all that a decomposed frame has; nothing in it can be compressed."""
    random = np.random.default_rng(seed)

    def even(*shape: int) -> np.ndarray:
        return random.random((count, *shape), dtype=np.float32)

    def unit(size: int) -> np.ndarray:
        vectors = even(size) - 0.5
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    return GaussianCloud(
        positions=even(3),
        orientations=unit(4),
        scales=0.001 + 0.01 * even(3),
        opacities=even(),
        radiance=even(4, 3),
        radiance_color_space="srgb_rec709_display",
        base_color=even(3),
        base_color_error=even(3),
        roughness=even(),
        roughness_error=even(),
        ambient_occlusion=even(),
        observability=even(),
        normals=unit(3),
        axes="rfu",
    )


def constants(bench: Bench) -> Iterator[Row]:
    """Seconds a step, by stage; of a key frame and a tracked one."""
    known = json.loads((record.RESULTS / WORKED).read_text(encoding="utf-8"))
    best = max(known["take"]["rows"], key=lambda row: row["frames_per_hour_a_gpu"])
    seconds = {name: best["steps"][kind]["median"] for name, kind in MEASURED.items()}
    yield {
        "processes": best["workers"] // best["gpus"],
        "seconds": seconds,
        "written": bench.written_frame,
        "device": known["measured"]["machine"]["device"],
    }


def take_steps(frames: int, segment: int) -> tuple[Step, ...]:
    """Return the steps of ``beam run`` for a take; nothing of it is read."""
    kept = ReconstructOptions(cameras="keep", masks="keep", exposures="keep", segment_length=segment)
    with tempfile.TemporaryDirectory() as name:
        folder: Any = Path(name)
        nothing: Any = None
        planned = FramePlan(dict.fromkeys(range(frames), ()), plan_segments(range(frames), segment), ())
        frames_work = ReconstructionWork(nothing, folder, nothing, kept, planned, [])
        light = EnvironmentMap(np.ones((4, 8, 3), np.float32))
        work = MaterialWork(folder, ReconstructedFrames(frames_work, None), light, RunOptions())
        return work.plan().with_steps_of(frames_work.plan()).steps


def as_stages(steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """Return the steps with stages of their own for key frames, and for materials where two segments overlap."""

    def stage(step: Step) -> str:
        if step.stage == "frame" and not step.inputs:
            return "key_frame"
        fades = any(name.startswith("seam-") for name in step.inputs)
        return "faded_materials" if step.stage == "materials" and fades else step.stage

    return tuple(replace(step, stage=stage(step)) for step in steps)


def takes(bench: Bench) -> Iterator[Row]:
    """Hours, GPU hours and efficiency of a take, by GPUs; also were its assets written by one process at the end."""
    (known,) = constants(bench)
    written, measured = known["written"], known["seconds"]
    survey, clip = (CLIP_FRAMES * written[name] for name in ("survey", "clip"))
    seconds = {
        "key_frame": measured["key_frame"],
        **dict.fromkeys(("frame", "seam"), measured["tracked_frame"]),
        "materials": measured["materials"],
        "faded_materials": FADED * measured["materials"],
        "light": 0.0,
        "preview": measured["preview"],
        **{f"{asset}-{stage}": spent for asset in ASSETS for stage, spent in (("survey", survey), ("clip", clip))},
        **{f"{asset}-whole": 0.0 for asset in ASSETS},
    }
    rows: list[Row] = []
    for segment in SEGMENTS:
        steps = as_stages(take_steps(bench.frames, segment))
        frames = tuple(step for step in steps if not step.stage.startswith(ASSETS))
        work = sum(seconds[step.stage] for step in frames)
        serial = len(ASSETS) * bench.frames * (written["survey"] + written["clip"])
        end = len(ASSETS) * written["end"]
        for gpus in GPUS:
            workers = gpus * known["processes"]
            spent = simulated(steps, (), seconds, workers) + end
            alone = simulated(frames, (), seconds, workers) + serial + end
            rows.append(
                {
                    "name": f"{gpus} x {segment}",
                    "gpus": gpus,
                    "workers": workers,
                    "segment": segment,
                    "hours": spent / 3600.0,
                    "busy_hours": work / 3600.0,
                    "efficiency": work / (workers * spent),
                    "frames_per_hour_a_gpu": bench.frames / (spent / 3600.0) / gpus,
                    "hours_written_by_one": alone / 3600.0,
                    "efficiency_written_by_one": work / (workers * alone),
                }
            )
            say(json.dumps(rows[-1]))
            yield {"frames": bench.frames, "rows": rows}


@dataclass
class Naps:
    """Work whose steps sleep."""

    later = ()
    folder: Path
    seconds: Mapping[str, float] = field(default_factory=dict)

    def common(self) -> str:
        """Return nothing: no code matters."""
        return ""

    def digest(self, step: Step) -> str:
        """Return nothing: nothing is read."""
        return ""

    def outputs(self, step: Step) -> tuple[Path, ...]:
        """Return one small file."""
        return (self.folder / "out" / step.name,)

    def do(self, task: Task, progress: Any) -> Mapping[str, Any]:
        """Sleep as long as the stage takes."""
        time.sleep(self.seconds[task.step.stage])
        with replacing(self.outputs(task.step)[0]) as temporary:
            temporary.write_bytes(b"")
        return {}


def check(bench: Bench) -> Iterator[Row]:
    """Compare the simulation with processes that sleep through the plan of 16 segments, two assets included."""
    seconds = {"key_frame": 12.0, "frame": 11.0, "seam": 11.0, "light": 1.0, "preview": 1.0}
    seconds |= {"materials": 3.0, "faded_materials": FADED * 3.0}
    seconds |= {f"{asset}-{stage}": 3.0 for asset in ASSETS for stage in ("survey", "clip", "whole")}
    naps = {stage: bench.nap * spent for stage, spent in seconds.items()}
    steps = as_stages(take_steps(16 * 5, 5))
    rows: list[Row] = []
    for workers in (4, 8):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "out").mkdir()
            plan = Plan(folder, steps, dict.fromkeys(naps, Naps(folder, naps)))
            receipts = carry_out(plan, crew_of(str(workers), None)(plan, "", lambda *_: None))
            end = max(receipt.ended for receipt in receipts.values())
            starts: dict[str, float] = {}
            for receipt in receipts.values():  # a process takes seconds to start, which a long take does not see
                began = receipt.ended - receipt.seconds
                starts[receipt.worker] = min(starts.get(receipt.worker, began), began)
        work = sum(naps[step.stage] for step in steps)
        spent = sum(end - start for start in starts.values())
        rows.append(
            {
                "name": str(workers),
                "workers": workers,
                "steps": len(steps),
                "efficiency": work / spent,
                "simulated_efficiency": work / (workers * simulated(steps, (), naps, workers)),
            }
        )
        say(json.dumps(rows[-1]))
        yield {"rows": rows}


PARTS = {"constants": constants, "takes": takes, "check": check}


def main() -> None:
    """Measure, and write the result after every part."""
    parser = record.parser(__doc__, quick="smaller, to see whether it runs", parts=PARTS)
    arguments = parser.parse_args()
    bench = Bench(frames=600, count=2000, written=70, nap=0.01) if arguments.quick else Bench()
    keep = functools.partial(record.write_result, arguments, resolve_device("cpu"))
    measure(PARTS, bench, only=arguments.parts, keep=keep)


if __name__ == "__main__":
    main()
