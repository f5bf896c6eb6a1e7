"""Draw docs/images/architecture.webp: the packages on their floors, and the way of the data.

The floors are those of `tests/test_layers.py`, the arrows are the imports of the source. Run it after a package or an
arrow between packages is added or removed; `tests/test_architecture.py` says when.

    python docs/draw_architecture.py
"""

from __future__ import annotations

import io
import json
import runpy
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from matplotlib.path import Path as Curve
from PIL import Image
from scipy.optimize import isotonic_regression

ROOT = Path(__file__).parent.parent
PICTURE = ROOT / "docs" / "images" / "architecture.webp"

WIDTH, FLOORS_HEIGHT, WAY_HEIGHT = 12.0, 9.3, 4.1
"""Size of the picture and of its two parts [inch]."""

RESOLUTION = 100
BOX, LANE, GAP = 1.72, 0.1, 0.34
"""Widths of a package's box, of an arrow's lane beside boxes on floors between its ends, and between them [inch]."""

SWEEPS = 40
INK, FAINT, ARROW = "#1f2933", "#9aa5b1", "#52606d"

COLORS = {
    "#e4e7eb": ("errors", "checks", "digests", "archives", "blocks", "outputs", "kernels", "device", "jobs", "plan"),
    "#d3e8d3": ("image", "world", "schema", "converters", "capture", "mesh", "stage"),
    "#fdebc8": ("light", "trace", "raster", "render", "interop"),
    "#d2e3f7": ("materials", "reconstruction", "decomposition"),
    "#ecdcf2": ("evaluate", "demo", "study", "reduction", "stability", "view", "cli"),
}
"""What packages are about: foundations, data, light transport, solving for an asset, and using one."""

KINDS = ("foundations", "data and files", "light transport", "solving for an asset", "using an asset")

WAY: Sequence[tuple[str, str, str, float, float]] = (
    ("photographs", "photographs\nwith cameras\nand their light", "", 0.0, 3.0),
    ("trained", "trained Gaussians\nof another program", "", 0.0, 1.0),
    ("capture", "capture\nread, inspect,\nundistort", "capture", 1.0, 3.0),
    ("reconstruct", "reconstruct\nfit the first frame,\ntrack the others", "reconstruction", 2.0, 3.0),
    ("read", "read\nsplats or USD files", "converters", 1.0, 1.0),
    ("sequence", "Gaussians\na cloud a frame,\nwith radiance", "world", 2.0, 1.0),
    ("decompose", "decompose\nread, see, light,\nsolve, write", "decomposition", 3.0, 2.0),
    ("asset", "relightable asset\nbase colour, normals,\nroughness, occlusion", "schema", 4.0, 2.0),
    ("convert", "convert\nto files of engines", "converters", 5.1, 4.0),
    ("validate", "validate\nagainst the contract", "schema", 5.1, 3.0),
    ("render", "render\nstages, shots, frames", "render", 5.1, 2.0),
    ("view", "view\nin the browser", "view", 5.1, 1.0),
    ("evaluate", "evaluate\nagainst captures", "evaluate", 5.1, 0.0),
)
"""Stations of the data: name, text, the package that does it (none for what is given), column and row."""

WAY_ARROWS = (
    ("photographs", "capture"),
    ("trained", "read"),
    ("capture", "reconstruct"),
    ("reconstruct", "sequence"),
    ("read", "sequence"),
    ("sequence", "decompose"),
    ("capture", "decompose"),
    ("decompose", "asset"),
    *(("asset", use) for use in ("convert", "validate", "render", "view", "evaluate")),
)


AROUND = ("capture", "decompose")
"""The arrow that goes around a station."""


class Packages:
    """The packages of the source: floors, sizes, and the imports between them."""

    def __init__(self) -> None:
        """Read the table of floors and every module's imports."""
        layers = runpy.run_path(str(ROOT / "tests" / "test_layers.py"))
        modules: Mapping[str, Path] = layers["MODULES"]
        self.floors: list[list[str]] = [row.split() for row in layers["FLOORS"].strip().splitlines()]
        self.modules: Counter[str] = Counter()
        self.folders: set[str] = set()
        self.lines: Counter[str] = Counter()
        self.imports: Counter[tuple[str, str]] = Counter()
        for module, path in modules.items():
            here = _package(module)
            if path.name == "__init__.py":
                self.folders.add(here)
            else:
                self.modules[here] += 1
            self.lines[here] += len(path.read_text(encoding="utf-8").splitlines())
            for name in layers["imports"](path) & set(modules):
                self.imports[here, _package(name)] += 1
        floor = {name: height for height, row in enumerate(self.floors) for name in row}
        self.floor = floor
        self.arrows = _without_detours(
            {(high, low) for high, low in self.imports if low in floor and floor.get(high, 0) > floor[low]}
        )

    def data(self) -> str:
        """Return floors and arrows as JSON: what a picture must show to be current."""
        return json.dumps({"floors": self.floors, "arrows": self.arrows})


