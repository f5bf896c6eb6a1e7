"""Kilobytes a frame of containers and of keyed assets against what relit images lose, over takes of 24 frames.

    python benchmarks/delivery_rates.py [--quick] [--made FOLDER] --out result.json

Takes have as many Gaussians as a user would deliver:

- ``figure``: the demo's dancer (`delivery_take.take`), 140,000 Gaussians with true materials. Its truth is path traced.
- ``walker``: what `beam run CAPTURE --gaussians 140000` makes of the capture's first frame, FOLDER/walker.usdc, which
  walks on (`walking_take.walk`). Its truth are the capture's true relit images of the frames that have them.

Each is written as a container at several factors of the bounds, as it is and after `beam reduce`. The loss is that of
relit images against the truth: PSNR of the take less PSNR of what the container gives back. Lights and cameras of the
truth are none that a search saw.

``dance``, ``calm`` and ``walk`` (by ``--parts``) are takes as USD assets, with a time sample at every frame and with
keys at several factors of the bounds: the dancer, the same three times as slow, and the walker, whose asset may have
any number of Gaussians. The loss that is counted as `beam reduce` does is that of draws of its distribution.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import record
from delivery_take import DANCE_SECONDS, FRAMES_PER_SECOND, take
from parts import measure_all, say
from pxr import Usd
from walking_take import FRAMES_PER_SECOND as WALKED_PER_SECOND
from walking_take import SkinnedModel, walk

from beam_warp.capture.capture import Capture
from beam_warp.converters import WriteOptions, read, write
from beam_warp.converters.common.bounds import bounds_of
from beam_warp.converters.delivery.decoder import Container
from beam_warp.demo.figure import build_figure
from beam_warp.demo.lights import demo_environments
from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.materials import EvaluateOptions, score_materials
from beam_warp.evaluate.relit import RelitComparison
from beam_warp.evaluate.trials import RelitTrials
from beam_warp.image.metrics import compare
from beam_warp.raster.records import RasterOptions
from beam_warp.reduction.job import ReduceOptions, Reducer
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import UNSHADOWED
from beam_warp.schema.keys import departure
from beam_warp.schema.layout import CHANNELS
from beam_warp.schema.stage_queries import array_attribute, splat_prims
from beam_warp.trace.mesh_paths import TracedMesh, trace_radiance
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.mesh import MaterialMesh
from beam_warp.world.shot import Shot

Row = dict[str, Any]
Score = Callable[[GaussianSequence], float]

LIGHTS = ("sunset", "stage")
SEEN = ((0, 25.0, 8.0), (13, 160.0, 20.0), (23, 290.0, 35.0))
"""Frames of the figure that are judged, with azimuth and elevation of the camera [degree]."""

KEYED = ("positions", "orientations", "normals", "ambient_occlusion", "radiance")
"""Arrays of these takes that change."""

WALKER_FRAMES = (0, 4)
"""Frames of the capture whose true images are known."""


@dataclass(frozen=True)
class Bench:
    """What the takes share: sizes, what is kept of them, and how exactly it is written."""

    count: int
    frames: int
    height: int
    paths: int
    shares: Sequence[float]
    factors: Sequence[float]
    options: ReduceOptions
    made: Path | None
    data: Path
    keyed_count: int = 30_000
    draws: int = 48


def figure(bench: Bench, period: float = DANCE_SECONDS) -> tuple[GaussianSequence, Score]:
    """Return the dancer, and what scores it against path-traced images."""
    frames = list(take(build_figure(), bench.count, bench.frames, period=period))
    raster = RasterOptions(antialiased=True)
    clouds = [cloud for _, cloud in frames]
    facts = {"frames_per_second": FRAMES_PER_SECOND, "metadata": raster.as_metadata()}
    views = [(min(frame, bench.frames - 1), *angles) for frame, *angles in SEEN]
    shown = [(frame, _camera(frames[frame][0], bench.height, *angles)) for frame, *angles in views]
    lights = {name: demo_environments()[name] for name in LIGHTS}
    truths = {
        (frame, name): trace_radiance(TracedMesh.from_mesh(frames[frame][0]), camera, light, sample_count=bench.paths)
        for frame, camera in shown
        for name, light in lights.items()
    }
    renderer = DeferredRenderer(UNSHADOWED, raster=raster)

    def score(sequence: GaussianSequence) -> float:
        found = []
        for frame, camera in shown:
            cloud = change_axes(sequence[frame], "rfu")
            for name, light in lights.items():
                image = renderer.draw(Shot(cloud=cloud, camera=camera, environment=light))
                truth = truths[frame, name]
                alphas: Row = {"alpha": image.alpha, "truth_alpha": truth.alpha}
                found.append(compare(image.rgb, truth.rgb, is_color=True, premultiplied=True, **alphas).psnr)
        return float(np.mean(found))

    return GaussianSequence.from_clouds(clouds, **facts), score


def _camera(mesh: MaterialMesh, height: int, azimuth: float, elevation: float) -> Camera:
    width = round(0.8 * height)
    return Camera.frame_points(mesh.vertices, azimuth=azimuth, elevation=elevation, width=width, height=height)


def walker(bench: Bench) -> tuple[GaussianSequence, Score]:
    """Return the walker, and what scores it against the capture's true images."""
    assert bench.made is not None
    first = read(bench.made / "walker.usdc")
    model = SkinnedModel(bench.data / "meshes/cesiumman/CesiumMan.glb")
    clouds = list(walk(change_axes(first[0], "rfu"), model, bench.frames))
    capture = Capture.read(bench.data / "captures/walker")
    metadata = {name: text for name, text in first.metadata.items() if name != "capture_frames"}
    shown = [frame for frame in WALKER_FRAMES if frame < bench.frames]

    def score(sequence: GaussianSequence) -> float:
        some = replace(sequence, frame_count=len(shown), read_frame=lambda k: sequence[shown[k]])
        scores = score_materials(some, capture, EvaluateOptions(frames=tuple(shown)))
        return scores.as_dict()["mean"]["relit_mean"]["deferred"]["psnr"]

    facts = {"frames_per_second": WALKED_PER_SECOND, "metadata": metadata}
    return GaussianSequence.from_clouds(clouds, **facts), score


