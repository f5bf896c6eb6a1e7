"""What do rays bring where they are needed, instead of as many for every Gaussian: error, bias, time and scores?

    python benchmarks/economy.py [--device cuda:0] [--parts light occlusion bounce pilot] --out JSON
    python benchmarks/economy.py --parts views --made DIR --out JSON

Materials of Gaussians on the true surface of three captures and of the demo's are measured with every Gaussian's light
by as many rays, and by as many as its neighbours' first rays say that it needs. Errors are of the arriving light at
each Gaussian, relative to it or to a twentieth of its mean, against many rays by another density. *Equal* is how many
rays for each have the same error, between those that were measured. *Stopped* is what not to do: each Gaussian stops
once its own rays agree; and *occlusion* is what the same rule would bring there. Both are looked up in the runs with as
many rays for each, whose sets begin alike. Seconds are of measuring all materials of the frame, in turn. *Bounce* is
the error of the bounced light over all light: without it, by as many rays for each, and by as many as it needs.
*Pilot* is what a pilot of roughness costs the first capture, and saves a white ball under even light, which says
nothing of it. *Views* is
base colour of a reconstruction, DIR/NAME/reconstruction as `beam run` leaves it, by all training views and by some; its
change is relative to the error that it states with all. Seconds of both are those of the processor.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import record
from constants_places import changed
from materials_truth import Materials, PerfectFrame, TruthViews, light_reference
from numpy.typing import NDArray
from timing import Task, spread, take_turns

from beam_warp.capture.capture import Capture
from beam_warp.converters import read
from beam_warp.decomposition import roughness_finder
from beam_warp.demo.capture import write_demo_capture
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.image.color import LINEAR_REC709
from beam_warp.image.metrics import root_mean_square
from beam_warp.jobs.progress import JobLog
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.base_color import fill_from_neighbors, solve_base_color
from beam_warp.materials.direct import MaterialMeasurement, measure_materials
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.light_rays import (
    BOUNCE_PART,
    LitPoints,
    MaterialOptions,
    light_batches,
    lit_points,
    mean_radiance,
)
from beam_warp.materials.normals import SurfaceNormals, SurfacePoints
from beam_warp.materials.pilot import rays_needed
from beam_warp.reconstruction.scores import read_truth_mesh, truth_frames
from beam_warp.study.true_surface import SHARP, colored_by_views, gaussians_on_mesh
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.rays import ray_batches
from beam_warp.trace.scene import Scene
from beam_warp.world.axes import change_axes
from beam_warp.world.directions import even_directions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.shapes import TiledSurface, tile

CAPTURES = ("walker", "runner", "robot", "demo")
FIXED = (16, 32, 64, 128, 256)
TARGETS = (0.025, 0.05, 0.1, 0.2)
OCCLUSION_TARGETS = (0.01, 0.02, 0.04)
REPEATS = 5
VIEW_SHARES, VIEW_RAYS = (1.0, 0.75, 0.5), 16

PILOTED = 40_000
"""Gaussians of subjects that have a pilot."""

Errors = Mapping[int, NDArray[np.floating[Any]]]
"""Errors of Gaussians by rays for each."""


class Subject:
    """A frame on its true surface, and what its light is."""

    def __init__(self, capture: Capture, count: int, rays: int, device: Any) -> None:
        """Sample the surface and trace the reference."""
        assert capture.environment_path is not None
        frame = truth_frames(capture)[0]
        self.frame = PerfectFrame.of(capture, frame, count, device)
        self.points = self.frame.points(exact=False)
        self.light = PreparedEnvironment(EnvironmentMap.read(capture.environment_path), device)
        self.roughness = np.full(count, 0.5, np.float32)
        self.truth = TruthViews(capture, frame, SHARP, 2, str(device))
        lit = self.measured(MaterialOptions(light_error=0.0)).evidence.unseen == 0.0
        self.rows = np.flatnonzero(lit)
        found = light_reference(self.frame.scene, self.points, self.rows, self.light, rays)
        self.reference = found.value
        self.scale = np.maximum(found.value, 0.05 * found.value.mean())

    def measured(self, options: MaterialOptions) -> MaterialMeasurement:
        """Measure all materials of the frame."""
        frame = self.frame
        return measure_materials(
            frame.cloud, frame.scene, self.points, self.roughness, self.light, options=options, views=frame.evidence
        )

    def errors(self, found: MaterialMeasurement) -> NDArray[np.float64]:
        """Return relative errors of the arriving light, ``(M, 3)``."""
        return (found.evidence.irradiance[self.rows] / np.pi - self.reference) / self.scale

    def scores(self, found: MaterialMeasurement) -> dict[str, float]:
        """Return PSNR of occlusion and base colour in the test views."""
        cloud, points = self.frame.cloud, self.points
        known = cloud.with_arrays(normal_confidence=points.confidence)
        color = solve_base_color(known, found.evidence, self.light.mean_irradiance).base_color
        openness, _ = fill_from_neighbors(
            cloud.positions, found.ambient_occlusion[:, None], found.ambient_occlusion_error[:, None], ~points.seen
        )
        row = self.truth.score(cloud, Materials(color, openness[:, 0].astype(np.float32)))
        return {name: row[name]["psnr"] for name in ("ambient_occlusion", "base_color")}

    def curve(self) -> NDArray[np.int32]:
        """Return the lit rows' order along the curve by which neighbours are found."""
        at = upload(self.rows.astype(np.int32), int, self.frame.scene.device)
        positions, normals = self.points.positions[at].contiguous(), self.points.normals[at].contiguous()
        return np.concatenate([b.rows.numpy() for b in ray_batches(self.frame.scene, positions, normals, 0.0, 1)])


