"""Photographs without masks: each of nine of a statue is left out, and compared with what the others show.

    python benchmarks/statue.py --out FILE [--data DIR] [--device NAME] [--preset NAME] [--reduction N] [--picture PNG]

Scores are those of pixels within the statue's outline, in display values. Cameras set their own exposure and white
balance, and what those of a photograph were is not known before it is seen. So a drawing is scored as it is, and
matched: times the three gains, of least squares in linear light, that bring it nearest to the photograph. Writes the
JSON after each photograph.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import record
from numpy.typing import NDArray
from skimage.draw import polygon2mask

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.device.arrays import resolve_device
from beam_warp.image.color import linear_to_srgb
from beam_warp.image.files import write_png
from beam_warp.image.metrics import block_means, psnr
from beam_warp.jobs.listeners import no_progress
from beam_warp.raster.gbuffer import rasterize
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.steps import FitAndTrack

WIDTH = 1368
"""Width of the photographs that `OUTLINES` are drawn on [pixel]."""

SHOWN = 342
"""Width of a photograph in the picture, about [pixel]."""

ACROSS = 3
"""Pairs in a row of the picture: the photographs are as many as three rows hold."""

OUTLINES = {
    "00006": (
        "455,100 480,50 560,15 640,15 720,60 745,110 820,170 850,215 930,250 990,310 1030,400 1055,480 1060,540 "
        "1030,620 1020,680 980,720 1000,770 290,770 240,650 235,500 225,400 235,330 300,230 350,215 390,160"
    ),
    "00007": (
        "405,420 420,330 460,300 490,260 540,220 570,140 640,90 740,90 790,80 850,65 930,80 960,145 1060,200 1130,300 "
        "1165,380 1150,440 1120,500 1060,580 980,620 900,670 820,690 740,710 620,660 550,600 520,560 480,500 420,470"
    ),
    "00018": (
        "630,110 650,75 700,60 760,75 790,120 830,170 900,200 940,280 970,350 930,430 890,500 870,570 820,640 760,690 "
        "680,700 600,660 550,590 520,510 470,420 440,350 450,270 500,200 560,160"
    ),
    "00028": (
        "375,370 400,290 450,260 520,220 560,190 620,120 720,90 830,85 950,120 1050,180 1110,250 1140,340 1160,400 "
        "1240,450 1200,520 1210,570 1200,620 1130,660 1050,700 960,750 860,770 700,770 580,710 500,650 480,560 "
        "430,510 390,450"
    ),
    "00046": (
        "470,350 510,240 590,150 680,120 780,130 900,200 970,280 985,370 970,460 920,560 840,640 740,680 690,700 "
        "640,670 560,600 510,540 475,440"
    ),
    "00047": (
        "535,360 570,260 610,190 690,130 770,120 880,170 950,240 990,310 980,400 930,500 850,570 780,580 765,630 "
        "740,640 660,590 610,530 560,460"
    ),
    "00052": (
        "235,360 260,310 310,290 330,250 400,230 430,160 500,115 620,110 720,125 850,140 920,150 1000,180 1080,200 "
        "1115,280 1120,400 1090,490 1030,550 920,580 840,640 770,670 720,660 650,630 520,660 440,620 410,540 380,525 "
        "310,480 250,440"
    ),
    "00055": (
        "475,360 480,260 530,170 590,120 680,80 700,40 760,0 1080,0 1180,80 1260,170 1320,300 1330,420 1290,560 "
        "1200,680 1100,770 690,770 580,700 530,600 490,450"
    ),
    "00060": (
        "55,350 100,270 130,180 150,130 210,60 300,0 620,10 700,15 900,20 1080,50 1200,50 1260,150 1280,300 1280,450 "
        "1270,580 1220,680 1100,710 900,690 700,700 600,720 420,750 280,720 200,650 150,560 100,480"
    ),
}
"""The statue's outline in each photograph, drawn by hand: x,y of its corners [pixel]."""


