"""``beam render``: options, a stage, a renderer, a plan of images, and the images or the film of that plan."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from beam_warp.capture.capture import Capture
from beam_warp.checks import require_count
from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import raster_options, stated
from beam_warp.cli.drawing.checks import require_consistent
from beam_warp.cli.drawing.flags import Render
from beam_warp.cli.drawing.stage import staged
from beam_warp.cli.drawing.targets import RenderPilot, Watched, with_settings
from beam_warp.cli.drawing.views import capture_views, image_size
from beam_warp.device.arrays import resolve_device
from beam_warp.image.video import INSTALL, VideoOptions, find_ffmpeg
from beam_warp.outputs import require_apart
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import samples_of_images
from beam_warp.render.options import LAYERS, DeferredOptions
from beam_warp.render.path import PathOptions
from beam_warp.render.pictures import BLACK, PictureOptions, PictureWriter
from beam_warp.stage.frame_times import FrameTimes, frame_times
from beam_warp.stage.jobs import FrameRenderer, FrameRequest, RenderJob, RenderTally
from beam_warp.stage.output import Film, FramePattern, Still, numbered, parse_target
from beam_warp.stage.renderers import DeferredFrames, PathFrames
from beam_warp.stage.stage import Stage
from beam_warp.study.targets import in_words, outcome
from beam_warp.world.metadata import numbers_of_frames


@dataclass(frozen=True)
class RenderPlan:
    """Images to render, and the files that they go to.

    Attributes:
        requests: One for each image.
        frames: Numbers that the user is told.
        outputs: Files that the user is told: one for each image, or the film.
        target: Film, or names of numbered images; None for single images, which are written over.
        film: How a film is encoded.
        ffmpeg: Program that encodes it.
        notes: What the user should know.
    """

    requests: list[FrameRequest]
    frames: list[int]
    outputs: list[Path]
    target: Film | FramePattern | None = None
    film: VideoOptions = field(default_factory=VideoOptions)
    ffmpeg: str = ""
    notes: tuple[str, ...] = ()


def render(args: Render) -> int:
    """Render what was asked for, and say what was written."""
    require_consistent(args)
    started = time.perf_counter()
    capture = None if args.camera.capture is None else Capture.read(args.camera.capture)
    stage, frame_count = staged(args, capture)
    device, target, said = resolve_device(args.device), args.targets.target, None
    picture, notes = _picture(args)
    with progress(args.quiet or args.json) as report:
        plan = _plan(args, stage, frame_count) if capture is None else _plan_of_capture(args, stage, capture)
        require_apart(plan.outputs, "out")
        if args.mode != "path" and args.deferred.samples is None and target is None:
            side = _samples(args, stage, plan)
            args = replace(args, deferred=replace(args.deferred, samples=side))
        renderer = _renderer(args, stage)  # refuses what is out of range
        writer, raster = PictureWriter(picture), _raster(args, stage)
        if target is None:
            tally = _carry_out(plan, RenderJob(stage, renderer, writer, report), overwrite=args.output.overwrite)
        else:
            tried = plan.requests[len(plan.requests) // 2]
            pilot = RenderPilot(
                args=args,
                shot_of=lambda: tried.shot(stage),
                frames=len(plan.requests),
                writer=writer,
                raster=raster,
                device=device,
                elapsed=lambda: time.perf_counter() - started,
            )
            chosen = pilot.chosen(target)
            args = with_settings(args, chosen)
            watched = Watched(_renderer(args, stage))
            tally = _carry_out(plan, RenderJob(stage, watched, writer, report), overwrite=args.output.overwrite)
            reached = watched.reached(target, raster, device, time.perf_counter() - started)
            said = outcome(target, chosen, reached)
    notes = list(dict.fromkeys((*stage.notes, *notes, *plan.notes)))
    _say(args, plan, tally, notes, str(device), time.perf_counter() - started, said)
    return 0


def _raster(args: Render, stage: Stage) -> RasterOptions:
    """Return how splats are drawn."""
    return raster_options(stage.raster_metadata, args.deferred.antialiased, args.deferred.low_pass)


def _renderer(args: Render, stage: Stage) -> FrameRenderer:
    """Make the renderer that was asked for; options that were not given are its own."""
    if args.mode == "path":
        path = args.path
        options = stated(samples=path.spp, bounces=args.bounces, seed=path.seed, denoiser=path.denoise)
        return PathFrames(PathOptions(**options), device=args.device)
    flags, aov = args.deferred, args.output.aov
    options = stated(
        samples=flags.samples,
        bounces=args.bounces,
        environment_shadows=flags.environment_shadows,
        light_map_size=flags.shadow_resolution,
    )
    shading = DeferredOptions(layers=LAYERS if aov else (), **options)
    return DeferredFrames(shading, raster=_raster(args, stage), errors=aov, device=args.device)


def _samples(args: Render, stage: Stage, plan: RenderPlan) -> int:
    """Return how many samples a side a pixel has where nobody says: those of the stage's first moment, for all images.

    So they are the same whichever frames are asked for, and a film can be filled in later.
    """
    first = replace(plan.requests[0], time=0.0).shot(stage)
    cameras = [request.camera for request in plan.requests if request.camera is not None]
    return samples_of_images(first.cloud, cameras or [first.camera], _raster(args, stage))


def _picture(args: Render) -> tuple[PictureOptions, list[str]]:
    """Return how images are shown, and what is to be said of it: a film is never transparent."""
    output, notes = args.output, []
    background = output.background
    if background == "transparent" and args.camera.capture is None and isinstance(parse_target(output.out), Film):
        background = BLACK
        notes.append("a film has no transparency: its background is black")
    options = PictureOptions(view=output.view, exposure=output.exposure, background=background, layers=output.aov)
    return options, notes


def _plan_of_capture(args: Render, stage: Stage, capture: Capture) -> RenderPlan:
    """Plan an image for every record of the split."""
    sequence = stage.assets[0].sequence
    numbers = numbers_of_frames(sequence.metadata, len(sequence))
    split, frame, out = args.camera.split, args.time.frame, args.output.out
    views, notes = capture_views(capture, numbers, split=split, frame=frame, out=out, suffix="exr")
    requests = [
        FrameRequest(
            number=index,
            time=stage.time_of(view.frame),
            width=view.camera.width,
            height=view.camera.height,
            camera=view.camera,
        )
        for index, view in enumerate(views)
    ]
    frames = sorted({view.frame for view in views})
    return RenderPlan(requests, frames, [view.path for view in views], notes=tuple(notes))


def _plan(args: Render, stage: Stage, frame_count: int) -> RenderPlan:
    """Plan one image, numbered ones, or a film."""
    times = _times(args, stage, frame_count)
    width, height = image_size(args.camera)
    frames = list(times.numbers)
    requests = [
        FrameRequest(number=number, time=moment, width=width, height=height)
        for number, moment in zip(times.numbers, times.times, strict=True)
    ]
    out, notes = args.output.out, []
    target = parse_target(out)
    if isinstance(target, Still) and len(requests) == 1:
        return RenderPlan(requests, frames, [target.path])
    if isinstance(target, Film):
        film, ffmpeg = VideoOptions(frames_per_second=times.rate, **stated(crf=args.output.crf)), find_ffmpeg()
        if ffmpeg is not None:
            return RenderPlan(requests, frames, [target.path], target, film, ffmpeg)
        target = target.instead
        notes.append(f"there is no ffmpeg to make {out.name}: its frames are {target}. For a film, {INSTALL}")
    pattern = target if isinstance(target, FramePattern) else numbered(target)
    outputs = [pattern.path(number) for number in frames]
    return RenderPlan(requests, frames, outputs, pattern, notes=tuple(notes))


def _times(args: Render, stage: Stage, frame_count: int) -> FrameTimes:
    """Return which moments are rendered."""
    asked = args.time
    if asked.frame is not None:
        number = require_count("frame", asked.frame, 0, frame_count - 1)
        return FrameTimes((number,), (stage.time_of(number),), stage.rate)
    return frame_times(
        frame_count, stage.rate, frames=asked.frames, seconds=asked.seconds, fps=asked.fps, speed=asked.speed
    )


def _carry_out(plan: RenderPlan, job: RenderJob, *, overwrite: bool) -> RenderTally:
    """Render the images of a plan, and encode its film."""
    if plan.target is None:
        return job.render_stills(list(zip(plan.requests, plan.outputs, strict=True)))
    if isinstance(plan.target, Film):
        return job.render_film(plan.target, plan.requests, plan.film, ffmpeg=plan.ffmpeg, overwrite=overwrite)
    return job.render_frames(plan.target, plan.requests, overwrite=overwrite)


def _say(
    args: Render,
    plan: RenderPlan,
    tally: RenderTally,
    notes: list[str],
    device: str,
    seconds: float,
    target: dict[str, Any] | None,
) -> None:
    """Print the result."""
    outputs = plan.outputs
    if args.json:
        print_json(
            {
                "outputs": [str(path) for path in outputs],
                "frames": plan.frames,
                "rendered": len(tally.rendered),
                "kept": len(tally.kept),
                "gaussian_count": tally.gaussian_count,
                "mode": args.mode or "deferred",
                "device": device,
                "notes": notes,
                "seconds": round(seconds, 3),
                **({} if target is None else {"target": target}),
            }
        )
        return
    if args.quiet:
        return
    print_notes(notes)
    last = f" … {outputs[-1].name}" if len(outputs) > 1 else ""
    count = len(tally.rendered) + len(tally.kept)
    images = f"{count} images, " if count > 1 else ""
    kept = f"{len(tally.kept)} of them were there, " if tally.kept else ""
    gaussians = f"{tally.gaussian_count:,} Gaussians, " if tally.rendered else ""
    print(f"wrote {outputs[0]}{last}: {images}{kept}{gaussians}{seconds:.2f} s")
    if target is not None:
        print(in_words(target))
