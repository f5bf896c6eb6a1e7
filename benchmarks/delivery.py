"""Size, error and speed of the delivery container b4d, and what its error costs in relit images.

    python benchmarks/delivery.py [--quick] [--parts PART] [--repeats 9] --out result.json

The take is `delivery_take.take`. Relit images of the container are compared with those of the take itself, drawn by the
same deferred renderer. Times are those of the processor, which other programs disturb less than the clock: of one
thread in NumPy, and in Node.js of all, with those that collect garbage. Pages have only a clock, so Chromium's times
need a machine that does nothing else. The lowest of repeats counts.

- ``takes``: a take in containers of several bounds: kilobytes a frame, errors, relit images, time to decode.
- ``codecs``: the blocks of the first container by several codecs.
"""

from __future__ import annotations

import copy
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
import record
import zstandard
from delivery_take import FRAMES_PER_SECOND, take
from parts import measure_all, say
from PIL import Image
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from engines.web.pages import chromium, open_page
from web.viewers import CHROMIUM

from beam_warp.converters import WriteOptions, read, write
from beam_warp.converters.delivery.decoder import Container
from beam_warp.demo.figure import build_figure
from beam_warp.demo.lights import demo_environments
from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.relit import loss_of
from beam_warp.image.metrics import compare
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import UNSHADOWED
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.shot import Shot

Row = dict[str, Any]

LIGHTS = ("studio", "sunset")
SCRIPT = Path(__file__).with_name("decode_delivery.mjs")
IN_A_PAGE = """async ([source, repeats]) => {
  const {decoding} = await import(URL.createObjectURL(new Blob([source], {type: "text/javascript"})));
  const bytes = new Uint8Array(await (await fetch("/take.b4d")).arrayBuffer());
  const opened = await Take.open("take.b4d", async (name, start, size) => bytes.subarray(start, start + size));
  return decoding(Take, opened, repeats, () => performance.now());
}"""


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


def takes(bench: Bench) -> Iterator[Row]:
    """Measure every take at every bound."""
    rows: list[Row] = []
    figure = build_figure()
    for count, factors in bench.settings:
        frames = list(take(figure, count, bench.frames))
        clouds = [cloud for _, cloud in frames]
        camera = Camera.frame_points(
            frames[0][0].vertices, azimuth=25.0, elevation=8.0, width=round(0.8 * bench.height), height=bench.height
        )
        sequence = GaussianSequence.from_clouds(clouds, frames_per_second=FRAMES_PER_SECOND)
        original = relit(clouds, camera)
        for factor in factors:
            path = bench.folder / f"{count}_{factor:g}.b4d"
            started = time.process_time()
            write(sequence, path, WriteOptions(error_scale=factor))
            written = time.process_time() - started
            back = list(read(path))
            differences = relit_psnr(relit(back, camera), original)
            rows.append(
                {
                    "name": f"{count} at {factor:g}",
                    "gaussians": len(clouds[0]),
                    "factor": factor,
                    "write_seconds_a_frame": written / bench.frames,
                    **sizes(path),
                    "errors": errors(clouds, back),
                    "relit_psnr": differences,
                    "relit_loss_db": float(loss_of(min(differences.values()))),
                    "numpy_ms": numpy_ms(path, bench.repeats),
                    "node_ms": node_ms(path, bench.repeats),
                    "chromium_ms": chromium_ms(path, bench.repeats),
                }
            )
            say(json.dumps(rows[-1]))
            yield {"rows": rows}


