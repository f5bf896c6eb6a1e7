"""``beam render`` under a light: a stage, a renderer, images or a film, and what is said of them."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beam_warp.capture.capture import Capture
from beam_warp.checks import require_count
from beam_warp.cli.console import print_json, progress
from beam_warp.cli.drawing import raster_options
from beam_warp.cli.render_stage import Staged, staged
from beam_warp.cli.render_views import capture_views, image_size
from beam_warp.device.arrays import resolve_device
from beam_warp.image.video import INSTALL, VideoOptions, find_ffmpeg
from beam_warp.render.options import LAYERS, DeferredOptions
from beam_warp.render.path import PathOptions
from beam_warp.stage.frame_times import FrameTimes, frame_times
from beam_warp.stage.jobs import Frame, FrameRenderer, RenderJob, Tally
from beam_warp.stage.output import Film, FramePattern, Still, numbered, parse_target
from beam_warp.stage.pictures import BLACK, PictureOptions, PictureWriter
from beam_warp.stage.renderers import DeferredFrames, PathFrames
from beam_warp.world.metadata import numbers_of_frames

if TYPE_CHECKING:
    from beam_warp.cli.render import Render
    from beam_warp.stage.stage import Stage


@dataclass
class _Outcome:
    """What there is to say: the files, the frames that they show, and what was done."""

    outputs: list[Path]
    frames: list[int]
    tally: Tally
    notes: list[str] = field(default_factory=list)


def render_relit(args: Render) -> int:
    """Render what was asked for, and say what was written."""
    started = time.perf_counter()
    capture = None if args.capture is None else Capture.read(args.capture)
    given = staged(args, capture)
    stage = given.stage
    device = str(resolve_device(args.device))
    renderer, notes = _renderer(args, stage), []
    with progress(args.quiet or args.json) as report:
        job = RenderJob(stage, renderer, PictureWriter(_picture(args, notes)), report)
        if capture is not None:
            outcome = _render_capture(args, stage, capture, job, notes)
        else:
            outcome = _render_frames(args, given, job, notes)
    said = list(dict.fromkeys((*stage.notes, *notes)))
    _say(args, outcome, said, device, time.perf_counter() - started)
    return 0


def _renderer(args: Render, stage: Stage) -> FrameRenderer:
    """Make the renderer that was asked for; options that were not given are its own."""
    if args.mode == "path":
        given = {"samples": args.spp, "bounces": args.bounces, "target_error": args.target_error, "seed": args.seed}
        return PathFrames(PathOptions(**_stated({**given, "denoiser": args.denoise})), device=args.device)
    given = {"environment_shadows": args.environment_shadows, "bounces": args.bounces}
    options = DeferredOptions(
        layers=LAYERS if args.aov else (), **_stated({**given, "light_map_size": args.shadow_resolution})
    )
    raster = raster_options(stage.raster_metadata, args.antialiased, args.low_pass)
    return DeferredFrames(options, raster=raster, errors=args.aov, device=args.device)


def _stated(options: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _picture(args: Render, notes: list[str]) -> PictureOptions:
    """Return how images are shown; a film is never transparent."""
    background = args.background
    if background == "transparent" and args.capture is None and isinstance(parse_target(args.out), Film):
        background = BLACK
        notes.append("a film has no transparency: its background is black")
    return PictureOptions(view=args.view, exposure=args.exposure, background=background, layers=args.aov)


def _render_capture(args: Render, stage: Stage, capture: Capture, job: RenderJob, notes: list[str]) -> _Outcome:
    """Render every record of the split."""
    sequence = stage.assets[0].sequence
    if args.frame is not None:
        require_count("frame", args.frame, 0, len(sequence) - 1)
    views = capture_views(args, capture, numbers_of_frames(sequence.metadata, len(sequence)), notes)
    images = [
        (
            Frame(
                number=index,
                time=stage.time_of(view.frame),
                width=view.camera.width,
                height=view.camera.height,
                camera=view.camera,
            ),
            view.path,
        )
        for index, view in enumerate(views)
    ]
    tally = job.render_stills(images)
    return _Outcome([view.path for view in views], sorted({view.frame for view in views}), tally)


def _render_frames(args: Render, given: Staged, job: RenderJob, notes: list[str]) -> _Outcome:
    """Render one image, numbered ones, or a film."""
    times = _times(args, given)
    width, height = image_size(args)
    frames = [
        Frame(number=number, time=moment, width=width, height=height)
        for number, moment in zip(times.numbers, times.times, strict=True)
    ]
    target = parse_target(args.out)
    if isinstance(target, Still) and len(frames) == 1:
        return _Outcome([target.path], list(times.numbers), job.render_stills([(frames[0], target.path)]))
    if isinstance(target, Film):
        ffmpeg = find_ffmpeg()
        options = VideoOptions(frames_per_second=times.rate, **_stated({"crf": args.crf}))
        if ffmpeg is not None:
            tally = job.render_film(target, frames, options, ffmpeg=ffmpeg, overwrite=args.overwrite)
            return _Outcome([target.path], list(times.numbers), tally)
        target = target.instead
        notes.append(f"there is no ffmpeg to make {args.out.name}: its frames are {target}. For a film, {INSTALL}")
    pattern = target if isinstance(target, FramePattern) else numbered(target)
    tally = job.render_frames(pattern, frames, overwrite=args.overwrite)
    return _Outcome([pattern.path(number) for number in times.numbers], list(times.numbers), tally)


def _times(args: Render, given: Staged) -> FrameTimes:
    """Return which moments are rendered."""
    count, rate = given.frame_count, given.stage.rate
    if args.frame is not None:
        number = require_count("frame", args.frame, 0, count - 1)
        return FrameTimes((number,), (given.stage.time_of(number),), rate)
    return frame_times(count, rate, frames=args.frames, seconds=args.seconds, fps=args.fps, speed=args.speed)


def _say(args: Render, outcome: _Outcome, notes: list[str], device: str, seconds: float) -> None:
    """Print the result."""
    tally, outputs = outcome.tally, outcome.outputs
    if args.json:
        print_json(
            {
                "outputs": [str(path) for path in outputs],
                "frames": outcome.frames,
                "rendered": len(tally.rendered),
                "kept": len(tally.kept),
                "gaussian_count": tally.gaussian_count,
                "mode": args.mode,
                "device": device,
                "notes": notes,
                "seconds": round(seconds, 3),
            }
        )
        return
    if args.quiet:
        return
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    last = f" … {outputs[-1].name}" if len(outputs) > 1 else ""
    count = len(tally.rendered) + len(tally.kept)
    images = f"{count} images, " if count > 1 else ""
    kept = f"{len(tally.kept)} of them were there, " if tally.kept else ""
    gaussians = f"{tally.gaussian_count:,} Gaussians, " if tally.rendered else ""
    print(f"wrote {outputs[0]}{last}: {images}{kept}{gaussians}{seconds:.2f} s")
