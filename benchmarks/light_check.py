"""Is the check of the light right? Five subjects under their own light, turned, mirrored, too dim and too bright ones.

    python benchmarks/light_check.py [--device cpu] --out JSON

Subjects: the captures walker, runner and robot of the data folder (`$BEAM_DATA`, or `--data`) at half their size, the
demo's capture, and its figure again with roughness 1 everywhere. Of each, the Gaussians of one frame are reconstructed
as coarsely as `beam demo` does, and `beam_warp.materials.light` judges the same evidence under every light of the
sweep.

A verdict is a warning. It is right if it is about what is wrong, and if the light that it asks for has at most half of
the error of the stated one: of irradiance over all normals, in the root mean square; of exposure, in stops. A warning
about a light that is right is always wrong. Silence is no verdict; it is counted by what it missed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import record

from beam_warp.capture.capture import Capture
from beam_warp.capture.views import CapturedView
from beam_warp.demo.capture import demo_figure_for, dome_cameras, write_capture
from beam_warp.demo.from_images import FromImagesOptions, demo_steps
from beam_warp.demo.lights import studio
from beam_warp.device.arrays import resolve_device
from beam_warp.jobs.listeners import no_progress
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.light import LightCheck, judge_light, light_evidence
from beam_warp.materials.light_fits import LightEvidence
from beam_warp.materials.normals import SurfacePoints
from beam_warp.trace.scene import Scene
from beam_warp.world.environment import EnvironmentMap

CAPTURES = ("walker", "runner", "robot")
SUBJECTS = (*CAPTURES, "demo", "matt demo")
REDUCTION = 2
ASKED = 1024
TURNS = (30.0, 45.0, 90.0, 135.0, 180.0, -135.0, -90.0, -45.0)
MIRRORED_TURNS = (0.0, 90.0, 180.0, -90.0)
STOPS = (-2.0, -1.0, 1.0, 2.0)
CODES = {
    "right": "",
    "turned": "environment-turned",
    "mirrored": "environment-turned",
    "exposed": "environment-exposure",
}
"""What a right verdict says of each kind of light."""

REMOVED = 0.5
"""Part of the error that the remedy of a right verdict may leave."""


@dataclass(frozen=True, eq=False)
class StatedLight:
    """A light of the sweep: its kind, by how much it is off [degree or stop], and itself."""

    kind: str
    amount: float
    light: EnvironmentMap


def sweep(light: EnvironmentMap) -> Iterator[StatedLight]:
    """Yield the right light and wrong ones."""
    yield StatedLight("right", 0.0, light)
    for degrees in TURNS:
        yield StatedLight("turned", degrees, light.rotated(degrees))
    for degrees in MIRRORED_TURNS:
        yield StatedLight("mirrored", degrees, mirror(light.rotated(degrees)))
    for stops in STOPS:
        yield StatedLight("exposed", stops, light.exposed(stops))


def mirror(light: EnvironmentMap) -> EnvironmentMap:
    """Return a light with its columns in reverse order."""
    return EnvironmentMap(np.ascontiguousarray(light.radiance[:, ::-1]))


def judged(check: LightCheck, stated: StatedLight, right: EnvironmentMap) -> dict[str, Any]:
    """Return what was said about a light, and whether that is right."""
    said = [finding.code for finding in check.findings if finding.severity == "warning"]
    if stated.kind == "exposed":
        left = abs(stated.amount + check.exposure_stops) / abs(stated.amount)
    else:
        undone = mirror(stated.light) if check.is_mirrored else stated.light
        before = irradiance_error(stated.light, right)
        left = irradiance_error(undone.rotated(check.best_rotation_degrees), right) / before if before > 0.0 else 1.0
    is_right = said == [CODES[stated.kind]] and left <= REMOVED
    return {
        "light": stated.kind,
        "off_by": stated.amount,
        "said": said,
        "verdict": ("right" if is_right else "wrong") if said else "silent",
        "certainty": check.certainty,
        "turn": check.best_rotation_degrees,
        "mirrored": check.is_mirrored,
        "stops": check.exposure_stops,
        "error_left": left,
    }


def irradiance_error(one: EnvironmentMap, other: EnvironmentMap) -> float:
    """Return the root mean square difference of irradiance over all normals."""
    cells = EnvironmentMap.constant((1.0, 1.0, 1.0), height=16)
    toward = cells.directions().reshape(-1, 3)
    angles = cells.solid_angles().reshape(-1, 1)
    difference = (one.resized(16, 32).radiance - other.resized(16, 32).radiance).reshape(-1, 3).astype(np.float64)
    irradiance = np.maximum(toward @ toward.T, 0.0) @ (difference * angles)
    return float(np.sqrt((angles * irradiance**2).sum() / angles.sum()))


def photographed(subject: str, data: Path, folder: Path, device: str) -> tuple[list[CapturedView], EnvironmentMap]:
    """Return a subject's training views of its first frame, and the light that it was captured in."""
    if subject in CAPTURES:
        capture = Capture.read(data / "captures" / subject)
    else:
        options = FromImagesOptions()
        mesh = demo_figure_for(options.size).at(0.0)
        if subject == "matt demo":
            mesh = replace(mesh, roughness=np.ones_like(mesh.roughness))
        cameras = dome_cameras([mesh.vertices], options.camera_count, 0, options.size, options.size)
        capture = write_capture(folder / subject, [mesh], cameras, studio(), samples=options.samples, device=device)
    views = [record.view() for record in capture.select(split="train", frames={capture.frames[0]})]
    assert capture.environment_path is not None
    return (
        [view.reduced(REDUCTION) for view in views] if subject in CAPTURES else views,
        EnvironmentMap.read(capture.environment_path),
    )