def summary(errors: NDArray[np.floating[Any]]) -> dict[str, float]:
    """Return what errors of independent points come to."""
    each = errors.reshape(len(errors), -1).mean(axis=1, dtype=np.float64)
    return {
        "rmse": root_mean_square(errors),
        "largest_hundredth": float(np.percentile(np.abs(errors), 99)),
        "mean": float(each.mean()),
        "mean_in_standard_errors": float(each.mean() / (each.std(ddof=1) / np.sqrt(len(each)))),
    }


def equal_rays(error: float, errors: Errors) -> float:
    """Return how many rays for each have an error, between those that were measured, on logarithmic axes."""
    counts, fixed = np.log(list(errors)), np.log([root_mean_square(found) for found in errors.values()])
    return float(np.exp(np.interp(np.log(error), fixed[::-1], counts[::-1])))


def light_of(subject: Subject, device: Any, repeats: int) -> dict[str, Any]:
    """Return errors of the light by rays for each and by target; scores and seconds at the default's occlusion."""
    default = MaterialOptions().sample_count
    fixed = {count: subject.measured(MaterialOptions(sample_count=count, light_error=0.0)) for count in FIXED}
    errors = {count: subject.errors(found) for count, found in fixed.items()}
    stated = {count: np.sqrt(found.evidence.noise[subject.rows]) for count, found in fixed.items()}
    rows = [{"name": f"{count} rays each", "rays": count} | summary(errors[count]) for count in FIXED]
    ways = {target: MaterialOptions(light_error=target) for target in (0.0, *TARGETS)}
    times = take_turns({k: Task(lambda o=o: subject.measured(o)) for k, o in ways.items()}, repeats, device)
    rows[FIXED.index(default)] |= {"seconds": spread(times[0.0].alone), "scores": subject.scores(fixed[default])}
    for target in TARGETS:
        found = subject.measured(ways[target])
        row = {"name": f"target {target:g}", "rays": found.economy["light"]["rays"] / found.economy["light"]["points"]}
        row |= summary(subject.errors(found))
        row["equal_rays"] = equal_rays(row["rmse"], errors)
        row |= {"seconds": spread(times[target].alone), "scores": subject.scores(found)}
        row["faster"] = times[target].faster_than(times[0.0])
        rows.append(row)
    return {"rows": rows, "stopped": [stopped(errors, stated, target) for target in TARGETS]}


