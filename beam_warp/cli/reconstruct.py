"""``beam reconstruct``: from a multi-view capture to a Gaussian sequence, from the command line."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp.capture.capture import Capture
from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import Device, Json, Quiet, Seed, Workers
from beam_warp.cli.common.pages import SECOND_PAGE
from beam_warp.errors import InvalidOptionError
from beam_warp.world.environment import EnvironmentMap

if TYPE_CHECKING:
    from beam_warp.reconstruction.frames.protocols import FrameSteps
    from beam_warp.reconstruction.job import ReconstructOptions


@dataclass(frozen=True)
class Modelling:
    """How a capture is modelled; the same words in every command that does."""

    gaussians: Annotated[int | None, arg(metavar="N", help="Most Gaussians of a frame; the preset's by default.")] = (
        None
    )
    target_psnr: Annotated[
        float | None, arg(metavar="DB", help="Stop a fit here, or when more no longer pays, with fewer Gaussians.")
    ] = None
    preset: Annotated[
        Literal["fast", "draft", "paper", "rade"],
        arg(help="Schedule: ours, few steps (for a CPU), the paper's 7,000 + 5,000, or like RaDe-GS's."),
    ] = "fast"
    segment_length: Annotated[
        int, arg(metavar="K", help="Frames from one key frame to the next, which workers share out; 0 for one segment.")
    ] = 0
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
    """

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE", help="Folder of a capture: images and cameras.")]
    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    modelling: OmitArgPrefixes[Modelling] = field(default_factory=Modelling)
    workers: Workers = "1"
    seed: Seed = 0
    device: Device = None
    quiet: Quiet = False
    json: Json = False


def reconstruct(args: Reconstruct) -> int:
    """Reconstruct and say what came out."""
    capture = Capture.read(args.capture)
    options = options_of(args.modelling, capture)
    light = None if capture.environment_path is None else EnvironmentMap.read(capture.environment_path)
    steps = steps_of(args.modelling, capture, args.seed, args.device, light)

    from beam_warp.plan.crew import crew_of
    from beam_warp.reconstruction.job import reconstruct as reconstruct_capture

    crew = crew_of(args.workers, args.device)
    with progress(args.quiet or args.json) as report:
        result = reconstruct_capture(capture, args.out, steps, options, progress=report, crew=crew)
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
    return ", ".join([*words, f"{report['seconds']:.1f} s on {report['device']['name']}"])


def steps_of(
    modelling: Modelling, capture: Capture, seed: int, device: str | None, environment: EnvironmentMap | None
) -> FrameSteps:
    """Return the steps that the words ask for, under a light that is known or not."""
    from beam_warp.reconstruction.fit import FitOptions
    from beam_warp.reconstruction.steps import FitAndTrack
    from beam_warp.reconstruction.track import TrackOptions

    asked: dict[str, Any] = {"target_psnr": modelling.target_psnr, "seed": seed}
    if modelling.gaussians is not None:
        asked["gaussian_count"] = modelling.gaussians
    tracking = TrackOptions.of_preset(modelling.preset)
    return FitAndTrack(
        fitting=FitOptions.of_preset(modelling.preset, **asked),
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
