"""How a second of a take holds together: drift, lost frames, quality and flicker over 24 frames.

    python benchmarks/steady_take.py --out FILE [--device cuda:0] [--data DIR] [--parts PART] [--keep DIR] [--quick]

``walk`` is the model of the capture ``walker``, whose own capture ends after 6 frames, path traced for 24 cameras of
320 x 320 pixels under its light; ``case`` are 16 frames of it with a case in the hand, which lets go of it in frame 8:
from frame 13 on it stands on the floor.
Each is run by the defaults of ``beam run`` (cameras, masks and exposures are kept: they are right), and scored as
``beam evaluate`` does. Drift is measured from each key frame to the frames that are tracked from it; a pixel is as
large as at the subject's middle. ``--keep`` leaves captures and assets there.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import record
from parts import measure_all, say
from reconstruction_captures import PUT_DOWN, write_walking_capture
from walking_take import SkinnedModel

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.cli.reconstruct import Modelling
from beam_warp.cli.run import Run, run
from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.materials import EvaluateOptions, score_materials
from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.evaluate.scores import MaterialScores
from beam_warp.reconstruction.drift import tracking_drift
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.world.environment import EnvironmentMap

Row = dict[str, Any]

KEPT = Modelling(cameras="keep", masks="keep", exposures="keep")

CASE_FRAMES = 16
"""Frames with a case: it stands by then."""

CHANNELS = ("novel_view", "ambient_occlusion", "base_color", "roughness")


@dataclass(frozen=True)
class Bench:
    """What both takes share.

    Attributes:
        model: The walker.
        light: That of its capture.
        device: Name of the device.
        place: Folder of captures and assets.
        frames: Frames of a take.
        size: Side of an image [pixel].
        samples: Paths of a pixel.
        subdivisions: Of the model's triangles.
        modelling: What ``beam run`` is told.
    """

    model: SkinnedModel
    light: EnvironmentMap
    device: str
    place: Path
    frames: int = 24
    size: int = 320
    samples: int = 32
    subdivisions: int = 2
    modelling: Modelling = KEPT


def measure_take(bench: Bench, *, case: bool) -> Iterator[Row]:
    """Yield what is known of a take: path traced, then reconstructed with its drift, then scored."""
    name = "case" if case else "walk"
    began = time.perf_counter()
    capture = write_walking_capture(
        bench.place / name,
        bench.model,
        bench.light,
        frame_count=min(bench.frames, CASE_FRAMES) if case else bench.frames,
        case=case,
        size=bench.size,
        samples=bench.samples,
        subdivisions=bench.subdivisions,
        device=bench.device,
    )
    found: Row = {"put_down": PUT_DOWN if case else None, "samples": bench.samples}
    found["seconds_to_path_trace"] = time.perf_counter() - began
    say(f"{name}: path traced")
    out, began = bench.place / f"{name}-asset", time.perf_counter()
    run(Run(input=capture.folder, out=out, modelling=bench.modelling, workers="1", device=bench.device, quiet=True))
    found["seconds_to_run"] = time.perf_counter() - began
    report = json.loads((out / "reconstruction" / "report.json").read_text(encoding="utf-8"))
    asset = converters.read(out / "asset.usda")
    found["pixel_mm"] = pixel_mm(capture)
    found["frames"] = [
        {name: entry.get(name) for name in ("frame", "kind", "segment", "lost", "psnr", "gap", "torn", "start")}
        | {"gaussians": entry["gaussians"], "seconds": entry["seconds"]}
        for entry in report["frames"]
    ]
    for entry in drifts(capture, asset, [entry["segment"] for entry in found["frames"]], bench.device):
        found["frames"][entry.pop("frame")]["drift"] = entry
    yield found
    options = EvaluateOptions(relighters=(), device=bench.device)
    scores = score_materials(asset, capture, options, metrics=PerceptualMetrics())
    for entry in found["frames"]:
        entry |= frame_scores(scores, entry["frame"])
    found["temporal"] = scores.temporal.as_dict()
    yield found


def drifts(capture: Capture, asset: Any, segments: list[int], device: str) -> Iterator[Row]:
    """Yield the drift of every frame since the key frame that it was tracked from."""
    for segment in sorted(set(segments)):
        frames = [frame for frame, of in enumerate(segments) if of == segment]
        meshes = [read_truth_mesh(capture, frame) for frame in frames]
        moved = tracking_drift(
            (asset[frame] for frame in frames),
            (mesh.vertices for mesh in meshes),
            meshes[0].faces,
            cameras=[entry.camera for entry in capture.select(split="train", frames=frames[:1])],
            device=device,
        )
        for frame, entry in zip(frames, moved, strict=True):
            yield {"frame": frame, **entry.as_dict()}


def frame_scores(scores: MaterialScores, frame: int) -> Row:
    """Return the means over the test views of a frame [dB; degree; mm]."""
    views = [view for view in scores.views if view.frame == frame]
    found: Row = {
        name: float(np.mean([view.channels[name].psnr for view in views]))
        for name in CHANNELS
        if all(name in view.channels for view in views)
    }
    for name in ("normals_mean_degrees", "depth_median_mm"):
        found[name] = float(np.mean([getattr(view, name) for view in views]))
    return found


def pixel_mm(capture: Capture) -> Row:
    """Return the side of a pixel at the middle of the first frame's surface, in the nearest camera and the median."""
    vertices = np.asarray(read_truth_mesh(capture, capture.frames[0]).vertices, np.float64)
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    sides = [
        1e3 * float(camera.project(middle[None])[0, 2]) / camera.focal_x
        for camera in (entry.camera for entry in capture.select(split="train", frames=capture.frames[:1]))
    ]
    return {"smallest": min(sides), "median": float(np.median(sides))}


def quick(model: SkinnedModel, light: EnvironmentMap, device: str, place: Path) -> Bench:
    """Return a bench of a few frames and Gaussians, for few cameras: does it run?"""
    modelling = replace(KEPT, gaussians=1_500, preset="draft")
    return Bench(model, light, device, place, frames=2, size=96, samples=4, subdivisions=0, modelling=modelling)


PARTS = {"walk": partial(measure_take, case=False), "case": partial(measure_take, case=True)}


def main() -> int:
    parser = record.parser(__doc__, device=True, data=True, quick="two frames of few Gaussians", parts=PARTS)
    parser.add_argument("--keep", type=Path, metavar="DIR", help="leave captures and assets in this folder")
    arguments = parser.parse_args()
    light = EnvironmentMap.read(arguments.data / "captures/walker/environment.exr")
    model = SkinnedModel(arguments.data / "meshes/cesiumman/CesiumMan.glb")
    with tempfile.TemporaryDirectory() as folder:
        place = arguments.keep or Path(folder)
        make = quick if arguments.quick else Bench
        bench = make(model, light, arguments.device, place)
        return measure_all(PARTS, bench, arguments, resolve_device(arguments.device), arguments.parts)


if __name__ == "__main__":
    sys.exit(main())
