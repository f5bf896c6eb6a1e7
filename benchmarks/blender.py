"""How near Cycles comes to our path tracer, with the add-on of `engines/blender`.

    BEAM_BPY=PYTHON python benchmarks/blender.py --out JSON [--quick] [--probes NAME ...] [--pictures DIR]

``$BEAM_BPY`` names a Python with ``bpy``. Each probe is written as a container, which both renderers read; camera,
environment and its rotation, bounces and the pixel's filter are the same. Both are noisy.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import record
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / place) for place in ("tests", "tests/engines", "engines/blender")]

import probes  # noqa: E402
from delivery_take import take  # noqa: E402
from zip_addon import build  # noqa: E402

from beam_warp import converters  # noqa: E402
from beam_warp.demo.figure import build_figure  # noqa: E402
from beam_warp.device.arrays import resolve_device  # noqa: E402
from beam_warp.image.color import linear_to_srgb  # noqa: E402
from beam_warp.image.files import read_image, write_exr  # noqa: E402
from beam_warp.image.metrics import bounding_box, psnr  # noqa: E402
from beam_warp.image.panels import lay_out  # noqa: E402
from beam_warp.render.path import PathOptions, PathRenderer  # noqa: E402
from beam_warp.world.axes import change_axes  # noqa: E402
from beam_warp.world.camera import Camera  # noqa: E402
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence  # noqa: E402
from beam_warp.world.shot import Shot  # noqa: E402

LIGHTS = ("studio", "sunset")
BOUNCES = 4
FIGURE_GAUSSIANS = 30_000


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much is measured: side of a square picture [pixel], samples of a pixel, Gaussians of the figure."""

    side: int = 64
    samples: int = 256
    cycles_samples: int = 128
    figure: int = FIGURE_GAUSSIANS


FULL, QUICK = Effort(), Effort(side=24, samples=16, cycles_samples=8, figure=2_000)


@dataclass(frozen=True, eq=False)
class Case:
    """A probe under a light: its file, and the shot of what that file holds."""

    probe: str
    light: str
    asset: Path
    shot: Shot

    def job(self, folder: Path, effort: Effort) -> dict[str, Any]:
        """Return what Blender is told."""
        camera, environment = self.shot.camera, folder / f"{self.light}.exr"
        assert self.shot.environment is not None
        channels = {name: self.shot.environment.radiance[..., k] for k, name in enumerate("RGB")}
        write_exr(environment, channels)
        pose = {"camera_to_world": camera.camera_to_world.tolist(), "focal": camera.focal_x}
        return {
            "asset": str(self.asset),
            "environment": str(environment),
            "rotation": self.shot.environment_rotation,
            "camera": pose | {"width": camera.width, "height": camera.height},
            "samples": effort.cycles_samples,
            "bounces": BOUNCES,
            "out": str(self.out(folder)),
        }

    def out(self, folder: Path) -> Path:
        """Return where Blender leaves its picture."""
        return folder / f"{self.probe}_{self.light}.exr"


def cloud_of(probe: str, effort: Effort) -> GaussianCloud:
    """Return the Gaussians of a probe; the figure is that of the delivery benchmark, with its noise."""
    return next(take(build_figure(), effort.figure, 1))[1] if probe == "figure" else probes.PROBES[probe]()


def cases(names: list[str], effort: Effort, folder: Path) -> Iterator[Case]:
    """Yield every probe under every light."""
    for name in names:
        asset = folder / f"{name}.b4d"
        converters.write(GaussianSequence.from_clouds([cloud_of(name, effort)]), asset)
        cloud = change_axes(converters.read(asset)[0], "rfu")
        points = cloud.positions.astype(np.float64)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        target = middle if probes.TARGETS[name] is None else probes.TARGETS[name]
        size = {"width": effort.side, "height": effort.side, "vertical_fov": probes.FIELDS[name]}
        camera = Camera.look_at(probes.EYES[name], target, **size)
        for light in LIGHTS:
            environment = probes.environment(light)
            shot = Shot(cloud=cloud, camera=camera, environment=environment, environment_rotation=probes.ROTATION)
            yield Case(name, light, asset, shot)


