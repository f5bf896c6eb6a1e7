"""What every constant that somebody chose is worth: the scores with half of it and with half as much again.

    python benchmarks/constants.py --out results.json [--device cuda:0] [--data DIR] [--workers 6] [--seconds S]
                                   [--only GROUP ...] [--quick]

Constants are those of `constants_registry`. The set-up is small: 20,000 Gaussians are fitted to the first frame of a
capture in a tenth of the usual steps, and from what the unchanged values give, one frame is tracked, a mesh extracted,
materials are found by the direct path, and test views relit. A constant is changed in that part alone which it belongs
to. Other seeds of the same say how much of a change is chance.

Several processes share the device. The JSON is written while rows come in, and another run with the same file takes up
where the last one ended; ``--seconds`` ends it early. A row that fails says so. ``--quick`` takes the demo's capture,
few Gaussians and a handful of constants. This is about scores only: no time is measured.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import pickle
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, ProcessPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import record
import trimesh
from constants_places import changed, is_option, load_packages, numbers_of, value_of, with_option
from constants_registry import GROUPS, JUDGED, SIDES, Constant

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.views import CapturedView
from beam_warp.demo.capture import write_demo_capture
from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.evaluate.scores import MaterialViewScores
from beam_warp.evaluate.views import ViewScorer
from beam_warp.jobs.listeners import no_progress
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.base_color import fill_from_neighbors, solve_base_color
from beam_warp.materials.direct import measure_materials
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.materials.normals import SurfacePoints
from beam_warp.materials.roughness import solve_roughness
from beam_warp.materials.roughness_profile import measure_roughness_profile
from beam_warp.mesh.distances import surface_distances
from beam_warp.mesh.extract import mesh_of_gaussians
from beam_warp.reconstruction.drift import tracking_drift
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.joint_tracking import JointOptions
from beam_warp.reconstruction.scores import read_truth_mesh, score_frame, truth_frames
from beam_warp.reconstruction.steps import FitAndTrack
from beam_warp.reconstruction.track import TrackOptions, advance_track, begin_track
from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.trace.scene import Scene
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.shot import Renderer

Row = dict[str, Any]

CAPTURES = ("walker", "runner", "robot")
"""The captures with truth: the first two are those that constants were chosen on, the third is not."""

QUICK_PLACES = ("FitOptions.weights.normal", "joints.rigidity", "SPREAD_PART", "TOLERANCE", "CURVATURE", "GAP_IN_SIZES")
"""Parts of the places of the few constants that a quick run takes: options, and constants of modules and kernels."""


def _small_fit() -> FitOptions:
    return FitOptions(gaussian_count=20_000, color_iterations=100, normal_iterations=200, refine_every=25)


def _small_tracking() -> TrackOptions:
    usual = TrackOptions()
    joints = replace(usual.joints, iterations=tuple(count // 10 for count in usual.joints.iterations))
    return replace(usual, joints=joints, refinement=replace(usual.refinement, normal_iterations=40))


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Options of all parts, from which constants are changed.

    Attributes:
        fit: Of the first frame's Gaussians.
        tracking: Of the next frame.
        materials: Of the direct path.
        deferred: Of relighting.
        paths: Of relighting by path tracing.
        surface_samples: Points on each surface of a distance between meshes.
        seeds: How many seeds the noise is told from; the first is that of all other rows.
    """

    fit: FitOptions = field(default_factory=_small_fit)
    tracking: TrackOptions = field(default_factory=_small_tracking)
    materials: MaterialOptions = field(default_factory=MaterialOptions)
    deferred: DeferredOptions = field(default_factory=lambda: DeferredOptions(samples=2, layers=()))
    paths: PathOptions = field(default_factory=PathOptions)
    surface_samples: int = 50_000
    seeds: int = 8

    def with_seed(self, seed: int) -> Setup:
        """Return the same with another seed of everything random."""
        return replace(
            self,
            fit=replace(self.fit, seed=seed),
            materials=replace(self.materials, seed=seed),
            paths=replace(self.paths, seed=seed),
        )

    def changed(self, place: str, constant: Constant, side: str) -> Setup:
        """Return the set-up with one option of a constant changed.

        Raises:
            KeyError: No options of the set-up are of that class.
        """
        name, *path = place.partition(":")[2].split(".")
        for own in fields(self):
            options = getattr(self, own.name)
            if type(options).__name__ == name:
                return replace(self, **{own.name: with_option(options, path, partial(constant.tried, side))})
        raise KeyError(f"{place} must be an option of the set-up, got options of {name}. Say why it is not varied.")