def _package(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def _without_detours(pairs: set[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the transitive reduction of pairs without circles: those that no chain of other pairs joins."""
    below: dict[str, set[str]] = {}
    for high, low in pairs:
        below.setdefault(high, set()).add(low)

    def reached(name: str) -> set[str]:
        return below.get(name, set()).union(*(reached(other) for other in below.get(name, ())))

    return sorted((high, low) for high, low in pairs if not any(low in reached(other) for other in below[high] - {low}))


class Layout:
    """Places of packages on their floors, with lanes for arrows that pass floors (Sugiyama et al. 1981)."""

    def __init__(self, packages: Packages) -> None:
        """Order boxes and lanes on every floor, then place them."""
        self.rows: list[list[Any]] = [list(row) for row in packages.floors]
        self.chains: dict[tuple[str, str], list[Any]] = {}
        for high, low in packages.arrows:
            lanes = [(high, low, height) for height in range(packages.floor[high] - 1, packages.floor[low], -1)]
            for lane in lanes:
                self.rows[lane[2]].append(lane)
            self.chains[high, low] = [high, *lanes, low]
        self.near: dict[Any, list[Any]] = {}
        for chain in self.chains.values():
            for above, under in pairwise(chain):
                self.near.setdefault(above, []).append(under)
                self.near.setdefault(under, []).append(above)
        self.x: dict[Any, float] = {}
        self.widths: dict[Any, float] = {}
        for row in self.rows:
            self._place(row, np.zeros(len(row)))
        best = (np.inf, self.rows, self.x)
        for sweep in range(SWEEPS):
            for row in self.rows[:: 1 if sweep % 2 else -1]:
                row.sort(key=self._pull)
                self._place(row, np.array([self._pull(node) for node in row]))
            length = sum(abs(self.x[a] - self.x[b]) for a in self.near for b in self.near[a])
            best = min(best, (length, [list(row) for row in self.rows], dict(self.x)), key=lambda found: found[0])
        _, self.rows, self.x = best

    def _pull(self, node: Any) -> float:
        """Return where a node's neighbours are in the mean; its own place if it has none."""
        near = self.near.get(node)
        return float(np.mean([self.x[other] for other in near])) if near else self.x[node]

    def _place(self, row: list[Any], wanted: np.ndarray) -> None:
        """Put a floor's nodes as near to where they should be as boxes beside each other can."""
        boxes = sum(isinstance(node, str) for node in row)
        most = (WIDTH - 0.9 - LANE * (len(row) - boxes) - GAP * (len(row) - 1)) / max(boxes, 1)
        box = min(BOX, most)  # a crowded floor has narrower boxes
        self.widths.update((node, box) for node in row)
        widths = np.array([box if isinstance(node, str) else LANE for node in row])
        offsets = np.concatenate([[0.0], np.cumsum(0.5 * (widths[:-1] + widths[1:]) + GAP)])
        places = isotonic_regression(wanted - offsets).x + offsets
        half = 0.5 * (WIDTH - 0.9)
        places = np.clip(places, offsets - half + 0.5 * box, offsets - offsets[-1] + half - 0.5 * box)
        self.x.update(zip(row, places.tolist(), strict=True))


def draw_floors(axes: Any, packages: Packages) -> None:
    """Draw every package as a box on its floor, and the imports as arrows down."""
    layout = Layout(packages)
    step = (FLOORS_HEIGHT - 1.0) / len(packages.floors)
    middle = 0.5 * WIDTH + 0.2
    heights = [0.3 + step * (height + 0.5) for height in range(len(packages.floors))]
    box = 0.58 * step
    for height, y in enumerate(heights):
        axes.axhline(y - 0.5 * step, color="#eef0f2", linewidth=0.8, zorder=0)
        axes.text(0.15, y, str(height + 1), color=FAINT, fontsize=9.0, va="center")
    for (high, low), chain in layout.chains.items():
        points = []
        for passed, node in enumerate(chain):
            x, y = middle + layout.x[node], heights[packages.floor[high] - passed]
            points += [(x, y + 0.5 * box + 0.02), (x, y - 0.5 * box)]
        axes.add_patch(
            FancyArrowPatch(
                path=_smooth(points[1:-1]),
                arrowstyle="-|>",
                mutation_scale=7.0,
                linewidth=0.4 + 0.4 * np.sqrt(packages.imports[high, low]),
                color=ARROW,
                alpha=0.55,
                zorder=1,
            )
        )
    for name, height in packages.floor.items():
        x, y = middle + layout.x[name], heights[height]
        width = layout.widths[name]
        _box(axes, x, y, width, box, _color(name))
        lines = packages.lines[name]
        size = (
            f"{packages.modules[name]} modules, {lines / 1000.0:.1f}k lines" if name in packages.folders else "1 module"
        )
        label = {"color": INK, "ha": "center", "va": "center", "zorder": 3}
        axes.text(x, y + 0.2 * box, name, fontsize=12.0, fontweight="bold", **label)
        axes.text(x, y - 0.25 * box, size, fontsize=9.0 * width / BOX, **label)


def draw_way(axes: Any) -> None:
    """Draw what happens to data, from photographs or trained Gaussians to what an asset is used for."""
    places = {name: (0.97 + 1.95 * column, 0.4 + 0.76 * row) for name, _, _, column, row in WAY}
    sizes = {name: (1.9, 0.56) if column > 4.5 else (1.62, 0.86) for name, _, _, column, _ in WAY}
    for start, end in WAY_ARROWS:
        (x0, y0), (x1, y1) = places[start], places[end]
        right, left = x0 + 0.5 * sizes[start][0], x1 - 0.5 * sizes[end][0] - 0.03
        bottom, top = y0 - 0.5 * sizes[start][1], y1 + 0.5 * sizes[end][1] + 0.03
        if x0 == x1:
            path = Curve([(x0, bottom), (x1, top)])
        elif (start, end) == AROUND:
            path = Curve([(x0, bottom), (x0, y1), (x0 + 0.3, y1), (left, y1)], [1, 3, 3, 2])
        else:
            path = _smooth([(right, y0), (left, y1)], sideways=True)
        axes.add_patch(
            FancyArrowPatch(path=path, arrowstyle="-|>", mutation_scale=10.0, linewidth=1.3, color=ARROW, zorder=1)
        )
    for name, text, package, _, _ in WAY:
        x, y = places[name]
        _box(axes, x, y, *sizes[name], _color(package))
        first, _, rest = text.partition("\n")
        label = {"color": INK, "ha": "center", "va": "center", "zorder": 3}
        lift = (0.13, 0.24)[rest.count("\n")]
        axes.text(x, y + lift, first, fontsize=10.5, fontweight="bold", **label)
        axes.text(x, y - 0.11, rest, fontsize=9.0, linespacing=1.25, **label)


def _smooth(points: Sequence[tuple[float, float]], *, sideways: bool = False) -> Curve:
    """Return a curve through points that leaves and meets each of them upright, or level."""
    vertices, codes = [points[0]], [Curve.MOVETO]
    for (x0, y0), (x1, y1) in pairwise(points):
        x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
        vertices += [(x, y0), (x, y1), (x1, y1)] if sideways else [(x0, y), (x1, y), (x1, y1)]
        codes += [Curve.CURVE4] * 3
    return Curve(vertices, codes)


def _box(axes: Any, x: float, y: float, width: float, height: float, color: str) -> None:
    corner = (x - 0.5 * width, y - 0.5 * height)
    axes.add_patch(
        FancyBboxPatch(
            corner,
            width,
            height,
            boxstyle="round,pad=0,rounding_size=0.07",
            facecolor=color,
            edgecolor=ARROW,
            linewidth=0.9,
            zorder=2,
        )
    )


def _color(package: str) -> str:
    return next((color for color, names in COLORS.items() if package in names), "white")


def draw(path: Path, packages: Packages) -> None:
    """Write the picture as WebP, with what it was drawn from as its XMP."""
    total = FLOORS_HEIGHT + WAY_HEIGHT
    figure = Figure(figsize=(WIDTH, total), facecolor="white")
    FigureCanvasAgg(figure)
    for low, height in ((WAY_HEIGHT / total, FLOORS_HEIGHT), (0.0, WAY_HEIGHT)):
        axes = figure.add_axes((0.0, low, 1.0, height / total))
        axes.set_xlim(0.0, WIDTH)
        axes.set_ylim(0.0, height)
        axes.set_axis_off()
    floors, way = figure.axes
    floors.text(0.15, FLOORS_HEIGHT - 0.25, "Packages on their floors", fontsize=14.0, fontweight="bold", color=INK)
    floors.text(
        3.35,
        FLOORS_HEIGHT - 0.24,
        "Arrows are imports, wider for more of them; one that a chain of others implies is left out.",
        fontsize=10.0,
        color=ARROW,
    )
    for index, (color, kind) in enumerate(zip(COLORS, KINDS, strict=True)):
        x = 0.35 + 2.3 * index
        _box(floors, x, FLOORS_HEIGHT - 0.5, 0.28, 0.16, color)
        floors.text(x + 0.22, FLOORS_HEIGHT - 0.5, kind, fontsize=10.5, color=INK, va="center")
    draw_floors(floors, packages)
    way.text(0.15, WAY_HEIGHT - 0.3, "The way of the data", fontsize=14.0, fontweight="bold", color=INK)
    draw_way(way)
    with io.BytesIO() as drawn:
        figure.savefig(drawn, dpi=RESOLUTION)
        few = Image.open(drawn).convert("RGB").quantize(64, dither=Image.Dither.NONE)  # half of the bytes
    few.convert("RGB").save(path, "WEBP", lossless=True, quality=60, xmp=packages.data().encode())


if __name__ == "__main__":
    draw(PICTURE, Packages())
    print(f"wrote {PICTURE.relative_to(ROOT)}")
