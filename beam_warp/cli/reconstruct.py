"""``beam reconstruct``: from a multi-view capture to a Gaussian sequence, from the command line."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp.capture.capture import Capture
from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import Device, Json, Quiet, Seed, Workers
from beam_warp.cli.common.pages import SECOND_PAGE
from beam_warp.cli.common.targets import TargetFlags, state
from beam_warp.errors import InvalidOptionError
from beam_warp.plan.crew import AUTO, crew_of
from beam_warp.study.table import Settings
from beam_warp.study.targets import Rung, Target, cheapest, climbed, fitted, in_words
from beam_warp.world.environment import EnvironmentMap

if TYPE_CHECKING:
    from beam_warp.reconstruction.frames.protocols import FrameSteps
    from beam_warp.reconstruction.job import ReconstructOptions

USUAL_PRESET = "fast"

PILOTS = 3
"""Settings that are tried where no error is asked."""


@dataclass(frozen=True)
class Modelling:
    """How a capture is modelled; the same words in every command that does."""

    gaussians: Annotated[int | None, arg(metavar="N", help="Most Gaussians of a frame; the preset's by default.")] = (
        None
    )
    preset: Annotated[
        Literal["fast", "draft", "paper", "rade"] | None,
        arg(help="Schedule: ours (the default), few steps (for a CPU), the paper's 7,000 + 5,000, or like RaDe-GS's."),
    ] = None
    segment_length: Annotated[
        int, arg(metavar="K", help="Frames from one key frame to the next, which workers share out; 0 for one segment.")
    ] = 0
    seam_frames: Annotated[
        int,
        arg(metavar="N", help="Frames in which a segment fades into the next one; each is tracked twice."),
        SECOND_PAGE,
    ] = 2
    cameras: Annotated[
        Literal["refine", "keep"],
        arg(help="Correct cameras that are beyond doubt wrong, or keep all as the capture states them."),
        SECOND_PAGE,
    ] = "refine"
    masks: Annotated[
        Literal["refine", "keep"],
        arg(help="Move masks of cut-outs that are beyond doubt wrong, or keep all as they are."),
        SECOND_PAGE,
    ] = "refine"
    exposures: Annotated[
        Literal["match", "keep"],
        arg(help="Match exposures and white balances that differ beyond chance, or keep all as photographed."),
        SECOND_PAGE,
    ] = "match"
    frames: Annotated[
        str | None, arg(metavar="A:B", help="Frames A to B - 1 of the capture; A:B:S takes every S-th of them.")
    ] = None


@dataclass(frozen=True)
class Reconstruct:
    """Reconstruct a multi-view capture as Gaussians with captured colour, tracked over time.

    Writes OUT/gaussians.usda (+ layers), OUT/report.json, OUT/previews/frame_*.png and, as it goes, OUT/frames. A job
    that was stopped continues where it was when it is called again. Segments (--segment-length) are shared out among
    workers; `beam plan OUT` says how far they are.

    Example: beam reconstruct captures/walker --gaussians 20000 --out walker

    Example: beam reconstruct captures/walker --target-seconds 600 --out walker
    """

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE", help="Folder of a capture: images and cameras.")]
    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    modelling: OmitArgPrefixes[Modelling] = field(default_factory=Modelling)
    targets: OmitArgPrefixes[TargetFlags] = field(default_factory=TargetFlags)
    workers: Workers = AUTO
    seed: Seed = 0
    device: Device = None
    quiet: Quiet = False
    json: Json = False


def reconstruct(args: Reconstruct) -> int:
    """Reconstruct and say what came out."""
    started = time.perf_counter()
    capture = Capture.read(args.capture)
    crew = crew_of(args.workers, args.device)
    options, target, chosen = options_of(args.modelling, capture), args.targets.target, None
    light = None if capture.environment_path is None else EnvironmentMap.read(capture.environment_path)
    asked = Asked(capture, args.seed, args.device, light)

    from beam_warp.reconstruction.job import reconstruct as reconstruct_capture

    modelling = args.modelling
    with progress(args.quiet or args.json) as report:
        if target is not None:
            chosen = modelling_for(target, modelling, asked, started)
            modelling = with_modelling(modelling, chosen)
        steps = steps_of(modelling, capture, args.seed, args.device, light)
        result = reconstruct_capture(capture, args.out, steps, options, progress=report, crew=crew)
    if target is not None and chosen is not None:
        error, seconds = _error(result.report), time.perf_counter() - started
        reached = None if math.isnan(error) else error
        state(result.report, args.out, target, chosen, reached, len(result.report["frames"]), seconds)
    if args.json:
        print_json(result.report)
    elif not args.quiet:
        print_notes((), result.report["warnings"])
        print(f"wrote {result.asset}: {summary(result.report)}\nlook at {args.out / 'previews'}")
    return 0


def summary(report: dict[str, Any]) -> str:
    """Return what a reconstruction's report says, in a line."""
    frames = report["frames"]
    counts = sorted({entry["gaussians"] for entry in frames})
    words = [
        f"{len(frames)} frame{'' if len(frames) == 1 else 's'}",
        f"{len(report['segments'])} segment{'' if len(report['segments']) == 1 else 's'}",
        f"{counts[0]:,} Gaussians" if len(counts) == 1 else f"{counts[0]:,} to {counts[-1]:,} Gaussians",
    ]
    if report["mean_psnr"] is not None:
        lowest = report["lowest_psnr"]
        words.append(f"{report['mean_psnr']:.2f} dB, lowest {lowest['psnr']:.2f} dB at frame {lowest['frame']}")
    said = f"\n{in_words(report['target'])}" if "target" in report else ""
    return ", ".join([*words, f"{report['seconds']:.1f} s on {report['device']['name']}"]) + said


