"""HTML page of a capture's report, in one file: the rig to turn, images in their frustums, findings."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageColor
from scipy import ndimage

from beam_warp.capture.corrections import RigCorrection
from beam_warp.capture.findings import Finding
from beam_warp.capture.images import Glimpse
from beam_warp.capture.inspect import CaptureReport
from beam_warp.capture.picture import (
    BOX_EDGES,
    COLORS,
    OUTLINE,
    SEVERITY_COLORS,
    VOLUME,
    Rig,
    all_findings,
    display_pixels,
    headline,
    legend_entries,
    shown_glimpses,
    verdict,
)
from beam_warp.capture.rigs import frustum_corners
from beam_warp.checks import require_package
from beam_warp.image.files import replacing

IMAGE_SIDE = 56
"""Longer side of the images in the frustums [pixel]; each pixel is drawn as two triangles."""

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 1.2em auto; max-width: 1400px; padding: 0 1em; color: #222; }
h1 { font-size: 1.35em; margin-bottom: 0; } .size { color: #555; margin-top: 0.2em; }
.verdict { float: right; font-size: 1.1em; }
#rig { height: min(70vh, 760px); border: 1px solid #ddd; border-radius: 4px; }
ul { list-style: none; padding: 0; } li { margin: 0.35em 0; padding-left: 0.7em; border-left: 3px solid; }
li small { color: #666; } li b { font-weight: 600; }
.images { display: grid; grid-template-columns: repeat(auto-fill, minmax(150px, 1fr)); gap: 0.7em; }
figure { margin: 0; } figure img { width: 100%; display: block; border: 2px solid; image-rendering: auto; }
figcaption { display: flex; justify-content: space-between; font-size: 0.8em; color: #555; }
"""


def write_page(report: CaptureReport, path: Path, corrections: RigCorrection | None = None) -> None:
    """Write a report, and corrections of its cameras, as one HTML file that needs no network.

    Raises:
        InvalidOptionError: plotly is not installed.
        OutputError: The file cannot be written.
    """
    require_package("plotly")
    from plotly.offline import get_plotlyjs

    rig = Rig.of(report, corrections)
    glimpses = shown_glimpses(report)
    script = files("beam_warp.capture").joinpath("page.js").read_text(encoding="utf-8")
    # "<" is escaped, so that no text in the data can end the element that holds it
    data = json.dumps(_data(rig, glimpses), ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
    name = html.escape(report.capture.folder.resolve().name)
    color = SEVERITY_COLORS["error"] if report.of("error") else "#222"
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{name}</title>\n<style>{STYLE}</style>\n<script>{get_plotlyjs()}</script>\n</head>\n<body>\n"
        f'<p class="verdict" style="color: {color}">{html.escape(verdict(report))}</p>\n<h1>{name}</h1>\n'
        f'<p class="size">{html.escape(headline(report, corrections))}</p>\n<div id="rig"></div>\n'
        f"<ul>{_findings(all_findings(report, corrections))}</ul>\n"
        f'<div class="images">{"".join(_figure(glimpse, rig) for glimpse in glimpses)}</div>\n'
        f'<script type="application/json" id="data">{data}</script>\n<script>{script}</script>\n</body>\n</html>\n'
    )
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _findings(findings: Sequence[Finding]) -> str:
    if not findings:
        return '<li style="border-color: #2E7D32">Nothing wrong was found.</li>'
    return "".join(
        f'<li style="border-color: {SEVERITY_COLORS[finding.severity]}">'
        f'<b style="color: {SEVERITY_COLORS[finding.severity]}">{finding.severity}</b> {html.escape(finding.what)}. '
        f"{html.escape(finding.remedy)}"
        f"{f'<br><small>{html.escape(finding.where)}</small>' if finding.where else ''}</li>"
        for finding in findings
    )


