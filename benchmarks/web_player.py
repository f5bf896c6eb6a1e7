"""The web renderer on a long take: how long seeking takes, how many pictures a second it draws, and what it keeps.

    python benchmarks/web_player.py --out result.json [--gaussians 100000] [--frames 60] [--minutes 5] [--size 256]

The take is that of `delivery_take.py`. The browser is a headless Chromium. Without a GPU it draws by SwiftShader, on
the processor: pictures a second are then those of a processor, and say nothing of a graphics card. ``--gpu`` leaves the
choice of the GPU to the browser.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import record
import warp as wp
from delivery_take import FRAMES_PER_SECOND, take

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from engines.web.pages import BACKENDS, camera_record, chromium, open_page

from beam_warp.converters import WriteOptions, write
from beam_warp.demo.figure import build_figure
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianSequence

GPU_FLAGS = ("--enable-features=Vulkan", "--use-angle=vulkan", "--enable-gpu")

SEEK = """async ([backend, camera, seeks]) => {
  const median = (list) => [...list].sort((a, b) => a - b)[list.length >> 1];
  window.made = await make({backend});
  const take = await Take.open("/take.b4d"), began = performance.now();
  await made.open(take);
  const opened = performance.now() - began, decoded = [], ready = [], drawn = [];
  await made.render(camera);
  await made.read();
  for (let k = 0; k < seeks; k++) { // from the beginning again each time, so that the segment is not there already
    const {segments, rate} = take.manifest, entry = segments[2 + k % (segments.length - 2)];
    await made.open(take);
    made.time = 0;
    await made.render(camera);
    await made.read();
    let from = performance.now();
    await take.tracks(entry, entry.frames);
    decoded.push(performance.now() - from);
    made.time = (entry.first + 0.4) / rate;
    from = performance.now();
    await made.ready();
    ready.push(performance.now() - from);
    from = performance.now();
    made.draw(camera);
    await made.read();
    drawn.push(performance.now() - from);
  }
  return {open_ms: opened, decode_ms: median(decoded), decode_worst_ms: Math.max(...decoded), seek_ms: median(ready),
    seek_worst_ms: Math.max(...ready), draw_ms: median(drawn)};
}"""

PLAY = """async ([camera, seconds]) => {
  const kept = () => {
    globalThis.gc?.();
    let bytes = 0;
    const size = {rgba32float: 16, rgba16float: 8, rgba8unorm: 4, r32float: 4, r8sint: 1};
    for (const each of made.gpu.made) bytes += each.width * each.height * (each.layers || 1) * size[each.format];
    return {heap_mb: performance.memory.usedJSHeapSize / 1e6, textures: made.gpu.made.size, texture_mb: bytes / 1e6};
  };
  const began = performance.now(), samples = [];
  let pictures = 0, next = 0;
  for (let now = 0; now < 1000 * seconds; now = performance.now() - began) {
    made.time = (now / 1000) % made.duration;
    if (made.draw(camera)) pictures++;
    if (pictures % 8 === 0) await made.read(); // as a display would, wait for what was drawn
    await new Promise((resolve) => setTimeout(resolve));
    if (now >= next) { samples.push({seconds: now / 1000, ...kept()}); next += 1000 * seconds / 20; }
  }
  return {pictures_a_second: pictures / seconds, samples, said: heard};
}"""


def measure(backend: str, path: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what is found of a backend."""
    size = arguments.size
    camera = camera_record(Camera.look_at((1.2, -2.6, 1.3), (0.0, 0.0, 0.9), width=size, height=size, vertical_fov=42))
    with chromium(*([GPU_FLAGS] if arguments.gpu else [])) as browser:
        page = open_page(browser, {"take.b4d": path})
        page.set_default_timeout(0)
        found = page.evaluate(SEEK, [backend, camera, 9])
        played = page.evaluate(PLAY, [camera, 60.0 * arguments.minutes])
    heap = [sample["heap_mb"] for sample in played["samples"]]
    half = len(heap) // 2
    return {
        "name": backend,
        **found,
        **played,
        "heap_growth_mb": max(heap[half:]) - max(heap[:half]),
        "texture_growth_mb": played["samples"][-1]["texture_mb"] - played["samples"][half]["texture_mb"],
    }


def main() -> int:
    """Make the take, measure, write."""
    parser = record.parser(__doc__)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--gpu", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "take.b4d"
        clouds = [cloud for _, cloud in take(build_figure(), arguments.gaussians, arguments.frames)]
        write(GaussianSequence.from_clouds(clouds, frames_per_second=FRAMES_PER_SECOND), path, WriteOptions())
        rows = [measure(backend, path, arguments) for backend in BACKENDS]
        result = {
            "take": {"gaussians": len(clouds[0]), "frames": len(clouds), "megabytes": path.stat().st_size / 1e6},
            "graphics": "the browser's choice" if arguments.gpu else "SwiftShader, on the processor",
            "players": {"rows": rows},
        }
    record.write_result(arguments, wp.get_device("cpu"), result)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
