"""The web renderer on a long take: what seeking takes, stage by stage, pictures a second, and whether memory grows.

    python benchmarks/web_player.py --out result.json [--gaussians 100000] [--frames 60] [--minutes 5] [--size 256]

The take is that of `delivery_take.py`; ``--take`` names a file that holds it, made if it is not there. The browser is a
headless Chromium. Without a GPU it draws by SwiftShader, on the processor: pictures a second are then those of a
processor, and say nothing of a graphics card. ``--gpu`` leaves the choice of the GPU to the browser.

A seek goes to a segment that is not at hand ("cold"), or to one that is ("warm"). It is "ready" when the moment's
Gaussians are on the GPU in order of depth, and "drawn" when the picture can be read. While the take plays, memory is
sampled after a collection of garbage: the page's heap by the DevTools protocol, what the page's process and the one
that draws hold by the system, textures by the renderer's own count. A line is fitted to the samples after the first
fifth; its slope comes with a standard error, which knows that a browser's memory rises and falls in waves.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import record
import warp as wp
from delivery_take import FRAMES_PER_SECOND, take

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from engines.web.pages import BACKENDS, BOTH_FLAGS, MODULE, START, camera_record, chromium

from beam_warp.converters import WriteOptions, write
from beam_warp.converters.delivery.decoder import Container
from beam_warp.demo.figure import build_figure
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianSequence

GPU_FLAGS = ("--enable-features=Vulkan", "--use-angle=vulkan", "--enable-gpu")
SEEKS = 7
SAMPLES = 30
SETTLING = 0.2
"""Share of the samples at the beginning, while caches fill, that no line is fitted to."""

BEGIN = """async ([backend, camera]) => {
  const began = performance.now();
  Object.assign(window, {made: await make({backend}), take: await Take.open("/take.b4d"), camera});
  await made.open(take);
  const opened = performance.now() - began;
  await made.render(camera);
  await made.read();
  window.seek = async (seconds) => {
    const from = performance.now();
    made.time = seconds;
    await made.ready();
    const ready = performance.now() - from;
    made.draw(camera);
    await made.read();
    return {ready, drawn: performance.now() - from, ...made.timings};
  };
  window.calm = async () => { // until nothing is read ahead any more
    for (let bytes = -1; bytes !== made.keptBytes;) {
      bytes = made.keptBytes;
      await new Promise((resolve) => setTimeout(resolve, 500));
    }
  };
  return opened;
}"""

COLD = """async (seeks) => {
  const {segments, rate} = take.manifest, found = [];
  for (let k = 0; k < seeks; k++) { // from the beginning each time, so that the segment is not at hand
    await made.open(take);
    await seek(0);
    await calm();
    found.push(await seek((segments[3 + k % (segments.length - 3)].first + 2.4) / rate));
  }
  return found;
}"""

WARM = """async (seeks) => {
  const {segments, rate} = take.manifest, found = [];
  for (const {first} of segments) await seek((first + 0.4) / rate);
  for (let k = 0; k < seeks; k++) {
    found.push(await seek((segments[(2 * k + 1) % segments.length].first + 3.4 + 0.1 * k) / rate));
  }
  return found;
}"""

PLAY = """(seconds) => {
  const began = performance.now();
  window.played = {pictures: 0, late: 0, isOver: false};
  (async () => {
    for (let now = 0; now < seconds; now = (performance.now() - began) / 1000) {
      made.time = now % made.duration;
      made.draw(camera);
      await made.read(); // as a display would, wait for what was drawn
      played.pictures++;
      if (Math.abs(made.shownTime - made.time) > 0.5 / take.manifest.rate) played.late++;
      await new Promise((resolve) => setTimeout(resolve));
    }
    played.isOver = true;
  })();
}"""

KEPT = """() => {
  const size = {rgba32float: 16, rgba16float: 8, rgba8unorm: 4, r32float: 4, r8sint: 1};
  let bytes = 0;
  for (const each of made.gpu.made) bytes += each.width * each.height * (each.layers || 1) * size[each.format];
  return {textures: made.gpu.made.size, texture_mb: bytes / 1e6};
}"""


class Host(BaseHTTPRequestHandler):
    """Serves the page, the module and the take, of which it sends ranges, as a web host does."""

    protocol_version = "HTTP/1.1"
    take = Path()

    def do_GET(self) -> None:
        """Answer a request."""
        name = self.path.lstrip("/")
        place = self.take if name == "take.b4d" else MODULE / name.removeprefix("module/")
        content = place.read_bytes() if place.is_file() else START.encode()
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        self.send_response(206 if asked else 200)
        if asked:
            total = len(content)
            content = content[int(asked[1]) : int(asked[2]) + 1]
            self.send_header("Content-Range", f"bytes {asked[1]}-{int(asked[1]) + len(content) - 1}/{total}")
        kind = {".js": "text/javascript", ".b4d": "application/octet-stream"}.get(Path(name).suffix, "text/html")
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


@contextmanager
def host(take_path: Path) -> Iterator[str]:
    """Serve a take while the context is open; yields the address of the page."""
    Host.take = take_path
    server = ThreadingHTTPServer(("localhost", 0), Host)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://localhost:{server.server_port}/"
    server.shutdown()


def memory(page: Any, browser: Any) -> dict[str, float]:
    """Return what is held after a collection of garbage: the page's heap, both processes, and textures [MB]."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    session.send("Performance.enable")
    metrics = {each["name"]: each["value"] for each in session.send("Performance.getMetrics")["metrics"]}
    session.detach()
    system = browser.new_browser_cdp_session()
    processes = system.send("SystemInfo.getProcessInfo")["processInfo"]
    system.detach()
    held = {"heap_mb": metrics["JSHeapUsedSize"] / 1e6}
    for name, kind in (("page_mb", "renderer"), ("gpu_mb", "GPU")):
        held[name] = sum(resident(each["id"]) for each in processes if each["type"] == kind)
    return held | page.evaluate(KEPT)