FULL = Setup()

QUICK = Setup(
    fit=replace(FULL.fit, gaussian_count=600, color_iterations=20, normal_iterations=20, refine_every=20),
    tracking=replace(
        FULL.tracking,
        joints=JointOptions(iterations=(2, 2, 2, 2)),
        refinement=replace(FULL.tracking.refinement, normal_iterations=4),
    ),
    materials=MaterialOptions(sample_count=8),
    deferred=DeferredOptions(samples=1, layers=(), environment_shadows=2, environment_map_size=32),
    paths=PathOptions(samples=2),
    surface_samples=1_000,
    seeds=3,
)


@dataclass(frozen=True, eq=False)
class Subject:
    """A capture with truth, what is read of it, and what the unchanged constants make of it.

    Attributes:
        name: Of the capture.
        folder: Where it is.
        device: Warp device.
        kept: Folder in which the unchanged results are shared by processes.
    """

    name: str
    folder: Path
    device: str
    kept: Path

    @cached_property
    def capture(self) -> Capture:
        """The capture."""
        return Capture.read(self.folder)

    @cached_property
    def frames(self) -> tuple[int, int]:
        """The first frame with truth, and the one after it."""
        first = truth_frames(self.capture)[0]
        return first, self.capture.frames[self.capture.frames.index(first) + 1]

    @cached_property
    def views(self) -> list[list[CapturedView]]:
        """The photographs of both frames."""
        frames = ([frame] for frame in self.frames)
        return [[record.view() for record in self.capture.select(split="train", frames=frame)] for frame in frames]

    @cached_property
    def meshes(self) -> list[trimesh.Trimesh]:
        """The true surface of both frames."""
        return [read_truth_mesh(self.capture, frame) for frame in self.frames]

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the photographs."""
        return [view.camera for view in self.views[0]]

    @cached_property
    def tests(self) -> Sequence[CaptureRecord]:
        """Views of the first frame that nothing is fitted to."""
        return self.capture.select(split="test", frames=[self.frames[0]])

    @cached_property
    def light(self) -> PreparedEnvironment:
        """The light of the capture."""
        assert self.capture.environment_path is not None
        return PreparedEnvironment(EnvironmentMap.read(self.capture.environment_path), resolve_device(self.device))

    @cached_property
    def lights(self) -> dict[str, EnvironmentMap]:
        """The lights that the test views are known under."""
        names = dict.fromkeys(name for record in self.tests for name in record.relit_paths)
        return {name: EnvironmentMap.read(self.capture.folder / "truth" / f"{name}.exr") for name in names}

    def unchanged(self, name: str, make: Callable[[], GaussianCloud]) -> GaussianCloud:
        """Return what the unchanged constants make, ``gaussians`` or ``materials``; made by the first who asks."""
        path = self.kept / f"{self.name}_{name}.pickle"
        if not path.exists():
            unfinished = path.with_suffix(f".{os.getpid()}")
            unfinished.write_bytes(pickle.dumps(make()))
            unfinished.replace(path)
        return pickle.loads(path.read_bytes())


def reconstruct(subject: Subject, setup: Setup) -> GaussianCloud:
    """Fit the first frame."""
    assert subject.capture.environment_path is not None
    light = EnvironmentMap.read(subject.capture.environment_path)
    steps = FitAndTrack(fitting=setup.fit, environment=light, device=subject.device)
    track, _ = steps.begin(subject.views[0], no_progress)
    return track.cloud


def surface_error(subject: Subject, setup: Setup, cloud: GaussianCloud) -> float:
    """Return the Chamfer distance of a cloud's mesh to the true surface [mm]."""
    mesh = mesh_of_gaussians(cloud, subject.cameras, options=setup.fit.raster, device=subject.device)
    return surface_distances(
        mesh, subject.meshes[0], subject.cameras, sample_count=setup.surface_samples, device=subject.device
    ).as_dict()["chamfer_mm"]