def relit(clouds: Sequence[GaussianCloud], camera: Camera) -> dict[str, list[Any]]:
    """Return images of the first, the middle and the last frame under every light."""
    renderer = DeferredRenderer(UNSHADOWED, raster=RasterOptions(antialiased=True))
    environments = demo_environments()
    frames = [change_axes(clouds[number], "rfu") for number in (0, len(clouds) // 2, -1)]
    return {
        light: [renderer.draw(Shot(cloud=cloud, camera=camera, environment=environments[light])) for cloud in frames]
        for light in LIGHTS
    }


def relit_psnr(images: dict[str, list[Any]], originals: dict[str, list[Any]]) -> dict[str, float]:
    """Return the PSNR of images against their originals by light, the mean over frames [dB]."""
    return {
        light: float(
            np.mean(
                [
                    compare(a.rgb, b.rgb, alpha=a.alpha, truth_alpha=b.alpha, is_color=True, premultiplied=True).psnr
                    for a, b in zip(found, originals[light], strict=True)
                ]
            )
        )
        for light, found in images.items()
    }


def sizes(path: Path) -> Row:
    """Return the kilobytes a frame of a container: all of it, and its segments."""
    manifest = Container(path).manifest
    moving = sum(entry["bytes"] for entry in manifest["segments"])
    frames = manifest["frames"]
    return {"kb_a_frame": path.stat().st_size / 1e3 / frames, "moving_kb_a_frame": moving / 1e3 / frames}


def errors(clouds: Sequence[GaussianCloud], back: Sequence[GaussianCloud]) -> Row:
    """Return the errors of what moves, root mean square and largest; rows are matched by places in three frames."""
    there = [change_axes(back[number], "rfu").positions for number in (0, len(back) // 2, -1)]
    here = [clouds[number].positions for number in (0, len(back) // 2, -1)]
    order = cKDTree(np.hstack(here)).query(np.hstack(there))[1]
    found: dict[str, list[np.ndarray]] = {"position_mm": [], "turn_degrees": [], "normal_degrees": [], "occlusion": []}
    for cloud, other in zip(clouds, back, strict=True):
        ours, theirs = cloud.select(order), change_axes(other, "rfu")
        cosines = np.abs(np.einsum("ij,ij->i", ours.orientations.astype(float), theirs.orientations))
        lean = np.linalg.norm(np.subtract(ours.normals, theirs.normals), axis=1)
        found["position_mm"].append(1e3 * np.linalg.norm(ours.positions - theirs.positions, axis=1))
        found["turn_degrees"].append(np.degrees(2.0 * np.arccos(np.minimum(cosines, 1.0))))
        found["normal_degrees"].append(np.degrees(2.0 * np.arcsin(np.minimum(0.5 * lean, 1.0))))
        found["occlusion"].append(np.abs(np.subtract(ours.ambient_occlusion, theirs.ambient_occlusion)))
    return {
        name: {"rms": float(np.sqrt(np.mean(np.square(values)))), "largest": float(np.max(values))}
        for name, values in found.items()
    }


def numpy_ms(path: Path, repeats: int) -> Row:
    """Return what a frame costs in NumPy [ms]; see ``decode_delivery.mjs`` for the names."""
    opened = Container(path)
    frames = opened.manifest["frames"]

    def play(_: int) -> None:
        take = copy.copy(opened)  # which has no segment at hand
        for number in range(frames):
            take.frame(number)

    with threadpool_limits(1):
        played = [each / frames for each in times(play, repeats)]
        jump = lowest(lambda _: copy.copy(opened).frame(frames // 2), repeats)
    return {"all": min(played), "median": float(np.median(played)), "random": jump}


def lowest(work: Callable[[int], object], repeats: int) -> float:
    """Return the lowest time of the processor that work takes [ms]."""
    return min(times(work, repeats))


def times(work: Callable[[int], object], repeats: int) -> list[float]:
    """Return the times of the processor that work takes [ms]; the first round is not counted."""
    found = []
    for number in range(repeats + 1):
        started = time.process_time()
        work(number)
        found.append(1e3 * (time.process_time() - started))
    return found[1:]


def node_ms(path: Path, repeats: int) -> Row | None:
    """Return the same in Node.js, by the reader in ``engines/web``; None where there is no Node.js."""
    node = shutil.which("node")
    if node is None:
        return None
    done = subprocess.run([node, SCRIPT, path, str(repeats)], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def chromium_ms(path: Path, repeats: int) -> Row | None:
    """Return the same in Chromium, by the clock; None where there is no Chromium."""
    if CHROMIUM is None:
        return None
    with chromium() as browser:
        page = open_page(browser, {"take.b4d": path})
        return page.evaluate(IN_A_PAGE, [SCRIPT.read_text(encoding="utf-8"), repeats])


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
    parser = record.parser(__doc__, quick="a take of few Gaussians and frames", parts=PARTS)
    parser.add_argument("--repeats", type=int, default=9, metavar="N")
    arguments = parser.parse_args()
    settings = [(2_000, (1.0,))] if arguments.quick else [(30_000, (1.0, 4.0)), (140_000, (1.0,))]
    with tempfile.TemporaryDirectory(prefix="beam_delivery_") as folder:
        frames, height = (4, 60) if arguments.quick else (24, 200)
        bench = Bench(settings, frames, height, arguments.repeats, Path(folder))
        return measure_all(PARTS, bench, arguments, resolve_device(None), arguments.parts)


if __name__ == "__main__":
    sys.exit(main())
