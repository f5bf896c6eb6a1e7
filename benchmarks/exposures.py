"""Exposures of views that are found by the points that views share: of sound captures, and with one view wrong.

    python benchmarks/exposures.py --out FILE [--data DIR] [--captures NAME ...] [--cameras N ...]

The first frame of every capture is seen by some of its cameras, evenly chosen, in images a quarter as wide. Each camera
is made wrong in turn. Writes the JSON after each number of cameras.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import record
from scipy.spatial.transform import Rotation

from beam_warp.capture.capture import Capture
from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device
from beam_warp.reconstruction.gains import view_gains
from beam_warp.reconstruction.initial import initial_gaussians
from beam_warp.reconstruction.track import outward_normals
from beam_warp.stability.capture_cases.alterations import evenly, training_cameras, with_cameras

POINTS = 1_500
"""Gaussians on the hull, at which views are compared."""

REDUCTION = 4

WRONG = (-1.0, -0.5, 0.5, 1.0)
"""Errors of exposure that a view is given [stop]."""


def measure(views: Sequence[CapturedView], device: str) -> dict[str, Any]:
    """Return the exposures that are found where nothing is wrong, and where each view is in turn [stop].

    ``sound`` is the largest of any view where none is wrong, ``others`` that of sound views beside a wrong one, and
    ``blamed`` how many of these would be reported. Each error has ``found`` of ``cases``, at ``lowest`` to ``highest``.
    """

    start = initial_gaussians(views, POINTS, device=device)  # where, whatever the exposures
    normals = outward_normals(start, Rotation.from_quat(start.orientations).apply([0.0, 0.0, 1.0]))
    sound = view_gains(start, normals, views, device=device)
    others, blamed, errors = 0.0, int(sound.off.sum()), {}
    for stops in WRONG:
        found, exposures = 0, []
        for index, view in enumerate(views):
            wrong = replace(view, color=view.color * np.float32(2.0**stops))
            seen = view_gains(start, normals, [*views[:index], wrong, *views[index + 1 :]], device=device)
            right = np.arange(len(views)) != index
            found += int(seen.off[index])
            blamed += int(seen.off[right].sum())
            exposures.append(float(seen.stops[index]))
            others = max(others, float(np.nanmax(np.abs(seen.stops[right]))))
        lowest, highest = min(exposures), max(exposures)
        errors[f"{stops:g}"] = {"cases": len(views), "found": found, "lowest": lowest, "highest": highest}
    return {"sound": float(np.nanmax(np.abs(sound.stops))), "others": others, "blamed": blamed, "errors": errors}


def main() -> int:
    parser = record.parser(__doc__, device=True, data=True)
    parser.add_argument("--captures", nargs="+", default=["walker", "runner", "robot"], metavar="NAME")
    parser.add_argument("--cameras", nargs="+", type=int, default=[4, 6, 8, 12, 24], metavar="N")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for name in arguments.captures:
        capture = Capture.read(arguments.data / "captures" / name)
        for count in arguments.cameras:
            chosen = with_cameras(capture, evenly(training_cameras(capture), count))
            records = chosen.select(split="train", frames=capture.frames[:1])
            views = [record.view().reduced(REDUCTION) for record in records]
            rows.append({"name": f"{name} {count}", "cameras": count, **measure(views, arguments.device)})
            print(rows[-1], file=sys.stderr, flush=True)
            record.write_result(arguments, resolve_device(arguments.device), {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
