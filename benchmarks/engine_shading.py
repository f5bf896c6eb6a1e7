"""Pictures by the shading source of engines against the deferred renderer, in every language and on every probe.

    python benchmarks/engine_shading.py --out result.json [--picture docs/images/engine_probes.webp]

Probes and lights are those of ``tests/engines/probes.py``. The generated texts are run as they are committed: WGSL and
HLSL on Vulkan, GLSL ES 3.00 in a headless browser, on the processor where there is no GPU. Each shades the G-buffer
that our rasteriser drew, so that what differs is arithmetic. A target whose tools are absent is left out, and named.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import record
import warp as wp
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from engines.harness import missing, packed, program, psnr
from engines.probes import SIDE, goldens

from beam_warp.image.panels import lay_out
from beam_warp.image.tone import display_over

TARGETS = ("wgsl", "hlsl", "glsl")
BEHIND = (0.25, 0.25, 0.25)


def main() -> int:
    """Measure every target, and write the result."""
    parser = record.parser(__doc__)
    parser.add_argument("--picture", type=Path, metavar="WEBP", help="the truth of all cases in one picture")
    args = parser.parse_args()
    cases = list(goldens())
    rows: list[dict[str, Any]] = [
        {"name": f"{each.probe}_{each.lighting}", "probe": each.probe, "lighting": each.lighting, "psnr": {}}
        for each in cases
    ]
    absent = {target: why for target in TARGETS if (why := missing(target))}
    for target in TARGETS:
        if target in absent:
            print(f"{target} is left out: {absent[target]}", flush=True)
            continue
        with tempfile.TemporaryDirectory() as folder, program(target, "shadedPixel", Path(folder)) as made:
            for row, case in zip(rows, cases, strict=True):
                row["psnr"][target] = psnr(made(packed(case), SIDE * SIDE), case)
                print(f"{target} {row['name']}: {row['psnr'][target]:.1f} dB", flush=True)
    record.write_result(args, wp.get_device("cpu"), {"side": SIDE, "absent": absent, "rows": rows})
    if args.picture:
        panels = [
            (f"{c.probe}, {c.lighting}", display_over(c.image.rgb, c.image.alpha, background=BEHIND)) for c in cases
        ]
        Image.fromarray(lay_out(panels, columns=6)).save(args.picture, quality=85, method=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())