def evidence_of(views: list[CapturedView], device: str) -> LightEvidence:
    """Reconstruct Gaussians from views, coarsely, and collect what they show."""
    steps = demo_steps(FromImagesOptions(), device=device, seed=0)
    track, _ = steps.begin(views, no_progress)
    seen = view_evidence(track.cloud, [view.camera for view in views], views, options=steps.raster, device=device)
    scene = Scene.from_gaussians(track.cloud, device)
    return light_evidence(scene, SurfacePoints.seen_by(track.cloud, seen, scene), seen, ASKED)


def summary(cases: list[dict[str, Any]]) -> dict[str, Any]:
    """Return how many verdicts were given, how many are right, and which wrong lights were found."""
    given = [case for case in cases if case["verdict"] != "silent"]
    right_lights = [case for case in cases if case["light"] == "right"]
    unturned = [case for case in cases if case["light"] in ("right", "exposed")]
    return {
        "cases": len(cases),
        "verdicts": len(given),
        "right_verdicts": sum(case["verdict"] == "right" for case in given),
        "right_lights": len(right_lights),
        "right_lights_accused": sum(case["verdict"] != "silent" for case in right_lights),
        "largest_certainty_without_a_turn": max(case["certainty"] for case in unturned),
        "found": {
            name: {"lights": len(some), "found": sum(case["verdict"] == "right" for case in some)}
            for name, some in (
                (f"{kind} {amount:+g}", [c for c in cases if (c["light"], c["off_by"]) == (kind, amount)])
                for kind, amounts in (("turned", TURNS), ("mirrored", MIRRORED_TURNS), ("exposed", STOPS))
                for amount in amounts
            )
        },
    }


def main() -> None:
    """Run the sweep and write what came out."""
    parser = record.parser(__doc__, device=True, data=True)
    parser.add_argument("--subjects", nargs="+", choices=SUBJECTS, default=SUBJECTS)
    given = parser.parse_args()
    device = str(resolve_device(given.device))
    cases = []
    for subject in given.subjects:
        with tempfile.TemporaryDirectory() as folder:
            views, light = photographed(subject, Path(given.data), Path(folder), device)
        evidence = evidence_of(views, device)
        for stated in sweep(light):
            case = {"subject": subject, **judged(judge_light(evidence, stated.light), stated, light)}
            cases.append(case)
            print(
                f"{subject:10} {case['light']:9}{case['off_by']:+6g}  {case['verdict']:7}"
                f"certainty {case['certainty']:+.2f}  error left {case['error_left']:.2f}  {', '.join(case['said'])}",
                flush=True,
            )
    record.write_result(given, resolve_device(device), {"summary": summary(cases), "cases": cases})


if __name__ == "__main__":
    main()
