"""Pictures by the shading source of engines against the deferred renderer, in every language and on every probe.

    python benchmarks/engine_shading.py --out result.json [--picture docs/images/engine_probes.webp]

Probes and lights are those of ``tests/engines/probes.py``; environments also with shadows of 16 regions. The generated
texts are run as they are committed: WGSL and HLSL on Vulkan, GLSL ES 3.00 in a headless browser, on the processor where
there is no GPU. Each shades the G-buffer that our rasteriser drew, so that what differs is arithmetic. Then engines
draw all of it themselves: the Unity package's entries on Vulkan, and the web on WebGL2 and WebGPU; those pictures are
compared as they are displayed, over grey. A target whose tools are absent is left out, and named.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import record
import warp as wp
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from engines.harness import missing, psnr, shaded
from engines.probes import ENVIRONMENTS, PROBES, REGIONS, SIDE, Golden, goldens
from engines.unity.device import Device
from engines.unity.pictures import picture
from engines.web.pages import GREY, drawing_pages, drawn

from beam_warp.image import metrics
from beam_warp.image.panels import lay_out
from beam_warp.image.tone import display_over

TARGETS = ("wgsl", "hlsl", "glsl")
BEHIND = (0.25, 0.25, 0.25)


def light_of(case: Golden) -> str:
    """Return what a case's light is called."""
    return f"{case.lighting}, {len(case.regions)} regions" if case.regions else case.lighting


def drawn_by_engines(cases: Sequence[Golden], absent: Mapping[str, str]) -> Iterator[dict[str, float]]:
    """Yield of each case how close engines come that draw all of it themselves [dB]."""
    with ExitStack() as stack:
        stands = None if "glsl" in absent else stack.enter_context(drawing_pages())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        device = None if "hlsl" in absent else Device()
        for case in cases:
            found = {}
            if device is not None:
                lit = picture(device, case)
                found["unity"] = closeness(
                    case, display_over(np.maximum(lit[..., :3], 0.0), np.clip(lit[..., 3], 0.0, 1.0), background=GREY)
                )
            for backend, _, shown in drawn(case, stands, folder) if stands else ():
                found[backend] = closeness(case, shown[..., :3])
            yield found


def closeness(case: Golden, shown: NDArray[np.uint8]) -> float:
    """Return the PSNR of a picture over grey, as it is displayed [dB]."""
    truth = display_over(case.image.rgb, np.minimum(case.image.alpha, 1.0), background=GREY)
    return float(metrics.psnr(truth / 255.0, shown / 255.0))


def main() -> int:
    """Measure every target, and write the result."""
    parser = record.parser(__doc__)
    parser.add_argument("--picture", type=Path, metavar="WEBP", help="the truth of all cases in one picture")
    args = parser.parse_args()
    cases = [*goldens(), *goldens(tuple(PROBES), ENVIRONMENTS, REGIONS)]
    rows: list[dict[str, Any]] = [
        {"name": f"{each.probe}_{light_of(each)}", "probe": each.probe, "lighting": light_of(each), "psnr": {}}
        for each in cases
    ]
    absent = {target: why for target in TARGETS if (why := missing(target))}
    for target in TARGETS:
        if target in absent:
            print(f"{target} is left out: {absent[target]}", flush=True)
            continue
        with tempfile.TemporaryDirectory() as folder:
            for row, case, made in zip(rows, cases, shaded(target, cases, Path(folder)), strict=True):
                row["psnr"][target] = psnr(made, case)
                print(f"{target} {row['name']}: {row['psnr'][target]:.1f} dB", flush=True)
    for row, found in zip(rows, drawn_by_engines(cases, absent), strict=True):
        row["psnr"] |= found
        print(row["name"], {name: f"{value:.1f}" for name, value in found.items()}, flush=True)
    record.write_result(args, wp.get_device("cpu"), {"side": SIDE, "absent": absent, "rows": rows})
    if args.picture:
        panels = [
            (f"{c.probe}, {c.lighting}", display_over(c.image.rgb, c.image.alpha, background=BEHIND))
            for c in cases
            if not c.regions
        ]
        Image.fromarray(lay_out(panels, columns=6)).save(args.picture, quality=85, method=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())
