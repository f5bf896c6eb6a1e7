"""The main job: Gaussians with captured radiance in, a relightable asset out, frame by frame and resumable.

    read      `beam_warp.decomposition.source`          frames and their images
    see       `beam_warp.decomposition.seen`            what views show, and where light is gathered
    light     `beam_warp.decomposition.capture_light`   the light's exposure, and whether it fits
    measure   `beam_warp.decomposition.measure`         occlusion and evidence of each frame
    solve     `beam_warp.decomposition.solve`           base colour from the evidence
    write     `beam_warp.decomposition.result`          asset, contact sheet and report

Records go from each step to the next. What is finished is also kept in a folder
(`beam_warp.decomposition.archive`), with which a stopped job continues.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.capture.digests import CaptureDigests
from beam_warp.checks import require_path
from beam_warp.converters.numbering import ASSET_NAME
from beam_warp.converters.staging import require_writable
from beam_warp.decomposition.archive import FrameArchive
from beam_warp.decomposition.capture_images import CaptureImages
from beam_warp.decomposition.capture_light import light_findings, prepare_light
from beam_warp.decomposition.measure import FrameMeasurement
from beam_warp.decomposition.options import OverviewOptions, RunOptions
from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.result import draw_overview, relightable_sequence, run_report
from beam_warp.decomposition.roughness_finder import RoughnessFinder
from beam_warp.decomposition.solve import solve_each, solve_jointly, take
from beam_warp.decomposition.source import Source
from beam_warp.device.arrays import resolve_device
from beam_warp.digests import array_digest, code_digest
from beam_warp.errors import InvalidOptionError
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.jobs.progress import JobLog
from beam_warp.jobs.report import REPORT_NAME, write_report
from beam_warp.jobs.store import make_folders
from beam_warp.materials.direct import ColorEvidence
from beam_warp.materials.roughness_source import RoughnessTexture
from beam_warp.outputs import remove_leftovers
from beam_warp.schema.staging import publish_asset, staged_folder
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

OVERVIEW_NAME = "overview.png"


@dataclass(frozen=True)
class RunResult:
    """Files and records that a run leaves.

    Attributes:
        asset: Root layer of the asset.
        overview: The contact sheet.
        sequence: The relightable sequence, read lazily from the store, axes "rfu".
        environment: The light as used: the given one times the exposure.
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

    Raises:
        InvalidArrayError: A frame has no captured radiance.
        InvalidOptionError: The capture lacks a frame of the sequence, or there is none for the image path.
        OutputError: The folder cannot be made or written.
        BeamError: An input or option breaks its contract.

    Source: BEAM §3.2, by the direct path (see `beam_warp.materials.direct`).
    """
    started = time.perf_counter()
    chosen = options or RunOptions()
    device = resolve_device(chosen.device)  # before a folder is made that would then stay empty
    out = require_path("out", out)
    images = None if capture is None else CaptureImages(capture, sequence)
    if chosen.images is not None and images is None:
        raise InvalidOptionError(
            "capture must be given for the image path, got none: it works on images. Pass one, or leave images out."
        )
    for name in (ASSET_NAME, OVERVIEW_NAME, REPORT_NAME):
        require_writable(out / name, is_made=True)
    folder, digests = make_folders(out, "frames", "digests")
    notes = [*remove_leftovers(out, folder, digests), *(images.notes if images is not None else ())]
    log = JobLog(progress, len(sequence), device)
    source = Source(
        sequence=sequence, images=images, options=chosen, digests=CaptureDigests(digests), device=str(device), log=log
    )
    described = _described(chosen, images, is_cuda=device.is_cuda)
    light = prepare_light(environment, source, described, folder)
    plan = JobPlan(
        source=source,
        light=light,
        persistent=chosen.persistent or sequence.topology == "constant",
        key=array_digest(light.environment.radiance, text=described),
        archive=FrameArchive(folder, source.first.cloud.radiance_color_space),
    )
    notes += plan.archive.remove_beyond(len(sequence))
    first_key = source.key(plan.key, source.first)
    findings = light_findings(source.first, light.environment, folder / "findings.json", first_key)
    roughness = RoughnessFinder(plan)
    frames = FrameMeasurement(plan, roughness)
    if chosen.images is not None:
        solved = take(plan, frames)
    else:
        solved = solve_jointly(plan, frames) if plan.persistent else solve_each(plan, frames)
    relightable = relightable_sequence(plan, solved)
    with staged_folder(out / "results") as staged:  # all of them appear, or none
        with log.timer("write asset"):
            layers = converters.write(relightable, staged / ASSET_NAME)
        with log.timer("overview"):
            progress("overview", 0, 1)
            draw_overview(staged / OVERVIEW_NAME, relightable, plan, overview or OverviewOptions())
            progress("overview", 1, 1)
        seconds = time.perf_counter() - started
        report = run_report(plan, frames, solved, findings=findings, roughness=roughness.report, seconds=seconds)
        report["input"]["notes"] += notes
        write_report(staged, report)
        publish_asset(staged, [REPORT_NAME, OVERVIEW_NAME, *(path.name for path in layers)], out)
    return RunResult(out / ASSET_NAME, out / OVERVIEW_NAME, relightable, light.environment, report)


def _described(options: RunOptions, images: CaptureImages | None, *, is_cuda: bool) -> str:
    """Return the code and the options that stored results depend on; input and light are not among them."""
    source = options.roughness
    files = [source.texture, source.mesh] if isinstance(source, RoughnessTexture) else []
    return json.dumps(
        {
            "code": code_digest(),
            "device": "cuda" if is_cuda else "cpu",
            "options": options.as_dict(),
            "raster": None if images is None else asdict(images.raster),
            "evidence": ColorEvidence.ARRAYS,
            "files": [hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest() for path in files],
        },
        sort_keys=True,
    )
