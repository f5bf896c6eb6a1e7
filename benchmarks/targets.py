"""Whether targets are met: runs of the commands on small scenes, each with a target of its own.

    python benchmarks/targets.py [--device cuda:0] [--runs 40] [--seed 0] [--commands reduce] --out result.json

Targets are drawn at random around what small scenes take. One that is refused is asked for again as the refusal offers.
The result is written after every run.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import record
from delivery_take import take

from beam_warp import GaussianSequence, write
from beam_warp.cli.main import main as beam
from beam_warp.demo.capture import write_demo_capture
from beam_warp.demo.figure import build_figure
from beam_warp.demo.lights import studio
from beam_warp.device.arrays import resolve_device
from beam_warp.image.color import LINEAR_REC709
from beam_warp.image.files import write_exr
from beam_warp.world.harmonics import SH_C0

GAUSSIANS = 1_500
OFFERED = re.compile(r"the nearest is ([\d.e+-]+)")

CASES: tuple[tuple[str, str, float], ...] = (
    ("run", "error", 0.12),
    ("render", "error", 0.08),
    ("render", "fps", 2.0),
    ("render", "seconds", 30.0),
    ("decompose", "error", 0.12),
    ("render --mode path", "error", 0.02),
    ("run", "seconds", 40.0),
    ("reconstruct", "error", 0.06),
    ("render --mode path", "seconds", 20.0),
    ("reconstruct", "seconds", 100.0),
    ("run capture", "error", 0.15),
    ("run capture", "seconds", 150.0),
    ("reduce", "error", 0.05),
    ("reduce", "fps", 60.0),
    ("reduce", "seconds", 100.0),
)
"""Commands, what is asked of them, and about which value; *run capture* goes all the way from photographs."""


def scenes(folder: Path, device: str) -> dict[str, list[str]]:
    """Write what the commands work on, and return the words of each command."""
    light = studio().resized(32, 64).radiance
    write_exr(folder / "light.exr", {name: light[..., index] for index, name in enumerate("RGB")})
    ((_, cloud),) = take(build_figure(), GAUSSIANS, 1)
    assert cloud.base_color is not None
    write(GaussianSequence.from_clouds([cloud]), folder / "asset.usda")
    colored = cloud.with_arrays(
        radiance=((0.5 * cloud.base_color - 0.5) / SH_C0)[:, None].astype(np.float32),
        radiance_color_space=LINEAR_REC709,
        **dict.fromkeys(("base_color", "roughness", "ambient_occlusion", "normals")),
    )
    write(GaussianSequence.from_clouds([colored]), folder / "bare.usda")
    write_demo_capture(folder / "capture", frame_count=1, camera_count=6, size=48, device=device)
    lit = ["--environment", str(folder / "light.exr")]
    keep = [word for name in ("cameras", "masks", "exposures") for word in (f"--{name}", "keep")]
    modelled = [str(folder / "capture"), "--gaussians", "400", *keep]
    return {
        "run capture": modelled,
        "run": [str(folder / "bare.usda"), *lit],
        "decompose": [str(folder / "bare.usda"), *lit],
        "render": [str(folder / "asset.usda"), *lit, "--width", "64"],
        "reconstruct": modelled,
        "reduce": [str(folder / "asset.usda"), "--height", "48", "--views", "24"],
    }


def asked(words: list[str]) -> tuple[dict[str, Any] | None, str]:
    """Run a command; return what it says of its target, or None and the line of its refusal."""
    said, refusal = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(refusal):
        code = beam([*words, "--json"])
    return (json.loads(said.getvalue())["target"] if code == 0 else None), refusal.getvalue().strip()


def measured(case: tuple[str, str, float], factor: float, words: list[str], out: Path, device: str) -> dict[str, Any]:
    """Run one case at a factor of its usual value."""
    command, name, usual = case
    first, *mode = command.removesuffix(" capture").split()
    place = out / {"render": "image.png", "reduce": "asset.usda"}.get(first, "")
    line = [first, *words, *mode, "--out", str(place), "--device", device]
    line += ["--gaussians", "300"] if (first, name) == ("reduce", "seconds") else []
    value, refused, started = float(f"{factor * usual:.3g}"), False, time.perf_counter()
    said, refusal = asked([*line, f"--target-{name}", str(value)])
    offered = OFFERED.search(refusal)
    if said is None and offered is not None:
        value, refused = float(offered[1]), True
        said, refusal = asked([*line, f"--target-{name}", str(value)])
    row = {"command": command, "target": name, "asked": value, "refused_first": refused}
    row |= {"wall": time.perf_counter() - started}
    if said is None:
        return {**row, "met": False, "reached": None, "chosen": None, "said": refusal}
    return {**row, "met": said["met"], "reached": said["reached"][name], "chosen": said["chosen"], "said": said}


def main() -> int:
    parser = record.parser(__doc__, device=True)
    parser.add_argument("--runs", type=int, default=40, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="+", metavar="NAME", help="only these; all of them without")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    keep = functools.partial(record.write_result, arguments, device)
    factors = 2.0 ** np.random.default_rng(arguments.seed).uniform(-0.5, 0.5, arguments.runs)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="beam_targets_") as folder:
        words = scenes(Path(folder), str(device))
        cases = [case for case in CASES if arguments.commands is None or case[0] in arguments.commands]
        for number, factor in enumerate(factors):
            case = cases[number % len(cases)]
            out = Path(folder) / f"out_{number}"
            out.mkdir()
            of_case = words.get(case[0]) or words[case[0].split()[0]]
            rows.append(measured(case, float(factor), of_case, out, str(device)))
            print(json.dumps({**rows[-1], "said": None}), file=sys.stderr, flush=True)
            keep({"rows": rows, "runs": len(rows), "met": sum(row["met"] for row in rows)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
