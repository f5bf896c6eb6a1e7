"""Viewers of the web in headless Chromium: which files each reads, how it is meant to place them, and a picture.

No network is involved: what the browser asks for is answered from the pages beside this file, from packages of npm and
from one folder of assets.
"""

from __future__ import annotations

import mimetypes
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import npm_packages
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from web.probe import EYE, FIELD_OF_VIEW, SIDE, TARGET, tripod

from beam_warp.converters import WriteOptions, write
from beam_warp.converters.common.importers import IMPORTERS
from beam_warp.converters.formats import FORMATS, suffix_of
from beam_warp.world.axes import axes_matrix
from beam_warp.world.gaussians import GaussianSequence

CHROMIUM = os.environ.get("BEAM_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    *("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
HERE = "http://localhost/"
PATIENCE = 180.0
"""Longest that a viewer may take to load a file and draw it [s]."""


@dataclass(frozen=True)
class Placement:
    """How a file stands in a viewer when it is opened as the viewer's manual or examples open it.

    Attributes:
        axes: Where x, y and z of the viewer's world point, right, up and forward being those of the subject.
        turned: True if the manual says to turn the file; the page does so then.
    """

    axes: str
    turned: bool = False


@dataclass(frozen=True)
class Viewer:
    """A viewer.

    Attributes:
        name: What people call it.
        package: Its package of npm.
        page: The page that opens it, beside this file.
        importer: Its name for ``--for``, in `beam_warp.converters.common.importers`, which says what it reads.
        placement: How a file that is written for it stands.
        others: The same for endings of files that stand otherwise.
        colors_wrong: Endings of which it shows view-dependent colour wrongly, whoever wrote the file.
    """

    name: str
    package: str
    page: str
    importer: str
    placement: Placement
    others: Mapping[str, Placement] = field(default_factory=dict)
    colors_wrong: frozenset[str] = frozenset()

    def endings(self) -> list[str]:
        """Return the endings that we write for it."""
        return [end for end in IMPORTERS[self.importer].suffixes if end in FORMATS and FORMATS[end].writer]


VIEWERS = {
    viewer.importer: viewer
    for viewer in (
        Viewer(
            "PlayCanvas",
            "playcanvas",
            "playcanvas.html",
            "playcanvas",
            Placement("luf", turned=True),  # half a turn about z, by the manual: upright, with its back to the front
            {".glb": Placement("luf")},  # as it is
        ),
        Viewer(
            "Spark",
            "@sparkjsdev/spark",
            "spark.html",
            "spark",
            Placement("rub", turned=True),  # half a turn about x, by the manual
            {".spz": Placement("rub")},  # which has y up by itself
        ),
        Viewer(
            "GaussianSplats3D",
            "@mkkellogg/gaussian-splats-3d",
            "gaussian_splats_3d.html",
            "mkkellogg",
            Placement("rdf"),  # the manual leaves splats as they are, and tells the camera that up is -y
        ),
        Viewer(
            "Babylon.js",
            "babylonjs",
            "babylon.html",
            "babylon",
            Placement("ruf"),  # the loader flips y by itself, of a GLB x, into a left-handed world
            colors_wrong=frozenset({".sog"}),
        ),
    )
}
"""Viewers by their names for ``--for``."""


def write_probe(folder: Path, viewer: Viewer, ending: str) -> Path:
    """Write the tripod for a viewer, as ``beam-convert --for`` does; returns the file."""
    path = folder / f"tripod_{viewer.importer}{ending}"
    write(GaussianSequence.from_clouds([tripod()]), path, WriteOptions(target=viewer.importer))
    return path


@contextmanager
def chromium() -> Iterator[Any]:
    """Start a browser without a screen or a GPU."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield browser
        browser.close()


def photograph(browser: Any, viewer: Viewer, file: Path) -> NDArray[np.uint8]:
    """Return what a viewer shows of a file from `web.probe.camera`, ``(SIDE, SIDE, 3)`` display-referred.

    Raises:
        RuntimeError: The viewer refuses the file, or has not drawn it in time.
    """
    placement = viewer.others.get(suffix_of(file.name), viewer.placement)
    to_viewer = axes_matrix("rfu", placement.axes)
    asked = {
        "file": f"/files/{file.name}",
        "turned": f"{placement.turned:d}",
        "fov": str(FIELD_OF_VIEW),
        **{name: _listed(to_viewer @ value) for name, value in (("eye", EYE), ("target", TARGET), ("up", (0, 0, 1)))},
    }
    page = browser.new_page(viewport={"width": SIDE, "height": SIDE})
    try:
        page.route("**/*", _answers(file.parent))
        page.goto(
            f"{HERE}{viewer.page}?" + "&".join(f"{name}={value}" for name, value in asked.items()), wait_until="commit"
        )
        return _settled(page, f"{viewer.name} and {file.name}")
    finally:
        page.close()


def _listed(values: ArrayLike) -> str:
    return ",".join(f"{value:.9g}" for value in np.asarray(values, np.float64))


def _settled(page: Any, what: str) -> NDArray[np.uint8]:
    """Return the first picture with something in it that stays."""
    last, before = time.monotonic() + PATIENCE, b""
    while time.monotonic() < last:
        state = page.evaluate("window.state") or ""
        if state.startswith("failed"):
            raise RuntimeError(f"{what}: {state}")
        if state == "loaded":
            shown = page.screenshot()
            picture = np.asarray(Image.open(BytesIO(shown)).convert("RGB"))
            if shown == before and np.ptp(picture) > 64:
                return picture
            before = shown
        page.wait_for_timeout(300)
    raise RuntimeError(f"{what}: nothing that stays was drawn within {PATIENCE:g} s")


def _answers(assets: Path) -> Callable[[Any], None]:
    """Return what answers requests; libraries that a viewer would load from another host come from its package."""
    packages, pages = npm_packages.packages(), Path(__file__).parent

    def answer(route: Any) -> None:
        path = route.request.url.split("?")[0]
        if path.startswith(HERE):
            top, _, rest = path.removeprefix(HERE).partition("/")
            file = {"packages": packages / rest, "files": assets / rest}.get(top, pages / top)
        else:
            place = re.fullmatch(r"https?://[^/]+/((?:@[^/]+/)?[^/@]+)(?:@[^/]+)?/(.+)", path)
            file = packages / place[1] / place[2] if place else pages / "absent"
        kind = "text/javascript" if file.suffix == ".mjs" else mimetypes.guess_type(file.name)[0]
        if file.is_file():
            route.fulfill(path=file, content_type=kind or "application/octet-stream")
        else:
            route.fulfill(status=404)

    return answer