def decompose(subject: Subject, setup: Setup, cloud: GaussianCloud) -> GaussianCloud:
    """Find a cloud's materials by the direct path, roughness too."""
    views, light, device = subject.views[0], subject.light, subject.device
    scene = Scene.from_gaussians(cloud, device)
    seen = view_evidence(cloud, subject.cameras, views, options=setup.fit.raster, device=device)
    points = SurfacePoints.seen_by(cloud, seen, scene, setup.materials.offset)
    profile = measure_roughness_profile(cloud, scene, points, light, seen, options=setup.materials)
    rough = solve_roughness(cloud.positions, profile).roughness
    measured = measure_materials(cloud, scene, points, rough, light, options=setup.materials, views=seen)
    normals = points.normals.numpy()
    normals, _ = fill_from_neighbors(cloud.positions, normals, np.zeros_like(normals), ~points.seen)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    up = np.where(lengths > 1e-6, normals / np.maximum(lengths, 1e-6), (0.0, 0.0, 1.0)).astype(np.float32)
    known = cloud.with_arrays(normals=up, normal_confidence=points.confidence)
    solved = solve_base_color(known, measured.evidence, light.mean_irradiance)
    openness, _ = fill_from_neighbors(
        cloud.positions, measured.ambient_occlusion[:, None], measured.ambient_occlusion_error[:, None], ~points.seen
    )
    return known.with_arrays(
        base_color=solved.base_color, roughness=rough, ambient_occlusion=openness[:, 0].astype(np.float32)
    )


def score_views(subject: Subject, setup: Setup, cloud: GaussianCloud, renderer: Renderer) -> list[MaterialViewScores]:
    """Draw and relight the test views, and score them."""
    scorer = ViewScorer(
        raster=setup.fit.raster,
        samples=setup.deferred.samples,
        renderers={"relit": renderer},
        metrics=PerceptualMetrics(),
        device=subject.device,
    )
    relit = scorer.relit(cloud, subject.tests, subject.lights)
    return [scorer.score(cloud, test, images).scores for test, images in zip(subject.tests, relit, strict=True)]


def relit_psnr(views: list[MaterialViewScores]) -> float:
    """Return the mean PSNR of relit views in the subject's box [dB]; NaN where it is not known what they look like."""
    found = [score.psnr for view in views for score in view.relit["relit"].values()]
    return float(np.mean(found)) if found else math.nan


def run_reconstruction(subject: Subject, setup: Setup) -> Row:
    """Fit the first frame; score new views and the surface."""
    cloud = reconstruct(subject, setup)
    scores = score_frame(cloud, subject.tests, options=setup.fit.raster, samples=2, device=subject.device).as_dict()
    return {
        "psnr": scores["psnr"],
        "normals": scores["normals_median_degrees"],
        "chamfer": surface_error(subject, setup, cloud),
    }


def run_tracking(subject: Subject, setup: Setup) -> Row:
    """Track the next frame; score its photographs, and the drift of the true surface's points."""
    options = setup.tracking.following(setup.fit)
    cloud = _gaussians(subject)
    key = begin_track(cloud, subject.views[0], options, device=subject.device)
    track, report = advance_track(key, subject.views[1], options, device=subject.device)
    drift = tracking_drift(
        [cloud, track.cloud],
        [mesh.vertices for mesh in subject.meshes],
        subject.meshes[0].faces,
        cameras=subject.cameras,
        device=subject.device,
    )
    return {"photographs": report["psnr"], "drift": drift[1].vertices.mean_mm}


def run_meshing(subject: Subject, setup: Setup) -> Row:
    """Extract the surface."""
    return {"chamfer": surface_error(subject, setup, _gaussians(subject))}