def chosen(errors: Errors, counts: NDArray[np.integer[Any]]) -> NDArray[np.floating[Any]]:
    """Return the errors of each Gaussian at its own number of rays."""
    result = errors[FIXED[0]].copy()
    for count in FIXED:
        result[counts == count] = errors[count][counts == count]
    return result


def stopped(errors: Errors, stated: Errors, target: float) -> dict[str, Any]:
    """Return what comes of stopping where a Gaussian's own rays agree."""
    counts = np.full(len(stated[FIXED[0]]), FIXED[-1])
    for count in reversed(FIXED[:-1]):
        counts[stated[count] <= target] = count
    return {"name": f"target {target:g}", "rays": float(counts.mean())} | summary(chosen(errors, counts))


def occlusion_of(subject: Subject, rays: int) -> list[dict[str, Any]]:
    """Return what the rule would bring for occlusion."""
    frame, rows, points = subject.frame, subject.rows, subject.points
    normals = points.normals.numpy()[rows]
    lifted = (points.positions.numpy()[rows] + normals * points.offsets.numpy()[rows, None]).astype(np.float32)

    def traced(count: int, seed: int = 0) -> Any:
        how: dict[str, Any] = {"offset": 0.0, "options": points.tracing, "seed": seed}
        return ambient_occlusion(frame.scene, lifted, normals, sample_count=count, **how)

    truth = traced(rays, 1 << 31).visibility.astype(np.float64)
    found = {count: traced(count) for count in FIXED}
    errors = {count: found[count].visibility - truth for count in FIXED}
    result = [{"name": f"{count} rays each", "rays": count} | summary(errors[count]) for count in FIXED]
    order, counts = subject.curve(), np.empty(len(rows), np.int64)
    for target in OCCLUSION_TARGETS:
        counts[order] = rays_needed(found[FIXED[0]].standard_error[order], FIXED[0], FIXED[-1], count=64, target=target)
        row = {"name": f"target {target:g}", "rays": float(counts.mean())} | summary(chosen(errors, counts))
        result.append(row | {"equal_rays": equal_rays(row["rmse"], errors)})
    return result


def bounce_of(subject: Subject, rays: int, device: Any, repeats: int) -> list[dict[str, Any]]:
    """Return the errors of the bounce over all light, without it, by rays for each and by need, and what they cost."""
    frame, light, scene, points = subject.frame, subject.light, subject.frame.scene, subject.points
    sent = mean_radiance(frame.cloud, frame.evidence)

    def traced(options: MaterialOptions) -> LitPoints:
        found = lit_points(frame.cloud, points, subject.roughness, light, subject.rows, frame.evidence)
        for _ in light_batches(scene, points, light, found, options, sent, 0, lambda *_: None):
            pass
        return found

    default = MaterialOptions()
    exact = traced(replace(default, light_error=0.0, sample_count=BOUNCE_PART * rays, seed=1 << 31))
    truth, arriving = exact.light.bounce.numpy().astype(np.float64), exact.light.arriving.numpy()
    ways = {
        "none": replace(default, bounce=False),
        "as many rays each": replace(default, light_error=0.0),
        "as many as needed": default,
    }
    times = take_turns({k: Task(lambda o=o: subject.measured(o)) for k, o in ways.items()}, repeats, device)
    rows = []
    for name, options in ways.items():
        found = traced(options)
        bounce = found.light.bounce.numpy() if options.bounce else np.zeros_like(truth)
        row = {"name": name, "rays": float(found.bounce_rays.mean()) if options.bounce else 0.0}
        row |= summary((bounce - truth) / np.maximum(arriving + truth, 0.05 * (arriving + truth).mean()))
        rows.append(row | {"seconds": spread(times[name].alone), "scores": subject.scores(subject.measured(options))})
    return rows


