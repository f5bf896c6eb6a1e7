"""Drawing of a capture's report: the rig from two sides, what most cameras see, images with masks, findings."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from beam_warp.capture.corrections import RigCorrection
from beam_warp.capture.findings import Finding, count_of
from beam_warp.capture.images import Glimpse
from beam_warp.capture.inspect import SPLIT, CaptureReport
from beam_warp.capture.records import SparsePoints
from beam_warp.capture.rigs import frustum_corners, meeting_point
from beam_warp.checks import require_package
from beam_warp.errors import BeamError
from beam_warp.image.color import linear_to_srgb
from beam_warp.image.files import replacing
from beam_warp.world.camera import Camera

GREY = "#555555"
WIDTH = 12.0
RESOLUTION = 100
SHOWN_GLIMPSES = 24
SHOWN_POINTS = 3000
COLUMNS = 8

COLORS = {"train": "#0072B2", "other": "#E08214", "left out": "#C51B1B"}
"""Colour of a camera by its kind: used for training, not used for training, left out."""

SEVERITY_COLORS = {"error": "#C51B1B", "warning": "#B36B00", "note": "#555555"}
OUTLINE = "#00E5FF"
VOLUME = "#2E8B57"
ARROW = "#FFD400"
BACKGROUND = 0.2
"""Display grey behind subjects, on which dark and white ones are both visible."""

DEPTH_SHARE = 0.16
"""Depth of the drawn frustums, as a share of the cameras' distance to what they look at."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A capture's cameras, as they are drawn.

    Attributes:
        cameras: Cameras by name.
        kinds: Kind of each camera by name, a key of `COLORS`.
        depth: Depth of the drawn frustums [m].
        volume: Corners of the common volume, ``(8, 3)``, or None.
        points: Sparse points and their display colours, ``(P, 3)`` each.
        corrections: What a reconstruction found wrong with cameras; None if there was none.
        ways: Which way that moves the subject's middle in the images of cameras that were moved [pixel], ``(2,)`` each.
    """

    cameras: dict[str, Camera]
    kinds: dict[str, str]
    depth: float
    volume: NDArray[np.float64] | None
    points: tuple[NDArray[np.float64], NDArray[np.float64]]
    corrections: RigCorrection | None = None
    ways: dict[str, NDArray[np.float64]] = field(default_factory=dict)

    @classmethod
    def of(cls, report: CaptureReport, corrections: RigCorrection | None = None) -> Rig:
        """Make the rig of a report, and of the corrections of a reconstruction from it."""
        poses = np.array([camera.camera_to_world for camera in report.cameras.values()])
        point = meeting_point(poses)
        if point is None:
            point = poses[:, :3, 3].mean(axis=0) if report.volume is None else np.mean(report.volume, axis=0)
        distance = float(np.median(np.linalg.norm(poses[:, :3, 3] - point, axis=1)))
        left = {}
        for record in report.capture.select(split=SPLIT):
            left.setdefault(record.camera_name, []).append(record.name in report.left_out)
        bad = set() if corrections is None else {camera.camera for camera in corrections.cameras if not camera.is_used}
        left |= {name: [True] for name in bad & set(left)}
        kinds = {
            name: "other" if name not in left else "left out" if all(left[name]) else "train" for name in report.cameras
        }
        volume = None
        if report.volume is not None:
            low, high = report.volume
            volume = np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i, j, k in BOX])
        ways = {} if corrections is None else corrections.ways(report.cameras, point)
        depth = DEPTH_SHARE * (distance or 1.0)
        return cls(report.cameras, kinds, depth, volume, _shown_points(report), corrections, ways)

    @property
    def magnification(self) -> float:
        """How many times larger than they are `ways` are drawn: the largest is a tenth of an image to a whole one."""
        shares = [np.linalg.norm(way) / self.cameras[name].width for name, way in self.ways.items()]
        return 10.0 ** float(np.floor(-np.log10(max([*shares, 1e-9]))))

    def correction(self, name: str) -> str:
        """Return what was found wrong with a camera, in words; empty if nothing is known."""
        found = [] if self.corrections is None else self.corrections.cameras
        own = next((camera for camera in found if camera.camera == name), None)
        return "" if own is None else own.summary()

    def labels(self) -> dict[str, str]:
        """Return a label for each camera by name: the name without the start that all cameras of its kind share."""
        found = {}
        for kind in COLORS:
            names = [name for name, own in self.kinds.items() if own == kind]
            short = _common_start(names)
            found |= {name: name[short:] for name in names}
        return found


BOX = tuple((i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1))
"""Corners of a box: 0 or 1 for each coordinate, the low or the high bound."""

BOX_EDGES = tuple(
    (a, b) for a in range(8) for b in range(a + 1, 8) if sum(x != y for x, y in zip(BOX[a], BOX[b], strict=True)) == 1
)


def _common_start(names: Sequence[str]) -> int:
    """Return how many leading characters names share, up to the last separator of words."""
    if len(names) < 2:
        return 0
    same = 0
    while same < min(map(len, names)) and len({name[same] for name in names}) == 1:
        same += 1
    start = names[0][:same]
    return max(start.rfind(sign) for sign in "_-. ") + 1


def _shown_points(report: CaptureReport) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return an even selection of a capture's points near the common volume, and their display colours."""
    try:
        found: SparsePoints | None = report.capture.points()
    except BeamError:  # inspection reports it
        found = None
    if found is None or not len(found.positions):
        return np.zeros((0, 3)), np.zeros((0, 3))
    positions = found.positions
    near = np.ones(len(positions), bool)
    if report.volume is not None:
        low, high = report.volume
        near = ((positions > low - 0.5 * (high - low)) & (positions < high + 0.5 * (high - low))).all(axis=1)
    index = np.flatnonzero(near)[:: max(1, int(near.sum()) // SHOWN_POINTS)]
    colors = np.full((len(index), 3), 0.4) if found.colors is None else linear_to_srgb(found.colors[index])
    return positions[index], np.clip(colors, 0.0, 1.0)


def shown_glimpses(report: CaptureReport) -> list[Glimpse]:
    """Return the images to show, of the first frame that was read: those left out, and an even selection of others."""
    if not report.glimpses:
        return []
    first = min(glimpse.record.frame for glimpse in report.glimpses)
    found = sorted(
        (glimpse for glimpse in report.glimpses if glimpse.record.frame == first),
        key=lambda glimpse: (glimpse.record.split != SPLIT, glimpse.record.camera_name),
    )
    bad = [place for place, glimpse in enumerate(found) if glimpse.record.name in report.left_out][:SHOWN_GLIMPSES]
    rest = [place for place in range(len(found)) if place not in bad]
    even = np.linspace(0, len(rest) - 1, min(len(rest), SHOWN_GLIMPSES - len(bad)))
    return [found[place] for place in sorted({*bad, *(rest[round(p)] for p in even)})]


def display_pixels(glimpse: Glimpse) -> NDArray[np.uint8]:
    """Return an image over the background as 8-bit sRGB, ``(H, W, 3)``."""
    if glimpse.alpha is None:
        return glimpse.pixels
    alpha = glimpse.alpha[..., None]
    return np.rint(glimpse.pixels * alpha + 255.0 * BACKGROUND * (1.0 - alpha)).astype(np.uint8)


def headline(report: CaptureReport, corrections: RigCorrection | None = None) -> str:
    """Return a capture's size, and what was moved of its cameras, in one line."""
    capture = report.capture
    splits = ", ".join(f"{len(capture.select(split=split)):,} {split}" for split in capture.splits)
    return (
        f"{len(report.cameras)} cameras, {count_of(len(capture.frames), 'frame')}, "
        f"{len(capture.records):,} images ({splits}); {len(report.glimpses)} looked at"
        f"{'' if corrections is None else f'; {corrections.summary()}'}"
    )


def verdict(report: CaptureReport) -> str:
    """Say whether a capture can be reconstructed."""
    errors, warnings = len(report.of("error")), len(report.of("warning"))
    if errors:
        return f"cannot be reconstructed: {count_of(errors, 'error')}, {count_of(warnings, 'warning')}"
    return f"ready, with {count_of(warnings, 'warning')}" if warnings else "ready"


def all_findings(report: CaptureReport, corrections: RigCorrection | None) -> list[Finding]:
    """Return the findings of a report and of corrections."""
    return [*report.findings, *([] if corrections is None else corrections.findings())]


def write_picture(report: CaptureReport, path: Path, corrections: RigCorrection | None = None) -> None:
    """Draw a report as a PNG, and corrections of its cameras as arrows: the way that the subject moved in an image.

    Raises:
        InvalidOptionError: matplotlib is not installed.
        OutputError: The file cannot be written.
    """
    require_package("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    glimpses = shown_glimpses(report)
    moved = [] if corrections is None else [(corrections.summary().capitalize() + ".", GREY)]
    lines = [*moved, *_finding_lines(all_findings(report, corrections))]
    aspect = max((g.pixels.shape[0] / g.pixels.shape[1] for g in glimpses), default=1.0)
    columns = -(-len(glimpses) // max(1, -(-len(glimpses) // COLUMNS))) or 1  # rows as even as they can be
    cell = (WIDTH - 0.6) / max(columns, 5)
    thumb = (cell - 0.1, (cell - 0.1) * aspect)
    rows = -(-len(glimpses) // columns)
    heights = {"title": 0.8, "rig": 5.0, "images": rows * (thumb[1] + 0.28) + 0.1, "findings": 0.35 + 0.19 * len(lines)}
    total = sum(heights.values())
    figure = Figure(figsize=(WIDTH, total), facecolor="white")
    FigureCanvasAgg(figure)

    def place(left: float, top: float, width: float, height: float) -> Any:
        return figure.add_axes((left / WIDTH, 1.0 - (top + height) / total, width / WIDTH, height / total))

    color = SEVERITY_COLORS["error"] if report.of("error") else "#222222"
    figure.text(
        0.3 / WIDTH, 1 - 0.36 / total, report.capture.folder.resolve().name, size=17, weight="bold", va="center"
    )
    figure.text(0.3 / WIDTH, 1 - 0.64 / total, headline(report), size=10, color=GREY, va="center")
    figure.text(1 - 0.3 / WIDTH, 1 - 0.36 / total, verdict(report), size=12, color=color, ha="right", va="center")
    rig = Rig.of(report, corrections)
    _legend(figure, rig, total)
    _draw_rig(place(0.1, 0.8, 6.9, 4.9), rig, _outside_view(rig))
    _draw_plan(place(7.55, 1.05, 4.2, 4.2), rig)
    top = heights["title"] + heights["rig"]
    for number, glimpse in enumerate(glimpses):
        row, column = divmod(number, columns)
        axes = place(0.3 + column * cell, top + row * (thumb[1] + 0.28) + 0.22, *thumb)
        _draw_glimpse(axes, glimpse, rig)
    top += heights["images"] + 0.2
    for number, (text, ink) in enumerate(lines):
        figure.text(0.3 / WIDTH, 1 - (top + 0.19 * number) / total, text, size=9, color=ink, va="center")
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=RESOLUTION, pil_kwargs={"optimize": True})


def _finding_lines(findings: Iterable[Finding]) -> list[tuple[str, str]]:
    lines = [
        ("    " * (number > 0) + line, SEVERITY_COLORS[finding.severity])
        for finding in findings
        for number, line in enumerate(textwrap.wrap(str(finding), 165))
    ]
    return lines or [("Nothing wrong was found.", "#2E7D32")]


def _legend(figure: Any, rig: Rig, total: float) -> None:
    """Draw the legend of colours."""
    from matplotlib.patches import Patch

    handles = [Patch(color=color, label=text) for text, color in legend_entries(rig)]
    figure.legend(
        handles=handles,
        loc="center right",
        bbox_to_anchor=(1 - 0.2 / WIDTH, 1 - 0.66 / total),
        ncols=len(handles),
        frameon=False,
        fontsize=9,
        handlelength=0.9,
        handleheight=0.9,
        handletextpad=0.5,
        columnspacing=1.4,
        borderpad=0.0,
    )


def legend_entries(rig: Rig) -> list[tuple[str, str]]:
    """Return the legend: each entry's text and colour."""
    names = {"train": "trained from", "other": "other cameras", "left out": "left out"}
    entries = [(names[kind], COLORS[kind]) for kind in COLORS if kind in rig.kinds.values()]
    entries += [("what most see", VOLUME)] if rig.volume is not None else []
    return entries + ([(f"correction × {rig.magnification:,.0f}", ARROW)] if rig.ways else [])


def _outside_view(rig: Rig) -> Camera:
    """Return a camera that sees the whole rig from a little above."""
    points = [camera.position for camera in rig.cameras.values()]
    points += [corner for camera in rig.cameras.values() for corner in frustum_corners(camera, rig.depth)]
    points += [] if rig.volume is None else list(rig.volume)
    return Camera.frame_points(
        np.array(points), azimuth=25.0, elevation=24.0, width=690, height=490, vertical_fov=28.0, margin=1.03
    )


def _draw_rig(axes: Any, rig: Rig, view: Camera) -> None:
    """Draw the frustums in perspective, far ones first and paler."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgba
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.0, foreground="white")]
    axes.set_xlim(0, view.width)
    axes.set_ylim(view.height, 0)
    axes.set_aspect("equal")
    axes.axis("off")
    depths = {name: float(view.project(camera.position[None])[0, 2]) for name, camera in rig.cameras.items()}
    near, far = min(depths.values()), max(depths.values())
    positions, colors = rig.points
    if len(positions):
        x, y, _ = view.project(positions).T
        axes.scatter(x, y, s=1.2, c=colors, linewidths=0, zorder=2, rasterized=True)
    if rig.volume is not None:
        corners = view.project(rig.volume)[:, :2]
        edges = [corners[list(edge)] for edge in BOX_EDGES]
        axes.add_collection(LineCollection(edges, colors=VOLUME, linewidths=1.2, zorder=3))
        origin, size = rig.volume[0], float((rig.volume[7] - rig.volume[0]).min()) * 0.35
        for axis, (name, color) in enumerate((("x", "#C51B1B"), ("y", "#2E7D32"), ("z", "#1A4FB4"))):
            tip = origin + size * np.eye(3)[axis]
            (x0, y0, _), (x1, y1, _) = view.project(np.array([origin, tip]))
            axes.annotate("", (x1, y1), (x0, y0), arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.6}, zorder=4)
            x2, y2, _ = view.project((origin + 1.18 * (tip - origin))[None])[0]
            axes.text(x2, y2, name, size=9, color=color, ha="center", va="center", weight="bold", zorder=4)
    labels = rig.labels()
    for order, name in enumerate(sorted(depths, key=lambda name: -depths[name])):
        camera, color = rig.cameras[name], COLORS[rig.kinds[name]]
        weight = 1.0 - 0.6 * (depths[name] - near) / max(far - near, 1e-12)
        corners = view.project(np.concatenate([frustum_corners(camera, rig.depth), camera.position[None]]))[:, :2]
        face, edge = to_rgba(color, 0.10 + 0.12 * weight), to_rgba(color, weight)
        square = PolyCollection([corners[:4]], facecolors=face, edgecolors=edge, linewidths=1.1, zorder=5 + order)
        axes.add_collection(square)
        sides = [np.array([corners[4], corner]) for corner in corners[:4]]
        axes.add_collection(LineCollection(sides, colors=[edge], linewidths=0.8, zorder=5 + order))
        style = {"color": color, "alpha": 0.5 + 0.5 * weight, "path_effects": halo, "zorder": 99}
        axes.text(*corners[4], labels[name], size=7, ha="center", va="bottom", **style)


def _draw_plan(axes: Any, rig: Rig) -> None:
    """Draw the rig from above, with z towards the viewer."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Polygon, Rectangle

    positions, colors = rig.points
    if len(positions):
        axes.scatter(positions[:, 0], positions[:, 1], s=0.8, c=colors, linewidths=0)
    if rig.volume is not None:
        low, high = rig.volume[0], rig.volume[7]
        axes.add_patch(Rectangle(low[:2], *(high - low)[:2], fill=True, fc=to_rgba(VOLUME, 0.12), ec=VOLUME, lw=1.2))
    labels = rig.labels()
    for name, camera in rig.cameras.items():
        color = COLORS[rig.kinds[name]]
        corners = frustum_corners(camera, rig.depth)
        outline = np.concatenate([camera.position[None], corners])[:, :2]
        hull = outline[ConvexHull(outline).vertices]
        axes.add_patch(Polygon(hull, closed=True, fc=to_rgba(color, 0.15), ec=color, lw=0.9))
        away = camera.position[:2] - corners.mean(axis=0)[:2]
        length = float(np.linalg.norm(away))
        shift = away / length * 0.45 * rig.depth if length > 0.2 * rig.depth else np.array([0.0, 0.45 * rig.depth])
        axes.text(*(camera.position[:2] + shift), labels[name], size=6.5, color=color, ha="center", va="center")
    corners = [frustum_corners(camera, 1.6 * rig.depth) for camera in rig.cameras.values()]
    every = np.concatenate([*corners, [camera.position for camera in rig.cameras.values()]])
    if rig.volume is not None:
        every = np.concatenate([every, rig.volume])
    middle = 0.5 * (every.max(axis=0) + every.min(axis=0))[:2]
    reach = 0.54 * float((every.max(axis=0) - every.min(axis=0))[:2].max()) + 0.3 * rig.depth
    axes.set_xlim(middle[0] - reach, middle[0] + reach)
    axes.set_ylim(middle[1] - reach, middle[1] + reach)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=8, colors=GREY, length=3)
    axes.set_xlabel("x [m]", size=9, color=GREY)
    axes.set_ylabel("y [m]", size=9, color=GREY, labelpad=1)
    axes.set_title("from above", size=10, color=GREY, loc="left", pad=4)
    for side in axes.spines.values():
        side.set_color("#BBBBBB")
    axes.grid(color="#EEEEEE", lw=0.8)
    axes.set_axisbelow(True)


def _draw_glimpse(axes: Any, glimpse: Glimpse, rig: Rig) -> None:
    """Draw an image with the outline of its mask and its camera's correction, under its name and exposure."""
    pixels, name = display_pixels(glimpse), glimpse.record.camera_name
    kind = rig.kinds[name]
    height, width = pixels.shape[:2]
    axes.imshow(pixels, interpolation="bilinear", extent=(0, width, height, 0))
    if glimpse.alpha is not None and glimpse.alpha.min() < 0.5 < glimpse.alpha.max():
        axes.contour(
            np.arange(width) + 0.5, np.arange(height) + 0.5, glimpse.alpha, levels=[0.5], colors=OUTLINE, linewidths=0.7
        )
    if name in rig.ways:
        way = rig.ways[name] * rig.magnification * width / rig.cameras[name].width
        start = np.array([0.5 * width, 0.5 * height])
        style = {"arrowstyle": "-|>", "color": ARROW, "lw": 1.4, "shrinkA": 0.0, "shrinkB": 0.0}
        axes.annotate("", tuple(start + way), tuple(start), arrowprops=style, annotation_clip=False)
    axes.text(0.03, 0.03, rig.correction(name), size=6.5, color="white", transform=axes.transAxes)
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_color(COLORS[kind])
        side.set_linewidth(1.0 if kind != "left out" else 2.5)
    axes.set_title(name if len(name) <= 18 else "…" + name[-17:], size=7, color=COLORS[kind], loc="left", pad=2)
    if glimpse.exposure is not None:
        axes.set_title(f"{glimpse.exposure:+.1f} EV", size=7, color=GREY, loc="right", pad=2)