def run_materials(subject: Subject, setup: Setup) -> Row:
    """Find materials; score them, and what is relit with them."""
    views = score_views(subject, setup, decompose(subject, setup, _gaussians(subject)), _deferred(subject, setup))
    scores = {
        name: _mean(view.channels[name].psnr for view in views)
        for name in ("ambient_occlusion", "base_color", "roughness")
    }
    return {**scores, "relit": relit_psnr(views)}


def run_relighting(subject: Subject, setup: Setup) -> Row:
    """Relight by deferred shading."""
    return {"relit": relit_psnr(score_views(subject, setup, _materials(subject), _deferred(subject, setup)))}


def run_path_tracing(subject: Subject, setup: Setup) -> Row:
    """Relight by path tracing."""
    renderer = PathRenderer(setup.paths, device=subject.device)
    return {"relit": relit_psnr(score_views(subject, setup, _materials(subject), renderer))}


RUNS: dict[str, Callable[[Subject, Setup], Row]] = {
    "reconstruction": run_reconstruction,
    "tracking": run_tracking,
    "meshing": run_meshing,
    "materials": run_materials,
    "relighting": run_relighting,
    "path tracing": run_path_tracing,
}
"""What is run and scored for the constants of a group."""

SECONDS_TO_KEEP = 15.0
"""Time between two writings of the result, which digests the code each time [s]."""

SEEDED = ("reconstruction", "tracking", "materials", "path tracing")
"""Groups whose scores depend on a seed; the others are run with the first alone."""


@dataclass(frozen=True)
class Task:
    """One row: a group's part with a constant changed, or with a seed, on all captures.

    Attributes:
        group: Which part.
        place: Of the constant; empty for a seed.
        side: ``"less"`` or ``"more"`` of it, or the number of the seed.
    """

    group: str
    place: str
    side: str


_worker: dict[str, Any] = {}


def start_worker(folders: dict[str, Path], device: str, kept: Path, setup: Setup) -> None:
    """Remember what all tasks of this process share, and load whatever may hold a constant."""
    load_packages()
    resolve_device(device)
    _worker["setup"] = setup
    _worker["subjects"] = {name: Subject(name, folder, device, kept) for name, folder in folders.items()}


def run_task(task: Task) -> Row:
    """Return a row: every score of all captures in their order, what was tried, or why there are none."""
    setup: Setup = _worker["setup"]
    row: Row = {}
    try:
        with ExitStack() as stack:
            if task.place:
                constant = next(each for each in GROUPS[task.group] if each.place == task.place)
                row["tried"] = numbers_of([constant.tried(task.side, value_of(place)) for place in constant.places])
                setup = _varied(constant, task.side, setup, stack)
            else:
                setup = setup.with_seed(int(task.side))
            for subject in _worker["subjects"].values():
                for score, value in RUNS[task.group](subject, setup).items():
                    row.setdefault(score, []).append(round(float(value), 4))
    except Exception as error:
        traceback.print_exc()
        return {"failed": f"{type(error).__name__}: {error}"[:200]}
    return row


def make_unchanged(name: str) -> None:
    """Make what the unchanged constants make of a capture, for all processes."""
    subject = _worker["subjects"][name]
    _gaussians(subject)
    _materials(subject)


def _varied(constant: Constant, side: str, setup: Setup, stack: ExitStack) -> Setup:
    """Change a constant until the stack is closed, and return the set-up with it."""
    for place in constant.places:
        if is_option(place):
            setup = setup.changed(place, constant, side)
        else:
            stack.enter_context(changed(place, constant.tried(side, value_of(place))))
    return setup


def _gaussians(subject: Subject) -> GaussianCloud:
    return subject.unchanged("gaussians", lambda: reconstruct(subject, _worker["setup"]))


def _materials(subject: Subject) -> GaussianCloud:
    return subject.unchanged("materials", lambda: decompose(subject, _worker["setup"], _gaussians(subject)))


def _deferred(subject: Subject, setup: Setup) -> Renderer:
    return DeferredRenderer(setup.deferred, raster=setup.fit.raster, device=subject.device)


def _mean(values: Iterator[float]) -> float:
    return float(np.mean(list(values)))


