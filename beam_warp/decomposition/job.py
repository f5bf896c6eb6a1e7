"""The main job: Gaussians with captured radiance in, a relightable asset out, frame by frame and resumable.

    read      `beam_warp.decomposition.source`          frames and their images
    see       `beam_warp.decomposition.seen`            what views show, and where light is gathered
    light     `beam_warp.decomposition.capture_light`   the light's exposure, and whether it fits
    measure   `beam_warp.decomposition.measure`         occlusion and evidence of each frame
    solve     `beam_warp.decomposition.solve`           base colour from the evidence
    write     `beam_warp.decomposition.result`          asset, contact sheet and report

The first five are steps of a plan (`beam_warp.decomposition.work`), which says what of them is done: a stopped job
continues. What they find is kept in a folder (`beam_warp.decomposition.archive`), from which the last one reads.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from threading import Timer
from typing import Any

from beam_warp.capture.capture import Capture
from beam_warp.checks import require_path
from beam_warp.converters.numbering import ASSET_NAME
from beam_warp.converters.staging import require_writable
from beam_warp.decomposition.frames import GivenFrames
from beam_warp.decomposition.options import OverviewOptions, RunOptions
from beam_warp.decomposition.result import Measurements, draw_overview, relightable_sequence, run_report
from beam_warp.decomposition.work import MaterialWork
from beam_warp.device.arrays import resolve_device
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.jobs.report import REPORT_NAME, write_report
from beam_warp.plan.carry import Counted, carry_out
from beam_warp.plan.steps import Plan, Receipt
from beam_warp.plan.workers import Crew, in_process
from beam_warp.reconstruction.job import Reconstruction, ReconstructionWork
from beam_warp.schema.staging import publish_asset, staged_folder
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

OVERVIEW_NAME = "overview.png"

AHEAD_AFTER = 2.5
"""Time after which modules for later are imported [s]: the first fit has begun by then, which waits for the device, and
what is done before does not."""

COUNTED = {"materials": "decompose"}
"""Stages that a listener hears of when a step is done, and what they are called."""


@dataclass(frozen=True)
class RunResult:
    """Files and records that a run leaves.

    Attributes:
        asset: Root layer of the asset.
        overview: The contact sheet.
        sequence: The relightable sequence, read lazily from the store, axes "rfu".
        environment: The light as used: the given one times the exposure, and turned if it was askew.
        report: What was measured, JSON-able; also written to ``report.json``.
    """

    asset: Path
    overview: Path
    sequence: GaussianSequence
    environment: EnvironmentMap
    report: dict[str, Any]


def run(
    sequence: GaussianSequence,
    environment: EnvironmentMap,
    out: str | Path,
    options: RunOptions | None = None,
    *,
    capture: Capture | None = None,
    overview: OverviewOptions | None = None,
    progress: StageProgress = no_progress,
    crew: Crew = in_process,
) -> RunResult:
    """Decompose a sequence; write ``out/asset.usda``, its layers, ``out/report.json`` and ``out/overview.png``.

    Every finished frame is kept in ``out/frames``. A second call with the same input, options and code takes up where
    the first was stopped; a call with others starts over.

    Args:
        sequence: Frames with captured radiance, in any axes.
        environment: The light of the capture, in the world "rfu". Where it is not known, another one: base colour
            explains the captured colour by it, and relightings by it are not comparable with what was captured.
        out: Folder; made if it does not exist.
        options: See `RunOptions`.
        capture: The images that the Gaussians were reconstructed from: light is gathered where they show the surface,
            and base colour explains what they show. None takes the Gaussians' own colour for it.
        overview: See `OverviewOptions`.
        progress: Called with (stage, done, total).
        crew: Who does the work: this process, or others, which must be able to unpickle the sequence.

    Raises:
        InvalidArrayError: A frame has no captured radiance.
        InvalidOptionError: The capture lacks a frame of the sequence, or there is none for the image path.
        OutputError: The folder cannot be made or written.
        BeamError: An input or option breaks its contract.

    Source: BEAM §3.2, by the direct path (see `beam_warp.materials.direct`).
    """
    started = time.perf_counter()

    def told(stage: str, done: int, total: int, note: str = "") -> None:
        progress(stage, done, total)

    work = MaterialWork(
        require_path("out", out),
        GivenFrames(read=lambda: sequence, seen=capture),
        environment,
        options or RunOptions(),
        told,
    )
    return run_materials(work, overview, started, crew)


def run_materials(
    work: MaterialWork, overview: OverviewOptions | None, started: float, crew: Crew = in_process
) -> RunResult:
    """Do what `run` does with frames that every worker reads for itself.

    Args:
        work: Input, options and folder.
        overview: See `OverviewOptions`.
        started: When the job began, by `time.perf_counter` [s].
        crew: Who does the work.
    """
    notes = _prepare(work)
    plan = work.plan()
    receipts = carry_out(plan, crew(plan, work.device_kind, work.progress), Counted(plan, COUNTED, work.progress))
    return _finish(work, receipts, notes, overview or OverviewOptions(), started)


@dataclass(frozen=True)
class TakeResult:
    """What a capture became.

    Attributes:
        reconstruction: Its Gaussians.
        result: The relightable asset.
    """

    reconstruction: Reconstruction
    result: RunResult


def run_capture(
    frames: ReconstructionWork,
    work: MaterialWork,
    overview: OverviewOptions | None,
    started: float,
    crew: Crew = in_process,
) -> TakeResult:
    """Reconstruct a capture and decompose it in one plan: the materials of a frame do not wait for all other frames.

    Args:
        frames: The capture, and how it is reconstructed.
        work: How the frames are decomposed; its frames are `ReconstructedFrames`.
        overview: See `OverviewOptions`.
        started: When the job began, by `time.perf_counter` [s].
        crew: Who does the work.

    Raises:
        UnfinishedError: Several frames failed; the others are kept.
        BeamError: As `run` and `beam_warp.reconstruction.job.reconstruct`.
    """
    with closing(frames):
        notes = _prepare(work)
        plan = work.plan().with_steps_of(frames.plan())
        watch = Counted(plan, {"frame": "frames", **COUNTED}, work.progress)
        with _importing_ahead(plan, work.device):
            receipts = carry_out(plan, crew(plan, work.device_kind, work.progress), watch)
        found = frames.finish(receipts, started)
        return TakeResult(found, _finish(work, receipts, notes, overview or OverviewOptions(), started))


@contextmanager
def _importing_ahead(plan: Plan, device: Any) -> Iterator[None]:
    """Import what later steps and the end need, and start the device, while steps wait for it or others do them."""

    def load() -> None:
        with suppress(ImportError):  # whoever needs it says so
            for name in (name for work in plan.works.values() for name in work.later):
                import_module(name)
        _ = device.context

    timer = Timer(AHEAD_AFTER, load)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _prepare(work: MaterialWork) -> list[str]:
    """Check everything, and then make the folders."""
    resolve_device(work.options.device)  # before a folder is made that would then stay empty
    for name in (ASSET_NAME, OVERVIEW_NAME, REPORT_NAME):
        require_writable(work.folder / name, is_made=True)
    return work.prepare()


def _finish(
    work: MaterialWork, receipts: Mapping[str, Receipt], notes: list[str], overview: OverviewOptions, started: float
) -> RunResult:
    """Write asset, contact sheet and report."""
    source = replace(work.source, sequence=work.whole)
    plan, out, log = replace(work.job, source=source), work.folder, source.log
    made = Measurements.of(receipts, work.frames.numbers())
    notes = [*notes, *(work.images.notes if work.images is not None else ())]
    notes += plan.archive.remove_beyond(len(source.sequence))
    persistent = work.are_persistent
    relightable = relightable_sequence(plan, work.solved, made.statistics, persistent=persistent)
    with staged_folder(out / "results") as staged:  # all of them appear, or none

        def draw() -> None:
            with log.timer("overview"):
                draw_overview(staged / OVERVIEW_NAME, relightable, plan, overview)

        work.progress("overview", 0, 1)
        with ThreadPoolExecutor(1) as beside:
            drawn = beside.submit(draw)
            with log.timer("write asset"):
                said = {name: receipt.facts for name, receipt in receipts.items()}
                layers = work.clips.write(relightable, staged / ASSET_NAME, said)
            drawn.result()
        work.progress("overview", 1, 1)
        seconds = time.perf_counter() - started
        report = run_report(plan, made, findings=work.findings(), persistent=persistent, seconds=seconds)
        report["input"]["notes"] += notes
        write_report(staged, report)
        publish_asset(staged, [REPORT_NAME, OVERVIEW_NAME, *(path.name for path in layers)], out)
    return RunResult(out / ASSET_NAME, out / OVERVIEW_NAME, relightable, plan.light.environment, report)