@dataclass(frozen=True)
class Asked:
    """All that a pilot of a reconstruction needs besides its words.

    Attributes:
        capture: Images and cameras.
        seed: Same seed, same result.
        device: Warp device; None for the first one.
        light: The light of the capture, if it is known.
    """

    capture: Capture
    seed: int
    device: str | None
    light: EnvironmentMap | None


def modelling_for(target: Target, modelling: Modelling, asked: Asked, started: float) -> Rung:
    """Choose Gaussians and schedule of a reconstruction that began at a time, by `time.perf_counter` [s].

    The first frame is fitted by settings that cost more and more, until one meets the target's error. Without an error,
    the costs of the cheapest three tell those of all: time falls on steps, and on Gaussians times steps. Where they
    take a pilot's part of the time, or one of them too long, no more is tried, and one of those that were is chosen.
    Where frames follow by tracking, the cheapest setting is tried with two of them.

    Raises:
        InvalidOptionError: The target cannot be reached.
    """
    from beam_warp.reconstruction.fit import FitOptions
    from beam_warp.reconstruction.frames.plan import plan_frames
    from beam_warp.reconstruction.job import reconstruct as reconstruct_capture

    plan = plan_frames(asked.capture, options_of(modelling, asked.capture).frames, modelling.segment_length)
    frames, keys = tuple(plan.records), len(plan.segments)
    ladder, folders = _ladder(modelling), count()
    # Drafts do not reflect a known light. The longer fits that they tell the costs of do, for most of their steps.
    as_long = {"reflect_until": FitOptions().reflect_until}

    def elapsed() -> float:
        return time.perf_counter() - started

    with TemporaryDirectory() as folder:

        def pilot(settings: Settings, few: tuple[int, ...], **fitting: float) -> tuple[float, float]:
            words, began = replace(modelling, **settings), time.perf_counter()
            steps = steps_of(words, asked.capture, asked.seed, asked.device, asked.light, **fitting)
            options = replace(options_of(modelling, asked.capture), frames=few)
            found = reconstruct_capture(asked.capture, Path(folder) / str(next(folders)), steps, options)
            return time.perf_counter() - began, _error(found.report)

        tracked = 0.0
        if target.seconds is not None or target.fps is not None:
            pilot(ladder[0], frames[:1], **as_long)  # compiles
            if len(frames) > keys:
                both, first = (pilot(ladder[0], frames[:number])[0] for number in (2, 1))
                tracked = max(both - first, 0.0) / first
        whole = keys + (len(frames) - keys) * tracked if tracked else len(frames)

        def rung(settings: Settings, seconds: float, error: float = math.nan) -> Rung:
            job = whole * seconds
            return Rung(settings=settings, seconds=job, frame_seconds=job / len(frames), error=error, spent=elapsed())

        def measure(settings: Settings, **fitting: float) -> Rung:
            return rung(settings, *pilot(settings, frames[:1], **fitting))

        if target.error is not None or len(ladder) <= PILOTS:
            return cheapest(climbed(ladder, measure, target, elapsed), target)
        # The next of these takes less than twice as long: it is begun as long as there is time at all.
        known = climbed(ladder[:PILOTS], partial(measure, **as_long), target, elapsed, growth=0.0)
        if len(known) < PILOTS:  # no time to learn what others cost
            return cheapest(known, target)

        def cost(settings: Settings) -> list[float]:
            fit = FitOptions.of_preset(str(settings["preset"]))
            steps = fit.color_iterations + fit.normal_iterations
            return [steps, steps * float(settings["gaussians"])]

        model = fitted([cost(one.settings) for one in known], [one.seconds / whole for one in known])
        return cheapest([rung(settings, float(model @ cost(settings))) for settings in ladder], target)