def pilot_of(capture: Capture, device: Any) -> dict[str, list[dict[str, Any]]]:
    """Return what a pilot costs where views say something, and saves where they say nothing: on a white ball."""
    assert capture.environment_path is not None
    light = PreparedEnvironment(EnvironmentMap.read(capture.environment_path), device)
    even = PreparedEnvironment(EnvironmentMap.constant((1.0, 1.0, 1.0)), device)
    frame = truth_frames(capture)[0]
    subjects = {
        "walker": (seen_frame(capture, frame, PILOTED, device), light),
        "white ball": (white_ball(PILOTED, device), even),
    }
    found: dict[str, list[dict[str, Any]]] = {}
    for name, (seen, shining) in subjects.items():
        for words, saved in (("without a pilot", 10**9), ("with a pilot", roughness_finder.LEAST_SAVED)):
            with changed("beam_warp.decomposition.roughness_finder:LEAST_SAVED", saved):
                found.setdefault(name, []).append(roughness_row(words, seen, shining))
    return found


def white_ball(count: int, device: Any) -> SimpleNamespace:
    """Return a ball that is as bright as an even light: it looks alike from everywhere, whatever its roughness."""
    places = even_directions(count)
    shown = np.full((count, 1, 3), 0.5 / SH_C0, np.float32)
    ball = tile((TiledSurface(places, places, float(np.sqrt(4.0 * np.pi / count))),))
    cloud = ball.with_arrays(radiance=shown, radiance_color_space=LINEAR_REC709)
    scene, sure = Scene.from_gaussians(cloud, str(device)), np.ones(count, np.float32)
    surface = SurfaceNormals(places.astype(np.float32), sure, sure < 0.0)
    points = SurfacePoints.at_centers(cloud, scene, surface, "auto")
    log = JobLog(lambda *_: None, 1, device)
    return SimpleNamespace(number=0, cloud=cloud, scene=scene, points=points, views=None, log=log)


def seen_frame(capture: Capture, number: int, count: int, device: Any) -> SimpleNamespace:
    """Return a frame as the main job sees it, of Gaussians on the true surface."""
    mesh = read_truth_mesh(capture, number)
    views = [record.view() for record in capture.select(split="train", frames={number})]
    bare = gaussians_on_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), count)
    cloud, cameras = colored_by_views(bare, views, options=SHARP, device=str(device)), [v.camera for v in views]
    scene, evidence = (
        Scene.from_gaussians(cloud, str(device)),
        view_evidence(cloud, cameras, views, options=SHARP, device=str(device)),
    )
    points = SurfacePoints.seen_by(cloud, evidence, scene, "auto")
    log = JobLog(lambda *_: None, 1, device)
    return SimpleNamespace(number=number, cloud=cloud, scene=scene, points=points, views=evidence, log=log)


def roughness_row(name: str, seen: SimpleNamespace, light: PreparedEnvironment) -> dict[str, Any]:
    """Return what an estimate from a frame says of itself, and the seconds of the processor that it took."""
    plan = SimpleNamespace(
        light=SimpleNamespace(prepared=light),
        source=SimpleNamespace(options=SimpleNamespace(gathering=MaterialOptions())),
    )
    started = time.process_time()
    profiles = roughness_finder.profiles_of(plan, [seen], 1)  # type: ignore[arg-type, list-item]
    found = roughness_finder.find_roughness(seen.cloud.positions, profiles)
    row = {"name": name, "seconds": time.process_time() - started, "stated": root_mean_square(found.standard_error)}
    return row | {"frames": found.report["frames"], "of": 1, "informed_part": found.report["informed_part"]}