def parts_of(path: Path, frames: int) -> dict[str, float]:
    """Return about how many kilobytes a frame each array of a container takes: each packed by itself."""
    container, found = Container(path), Counter[str]()
    content = path.read_bytes()
    for entry in (container.manifest["static"], *container.manifest["segments"]):
        start = container._start + entry["offset"]
        found.update(_packed(zlib.decompress(content[start : start + entry["bytes"]]), container.manifest["count"]))
    return {name: size / 1e3 / frames for name, size in found.most_common()}


def _packed(block: bytes, count: int) -> Counter[str]:
    """Return the packed bytes of the planes of each array of a block."""
    length = int.from_bytes(block[:4], "little")
    arrays, found = json.loads(block[4 : 4 + length])["arrays"], Counter[str]()
    sizes = [(each["name"], count * sum(map(sum, pair))) for each in arrays for pair in each["planes"]]
    at = len(block) - sum(size for _, size in sizes)
    for name, size in sizes:
        found[name] += len(zlib.compress(block[at : at + size], 9))
        at += size
    return found


def rates(name: str, made: Callable[[Bench], tuple[GaussianSequence, Score]], bench: Bench) -> Iterator[Row]:
    """Write a take at every share of its Gaussians and factor of its bounds."""
    original, score = made(bench)
    rows: list[Row] = []
    truth = score(original)
    say(f"{name}: {len(original[0])} Gaussians, {truth:.2f} dB")
    reducer = None
    with tempfile.TemporaryDirectory(prefix="beam_rates_") as folder:
        for share in bench.shares:
            kept = original
            if share < 1.0:
                reducer = reducer or Reducer(original, list(demo_environments().values()), bench.options)
                reduced = reducer.reduced(round(share * len(reducer)))
                kept = replace(reduced, read_frame=functools.cache(reduced.read_frame))
            for factor in bench.factors:
                path = Path(folder) / f"{share:g}_{factor:g}.b4d"
                write(kept, path, WriteOptions(error_scale=factor))
                row: Row = {"name": f"{share:g} at {factor:g}", "share": share, "gaussians": len(kept[0])}
                row |= {"factor": factor, "kb_a_frame": path.stat().st_size / 1e3 / bench.frames}
                row |= {"loss": truth - score(read(path)), "kb_of": parts_of(path, bench.frames)}
                rows.append(row)
                say(f"{name} {row}")
                yield {"psnr": truth, "frames": bench.frames, "rows": rows}