def _figure(glimpse: Glimpse, rig: Rig) -> str:
    """Return the HTML of an image with its mask's outline, its name and its exposure."""
    name = html.escape(glimpse.record.camera_name, quote=True)
    exposure = "" if glimpse.exposure is None else f"{glimpse.exposure:+.1f} EV"
    moved = rig.correction(glimpse.record.camera_name)
    color = COLORS[rig.kinds[glimpse.record.camera_name]]
    file = io.BytesIO()
    PillowImage.fromarray(_outlined(glimpse)).save(file, "PNG", optimize=True)
    source = base64.b64encode(file.getvalue()).decode("ascii")
    said = "".join(f"<span>{text}</span>" for text in (name, moved, exposure) if text)
    caption = f"<figcaption>{said}</figcaption>"
    image = f'<img alt="{name}" style="border-color: {color}" src="data:image/png;base64,{source}">'
    return f'<figure data-camera="{name}">{image}{caption}</figure>'


def _outlined(glimpse: Glimpse) -> NDArray[np.uint8]:
    """Return an image at twice its size, with its mask's outline drawn one pixel wide."""
    pixels = np.repeat(np.repeat(display_pixels(glimpse), 2, axis=0), 2, axis=1)
    if glimpse.alpha is not None:
        inside = np.asarray(ndimage.zoom(glimpse.alpha, 2, order=1, grid_mode=True, mode="nearest")) > 0.5
        edge = inside & ~np.asarray(ndimage.binary_erosion(inside, border_value=1), bool)
        pixels[edge] = ImageColor.getrgb(OUTLINE)
    return pixels


def _data(rig: Rig, glimpses: list[Glimpse]) -> dict[str, Any]:
    """Return a rig in the form that the page's script reads."""
    by_camera = {glimpse.record.camera_name: glimpse for glimpse in glimpses}
    positions, colors = rig.points
    kinds = [kind for kind in COLORS if kind in rig.kinds.values()]
    titles = {color: title for title, color in legend_entries(rig)}
    return {
        "cameras": [
            {
                "name": name,
                "kind": rig.kinds[name],
                "position": camera.position.tolist(),
                "corners": frustum_corners(camera, rig.depth).tolist(),
                "text": f"{html.escape(name)}<br>{camera.width} x {camera.height}, focal {camera.focal_x:.0f} px"
                f"{f'<br>moved by {rig.correction(name)}' if name in rig.ways else ''}",
                "image": _small(by_camera[name]) if name in by_camera else None,
            }
            for name, camera in rig.cameras.items()
        ],
        "kinds": [{"name": kind, "title": titles[COLORS[kind]], "color": COLORS[kind]} for kind in kinds],
        "volume": None
        if rig.volume is None
        else [[rig.volume[a].tolist(), rig.volume[b].tolist()] for a, b in BOX_EDGES],
        "volumeName": titles.get(VOLUME, ""),
        "volumeColor": VOLUME,
        "points": np.round(positions, 4).tolist(),
        "pointColors": [bytes(color).hex() for color in np.rint(255.0 * colors).astype(np.uint8)],
    }


def _small(glimpse: Glimpse) -> dict[str, Any]:
    """Return a small image: rows, columns, and six hexadecimal digits a pixel, or dashes outside the mask."""
    picture = PillowImage.fromarray(display_pixels(glimpse))
    scale = IMAGE_SIDE / max(picture.size)
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    pixels = np.asarray(picture.resize(size, PillowImage.Resampling.BOX))
    solid = np.ones(size[::-1], bool)
    if glimpse.alpha is not None:
        solid = np.asarray(PillowImage.fromarray(glimpse.alpha).resize(size, PillowImage.Resampling.BOX)) > 0.5
    colors = (
        bytes(pixel).hex() if inside else "-" * 6
        for pixel, inside in zip(pixels.reshape(-1, 3), solid.flat, strict=True)
    )
    return {"rows": size[1], "columns": size[0], "colors": "".join(colors)}
