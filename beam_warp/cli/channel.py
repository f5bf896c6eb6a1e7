"""``beam channel``: one array of an asset as a picture, without light."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp.capture.capture import Capture
from beam_warp.checks import require_choice, require_count
from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import Device, Json, Quiet, ReadingFlags, notes_of
from beam_warp.cli.drawing.checks import kind_of, require_capture_folder, require_one_camera, require_place
from beam_warp.cli.drawing.flags import StillCameraFlags
from beam_warp.cli.drawing.views import PlannedView, capture_views, still_camera
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidOptionError
from beam_warp.image.files import write_exr, write_png
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import samples_of_images
from beam_warp.render.channels import DRAWABLE, OBSERVABILITY, channel_range, see_channel
from beam_warp.stage.output import IMAGE_SUFFIXES, FramePattern, Still, numbered, parse_target, require_folder
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.metadata import numbers_of_frames


@dataclass(frozen=True)
class DrawChannel:
    """Draw one array of an asset as a picture, without light: materials, their standard errors, flags.

    A .png shows colours as they are, numbers and standard errors by a colour map whose range is printed, and
    observability as the gravest flag of what each pixel sees, counted in the legend. An .exr holds the values. Several
    frames are numbered and share one camera and one range.

    With --capture, every test record of the capture is drawn into the folder --out as CAMERA_FRAME.png.

    Example: beam channel person.usdz base_color_error --out error.png

    Example: beam channel person.usdz observability --orbit 90 10 --frame 0 --out flags.exr
    """

    asset: Annotated[
        Positional[Path],
        arg(metavar="ASSET", help="File of Gaussians, a folder with asset.usda, or a folder of numbered files."),
    ]
    name: Annotated[
        Positional[str], arg(metavar="NAME", help="Array: base_color, roughness_error, observability, normals, ….")
    ]
    out: Annotated[
        Path, arg(metavar="FILE", help=".png or .exr; frames/%04d.png for numbers; a folder with --capture.")
    ]
    range: Annotated[
        tuple[float, float] | None,
        arg(metavar="LOW HIGH", help="Ends of the colour map; by default 0 and what most Gaussians are below."),
    ] = None
    samples: Annotated[
        int | None,
        arg(metavar="N", help="A pixel is the mean of N x N samples; by default as many as fits take, 2 at least."),
    ] = None
    frame: Annotated[int | None, arg(metavar="N", help="Only this frame, counted from 0; all by default.")] = None
    camera: OmitArgPrefixes[StillCameraFlags] = field(default_factory=StillCameraFlags)
    reading: OmitArgPrefixes[ReadingFlags] = field(default_factory=ReadingFlags)
    device: Device = None
    quiet: Quiet = False
    json: Json = False


def channel(args: DrawChannel) -> int:
    """Draw the channel of every frame that was asked for, and say what was written."""
    _require_consistent(args)
    started = time.perf_counter()
    capture = None if args.camera.capture is None else Capture.read(args.camera.capture)
    sequence = args.reading.read(args.asset)
    options = args.reading.raster(sequence)
    notes = notes_of(sequence)
    if capture is None:
        views = _numbered_views(args, sequence)
    else:
        numbers = numbers_of_frames(sequence.metadata, len(sequence))
        views, left_out = capture_views(
            capture, numbers, split=args.camera.split, frame=args.frame, out=args.out, suffix="png"
        )
        notes += left_out
    device = str(resolve_device(args.device))
    drawing, gaussian_count = _ChannelDrawing(args, options), 0
    cloud_of = lru_cache(1)(lambda frame: change_axes(sequence[frame], WORLD_AXES))  # each is read once, one is held
    with progress(args.quiet or args.json) as report:
        for done, view in enumerate(views, start=1):
            cloud = cloud_of(view.frame)
            drawing.draw(view, cloud)
            gaussian_count = max(gaussian_count, len(cloud))
            report("render", done, len(views))
    seconds = time.perf_counter() - started
    if args.json:
        print_json(
            {
                "outputs": [str(view.path) for view in views],
                "frames": sorted({view.frame for view in views}),
                "gaussian_count": gaussian_count,
                "device": device,
                "notes": notes,
                **drawing.facts(),
                "seconds": round(seconds, 3),
            }
        )
    elif not args.quiet:
        print_notes(notes)
        last = f" … {views[-1].path.name}" if len(views) > 1 else ""
        images = f"{len(views)} images, " if len(views) > 1 else ""
        print(f"wrote {views[0].path}{last}: {images}{gaussian_count:,} Gaussians, {seconds:.2f} s")
        for line in drawing.lines():
            print(line)
    return 0


def _require_consistent(args: DrawChannel) -> None:
    """Refuse options that contradict each other, and an output that cannot be written."""
    require_one_camera(args.camera)
    require_choice("channel", args.name, DRAWABLE)
    if args.range is not None and not args.range[0] < args.range[1]:
        raise InvalidOptionError(f"range must be two numbers, the lower one first, got {args.range}. Swap them.")
    if args.camera.capture is not None:
        require_capture_folder(args.camera, args.out)
        return
    target = parse_target(args.out)
    if kind_of(target) not in IMAGE_SUFFIXES:
        raise InvalidOptionError(f"out must end in .png or .exr for a channel, got {args.out.name}. Rename it.")
    require_place(target)


def _numbered_views(args: DrawChannel, sequence: GaussianSequence) -> list[PlannedView]:
    """Plan one image for each frame, all from one camera."""
    frames = range(len(sequence))
    if args.frame is not None:
        frames = range(args.frame, require_count("frame", args.frame, 0, len(sequence) - 1) + 1)
    camera = still_camera(args.camera, frames, lambda frame: change_axes(sequence[frame], WORLD_AXES))
    target = parse_target(args.out)
    if isinstance(target, Still):
        if len(frames) == 1:
            require_folder(target)
            return [PlannedView(frames[0], camera, args.out)]
        target = numbered(target)
    assert isinstance(target, FramePattern)
    require_folder(target)
    return [PlannedView(frame, camera, target.path(frame)) for frame in frames]


class _ChannelDrawing:
    """Draws one channel of the asset; all images have one range and as many samples a pixel, those of the first."""

    def __init__(self, args: DrawChannel, options: RasterOptions) -> None:
        self._args = args
        self._options = options
        self._name = args.name
        self._range = args.range
        self._samples = args.samples
        self._is_mapped = False
        self._shares: list[dict[str, float]] = []

    def draw(self, view: PlannedView, cloud: GaussianCloud) -> None:
        """Draw one image and write it."""
        if self._samples is None:
            self._samples = samples_of_images(cloud, [view.camera], self._options)
        seen = see_channel(
            cloud, view.camera, self._name, samples=self._samples, options=self._options, device=self._args.device
        )
        self._is_mapped = seen.is_mapped
        if self._range is None:
            self._range = channel_range(cloud, self._name)
        if self._name == OBSERVABILITY:
            self._shares.append(seen.flag_shares())
        if view.path.suffix.lower() == ".png":
            write_png(view.path, seen.picture(self._range))
        else:
            write_exr(view.path, seen.layers())

    def facts(self) -> dict[str, Any]:
        """Return the facts for JSON: the range of numbers, or the flags' shares of what is seen."""
        said: dict[str, Any] = {"channel": self._name}
        if self._shares:
            said["flags"] = {word: float(np.mean([image[word] for image in self._shares])) for word in self._shares[0]}
        elif self._is_mapped and self._range is not None:
            said["range"] = list(self._range)
        return said

    def lines(self) -> list[str]:
        """Return the same in words."""
        said = self.facts()
        if "flags" in said:
            return [f"{self._name}: " + ", ".join(f"{word} {share:.1%}" for word, share in said["flags"].items())]
        return [f"{self._name}: {said['range'][0]:g} (dark) to {said['range'][1]:g}"] if "range" in said else []
