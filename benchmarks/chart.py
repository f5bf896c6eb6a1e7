"""What `beam chart tracing` measures on its built-in scene: the picture of docs/charts.md is drawn from it.

python benchmarks/chart.py --device cpu --out benchmarks/results/chart_tracing_cpu.json
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import record

from beam_warp.demo.lights import sunset
from beam_warp.device.arrays import resolve_device
from beam_warp.study.table import run_study, table_paths
from beam_warp.study.tracing import tracing_study
from beam_warp.world.shapes import still_life


def main() -> int:
    parser = record.parser(__doc__, device=True)
    parser.add_argument("--budget-seconds", type=float, default=30.0, help="of measuring, after the references")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    names = {"name": "the built-in still life", "environment_name": "the built-in low sun"}
    with tempfile.TemporaryDirectory() as folder:
        study = tracing_study(still_life(), sunset(), **names, device=str(device))
        _, skipped = run_study(study, Path(folder), budget_seconds=arguments.budget_seconds)
        table, _ = table_paths(Path(folder), study.subject)
        result = {"skipped": len(skipped), "table": table.read_text(encoding="utf-8").splitlines()}
    record.write_result(arguments, device, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
