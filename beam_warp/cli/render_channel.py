"""``beam render --channel``: one array of an asset as a picture, without light."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.checks import require_count
from beam_warp.cli.console import print_json, progress
from beam_warp.cli.drawing import raster_options
from beam_warp.cli.render_views import View, capture_views, still_camera
from beam_warp.device.arrays import resolve_device
from beam_warp.image.files import write_exr, write_png
from beam_warp.render.channels import OBSERVABILITY, channel_range, see_channel
from beam_warp.stage.output import FramePattern, Still, numbered, parse_target, require_folder
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.metadata import numbers_of_frames

if TYPE_CHECKING:
    from beam_warp.cli.render import Render
    from beam_warp.raster.records import RasterOptions


def render_channel(args: Render) -> int:
    """Draw the channel of every frame that was asked for, and say what was written."""
    started = time.perf_counter()
    capture = None if args.capture is None else Capture.read(args.capture)
    sequence = converters.read(args.asset[0], source_axes=args.source_axes, drop_invalid=args.drop_invalid)
    if args.frame is not None:
        require_count("frame", args.frame, 0, len(sequence) - 1)
    options = raster_options(sequence.metadata, args.antialiased, args.low_pass)
    notes = [line for line in sequence.metadata.get("notes", "").splitlines() if line]
    if capture is not None:
        views = capture_views(args, capture, numbers_of_frames(sequence.metadata, len(sequence)), notes)
    else:
        views = _numbered_views(args, sequence)
    device = str(resolve_device(args.device))
    drawing, gaussian_count = _Channel(args, options), 0
    with progress(args.quiet or args.json) as report:
        for done, (view, cloud) in enumerate(_with_clouds(views, sequence), start=1):
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
        for note in notes:
            print(f"note: {note}", file=sys.stderr)
        last = f" … {views[-1].path.name}" if len(views) > 1 else ""
        images = f"{len(views)} images, " if len(views) > 1 else ""
        print(f"wrote {views[0].path}{last}: {images}{gaussian_count:,} Gaussians, {seconds:.2f} s")
        for line in drawing.lines():
            print(line)
    return 0


def _numbered_views(args: Render, sequence: GaussianSequence) -> list[View]:
    """Plan one image for each frame, all from one camera."""
    frames = range(len(sequence)) if args.frame is None else range(args.frame, args.frame + 1)
    camera = still_camera(args, frames, lambda frame: change_axes(sequence[frame], WORLD_AXES))
    target = parse_target(args.out)
    if isinstance(target, Still):
        if len(frames) == 1:
            return [View(frames[0], camera, args.out)]
        target = numbered(target)
    assert isinstance(target, FramePattern)
    require_folder(target)
    return [View(frame, camera, target.path(frame)) for frame in frames]


def _with_clouds(views: list[View], sequence: GaussianSequence) -> Iterator[tuple[View, GaussianCloud]]:
    """Give each view its cloud, frame by frame, so that each is read once and one is held at a time."""
    held, cloud = -1, None
    for view in views:
        if cloud is None or view.frame != held:
            held, cloud = view.frame, change_axes(sequence[view.frame], WORLD_AXES)
        yield view, cloud


class _Channel:
    """Draws one channel of the asset; all images have one range, that of the first."""

    def __init__(self, args: Render, options: RasterOptions) -> None:
        self._args = args
        self._options = options
        self._name = args.channel or ""
        self._range = args.range
        self._is_mapped = False
        self._shares: list[dict[str, float]] = []

    def draw(self, view: View, cloud: GaussianCloud) -> None:
        """Draw one image and write it."""
        seen = see_channel(cloud, view.camera, self._name, options=self._options, device=self._args.device)
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
        """Return what JSON says of it besides: the range of numbers, or the flags' shares of what is seen."""
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
