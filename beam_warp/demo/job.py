"""The embedded demo: a figure whose truth is known, as Gaussians and from images, decomposed, relit and scored."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from beam_warp.decomposition.job import OverviewOptions, RunOptions, RunResult, run
from beam_warp.demo.figure import build_figure
from beam_warp.demo.from_images import FromImagesOptions, demo_from_images
from beam_warp.demo.lights import demo_environments
from beam_warp.demo.stand_in import sample_surface, trained_gaussians
from beam_warp.demo.truth import DemoTruth, comparison, relit_views, score_views
from beam_warp.image.files import write_exr, write_png
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.jobs.report import write_report
from beam_warp.raster.records import RasterOptions
from beam_warp.render.sheet import Relighting
from beam_warp.trace.mesh_paths import TracedMesh
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

VIEWS = ((25.0, 8.0), (-150.0, 14.0))
"""Azimuth and elevation of the cameras with truth [degree]."""

TRUTH_PATHS = 64

RASTER = RasterOptions(antialiased=True)
"""The stand-in was not trained against a widening filter, so the one that keeps energy is the fair one."""


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Size of the demo.

    Attributes:
        frame_count: Frames of the figure's dance.
        gaussian_count: About how many Gaussians are on the figure.
        image_height: Height of the images with truth [pixel].
        device: Warp device; None takes the first CUDA device, or the CPU.
        seed: Same seed, same device: same result.
        images: Size of the second half, which starts from photographs.
    """

    frame_count: int = 1
    gaussian_count: int = 45_000
    image_height: int = 300
    device: str | None = None
    seed: int = 0
    images: FromImagesOptions = field(default_factory=FromImagesOptions)


@dataclass(frozen=True, eq=False)
class DemoScene:
    """The input of the demo, and its truth.

    Attributes:
        sequence: Gaussians as a training would leave them: display-referred radiance, no material.
        lights: Environments by name; the figure was captured under ``studio``.
        truth: Path-traced views of ``truth_frame``.
        truth_frame: Index of the frame that has truth.
    """

    sequence: GaussianSequence
    lights: Mapping[str, EnvironmentMap]
    truth: Sequence[DemoTruth]
    truth_frame: int


def build_demo(options: DemoOptions, progress: StageProgress = no_progress) -> DemoScene:
    """Build the figure, capture it as Gaussians, and path trace the truth."""
    rng = np.random.default_rng(options.seed)
    figure = build_figure()
    lights = demo_environments()
    samples = sample_surface(figure.rest, options.gaussian_count, rng)
    truth_frame = options.frame_count // 2
    clouds, truth = [], []
    for frame in range(options.frame_count):
        mesh = figure.at(frame / options.frame_count * 0.5)
        traced = TracedMesh.from_mesh(mesh, device=options.device)
        clouds.append(trained_gaussians(mesh, traced, samples, lights["studio"], options.seed + frame))
        progress("capture", frame + 1, options.frame_count)
        if frame == truth_frame:
            for azimuth, elevation in VIEWS:
                camera = Camera.frame_points(
                    mesh.vertices,
                    azimuth=azimuth,
                    elevation=elevation,
                    width=round(options.image_height * 0.8),
                    height=options.image_height,
                )
                truth.append(DemoTruth.of(traced, camera, lights, TRUTH_PATHS))
                progress("path trace truth", len(truth), len(VIEWS))
    metadata = {"producer": "beam demo", **RASTER.as_metadata()}
    sequence = GaussianSequence.from_clouds(clouds, frames_per_second=6.0, metadata=metadata)
    return DemoScene(sequence, lights, truth, truth_frame)


def run_demo(out: Path, options: DemoOptions | None = None, progress: StageProgress = no_progress) -> RunResult:
    """Build the demo, run the main job on it, score the result and draw it; then do the same from images.

    Writes what `beam_warp.run` writes, ``out/lights/*.exr`` and ``out/relit.png``: ours above, truth below; and what
    `demo_from_images` writes. The scores are in the report, under ``scores`` and ``from_images``.

    Args:
        out: Folder; made if its parent exists.
        options: See `DemoOptions`.
        progress: Called with (stage, done, total).
    """
    options = options or DemoOptions()
    started = time.perf_counter()
    scene = build_demo(options, progress)
    built = time.perf_counter() - started
    result = run(
        scene.sequence,
        scene.lights["studio"],
        out,
        # The light is known, so its exposure is stated, not estimated: that is what makes the scores unscaled.
        RunOptions(exposure=0.0, roughness=0.5, device=options.device),
        overview=OverviewOptions(
            second_light=Relighting("relit by a sunset", scene.lights["sunset"]),
            azimuth=VIEWS[0][0],
            elevation=VIEWS[0][1],
        ),
        progress=progress,
    )
    folder = out / "lights"
    folder.mkdir(exist_ok=True)
    for name, light in scene.lights.items():
        write_exr(folder / f"{name}.exr", {c: light.radiance[..., i] for i, c in enumerate("RGB")})
    relit = relit_views(
        result.sequence[scene.truth_frame],
        [truth.camera for truth in scene.truth],
        scene.lights,
        raster=RASTER,
        device=options.device,
    )
    result.report["scores"] = score_views(scene.truth, relit)
    write_png(out / "relit.png", comparison(scene.truth[0], relit[0], scene.lights))
    images = demo_from_images(
        out, options.images, scene.lights, device=options.device, seed=options.seed, progress=progress
    )
    result.report["from_images"] = images.report
    result.report["seconds"]["build demo"] = built
    result.report["seconds"]["total"] = time.perf_counter() - started
    write_report(out, result.report)
    return replace(result, report=result.report)
