"""Draw docs/images/player.jpg, player_stage.jpg and viewer.jpg: the player page, a stage by two renderers, a still.

The take is that of `delivery.py`: the demo's figure, which dances. The page is drawn by a headless Chromium,
in software. The stage is drawn by ``beam render`` and by the page, from the same file. The still is ``beam view``'s.

    python benchmarks/player.py [--gaussians 30000] [--frames 12] [--only viewer]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from delivery_take import FRAMES_PER_SECOND, take
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from web.viewers import chromium

from beam_warp.cli.convert import main as beam_convert
from beam_warp.cli.main import main as beam
from beam_warp.cli.view import ViewCommand, shown
from beam_warp.converters import write
from beam_warp.demo.figure import build_figure
from beam_warp.demo.lights import sunset
from beam_warp.image.files import write_exr
from beam_warp.image.panels import lay_out
from beam_warp.view.viewer import Viewer, ViewOptions
from beam_warp.world.gaussians import GaussianSequence

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
PAGE, PICTURE = (1120, 680), (400, 300)
"""Sizes of the page and of the stage's picture [pixel]."""

BACKGROUND = 33
FRAME = 4
PATIENCE = 900.0
STAGE = {
    "beam-stage": 1,
    "duration": 0.2,
    "assets": [
        {"path": "dancer.usdc", "translate": [-0.75, 0.25, 0], "rotate": 20, "on_ground": True, "centered": True},
        {"path": "dancer.usdc", "translate": [0.7, -0.2, 0], "rotate": -35, "on_ground": True, "centered": True}
        | {"start": -0.15, "loop": True},
    ],
    "meshes": [{"ground": True, "size": 7, "base_color": [0.32, 0.3, 0.28], "roughness": 0.5}],
    "lights": [
        {"type": "spot", "position": [2.6, -1.8, 3.0], "direction": [-1.0, 0.75, -0.85], "intensity": [60, 52, 40]}
        | {"inner_angle": 20, "outer_angle": 34, "radius": 0.08}
    ],
    "environment": {"path": "sunset.exr", "rotate": 60, "exposure": -1.0},
    "camera": {"type": "fixed", "position": [0.4, -5.2, 1.9], "target": [0, 0, 0.8], "fov": 32},
}
STILL_SAMPLES = 64
LAMP = {"type": "point", "position": [-0.75, -0.8, 1.5], "intensity": [4.5, 2.9, 1.5], "radius": 0.05}

PLACE = "async (light) => player.lamps.set([(await import('beam-relight/lamps.js')).fromLight(light, player.box)])"


def settled(page: Any, condition: str = "true") -> None:
    """Wait until a page has drawn all that it was asked for."""
    last = time.monotonic() + PATIENCE
    still = "window.player?.isReady && !player.isChanged && player.pending == null && !player.isDrawing"
    while not page.evaluate(f"Boolean({still} && {condition})"):
        if time.monotonic() > last:
            raise TimeoutError(page.locator(".message").inner_text())
        page.wait_for_timeout(200)


def photograph(page: Any) -> NDArray[np.uint8]:
    """Return a screenshot of a page that stands still."""
    settled(page)
    page.wait_for_timeout(500)
    settled(page)
    return np.asarray(Image.open(BytesIO(page.screenshot(timeout=1000 * PATIENCE))).convert("RGB"))


def opened(browser: Any, address: str, size: tuple[int, int]) -> Any:
    """Return a page at a frame that stands still."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]}, reduced_motion="reduce")
    page.goto(address)
    settled(page)
    page.evaluate(f"player.change({{time: {FRAME} / player.frameRate}})")
    return page


def stage_by_page(browser: Any, path: Path) -> NDArray[np.uint8]:
    """Return what the page shows of the stage, as its "Save PNG" saves it."""
    page = opened(browser, path.as_uri(), PICTURE)
    settled(page)
    with page.expect_download(timeout=1000 * PATIENCE) as waiting:
        page.evaluate("player.savePng()")
    picture = np.asarray(Image.open(waiting.value.path()).convert("RGB"))
    page.close()
    return picture


def still_of_viewer(browser: Any, asset: Path) -> NDArray[np.uint8]:
    """Return a screenshot of ``beam view`` with a path-traced still."""
    sequence, parts = shown(ViewCommand(asset=asset), {"sunset (built in)": sunset})
    viewer = Viewer(sequence, title="dancer", options=ViewOptions(port=0), **parts)
    try:
        page = opened(browser, viewer.url, PAGE)
        page.evaluate(f"({PLACE})({json.dumps(LAMP)})")
        settled(page)
        page.evaluate(
            "document.querySelectorAll('aside details').forEach((each, k) => { each.open = [1, 3].includes(k); })"
        )
        page.evaluate("player.stills.ground.value = 'grey'")
        page.get_by_label("Samples").fill(str(STILL_SAMPLES))
        page.get_by_role("button", name="Draw still").click()
        settled(page, "player.stills.isShown && !player.stills.isDrawing")
        picture = photograph(page)
        page.close()
        return picture
    finally:
        viewer.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=30_000)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--only", choices=("player", "viewer"), help="draw the pictures of one page alone")
    parser.add_argument("--folder", type=Path, help="keep what is made in between here, and use what is there")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary, chromium() as browser:
        folder = args.folder or Path(temporary)
        dancer = folder / "dancer.usdc"
        if not dancer.exists():
            clouds = [cloud for _, cloud in take(build_figure(), args.gaussians, args.frames)]
            write(GaussianSequence.from_clouds(clouds, frames_per_second=FRAMES_PER_SECOND), dancer)
        if args.only != "player":
            Image.fromarray(still_of_viewer(browser, dancer)).save(IMAGES / "viewer.jpg", quality=88)
        if args.only == "viewer":
            return 0
        light = sunset()
        write_exr(folder / "sunset.exr", {name: light.radiance[..., k] for k, name in enumerate("RGB")})
        (folder / "stage.json").write_text(json.dumps(STAGE), encoding="utf-8")
        stage, rendered = str(folder / "stage.json"), folder / "render.png"
        beam_convert([str(dancer), str(folder / "dancer.html"), "--player"])
        page = opened(browser, (folder / "dancer.html").as_uri(), PAGE)
        page.evaluate("player.choose('sunset (built in)')")
        page.evaluate(f"({PLACE})({json.dumps(LAMP)})")
        Image.fromarray(photograph(page)).save(IMAGES / "player.jpg", quality=88)
        page.close()
        beam_convert([stage, str(folder / "stage.html"), "--player"])
        grey = [f"{BACKGROUND / 255:.4f}"] * 3
        size = ["--width", *PICTURE[:1], "--height", *PICTURE[1:]]
        words = ["render", stage, "--frame", FRAME, *size, "--out", rendered, "--background", *grey]
        beam([str(word) for word in words])
        panels = [
            ("beam render", np.asarray(Image.open(rendered).convert("RGB"))),
            ("the player page", stage_by_page(browser, folder / "stage.html")),
        ]
        Image.fromarray(lay_out(panels, columns=2)).save(IMAGES / "player_stage.jpg", quality=90)
    return 0


if __name__ == "__main__":
    sys.exit(main())
