"""Size, error and speed of the delivery container b4d, and what its error costs in relit images.

    python benchmarks/delivery.py [--quick] [--parts PART] [--repeats 9] --out result.json

The take is `delivery_take.take`: its surface is known, so relit images are compared with path-traced truth. Times are
those of one thread's processor, which other programs disturb less than the clock; the lowest of repeats counts.

- ``takes``: a take in containers of several bounds: kilobytes a frame, errors, relit loss, time to decode.
- ``codecs``: the blocks of the first container by several codecs.
"""

from __future__ import annotations

import argparse
import functools
import io
import json
import lzma
import shutil
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import parts
import record
import zstandard
from delivery_take import FRAMES_PER_SECOND, take
from PIL import Image
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from beam_warp.converters import WriteOptions, read, write
from beam_warp.converters.delivery.decoder import Container
from beam_warp.demo.figure import build_figure
from beam_warp.demo.lights import demo_environments
from beam_warp.demo.truth import DemoTruth, relit_views, score_views
from beam_warp.device.arrays import resolve_device
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import UNSHADOWED
from beam_warp.trace.mesh_paths import TracedMesh
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.mesh import MaterialMesh

Row = dict[str, Any]

RASTER = RasterOptions(antialiased=True)
TRUTH_PATHS = 32
LIGHTS = ("studio", "sunset")
SCRIPT = Path(__file__).with_name("decode_delivery.mjs")


@dataclass(frozen=True)
class Bench:
    """What the parts share.

    Attributes:
        settings: Gaussians of a take, and the factors of its bounds.
        frames: Frames of a take.
        height: Height of relit images [pixel].
        repeats: Repeats of everything that is timed.
        folder: Where files go.
    """

    settings: Sequence[tuple[int, tuple[float, ...]]]
    frames: int
    height: int
    repeats: int
    folder: Path

    def say(self, line: str) -> None:
        print(line, file=sys.stderr, flush=True)


def takes(bench: Bench) -> Iterator[Row]:
    """Measure every take at every bound."""
    rows: list[Row] = []
    figure = build_figure()
    truths: dict[int, DemoTruth] = {}
    for count, factors in bench.settings:
        frames = list(take(figure, count, bench.frames))
        clouds = [cloud for _, cloud in frames]
        for frame in {0, bench.frames - 1} - truths.keys():
            truths[frame] = _truth(frames[frame][0], bench.height)
        sequence = GaussianSequence.from_clouds(clouds, frames_per_second=FRAMES_PER_SECOND)
        original = relit(clouds, truths)
        for factor in factors:
            path = bench.folder / f"{count}_{factor:g}.b4d"
            started = time.process_time()
            write(sequence, path, WriteOptions(error_scale=factor))
            written = time.process_time() - started
            back = list(read(path))
            shown = relit(back, truths)
            rows.append(
                {
                    "name": f"{count} at {factor:g}",
                    "gaussians": len(clouds[0]),
                    "factor": factor,
                    "write_seconds_a_frame": written / bench.frames,
                    **sizes(path),
                    "errors": errors(clouds, back),
                    "relit_psnr": {light: [original[light], shown[light]] for light in LIGHTS},
                    "relit_loss_db": max(original[light] - shown[light] for light in LIGHTS),
                    "numpy_ms": numpy_ms(path, bench.repeats),
                    "node_ms": node_ms(path, bench.repeats),
                }
            )
            bench.say(json.dumps(rows[-1]))
            yield {"rows": rows}


def _truth(mesh: MaterialMesh, height: int) -> DemoTruth:
    lights = {name: light for name, light in demo_environments().items() if name in LIGHTS}
    camera = Camera.frame_points(mesh.vertices, azimuth=25.0, elevation=8.0, width=round(0.8 * height), height=height)
    return DemoTruth.of(TracedMesh.from_mesh(mesh), camera, lights, TRUTH_PATHS)


def relit(clouds: Sequence[GaussianCloud], truths: dict[int, DemoTruth]) -> dict[str, float]:
    """Return the mean PSNR of relit images by light, deferred against path traced [dB]."""
    renderer = DeferredRenderer(UNSHADOWED, raster=RASTER)
    lights = {name: light for name, light in demo_environments().items() if name in LIGHTS}
    found = []
    for frame, truth in truths.items():
        views = relit_views(change_axes(clouds[frame], "rfu"), [truth.camera], lights, renderer, raster=RASTER)
        found.append(score_views([truth], views))
    return {light: float(np.mean([scores[f"relit_{light}"]["psnr"] for scores in found])) for light in LIGHTS}


def sizes(path: Path) -> Row:
    """Return the kilobytes a frame of a container: all of it, and its segments."""
    manifest = Container(path).manifest
    moving = sum(entry["bytes"] for entry in manifest["segments"])
    frames = manifest["frames"]
    return {"kb_a_frame": path.stat().st_size / 1e3 / frames, "moving_kb_a_frame": moving / 1e3 / frames}