def in_blender(python: str, todo: list[Case], folder: Path, effort: Effort) -> str:
    """Draw all cases in one session of Blender, whose version is returned."""
    build(folder / "addon.zip")
    job = {"addon": str(folder / "addon.zip"), "cases": [case.job(folder, effort) for case in todo]}
    (folder / "job.json").write_text(json.dumps(job))
    homes = {"HOME": str(folder), "BLENDER_USER_RESOURCES": str(folder / "resources")}
    command = [python, str(Path(__file__).with_name("blender_cycles.py")), str(folder / "job.json")]
    done = subprocess.run(command, env=os.environ | homes, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stdout[-2000:] + done.stderr[-2000:])
    return json.loads(done.stdout.strip().splitlines()[-1])["blender"]


def compared(case: Case, effort: Effort, folder: Path) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Path trace a case and compare Cycles' picture with it."""
    options = PathOptions(samples=effort.samples, bounces=BOUNCES)
    ours = PathRenderer(options, device="cpu").draw(case.shot)
    theirs = read_image(case.out(folder)).linear_rgba()
    rgb, alpha = theirs[..., :3], theirs[..., 3]
    pair = [linear_to_srgb(np.clip(each, 0.0, 1.0)) for each in (ours.rgb, rgb)]
    box, solid = bounding_box(ours.alpha), ours.alpha > 0.9
    row = {
        "name": f"{case.probe}_{case.light}",
        "probe": case.probe,
        "light": case.light,
        "gaussians": len(case.shot.cloud),
        "psnr": psnr(pair[1][box], pair[0][box]),
        "alpha_psnr": psnr(alpha[box], ours.alpha[box]),
        "brightness": float(rgb[solid].mean() / ours.rgb[solid].mean()),
    }
    return row, pair


def picture(path: Path, shown: list[tuple[str, list[np.ndarray]]]) -> None:
    """Write pairs side by side, ours and then Cycles', each pixel as four."""
    panels = [
        (f"{who}, {light}", np.rint(255.0 * pixels.repeat(2, axis=0).repeat(2, axis=1)).astype(np.uint8))
        for light, pair in shown
        for who, pixels in zip(("beam-warp", "Cycles"), pair, strict=True)
    ]
    Image.fromarray(lay_out(panels, len(panels))).save(path, quality=88)


def main() -> int:
    parser = record.parser(__doc__, quick="small pictures of few samples")
    parser.add_argument("--probes", nargs="+", choices=list(probes.PROBES), default=list(probes.PROBES))
    parser.add_argument("--picture", type=Path, metavar="JPG", help="the last probe, ours beside Cycles'")
    parser.add_argument("--side", type=int, metavar="PX", help=f"side of pictures, {FULL.side} by default")
    arguments = parser.parse_args()
    python = os.environ.get("BEAM_BPY", "").split(os.pathsep)[0]
    if not python:
        parser.error("BEAM_BPY must name a Python with bpy, got nothing. Install bpy into an environment of its own.")
    effort = QUICK if arguments.quick else FULL
    effort = replace(effort, side=arguments.side or effort.side)
    with tempfile.TemporaryDirectory(prefix="beam_blender_") as name:
        folder = Path(name)
        todo = list(cases(arguments.probes, effort, folder))
        version = in_blender(python, todo, folder, effort)
        rows, shown = [], []
        for case in todo:
            row, pair = compared(case, effort, folder)
            print(row, flush=True)
            rows.append(row)
            shown.append((case.light, pair))
        if arguments.picture:
            picture(arguments.picture, shown[-len(LIGHTS) :])
    record.write_result(arguments, resolve_device("cpu"), {"blender": version, "effort": vars(effort), "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
