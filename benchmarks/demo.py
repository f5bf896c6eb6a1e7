"""What `beam demo` scores, from Gaussians and from images, and how long it takes.

    python benchmarks/demo.py --device cuda:0 --folder demo --out result.json

The folder then has the demo's asset and lights, which parity.py reads. The demo is timed once: its kernels compile, or
come from Warp's cache, within.
"""

from __future__ import annotations

import sys
from pathlib import Path

import record

from beam_warp.demo.job import DemoOptions, run_demo
from beam_warp.device.arrays import resolve_device


def main() -> int:
    parser = record.parser(__doc__, device=True)
    parser.add_argument("--folder", type=Path, required=True, help="where the demo writes")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    report = run_demo(arguments.folder, DemoOptions(device=str(device))).report
    kept = ("input", "scores", "from_images", "seconds")
    record.write_result(arguments, device, {name: report[name] for name in kept})
    return 0


if __name__ == "__main__":
    sys.exit(main())
