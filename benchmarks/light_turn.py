"""How well are a small turn of the light, and its scale, told? Walker, runner and robot on their true surfaces.

    python benchmarks/light_turn.py [--device cpu] --out JSON

Of each capture, Gaussians on the true surface of its first frame are asked, so that nothing is wrong but what
`beam_warp.materials.light_turn` leaves out; two disjoint halves of them are two subsets. The light is stated turned by
each of `TURNS`. *Scale* is how bright highlights change from view to view over what the stated light predicts, F0 =
0.04, in least squares over points and views: 1 where the roughness is right and normals are exact. Tilts about level
axes are not looked for.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np
import record

from beam_warp.capture.capture import Capture
from beam_warp.device.arrays import resolve_device
from beam_warp.materials import light_fits
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.light import light_evidence, possible_scales
from beam_warp.materials.light_fits import LightEvidence
from beam_warp.materials.light_turn import find_turn
from beam_warp.materials.normals import SurfacePoints
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.study.true_surface import colored_by_views, gaussians_on_mesh
from beam_warp.trace.scene import Scene
from beam_warp.world.environment import EnvironmentMap

CAPTURES = ("walker", "runner", "robot")
TURNS = (0.0, 2.0, -2.0, 4.0, -4.0, 8.0, -8.0)
ROUGHNESSES = (0.3, 0.5, 0.7)
GAUSSIANS = 30_000
ASKED = 2048


def evidence_of(capture: Capture, device: str) -> LightEvidence:
    """Collect what Gaussians on the true surface show."""
    frame = capture.frames[0]
    views = [record.view() for record in capture.select(split="train", frames={frame})]
    mesh = read_truth_mesh(capture, frame)
    bare = gaussians_on_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), GAUSSIANS)
    cloud = colored_by_views(bare, views, device=device)
    seen = view_evidence(cloud, [view.camera for view in views], views, device=device)
    scene = Scene.from_gaussians(cloud, device)
    return light_evidence(scene, SurfacePoints.seen_by(cloud, seen, scene), seen, ASKED)


def some(evidence: LightEvidence, rows: slice) -> LightEvidence:
    """Return some of the points."""
    return LightEvidence(
        positions=evidence.positions[rows],
        normals=evidence.normals[rows],
        openness=evidence.openness[rows],
        colors=evidence.colors[:, rows],
        weights=evidence.weights[:, rows],
        directions=evidence.directions[:, rows],
    )


def turns(evidence: LightEvidence, light: EnvironmentMap) -> list[dict[str, Any]]:
    """Return what is found of every stated turn, in both halves of the points."""
    found = []
    for half in (0, 1):
        asked = some(evidence, slice(half, None, 2))
        for stated in TURNS:
            turn = find_turn(asked, light.rotated(stated))
            said = {"error": turn.degrees + stated, "standard_error": turn.standard_error}
            found.append({"half": half, "stated": stated, **said, "applied": turn.is_certain})
    return found


def highlight_scales(evidence: LightEvidence, light: EnvironmentMap) -> dict[str, dict[str, float]]:
    """Return how bright highlights are over those expected of each roughness, with the jackknife's standard error."""
    shown = light_fits.well_shown(some(evidence, slice(0, None, 2)))
    lights, parts = light_fits.turned_lights(light)[:1], light_fits.parts_of(shown.positions)
    found = {}
    for roughness in ROUGHNESSES:
        met, expected, seen = light_fits.glossy_sums(shown, lights, parts, roughness)
        without = (met.sum() - met) / (expected.sum() - expected)
        found[f"{roughness:g}"] = {
            "scale": float(met.sum() / expected.sum()),
            "standard_error": float(np.sqrt((len(without) - 1) * without.var())),
            "correlation": float(met.sum() / np.sqrt(expected.sum() * seen.sum())),
        }
    return found


def main() -> None:
    """Ask every capture and write what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=os.environ.get("BEAM_DATA", "../shared/data"), help="data folder")
    parser.add_argument("--device", default="cpu")
    record.add_arguments(parser)
    given = parser.parse_args()
    device = resolve_device(given.device)
    rows: dict[str, Any] = {}
    for name in CAPTURES:
        capture = Capture.read(Path(given.data) / "captures" / name)
        assert capture.environment_path is not None
        light, evidence = EnvironmentMap.read(capture.environment_path), evidence_of(capture, str(device))
        rows[name] = {
            "turns": turns(evidence, light),
            "highlights": highlight_scales(evidence, light),
            "possible_scales": possible_scales(evidence, light),
        }
        print(name, rows[name], flush=True)
    record.write_result(given, device, {"captures": rows})


if __name__ == "__main__":
    main()