def tasks_of(setup: Setup, only: list[str], quick: bool) -> list[Task]:
    """Return all rows: seeds first, then the constants of all groups in turn, those chosen by judgement last."""
    groups = only or list(GROUPS)
    tasks = [Task(group, "", str(seed)) for group in groups for seed in range(setup.seeds if group in SEEDED else 1)]
    varied = [
        (group, constant)
        for group in groups
        for constant in GROUPS[group]
        if not constant.not_varied and (not quick or any(part in constant.place for part in QUICK_PLACES))
    ]
    varied.sort(key=lambda pair: pair[1].chosen_on == JUDGED)
    return tasks + [Task(group, constant.place, side) for group, constant in varied for side in SIDES]


def find(result: Row, task: Task) -> tuple[Row, str]:
    """Return where the row of a task is kept: a record, and the key in it."""
    if not task.place:
        return result["seeds"].setdefault(task.group, {}), task.side
    return result["constants"].setdefault(task.place, {}), task.side


def measure(
    tasks: list[Task], result: Row, pool: Executor, workers: int, keep: Callable[[], None], until: float = math.inf
) -> None:
    """Run the tasks that have no row yet, and put their rows into the result.

    Args:
        tasks: What to run, in this order.
        result: Is filled; what it holds already stays.
        pool: Processes that `start_worker` has begun.
        workers: How many they are.
        keep: Called after rows, a few times a minute, and at the end.
        until: Time of `time.monotonic` after which no task is begun.
    """
    list(pool.map(make_unchanged, result["captures"]))
    waiting = [task for task in tasks if find(result, task)[1] not in find(result, task)[0]]
    running: dict[Any, Task] = {}
    kept = time.monotonic()
    try:
        while waiting or running:
            while waiting and len(running) < 2 * workers and time.monotonic() < until:
                task = waiting.pop(0)
                running[pool.submit(run_task, task)] = task
            if not running:
                print(f"{len(waiting)} rows are left for another run")
                return
            for done in wait(running, return_when=FIRST_COMPLETED).done:
                task = running.pop(done)
                holder, key = find(result, task)
                holder[key] = done.result()
                print(f"{task.group} {task.place or 'seed'} {key}: {holder[key].get('failed', 'ok')}", flush=True)
            if time.monotonic() > kept + SECONDS_TO_KEEP:
                keep()
                kept = time.monotonic()
    finally:
        keep()


def main() -> int:
    parser = record.parser(__doc__, device=True, data=True, quick="the demo's capture and a handful of constants")
    parser.add_argument("--workers", type=int, default=6, help="processes that share the device")
    parser.add_argument("--seconds", type=float, help="begin no row after so long")
    parser.add_argument("--only", nargs="+", choices=list(GROUPS), default=[], metavar="GROUP")
    arguments = parser.parse_args()
    until = time.monotonic() + (arguments.seconds or math.inf)
    device = resolve_device(arguments.device)
    setup = QUICK if arguments.quick else FULL
    result: Row = {"captures": ["demo"] if arguments.quick else list(CAPTURES), "seeds": {}, "constants": {}}
    if arguments.out.is_file():
        before = json.loads(arguments.out.read_text(encoding="utf-8"))
        if before["measured"]["commit"] == arguments.commit:
            result = {name: before[name] for name in result}
    with tempfile.TemporaryDirectory() as folder:
        folders = {name: arguments.data / "captures" / name for name in CAPTURES}
        if arguments.quick:
            made = write_demo_capture(
                Path(folder) / "demo",
                camera_count=6,
                test_camera_count=1,
                size=64,
                samples=4,
                frame_count=2,
                device=str(device),
            )
            folders = {"demo": made.folder}
        pool = ProcessPoolExecutor(
            arguments.workers,
            multiprocessing.get_context("spawn"),
            start_worker,
            (folders, str(device), Path(folder), setup),
        )
        with pool:
            measure(
                tasks_of(setup, arguments.only, arguments.quick),
                result,
                pool,
                arguments.workers,
                lambda: record.write_result(arguments, device, result),
                until,
            )
    rows = [row for held in (*result["seeds"].values(), *result["constants"].values()) for row in held.values()]
    failed = sum("failed" in row for row in rows)
    print(f"{len(rows)} rows, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
