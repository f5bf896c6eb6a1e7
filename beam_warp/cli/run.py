"""``beam run``: the main job from the command line, from Gaussians or all the way from a capture."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.checks import require_number, require_path
from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import Device, DropInvalid, Json, Keyed, MetersPerUnit, Quiet, Seed, SourceAxes, Workers
from beam_warp.cli.common.pages import SECOND_PAGE
from beam_warp.cli.common.targets import TargetFlags
from beam_warp.cli.decompose import (
    Measuring,
    Piloted,
    light_of,
    outcome,
    overview_options,
    rays_for,
    run_options,
    state_target,
    with_rays,
)
from beam_warp.cli.reconstruct import Asked, Modelling, modelling_for, options_of, steps_of, summary, with_modelling
from beam_warp.converters.numbering import SOG_NAMES, holds_gaussians
from beam_warp.errors import InvalidOptionError, MissingFileError
from beam_warp.plan.crew import AUTO, crew_of
from beam_warp.study.targets import Target
from beam_warp.world.environment import EnvironmentMap

RECONSTRUCTION_PART = 0.75
"""Part of the time that is asked for which a capture's reconstruction may take; materials get what is left."""

if TYPE_CHECKING:
    from beam_warp.decomposition.job import RunOptions
    from beam_warp.reconstruction.job import ReconstructionWork
    from beam_warp.world.gaussians import GaussianSequence


@dataclass(frozen=True)
class Run:
    """Decompose Gaussians with captured colour into a relightable asset; of a capture, reconstruct them first.

    Writes OUT/asset.usda (+ layers), OUT/report.json and OUT/overview.png; of a capture, also OUT/reconstruction with
    what `beam reconstruct` writes. A job that was stopped continues where it was when it is called again with the same
    input and options, by as many workers as there are; `beam plan OUT` says how far it is.

    Example: beam run person.compressed.ply --environment studio.hdr --out person

    Example: beam run captures/walker --gaussians 20000 --out walker

    Example: beam run person.ply --environment studio.hdr --target-seconds 60 --out person
    """

    input: Annotated[
        Positional[Path],
        arg(metavar="INPUT", help="File of Gaussians, a folder of numbered files, or the folder of a capture."),
    ]
    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    modelling: OmitArgPrefixes[Modelling] = field(default_factory=Modelling)
    measuring: OmitArgPrefixes[Measuring] = field(default_factory=Measuring)
    targets: OmitArgPrefixes[TargetFlags] = field(default_factory=TargetFlags)
    source_axes: Annotated[SourceAxes, SECOND_PAGE] = None
    meters_per_unit: Annotated[MetersPerUnit, SECOND_PAGE] = None
    persistent: Annotated[
        bool, arg(help="Row i is the same Gaussian in every frame: fit over all frames."), SECOND_PAGE
    ] = False
    fps: Annotated[float | None, arg(metavar="RATE", help="Frames per second; else the input's word, else 30.")] = None
    keyed: Annotated[Keyed, SECOND_PAGE] = False
    error_scale: Annotated[float, arg(metavar="X", help="With --keyed: multiply all bounds."), SECOND_PAGE] = 1.0
    workers: Workers = AUTO
    seed: Seed = 0
    drop_invalid: Annotated[DropInvalid, SECOND_PAGE] = False
    device: Device = None
    quiet: Quiet = False
    json: Json = False


