"""The demo from images: its own small capture, reconstructed, meshed, made relightable, and scored at every step."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.decomposition.job import OverviewOptions, RunOptions, RunResult, run
from beam_warp.decomposition.options import ESTIMATE
from beam_warp.demo.capture import DANCE_SECONDS, FRAMES_PER_SECOND, demo_figure_for, require_free, write_demo_capture
from beam_warp.demo.truth import DemoTruth, relit_views, score_views
from beam_warp.device.arrays import resolve_device
from beam_warp.digests import code_digest
from beam_warp.image.files import write_png
from beam_warp.image.metrics import block_means
from beam_warp.image.panels import Panel, display_color, lay_out, over_background
from beam_warp.jobs.listeners import StageProgress
from beam_warp.jobs.progress import StageTimer
from beam_warp.jobs.report import write_json
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.mesh.extract import mesh_of_gaussians
from beam_warp.mesh.preview import shaded_image
from beam_warp.raster.channels import RADIANCE, SURFACE_NORMALS
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.pixel_means import PixelMeans
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import samples_of_images
from beam_warp.reconstruction.drift import tracking_drift
from beam_warp.reconstruction.fit import FitOptions, LearningRates
from beam_warp.reconstruction.job import Reconstruction, ReconstructOptions, reconstruct
from beam_warp.reconstruction.joint_tracking import JointOptions
from beam_warp.reconstruction.scores import read_truth_mesh, score_frame, seen_radiance
from beam_warp.reconstruction.steps import FitAndTrack
from beam_warp.reconstruction.track import TrackOptions
from beam_warp.render.sheet import Relighting, display_exposure
from beam_warp.trace.mesh_paths import TracedMesh
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

TRUTH_PATHS = 64
CHAMFER_SAMPLES = 20_000
"""Points on each surface: their mean distance is known to 1 % of it."""

PANEL_HEIGHT = 300
PANEL_MARGIN = 3
"""Margin of a panel around the subject [pixel of the photograph]."""

OVERVIEW_HEIGHT = 400


@dataclass(frozen=True, kw_only=True)
class FromImagesOptions:
    """Size of the demo from images.

    Attributes:
        size: Width and height of the images [pixel].
        frame_count: Frames, 1/24 s apart.
        camera_count: Training cameras.
        test_camera_count: Cameras that training does not see, at least one.
        samples: Paths per pixel of a training view.
        gaussian_count: Most Gaussians.
        color_iterations: Steps of the first frame without the term of normals.
        normal_iterations: Steps with it.
        joint_iterations: Steps that find the joints' motion, for every later frame.
        track_iterations: Steps that then fit the Gaussians.
    """

    size: int = 128
    frame_count: int = 4
    camera_count: int = 12
    test_camera_count: int = 2
    samples: int = 16
    gaussian_count: int = 6_000
    color_iterations: int = 60
    normal_iterations: int = 100
    joint_iterations: int = 40
    track_iterations: int = 30


@dataclass(frozen=True)
class FromImages:
    """The result of the demo from images.

    Attributes:
        picture: Path of a picture: photographs, renders, normals, meshes and relightings side by side.
        result: Result of the main job on the reconstructed sequence.
        report: Scores and seconds, JSON-able.
    """

    picture: Path
    result: RunResult
    report: dict[str, Any]


def demo_from_images(
    out: Path,
    options: FromImagesOptions,
    lights: Mapping[str, EnvironmentMap],
    *,
    device: str | None,
    seed: int,
    progress: StageProgress,
) -> FromImages:
    """Photograph the figure, reconstruct it from the photographs, make it relightable, and score all of that.

    Writes ``out/capture``, ``out/reconstruction`` and ``out/from_images``, as `write_demo_capture`, `reconstruct` and
    `beam_warp.run` do, and ``out/reconstruction.png``. Materials and relightings are scored in the last frame, which is
    the farthest from the key frame.

    Args:
        out: Folder, which exists.
        options: See `FromImagesOptions`.
        lights: Environments by name; the first one is that of the capture, all are put on the result.
        device: Warp device; None takes the first CUDA device, or the CPU.
        seed: Same seed, same device: same result.
        progress: Called with (stage, done, total).

    Raises:
        OutputError: ``out/capture`` holds another capture than these options make, or a folder cannot be written.
    """
    timer = StageTimer(resolve_device(device))
    with timer("capture"):
        capture = demo_capture(out, options, device, seed, progress)
    steps = demo_steps(options, device=device, seed=seed)
    with timer("reconstruct"):
        found = reconstruct(
            capture,
            out / "reconstruction",
            steps,
            ReconstructOptions(cameras="keep"),  # they are exact
            progress=lambda stage, done, total, note="": progress(stage, done, total),
        )
    with timer("mesh"):
        meshes = [
            mesh_of_gaussians(cloud, _training_cameras(capture, frame), options=steps.raster, device=device)
            for frame, cloud in enumerate(found.sequence)
        ]
    with timer("score"):
        frames = _score_frames(capture, found, meshes, steps.raster, device)
        drift = tracking_drift(
            found.sequence,
            [read_truth_mesh(capture, frame).vertices for frame in capture.frames],
            read_truth_mesh(capture, 0).faces,
            cameras=_training_cameras(capture, 0),
            device=device,
        )
    with timer("decompose"):
        result = _decompose(out / "from_images", capture, found.sequence, lights, device, progress)
    started = time.perf_counter()
    last = capture.frames[-1]
    cameras = [record.camera for record in capture.select(split="test", frames={last})]
    figure = demo_figure_for(options.size).at(last / (FRAMES_PER_SECOND * DANCE_SECONDS))
    traced = TracedMesh.from_mesh(figure, device=device)
    truths = [DemoTruth.of(traced, camera, lights, TRUTH_PATHS) for camera in cameras]
    prepared = [PreparedEnvironment(light, device) for light in lights.values()]
    relit = relit_views(result.sequence[last], cameras, lights, raster=steps.raster, device=device, prepared=prepared)
    report: dict[str, Any] = {
        "options": asdict(options),
        "gaussians": [len(cloud) for cloud in found.sequence],
        "frames": frames,
        "drift": [entry.as_dict() for entry in drift],
        "relightable": {"frame": last, **score_views(truths, relit)},
        "warnings": [*found.report["warnings"], *result.report["warnings"]],
    }
    picture = out / "reconstruction.png"
    _write_picture(picture, capture, found.sequence, result.sequence, meshes, lights, prepared, steps.raster, device)
    report["seconds"] = {**timer.seconds, "score relightings": time.perf_counter() - started}
    return FromImages(picture, result, report)


def demo_steps(options: FromImagesOptions, *, device: str | None, seed: int) -> FitAndTrack:
    """Return a schedule for two CPU cores: a tenth of the usual steps, for a twentieth of the usual pixels.

    Joints are looked for at full resolution only, and held together more than usual: from frame to frame a hand moves
    by two pixels, and there are few pixels that say how.
    """
    usual = TrackOptions()
    return FitAndTrack(
        fitting=FitOptions(
            gaussian_count=options.gaussian_count,
            color_iterations=options.color_iterations,
            normal_iterations=options.normal_iterations,
            rates=LearningRates(final_others=1.0),  # few steps do not come to rest anyway
            seed=seed,
        ),
        tracking=TrackOptions(
            joints=JointOptions(levels=(1,), iterations=(options.joint_iterations,), rigidity=0.2),
            refinement=FitOptions(
                **{**vars(usual.refinement), "normal_iterations": options.track_iterations, "seed": seed}
            ),
        ),
        device=device,
    )


def demo_capture(
    out: Path, options: FromImagesOptions, device: str | None, seed: int, progress: StageProgress
) -> Capture:
    """Write ``out/capture``, or read it if it was written with the same options.

    Raises:
        OutputError: ``out/capture`` holds another capture, or cannot be written.
    """
    names = ("frame_count", "camera_count", "test_camera_count", "size", "samples")
    sizes: dict[str, Any] = {**{name: getattr(options, name) for name in names}, "seed": seed}
    asked = {"code": code_digest(), "device": "cuda" if resolve_device(device).is_cuda else "cpu", **sizes}
    note, folder = out / "capture.json", out / "capture"
    if folder.exists() and _read_json(note) == asked:
        return Capture.read(folder)
    require_free(folder)  # before the note, which is about what it holds, is written
    write_json(note, asked)
    return write_demo_capture(folder, **sizes, device=device, progress=progress)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _training_cameras(capture: Capture, frame: int) -> list[Camera]:
    """Return the cameras that train in a frame."""
    return [record.camera for record in capture.select(split="train", frames={frame})]


def _score_frames(
    capture: Capture,
    found: Reconstruction,
    meshes: Sequence[trimesh.Trimesh],
    raster: RasterOptions,
    device: str | None,
) -> list[dict[str, Any]]:
    """Score every frame against views that training did not see, and its mesh against the truth."""
    entries = found.report["frames"]
    reports = []
    for index, frame in enumerate(capture.frames):
        score = score_frame(
            found.sequence[index],
            capture.select(split="test", frames={frame}),
            meshes[index],
            truth_mesh=read_truth_mesh(capture, frame),
            seeing=_training_cameras(capture, frame),
            options=raster,
            samples=int(entries[0]["samples"]),
            sample_count=CHAMFER_SAMPLES,
            device=device,
        )
        entry = entries[index]
        reports.append({"frame": frame, **score.as_dict(), "train_psnr": entry["psnr"], "kind": entry["kind"]})
    return reports


def _decompose(
    out: Path,
    capture: Capture,
    sequence: GaussianSequence,
    lights: Mapping[str, EnvironmentMap],
    device: str | None,
    progress: StageProgress,
) -> RunResult:
    """Make the reconstructed sequence relightable, under the first of the lights."""
    light, *others = lights
    return run(
        sequence,
        lights[light],
        out,
        # The capture's light and its exposure are known, and its images are scene-linear.
        RunOptions(exposure=0.0, roughness=ESTIMATE, device=device),
        capture=capture,
        overview=OverviewOptions(
            second_light=Relighting(f"relit by a {others[0]}", lights[others[0]]) if others else None,
            azimuth=25.0,
            elevation=8.0,
            height=OVERVIEW_HEIGHT,
        ),
        progress=progress,
    )


def _write_picture(
    path: Path,
    capture: Capture,
    sequence: GaussianSequence,
    relightable: GaussianSequence,
    meshes: Sequence[trimesh.Trimesh],
    lights: Mapping[str, EnvironmentMap],
    prepared: Sequence[PreparedEnvironment],
    raster: RasterOptions,
    device: str | None,
) -> None:
    """Draw a row a frame, from one test camera after the other: photograph, ours, normals, mesh, other lights."""
    records = _test_views(capture)
    others = {name: lights[name] for name in list(lights)[1:]}
    rows, columns = _subject([record.image().alpha for record in records])
    factor = -(-PANEL_HEIGHT // (rows.stop - rows.start))
    panels: list[Panel] = []

    def show(title: str, pixels: NDArray[np.uint8], finer: int = 1) -> None:
        part = pixels[finer * rows.start : finer * rows.stop, finer * columns.start : finer * columns.stop]
        panels.append((title, np.repeat(np.repeat(part, factor // finer, axis=0), factor // finer, axis=1)))

    for index, record in enumerate(records):
        cloud, camera = sequence[index], record.camera
        image = record.image().linear_rgba()
        side = samples_of_images(cloud, [camera], raster)
        samples = rasterize(
            cloud, camera.supersampled(side), channels=(RADIANCE, SURFACE_NORMALS), options=raster, device=device
        )
        drawn = PixelMeans.of(samples, side)
        alpha = drawn.alpha[..., None]
        seen = display_color(block_means(seen_radiance(samples, cloud), side), drawn.alpha)
        (relit,) = relit_views(relightable[index], [camera], others, raster=raster, device=device, prepared=prepared)
        photograph = over_background(display_color(image[..., :3], image[..., 3]), image[..., 3:])
        show(f"frame {record.frame}: photograph", photograph)
        show("Gaussians", over_background(seen, alpha))
        show("normals", over_background(0.5 * drawn.channels[SURFACE_NORMALS] + 0.5, alpha))
        show("mesh", shaded_image(meshes[index], camera.supersampled(factor), device), factor)
        for name, light in others.items():
            lit = display_color(relit.radiance[name], relit.seen.alpha, display_exposure(light))
            show(f"relit: {name}", over_background(lit, relit.seen.alpha[..., None]))
    write_png(path, lay_out(panels, len(panels) // len(records)))


def _test_views(capture: Capture) -> list[CaptureRecord]:
    """Return one test view of every frame: a camera after the other."""
    views = [capture.select(split="test", frames={frame}) for frame in capture.frames]
    return [found[index % len(found)] for index, found in enumerate(views)]


def _subject(alphas: Sequence[NDArray[np.float32] | None]) -> tuple[slice, slice]:
    """Return the rows and columns on which the subject is in any of some images, and a margin."""
    covered = np.any([alpha > 0.0 for alpha in alphas if alpha is not None], axis=0)
    bounds = []
    for axis in (1, 0):
        there = np.flatnonzero(covered.any(axis=axis))
        bounds.append(slice(max(0, int(there[0]) - PANEL_MARGIN), int(there[-1]) + 1 + PANEL_MARGIN))
    return bounds[0], bounds[1]