def errors(clouds: Sequence[GaussianCloud], back: Sequence[GaussianCloud]) -> Row:
    """Return the errors of what moves, root mean square and largest, over all frames; rows are matched by place."""
    first = change_axes(back[0], "rfu")
    order = cKDTree(clouds[0].positions).query(first.positions)[1]
    found: dict[str, list[np.ndarray]] = {"position_mm": [], "turn_degrees": [], "normal_degrees": [], "occlusion": []}
    for cloud, other in zip(clouds, back, strict=True):
        ours, theirs = cloud.select(order), change_axes(other, "rfu")
        cosines = np.abs(np.einsum("ij,ij->i", ours.orientations.astype(float), theirs.orientations))
        lean = np.linalg.norm(ours.normals - theirs.normals, axis=1)
        found["position_mm"].append(1e3 * np.linalg.norm(ours.positions - theirs.positions, axis=1))
        found["turn_degrees"].append(np.degrees(2.0 * np.arccos(np.minimum(cosines, 1.0))))
        found["normal_degrees"].append(np.degrees(2.0 * np.arcsin(np.minimum(0.5 * lean, 1.0))))
        found["occlusion"].append(np.abs(ours.ambient_occlusion - theirs.ambient_occlusion))
    return {
        name: {"rms": float(np.sqrt(np.mean(np.square(values)))), "largest": float(np.max(values))}
        for name, values in found.items()
    }


def numpy_ms(path: Path, repeats: int) -> Row:
    """Return what a frame costs in NumPy: its part of unpacking its segment, and the frame itself [ms]."""
    container = Container(path)
    entry = container.manifest["segments"][0]
    count = entry["frames"]
    with threadpool_limits(1):
        unpacked = lowest(lambda _: container.tracks(entry, count), repeats) / count
        decoded = lowest(lambda number: container.frame(number % count), 3 * repeats)
    return {"unpack": unpacked, "frame": decoded, "all": unpacked + decoded}


def lowest(work: Callable[[int], object], repeats: int) -> float:
    """Return the lowest time of the processor that work takes [ms]; the first round is not counted."""
    found = []
    for number in range(repeats + 1):
        started = time.process_time()
        work(number)
        found.append(time.process_time() - started)
    return 1e3 * min(found[1:])


def node_ms(path: Path, repeats: int) -> Row | None:
    """Return the same in Node.js, by the reader in ``engines/web``; None where there is no Node.js."""
    node = shutil.which("node")
    if node is None:
        return None
    done = subprocess.run([node, SCRIPT, path, str(repeats)], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def _webp(content: bytes) -> bytes:
    """Return bytes as a lossless WebP of one channel in three, as textures have them."""
    pixels = np.frombuffer(content.ljust(-(-len(content) // 12288) * 12288, b"\0"), np.uint8).reshape(-1, 4096, 3)
    found = []
    for start in range(0, len(pixels), 4096):
        stream = io.BytesIO()
        Image.fromarray(pixels[start : start + 4096]).save(stream, "WEBP", lossless=True, quality=50, method=4)
        found.append(stream.getvalue())
    return b"".join(len(each).to_bytes(4, "little") + each for each in found)


def _from_webp(packed: bytes) -> None:
    at = 0
    while at < len(packed):
        size = int.from_bytes(packed[at : at + 4], "little")
        Image.open(io.BytesIO(packed[at + 4 : at + 4 + size])).load()
        at += 4 + size


CODECS: dict[str, tuple[str, Callable[[bytes], bytes], Callable[[bytes], object]]] = {
    "deflate, level 6": ("every browser, .NET", lambda b: zlib.compress(b, 6), zlib.decompress),
    "deflate, level 9": ("every browser, .NET", lambda b: zlib.compress(b, 9), zlib.decompress),
    "WebP, lossless": ("every browser, as pictures", _webp, _from_webp),
    "Zstandard, level 19": (
        "few browsers",
        zstandard.ZstdCompressor(level=19).compress,
        zstandard.ZstdDecompressor().decompress,
    ),
    "LZMA": ("none", lzma.compress, lzma.decompress),
}
"""Codecs by name: where they are native, and what packs and unpacks."""


def codecs(bench: Bench) -> Iterator[Row]:
    """Pack the first segment of the smallest take by every codec."""
    path = next(bench.folder.glob("*.b4d"))
    container = Container(path)
    entry = container.manifest["segments"][0]
    with path.open("rb") as stream:
        stream.seek(container._start + entry["offset"])
        content = zlib.decompress(stream.read(entry["bytes"]))
    rows = []
    for name, (native, pack, unpack) in CODECS.items():
        packed = pack(content)
        cost = lowest(lambda _, packed=packed, unpack=unpack: unpack(packed), bench.repeats) / entry["frames"]
        rows.append({"name": name, "native": native, "kb_a_frame": len(packed) / 1e3 / entry["frames"], "ms": cost})
        yield {"gaussians": container.manifest["count"], "rows": rows}


PARTS = {"takes": takes, "codecs": codecs}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a take of few Gaussians and frames")
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=[], help="measure these only")
    parser.add_argument("--repeats", type=int, default=9, metavar="N")
    record.add_arguments(parser)
    arguments = parser.parse_args()
    settings = [(2_000, (1.0,))] if arguments.quick else [(30_000, (1.0, 2.0, 4.0)), (140_000, (1.0,))]
    with tempfile.TemporaryDirectory(prefix="beam_delivery_") as folder:
        frames, height = (4, 60) if arguments.quick else (24, 200)
        bench = Bench(settings, frames, height, arguments.repeats, Path(folder))
        keep = functools.partial(record.write_result, arguments, resolve_device(None))
        result = parts.measure(PARTS, bench, only=arguments.parts, keep=keep)
        keep(result)
    return 1 if result["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