def run(args: Run) -> int:
    """Run the job and say what came out; all that was asked is checked before the first frame is worked on."""
    started = time.perf_counter()
    capture = capture_at(args.input)
    _check_words(args, capture)
    written = converters.WriteOptions(keyed=args.keyed, error_scale=args.error_scale)
    light = light_of(args.measuring, capture, args.input)
    crew = crew_of(args.workers, args.device)
    environment = EnvironmentMap.read(light).rotated(args.measuring.rotate)
    if args.fps is not None:
        require_number("frames_per_second", args.fps, 1e-3, 1e6)

    from beam_warp.decomposition.frames import GivenFrames, ReconstructedFrames
    from beam_warp.decomposition.job import run_capture, run_materials
    from beam_warp.decomposition.work import MaterialWork
    from beam_warp.reconstruction.job import reconstruct as reconstruct_capture

    target = args.targets.target
    if target is not None and target.fps is not None and capture is not None:
        raise InvalidOptionError(
            f"target-fps must be left out for a capture, got {target.fps:g}: both its jobs take time. Give "
            "--target-seconds."
        )

    def options_for(measuring: Measuring) -> RunOptions:
        return run_options(
            measuring, capture, preset="direct", seed=args.seed, device=args.device, persistent=args.persistent
        )

    options, view, chosen = options_for(args.measuring), overview_options(args.measuring), None
    with progress(args.quiet or args.json) as report:
        if capture is None:
            given = GivenFrames(partial(_read, args), None)
            if target is not None:
                source = Piloted(given.sequence, None, environment, options_for)
                chosen = rays_for(target, args.measuring, source, len(given.numbers()), started)
                options = options_for(with_rays(args.measuring, chosen))
            work = MaterialWork(require_path("out", args.out), given, environment, options, report, written)
            result, reconstruction = run_materials(work, view, started, crew), None
        else:
            modelling = _modelling(args, capture, environment, started)
            frames = _frame_work(args, modelling, capture, environment)
            if target is not None:
                found = reconstruct_capture(
                    capture, frames.folder, frames.steps, frames.options, progress=report, crew=crew
                )
                source = Piloted(lambda: found.sequence, found.capture, environment, options_for)
                chosen = rays_for(target, args.measuring, source, len(found.sequence), started)
                options = options_for(with_rays(args.measuring, chosen))
            made = ReconstructedFrames(frames, args.fps)
            work = MaterialWork(args.out, made, environment, options, report, written)
            both = run_capture(frames, work, view, started, crew)
            result, reconstruction = both.result, both.reconstruction.report
    if target is not None and chosen is not None:
        state_target(result, target, chosen, started)
    if args.json:
        print_json(result.report if reconstruction is None else {**result.report, "reconstruction": reconstruction})
    elif not args.quiet:
        warnings = [] if reconstruction is None else reconstruction["warnings"]
        print_notes(result.report["input"]["notes"], [*warnings, *result.report["warnings"]])
        if reconstruction is not None:
            print(f"reconstructed {args.input}: {summary(reconstruction)}")
        print(outcome(result, time.perf_counter() - started))
    return 0


def capture_at(path: Path) -> Capture | None:
    """Return the capture at a path; None if there is none, but perhaps Gaussians."""
    if not (path.is_dir() or path.suffix == ".json") or path.name in SOG_NAMES:
        return None
    try:
        return Capture.read(path)
    except MissingFileError:
        if holds_gaussians(path) and not (path / "transforms.json").exists():
            return None
        raise


def _check_words(args: Run, capture: Capture | None) -> None:
    """Refuse words that do not go with the input."""
    if capture is None and args.modelling != Modelling():
        raise InvalidOptionError(
            "gaussians, preset, segment-length, seam-frames, cameras, masks, exposures and frames must be left out "
            f"unless the input is a capture, got {args.input}. Drop them."
        )
    if args.error_scale != 1.0 and not args.keyed:
        raise InvalidOptionError(
            f"error-scale must be left out without keyed, got {args.error_scale:g}, which nothing goes by. Add --keyed."
        )
    of_files = (args.source_axes, args.meters_per_unit, args.drop_invalid or None, args.persistent or None)
    if capture is not None and any(value is not None for value in of_files):
        raise InvalidOptionError(
            "source-axes, meters-per-unit, drop-invalid and persistent must be left out for a capture, whose Gaussians "
            f"are made here, got {args.input}. Drop them."
        )


def _read(args: Run) -> GaussianSequence:
    """Read the Gaussians that a command names."""
    sequence = converters.read(
        args.input, source_axes=args.source_axes, meters_per_unit=args.meters_per_unit, drop_invalid=args.drop_invalid
    )
    return sequence if args.fps is None else replace(sequence, frames_per_second=args.fps)


def _modelling(args: Run, capture: Capture, environment: EnvironmentMap, started: float) -> Modelling:
    """Return how the capture is modelled: within its part of the time, where one is asked for."""
    asked = args.targets.target_seconds
    if asked is None:
        return args.modelling
    target = Target(seconds=RECONSTRUCTION_PART * asked)
    source = Asked(capture, args.seed, args.device, environment)
    return with_modelling(args.modelling, modelling_for(target, args.modelling, source, started))


def _frame_work(args: Run, modelling: Modelling, capture: Capture, environment: EnvironmentMap) -> ReconstructionWork:
    from beam_warp.jobs.store import make_folders
    from beam_warp.reconstruction.job import ReconstructionWork

    steps = steps_of(modelling, capture, args.seed, args.device, environment)
    options = options_of(modelling, capture)
    make_folders(args.out)
    return ReconstructionWork.prepare(capture, args.out / "reconstruction", steps, options)