def views_of(capture: Capture, made: Path, device: Any) -> list[dict[str, Any]]:
    """Return base colour and occlusion of a reconstruction by all training views of its first frame, and by some."""
    frame, cloud = truth_frames(capture)[0], change_axes(read(made / "reconstruction" / "gaussians.usda")[0], "rfu")
    views = [record.view() for record in capture.select(split="train", frames={frame})]
    assert capture.environment_path is not None
    light = PreparedEnvironment(EnvironmentMap.read(capture.environment_path), device)
    scene, truth = Scene.from_gaussians(cloud, str(device)), TruthViews(capture, frame, SHARP, 2, str(device))
    rough, options = np.full(len(cloud), 0.5, np.float32), MaterialOptions(sample_count=VIEW_RAYS)
    rows: list[dict[str, Any]] = []
    first = None
    for share in VIEW_SHARES:
        kept = [view for place, view in enumerate(views) if int((place + 1) * share) > int(place * share)]
        started = time.process_time()
        shown = view_evidence(cloud, [view.camera for view in kept], kept, options=SHARP, device=str(device))
        row: dict[str, Any] = {"name": f"{len(kept)} views", "evidence_seconds": time.process_time() - started}
        points = SurfacePoints.seen_by(cloud, shown, scene, "auto")
        found = measure_materials(cloud, scene, points, rough, light, options=options, views=shown)
        row["seconds"] = time.process_time() - started
        known = cloud.with_arrays(normal_confidence=points.confidence)
        color = solve_base_color(known, found.evidence, light.mean_irradiance)
        openness = found.ambient_occlusion[:, None], found.ambient_occlusion_error[:, None]
        filled, _ = fill_from_neighbors(cloud.positions, *openness, ~points.seen)
        score = truth.score(cloud, Materials(color.base_color, filled[:, 0].astype(np.float32)))
        row |= {key: score[key]["psnr"] for key in ("base_color", "ambient_occlusion")}
        first = first or color
        change = np.abs(color.base_color - first.base_color) / np.maximum(first.standard_error, 1e-6)
        rows.append(row | {"change_median": float(np.median(change)), "beyond_error": float((change > 1.0).mean())})
    return rows


PARTS = ("light", "occlusion", "bounce", "pilot")


def main() -> None:
    """Measure every subject and write what came out."""
    parser = record.parser(__doc__, device=True, data=True)
    parser.add_argument("--captures", nargs="+", default=CAPTURES, choices=CAPTURES)
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--reference-rays", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=(*PARTS, "views"))
    parser.add_argument("--made", type=Path, metavar="DIR", help="where reconstructions of the captures are")
    given = parser.parse_args()
    device = resolve_device(given.device)
    rows: dict[str, Any] = {}
    pilot: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in given.captures:
            if name == "demo":
                capture = write_demo_capture(Path(folder) / "demo", frame_count=1, samples=64, device=str(device))
            else:
                capture = Capture.read(Path(given.data) / "captures" / name)
            rows[name] = {}
            if "pilot" in given.parts:
                pilot = pilot or pilot_of(capture, device)
            if "views" in given.parts:
                rows[name]["views"] = views_of(capture, given.made / name, device)
            record.write_result(given, device, {"captures": rows, "pilot": pilot})
            for row in rows[name].get("views", ()):
                print(name, row, flush=True)
            if not {"light", "occlusion", "bounce"} & {*given.parts}:
                continue
            subject = Subject(capture, given.gaussians, given.reference_rays, device)
            rows[name]["points"] = len(subject.rows)
            if "light" in given.parts:
                rows[name]["light"] = light_of(subject, device, given.repeats)
            if "occlusion" in given.parts:
                rows[name]["occlusion"] = occlusion_of(subject, given.reference_rays)
            if "bounce" in given.parts:
                rows[name]["bounce"] = bounce_of(subject, given.reference_rays, device, given.repeats)
            record.write_result(given, device, {"captures": rows})
            for row in [*rows[name].get("light", {}).get("rows", ()), *rows[name].get("bounce", ())]:
                print(name, {key: value for key, value in row.items() if key != "seconds"}, flush=True)


if __name__ == "__main__":
    main()