def keys(name: str, made: Callable[[Bench], tuple[GaussianSequence, Score]], bench: Bench) -> Iterator[Row]:
    """Write a take with a time sample at every frame, and with keys at every factor of the bounds."""
    original, score = made(replace(bench, count=bench.keyed_count))
    trials = RelitTrials(list(demo_environments().values()), height=bench.options.height)
    draws = trials.draw("certificate", range(bench.draws), range(len(original)))
    comparison, bounds, truth = RelitComparison(original, trials), bounds_of(original[0]), score(original)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="beam_keys_") as folder:
        every = Path(folder) / "every.usdc"
        for factor in (None, *bench.factors):
            path = every if factor is None else every.with_stem(f"keys_{factor:g}")
            options = WriteOptions() if factor is None else WriteOptions(keyed=True, error_scale=factor)
            started = time.process_time()
            write(original, path, options)
            seconds, back = (time.process_time() - started) / bench.frames, read(path)
            losses = comparison.errors(back, draws, keep=True).values("loss")
            row: Row = {"name": f"{factor}", "factor": factor, "kb_a_frame": path.stat().st_size / 1e3 / bench.frames}
            row |= {"write_seconds_a_frame": seconds, "samples": samples_of(path), "loss": truth - score(back)}
            row |= {"counted_mean": float(losses.mean()), "counted_worst": float(losses.max())}
            if factor is not None:
                row["of_bound"] = {n: far / factor / bounds[n] for n, far in departures(back, read(every)).items()}
            rows.append(row)
            say(f"{name} {row}")
            yield {"psnr": truth, "frames": bench.frames, "gaussians": len(original[0]), "rows": rows}


def samples_of(path: Path) -> dict[str, int]:
    """Return how many time samples the arrays of an asset have, those that change."""
    stage = Usd.Stage.Open(str(path))
    found = {each.name: array_attribute(splat_prims(stage)[0], each) for each in CHANNELS.values()}
    counts = {name: attribute.GetNumTimeSamples() for name, attribute in found.items() if attribute is not None}
    return {name: max(count, 1) for name, count in counts.items() if name in KEYED}


def departures(back: GaussianSequence, every: GaussianSequence) -> dict[str, float]:
    """Return how far the arrays of an asset are from those that have a sample at every frame, in the worst frame."""
    pairs = [(one.arrays(), other.arrays()) for one, other in zip(back, every, strict=True)]
    names = [name for name in KEYED if name in pairs[0][0]]
    return {name: max(departure(name, one[name], other[name]) for one, other in pairs) for name in names}


PARTS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    made.__name__: functools.partial(rates, made.__name__, made) for made in (figure, walker)
}
KEYED_PARTS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "dance": functools.partial(keys, "dance", figure),
    "calm": functools.partial(keys, "calm", functools.partial(figure, period=3.0 * DANCE_SECONDS)),
    "walk": functools.partial(keys, "walk", walker),
}


def main() -> int:
    every = PARTS | KEYED_PARTS
    parser = record.parser(__doc__, quick="a small figure of few frames", parts=every, data=True)
    parser.add_argument("--made", type=Path, metavar="FOLDER", help="where walker.usdc is")
    arguments = parser.parse_args()
    bench = _bench(arguments)
    usual = ("figure",) if arguments.made is None else tuple(PARTS)
    return measure_all(every, bench, arguments, resolve_device(None), arguments.parts or usual)


def _bench(arguments: argparse.Namespace) -> Bench:
    options = ReduceOptions(gaussians=1)
    paths: Row = {"made": arguments.made, "data": arguments.data}
    if arguments.quick:
        options = replace(options, height=48, views=4, steps=4)
        return Bench(800, 3, 60, 4, (1.0, 0.3), (1.0, 4.0), options, keyed_count=800, draws=4, **paths)
    return Bench(140_000, 24, 400, 64, (1.0, 0.25), (1.0, 2.0, 4.0, 8.0), options, **paths)


if __name__ == "__main__":
    sys.exit(main())