def _ladder(modelling: Modelling) -> list[Settings]:
    """Return what a target may choose of Gaussians and schedules, the cheapest first; what is stated stays."""
    from beam_warp.reconstruction.fit import FitOptions

    most, preset = FitOptions().gaussian_count, modelling.preset
    parts = [(16, "draft"), (8, "draft"), (4, "draft"), (4, "fast"), (2, "fast"), (1, "fast")]
    found = [
        {"gaussians": modelling.gaussians or most // part, "preset": preset or schedule} for part, schedule in parts
    ]
    return [settings for place, settings in enumerate(found) if settings not in found[:place]]


def with_modelling(modelling: Modelling, chosen: Rung) -> Modelling:
    """Return the words with what a target chose."""
    return replace(modelling, **chosen.settings)


def _error(report: dict[str, Any]) -> float:
    """Return the root mean square error of colour in the photographs."""
    return math.nan if report["mean_psnr"] is None else 10.0 ** (-report["mean_psnr"] / 20.0)


def steps_of(
    modelling: Modelling,
    capture: Capture,
    seed: int,
    device: str | None,
    environment: EnvironmentMap | None,
    **fitting: float,
) -> FrameSteps:
    """Return the steps that the words ask for, under a light that is known or not; some of `FitOptions` changed."""
    from beam_warp.reconstruction.fit import FitOptions
    from beam_warp.reconstruction.steps import FitAndTrack
    from beam_warp.reconstruction.track import TrackOptions

    asked: dict[str, Any] = {"seed": seed}
    if modelling.gaussians is not None:
        asked["gaussian_count"] = modelling.gaussians
    preset = modelling.preset or USUAL_PRESET
    tracking = TrackOptions.of_preset(preset)
    return FitAndTrack(
        fitting=FitOptions.of_preset(preset, **asked, **fitting),
        tracking=replace(tracking, refinement=replace(tracking.refinement, seed=seed)),
        points=capture.points(),
        environment=environment,
        device=device,
    )


def options_of(modelling: Modelling, capture: Capture) -> ReconstructOptions:
    """Return which frames are reconstructed, and in which segments."""
    from beam_warp.reconstruction.job import ReconstructOptions

    frames = None if modelling.frames is None else frames_of(modelling.frames, capture.frames)
    return ReconstructOptions(
        segment_length=modelling.segment_length,
        seam_frames=modelling.seam_frames,
        frames=frames,
        cameras=modelling.cameras,
        masks=modelling.masks,
        exposures=modelling.exposures,
    )


def frames_of(words: str, there: tuple[int, ...]) -> tuple[int, ...]:
    """Return the frames that ``A:B`` or ``A:B:S`` asks for; A, B and S may be left out.

    Raises:
        InvalidOptionError: It is no range, or no frame is in it.
    """
    try:
        low, high, step = [int(word) if word else None for word in words.split(":")] + [None] * (2 - words.count(":"))
    except ValueError:
        low, high, step = None, None, 0
    if ":" not in words or (step is not None and step < 1):
        raise InvalidOptionError(f"frames must be A:B or A:B:S, got {words}. Write 0:10 for the first ten.")
    first, end = there[0] if low is None else low, there[-1] + 1 if high is None else high
    found = [frame for frame in there if first <= frame < end][::step]
    if not found:
        raise InvalidOptionError(
            f"frames must hold some of the capture's {len(there)} from {there[0]} to {there[-1]}, got {words}. Widen "
            "the range."
        )
    return tuple(found)