def within_outline(name: str, height: int, width: int) -> NDArray[np.bool_]:
    """Return which pixels of a photograph the statue covers, ``(height, width)``."""
    corners = np.array([corner.split(",") for corner in OUTLINES[name].split()], float) * (width / WIDTH) - 0.5
    return polygon2mask((height, width), corners[:, ::-1])


def left_out(
    records: list[CaptureRecord], index: int, steps: FitAndTrack, reduction: int
) -> tuple[dict[str, object], NDArray[np.float64]]:
    """Fit all photographs but one, and compare that; the row of the result, and the photograph beside the drawing."""
    started = time.perf_counter()
    held, others = records[index], [one for place, one in enumerate(records) if place != index]
    names = [one.camera_name for one in others]
    found = steps.find_exposures(names, [one.view().reduced(reduction) for one in others], no_progress)
    if found is not None:
        others = found.corrected(others)
    track, report = steps.begin([one.view().reduced(reduction) for one in others], no_progress)
    photograph = held.view().reduced(reduction)
    drawn = rasterize(
        track.cloud, photograph.camera, channels=("radiance",), options=steps.fitting.raster, device=steps.device
    )
    light = np.maximum(drawn.channels["radiance"] * drawn.alpha[..., None], 0.0).astype(np.float64)
    seen = np.clip(photograph.color, 0.0, 1.0).astype(np.float64)
    inside = within_outline(held.camera_name, *seen.shape[:2])
    gains = (seen * light)[inside].sum(axis=0) / np.square(light)[inside].sum(axis=0)
    as_drawn, matched = (linear_to_srgb(np.clip(image, 0.0, 1.0)) for image in (light, gains * light))
    display = linear_to_srgb(seen)
    row = {
        "photograph": held.camera_name,
        "psnr": psnr(as_drawn, display, inside),
        "matched": psnr(matched, display, inside),
        "gains": gains,
        "covered": drawn.alpha[inside].mean(),
        "matched_cameras": found is not None and (found.exposure_undone or found.balance_undone),
        "used_psnr": report["psnr"],
        "gaussians": len(track.cloud),
        "seconds": time.perf_counter() - started,
    }
    return row, np.concatenate([display, matched], axis=1)


def sheet(pairs: list[NDArray[np.float64]]) -> NDArray[np.uint8]:
    """Return photographs and drawings, three pairs in a row."""
    step = max(1, pairs[0].shape[1] // (2 * SHOWN))
    fitting = (pairs[0].shape[0] // step * step, pairs[0].shape[1] // step * step)
    small = [
        np.stack([block_means(pair[: fitting[0], : fitting[1], k], step) for k in range(3)], axis=-1) for pair in pairs
    ]
    rows = [np.concatenate(small[first : first + ACROSS], axis=1) for first in range(0, len(small), ACROSS)]
    return np.rint(255.0 * np.concatenate(rows)).astype(np.uint8)


def main() -> int:
    parser = record.parser(__doc__, device=True, data=True)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--gaussians", type=int, default=FitOptions().gaussian_count, metavar="N")
    parser.add_argument("--reduction", type=int, default=1, metavar="N", help="how much narrower images are")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="each photograph beside what the others show")
    arguments = parser.parse_args()
    records = [
        replace(one, camera_name=one.camera_name.split("_")[0])
        for one in Capture.read(arguments.data / "photos" / "buddha").records
    ]
    fitting = FitOptions.of_preset(arguments.preset, gaussian_count=arguments.gaussians)
    steps = FitAndTrack(fitting=fitting, device=arguments.device)
    rows, pairs = [], []
    for index in range(len(records)):
        row, pair = left_out(records, index, steps, arguments.reduction)
        rows.append(row)
        print(row, file=sys.stderr, flush=True)
        pairs.append(pair)
        record.write_result(arguments, resolve_device(arguments.device), {"rows": rows})
    if arguments.picture is not None:
        write_png(arguments.picture, sheet(pairs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
