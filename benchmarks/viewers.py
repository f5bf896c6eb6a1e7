"""Our files in viewers of the web: whether they stand upright and unmirrored there, and how they look.

    python benchmarks/viewers.py --out result.json --picture docs/images/viewers.webp

The probe, the pages and their camera are those of ``tests/web``. The viewers come from npm (`npm_packages.py`), the
browser is a headless Chromium that draws in software.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import npm_packages
import numpy as np
import record
import warp as wp
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from web import probe
from web.viewers import VIEWERS, Viewer, chromium, photograph, write_probe

from beam_warp.image.panels import lay_out


def look(browser: Any, viewer: Viewer, ending: str, folder: Path) -> tuple[dict[str, Any], NDArray[np.uint8]]:
    """Return what is found in a viewer's picture of the probe, and the picture."""
    picture = photograph(browser, viewer, write_probe(folder, viewer, ending))
    row = {
        "name": f"{viewer.name} {ending}",
        "viewer": viewer.name,
        "ending": ending,
        "largest_shift": max(probe.shifts(picture).values()),
        "color_error": None
        if ending in viewer.colors_wrong
        else probe.color_error(picture, harmonics=ending != ".splat"),
    }
    return row, picture


def main() -> int:
    parser = record.parser(__doc__)
    parser.add_argument("--picture", type=Path, metavar="WEBP", help="all screenshots in one picture")
    args = parser.parse_args()
    rows, panels = [], []
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        for viewer in VIEWERS.values():
            for ending in viewer.endings():
                row, picture = look(browser, viewer, ending, Path(folder))
                rows.append(row)
                panels.append((f"{viewer.name}, {ending}", picture[32:-32, 10:-10]))
                print(f"{row['name']}: {row['largest_shift']:.2f} pixel", flush=True)
        result = {
            "browser": f"Chromium {browser.version}",
            "side": probe.SIDE,
            "versions": {viewer.name: npm_packages.version(viewer.package) for viewer in VIEWERS.values()},
            "rows": rows,
        }
    record.write_result(args, wp.get_device("cpu"), result)
    if args.picture:
        Image.fromarray(lay_out(panels, columns=5)).save(args.picture, quality=85, method=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())
