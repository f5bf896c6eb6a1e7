"""How well are a small turn of the light, its scale, and another place told? Three captures on their true surfaces.

    python benchmarks/light_turn.py [--device cpu] --out JSON

Of each capture, Gaussians on the true surface of its first frame are asked, so that nothing is wrong but what
`beam_warp.materials.light_turn` leaves out; two disjoint halves of them are two subsets. The light is stated turned by
each of `TURNS`. *Scale* is how bright highlights change from view to view over what the stated light predicts, F0 =
0.04, in least squares over points and views: 1 where the roughness is right and normals are exact. Tilts about level
axes are not looked for. *Other places*: lights of other captures, and those that captures are relit with, brought to
the same mean, in turn; what is said of each.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import record

from beam_warp.capture.capture import Capture
from beam_warp.device.arrays import resolve_device
from beam_warp.materials import light_fits
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.light import judge_light, light_evidence, possible_scales
from beam_warp.materials.light_fits import LightEvidence
from beam_warp.materials.light_turn import find_turn
from beam_warp.materials.normals import SurfacePoints
from beam_warp.study.true_surface import surface_of_capture
from beam_warp.trace.scene import Scene
from beam_warp.world.environment import EnvironmentMap

CAPTURES = ("walker", "runner", "robot")
TURNS = (0.0, 2.0, -2.0, 4.0, -4.0, 8.0, -8.0)
ROUGHNESSES = (0.3, 0.5, 0.7)
GAUSSIANS = 30_000
ASKED = 4096
SAME_LIGHT = 0.1
"""Mean difference of two lights of mean 1 below which they are the same."""


def evidence_of(capture: Capture, device: str) -> LightEvidence:
    """Collect what Gaussians on the true surface show."""
    frame = capture.frames[0]
    cloud, views = surface_of_capture(capture, frame, GAUSSIANS, device=device)
    seen = view_evidence(cloud, [view.camera for view in views], views, device=device)
    scene = Scene.from_gaussians(cloud, device)
    return light_evidence(scene, SurfacePoints.seen_by(cloud, seen, scene), seen, ASKED)


def turns(evidence: LightEvidence, light: EnvironmentMap) -> list[dict[str, Any]]:
    """Return what is found of every stated turn, in both halves of the points."""
    found = []
    for half in (0, 1):
        asked = evidence.some(slice(half, None, 2))
        for stated in TURNS:
            turn = find_turn(asked, light.rotated(stated))
            said = {"error": turn.degrees + stated, "standard_error": turn.standard_error}
            found.append({"half": half, "stated": stated, **said, "applied": turn.is_certain})
    return found


def places(data: Path) -> dict[str, EnvironmentMap]:
    """Return all different lights of captures, the ones that they are relit with included, of one mean radiance."""
    found: dict[str, EnvironmentMap] = {}
    for path in sorted(data.glob("captures/*/environment.exr")) + sorted(data.glob("captures/*/truth/*.exr")):
        if path.stem.startswith("test_"):
            continue
        light = EnvironmentMap.read(path).resized(64, 128)
        light = light.scaled(1.0 / float(light.mean_radiance().mean()))
        if not any(is_same(light, other) for other in found.values()):
            found[f"{path.parent.name} {path.stem}".removeprefix("truth ").removesuffix(" environment")] = light
    return found


def is_same(light: EnvironmentMap, other: EnvironmentMap) -> bool:
    """Return whether two lights of one mean are the same up to how they were sampled."""
    return bool(np.abs(light.resized(16, 32).radiance - other.resized(16, 32).radiance).mean() < SAME_LIGHT)


def of_other_places(
    evidence: LightEvidence, light: EnvironmentMap, others: dict[str, EnvironmentMap]
) -> dict[str, dict[str, Any]]:
    """Return what is said of every light, brought to the mean of the right one."""
    mean = float(light.mean_radiance().mean())
    found = {}
    for name, other in others.items():
        check = judge_light(evidence, other.scaled(mean))
        said = [finding.code for finding in check.findings if finding.severity == "warning"]
        found[name] = {"is_right": is_same(other, light.resized(64, 128).scaled(1.0 / mean)), "said": said}
    return found


def highlight_scales(evidence: LightEvidence, light: EnvironmentMap) -> dict[str, dict[str, float]]:
    """Return how bright highlights are over those expected of each roughness, with the jackknife's standard error."""
    shown = light_fits.well_shown(evidence.some(slice(0, None, 2)))
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
    parser = record.parser(__doc__, device=True, data=True)
    given = parser.parse_args()
    device = resolve_device(given.device)
    rows: dict[str, Any] = {}
    others = places(Path(given.data))
    for name in CAPTURES:
        capture = Capture.read(Path(given.data) / "captures" / name)
        assert capture.environment_path is not None
        light, evidence = EnvironmentMap.read(capture.environment_path), evidence_of(capture, str(device))
        rows[name] = {
            "turns": turns(evidence, light),
            "highlights": highlight_scales(evidence, light),
            "possible_scales": possible_scales(evidence, light),
            "places": of_other_places(evidence.some(slice(0, None, 2)), light, others),
        }
        print(name, rows[name], flush=True)
    record.write_result(given, device, {"captures": rows})


if __name__ == "__main__":
    main()