def resident(process: int) -> float:
    """Return the memory of a process that is not that of files [MB]; 0 if it is gone."""
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return 0.0
    sizes = {name: int(rest.split()[0]) for name, _, rest in (line.partition(":") for line in lines) if "kB" in rest}
    return (sizes["RssAnon"] + sizes["RssShmem"]) * 1024 / 1e6


def slope(samples: list[dict[str, float]], name: str) -> list[float]:
    """Return by how much a quantity grows a minute, and the standard error of that.

    Neighbouring samples resemble each other. They count as so many as their correlation leaves (Santer et al. 2000).
    """
    kept = samples[int(SETTLING * len(samples)) :]
    minutes, values = (np.array([each[key] for each in kept]) for key in ("minutes", name))
    away = minutes - minutes.mean()
    grows = (away @ values) / (away @ away)
    rest = values - values.mean() - grows * away
    alike = max((rest[1:] @ rest[:-1]) / max(rest @ rest, 1e-12), 0.0)
    independent = len(kept) * (1.0 - alike) / (1.0 + alike)
    return [float(grows), float(np.sqrt((rest @ rest) / max(independent - 2.0, 1.0) / (away @ away)))]


def seek_row(seeks: list[dict[str, float]]) -> dict[str, list[float]]:
    """Return median and largest time of each stage [ms]."""
    return {
        name: [float(np.median([each[name] for each in seeks])), max(each[name] for each in seeks)] for name in seeks[0]
    }


def measure(backend: str, path: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what is found of a backend."""
    size = arguments.size
    camera = camera_record(Camera.look_at((1.2, -2.6, 1.3), (0.0, 0.0, 0.9), width=size, height=size, vertical_fov=42))
    with chromium(GPU_FLAGS if arguments.gpu else BOTH_FLAGS) as browser, host(path) as address:
        page = browser.new_page()
        page.set_default_timeout(0)
        page.goto(address)
        page.wait_for_function("window.isThere")
        opened = page.evaluate(BEGIN, [backend, camera])
        print(f"{backend}: opened after {opened:.0f} ms", flush=True)
        cold, warm = (seek_row(page.evaluate(script, SEEKS)) for script in (COLD, WARM))
        print(f"{backend}: a seek takes, in the median and at most [ms], {cold}; to what is at hand {warm}", flush=True)
        seconds, samples = 60.0 * arguments.minutes, []
        page.evaluate(PLAY, seconds)
        began = time.monotonic()
        while time.monotonic() - began < seconds * SAMPLES / (SAMPLES + 1):
            page.wait_for_timeout(1000.0 * seconds / (SAMPLES + 1))
            samples.append({"minutes": (time.monotonic() - began) / 60.0} | memory(page, browser))
        page.wait_for_function("played.isOver")
        played, said = page.evaluate("[played, heard]")
    names = [name for name in samples[0] if name != "minutes"]
    return {
        "name": backend,
        "open_ms": opened,
        "cold": cold,
        "warm": {name: warm[name] for name in ("ready", "drawn")},
        "pictures_a_second": played["pictures"] / seconds,
        "late_share": played["late"] / played["pictures"],
        "held": {name: samples[-1][name] for name in names},
        "growth": {name: slope(samples, name) for name in names},
        "samples": samples,
        "said": said,
    }


def main() -> int:
    """Make the take, measure, write."""
    parser = record.parser(__doc__)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--gpu", action="store_true")
    parser.add_argument("--take", type=Path, metavar="B4D", help="the take; it is made if it is not there")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.take or Path(folder) / "take.b4d"
        if not path.is_file():
            clouds = [cloud for _, cloud in take(build_figure(), arguments.gaussians, arguments.frames)]
            write(GaussianSequence.from_clouds(clouds, frames_per_second=FRAMES_PER_SECOND), path, WriteOptions())
        manifest = Container(path).manifest
        size = path.stat().st_size / 1e6
        result: dict[str, Any] = {
            "take": {"gaussians": manifest["count"], "frames": manifest["frames"], "megabytes": size},
            "graphics": "the browser's choice" if arguments.gpu else "SwiftShader, on the processor",
            "players": {"rows": []},
        }
        for backend in BACKENDS:
            result["players"]["rows"].append(measure(backend, path, arguments))
            record.write_result(arguments, wp.get_device("cpu"), result)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
