"""How soon ``beam view`` answers and its page shows a picture, stage by stage.

    python benchmarks/view_start.py --out result.json [--take take.b4d] [--repeats 5] [--only b4d]

The take is that of `delivery_take.py`; ``--take`` names a file that holds it. It is viewed as a container, as USD, and
one frame of it as PLY. Each time a new process starts, in a file cache that is warm, and a page opens in a headless
Chromium that is there already and holds nothing of pages before. Times count from the start of the process: until it
prints the address, until the page itself is answered, until the take is open in the page, and until the first picture
in the environment's light is there. Without a GPU, SwiftShader draws on the processor: what all pictures until then
took to be drawn stands apart, with what it compiles for them.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import record
import warp as wp
from delivery_take import FRAMES_PER_SECOND, take

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from web.viewers import chromium

from beam_warp import converters
from beam_warp.demo.figure import build_figure
from beam_warp.world.gaussians import GaussianSequence

VIEW = "import sys; from beam_warp.cli.entry import beam; sys.exit(beam())"
WIDTH, HEIGHT = 800, 420

WATCH = """
window.starts = {drawing: 0};
Object.defineProperty(window, "player", {configurable: true, set(player) {
  Object.defineProperty(window, "player", {value: player});
  const {open, timed} = player;
  player.open = async (...given) => { await open.apply(player, given); starts.opened ??= Date.now(); };
  player.timed = async (...given) => {
    const isReady = player.isReady, began = performance.now(), milliseconds = await timed.apply(player, given);
    if (!starts.shown) starts.drawing += performance.now() - began;
    if (isReady && player.relight.shownTime !== null) starts.shown ??= Date.now();
    return milliseconds;
  };
}});
"""


def start(path: Path, browser: Any) -> dict[str, float]:
    """Return the times of one start [s]."""
    began = time.time()
    command = [sys.executable, "-P", "-c", VIEW, "view", str(path), "--port", "0", "--no-open", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        lines = iter(process.stdout.readline, "")
        text = next(lines)
        while text.count("{") != text.count("}"):
            text += next(lines)
        served = time.time()
        url = json.loads(text)["url"]
        with urllib.request.urlopen(url) as answer:
            answer.read()
        answered = time.time()
        page = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, reduced_motion="reduce").new_page()
        page.set_default_timeout(300_000)
        page.add_init_script(WATCH)
        page.goto(url)
        while not page.evaluate("Boolean(window.starts?.shown)"):
            page.wait_for_timeout(50)
        found = page.evaluate("starts")
        page.context.close()
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)
    times = {"served": served, "answered": answered, "opened": found["opened"] / 1000, "shown": found["shown"] / 1000}
    return {name: at - began for name, at in times.items()} | {"drawing": found["drawing"] / 1000}


def assets(given: Path | None, folder: Path, gaussians: int, frames: int) -> dict[str, Path]:
    """Return what is viewed, by its kind."""
    path = given or folder / "take.b4d"
    if not path.is_file():
        clouds = [cloud for _, cloud in take(build_figure(), gaussians, frames)]
        converters.write(GaussianSequence.from_clouds(clouds, frames_per_second=FRAMES_PER_SECOND), path)
    sequence = converters.read(path)
    converters.write(sequence, folder / "asset.usda")
    converters.write(GaussianSequence.from_clouds([sequence[0]]), folder / "frame.ply")
    return {"b4d": path, "usd": folder / "asset.usda", "ply": folder / "frame.ply"}


def main() -> int:
    """Start again and again, and write the medians."""
    parser = record.parser(__doc__)
    parser.add_argument("--take", type=Path, metavar="B4D", help="the take; it is made if it is not there")
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", help="one kind of asset: b4d, usd or ply")
    arguments: argparse.Namespace = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        for name, path in assets(arguments.take, Path(folder), arguments.gaussians, arguments.frames).items():
            if arguments.only not in (None, name):
                continue
            runs = [start(path, browser) for _ in range(arguments.repeats + 1)][1:]
            spread = {key: np.percentile([run[key] for run in runs], [50, 0, 100]).tolist() for key in runs[0]}
            rows.append({"name": name, **spread})
            print(name, {key: f"{value[0]:.2f}" for key, value in spread.items()}, flush=True)
            record.write_result(arguments, wp.get_device("cpu"), {"starts": {"rows": rows}})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
