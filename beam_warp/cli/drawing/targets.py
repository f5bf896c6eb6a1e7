"""Targets of ``beam render``: mode and settings by a pilot on one frame, and what was reached in all."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from beam_warp.cli.common.flags import stated
from beam_warp.cli.drawing.flags import DeferredFlags, Render
from beam_warp.image.metrics import root_mean_square
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.raster.records import RasterOptions
from beam_warp.render.options import UNSHADOWED, DeferredOptions
from beam_warp.render.pictures import PictureWriter
from beam_warp.stage.jobs import FrameContext, FrameRenderer
from beam_warp.study.relighting import TruePixels, covered_pixels, deferred_frame, noise_of, path_frame
from beam_warp.study.table import Settings
from beam_warp.study.targets import Rung, Target, cheapest, climbed, fitted
from beam_warp.world.shot import RenderedImage, Shot

DEFERRED_LADDER = ((1, 0, 0), (2, 0, 0), (3, 0, 0), (2, 4, 1), (2, 16, 2), (3, 16, 2), (3, 64, 2))
"""Samples, environment shadows and bounces that a target may choose, the cheapest first."""

PATH_PILOTS = (16, 64)
"""Samples of the pixels of a path tracer's pilot."""

PATH_LADDER = tuple(2**power for power in range(4, 17))
"""Samples a pixel that a target may choose: fewer than the pilots' are noisier than these predict."""


@dataclass(eq=False)
class Watched:
    """A renderer whose frames are timed, and judged when all are drawn.

    Attributes:
        renderer: Who draws.
        seconds: Time of each frame [s]; the first one's has what is done once.
        noises: Noise of each path-traced frame.
        last: The last frame.
    """

    renderer: FrameRenderer
    seconds: list[float] = field(default_factory=list)
    noises: list[float] = field(default_factory=list)
    last: tuple[Shot, RenderedImage, FrameContext] | None = None

    @property
    def decisive(self) -> tuple[Any, ...]:
        """What decides the images."""
        return self.renderer.decisive

    def draw(self, shot: Shot, context: FrameContext) -> RenderedImage:
        """Render one frame."""
        started = time.perf_counter()
        image = self.renderer.draw(shot, context)
        self.seconds.append(time.perf_counter() - started)
        if "standard_error" in image.layers:
            self.noises.append(noise_of(image))
        self.last = shot, image, context
        return image

    def reached(self, target: Target, raster: RasterOptions, device: Any, seconds: float) -> dict[str, float | None]:
        """Return what was reached in a command's time [s]: the error in pixels that the pilot did not look at."""
        error = None
        if self.noises:
            error = root_mean_square(self.noises)
        elif target.error is not None and self.last is not None:
            shot, image, _ = self.last
            error = TruePixels.traced(shot, raster, device, seed=1).error(image).value
        if target.fps is not None and self.last is not None and len(self.seconds) == 1:
            shot, _, context = self.last
            self.draw(replace(shot, cloud=shot.cloud.with_arrays()), context)
        later = self.seconds[1:]
        fps = len(later) / sum(later) if later else None
        return {"error": error, "seconds": seconds, "fps": fps}


@dataclass(frozen=True, eq=False)
class RenderPilot:
    """Everything that a pilot needs.

    Attributes:
        args: The words; what they state stays.
        shot_of: Returns the frame that is tried.
        frames: Number of images.
        writer: Writes them.
        raster: How splats are drawn.
        device: Warp device.
        elapsed: Returns the time since the command began [s].
    """

    args: Render
    shot_of: Callable[[], Shot]
    frames: int
    writer: PictureWriter
    raster: RasterOptions
    device: Any
    elapsed: Callable[[], float]

    def chosen(self, target: Target) -> Rung:
        """Choose mode and settings: deferred shading if that will do, or else, unless it is stated, path tracing.

        Raises:
            InvalidOptionError: The target cannot be reached.
        """
        started = time.perf_counter()
        shot, rungs, mode = self.shot_of(), list[Rung](), self.args.mode
        reading = time.perf_counter() - started
        if mode != "path":
            true = None if target.error is None else TruePixels.traced(shot, self.raster, self.device)
            rungs = climbed(self._deferred_ladder(), self._deferred(shot, true, reading), target, self.elapsed)
        is_open = mode is None and self.args.deferred == DeferredFlags() and target.error is not None
        if mode == "path" or (is_open and not any(map(target.meets, rungs))):
            rungs += self._path(shot, reading)
        return cheapest([replace(rung, spent=self.elapsed()) for rung in rungs], target)

    def _deferred_ladder(self) -> Iterator[Settings]:
        """Yield the settings of deferred shading; what is stated stays."""
        flags, names, seen = self.args.deferred, ("samples", "environment_shadows", "bounces"), set[tuple[int, ...]]()
        given = (flags.samples, flags.environment_shadows, self.args.bounces)
        for levels in DEFERRED_LADDER:
            some = tuple(level if own is None else own for level, own in zip(levels, given, strict=True))
            if some not in seen:
                seen.add(some)
                yield {"mode": "deferred", **dict(zip(names, some, strict=True))}

    def _deferred(self, shot: Shot, true: TruePixels | None, reading: float) -> Callable[[Settings], Rung]:
        """Return what measures a setting of deferred shading on a frame."""
        prepared = () if shot.environment is None else (PreparedEnvironment(shot.environment, self.device),)
        around, once = list[float](), 0.0
        for ready in (prepared, ()):  # the first one compiles, the second one tells what a job does once
            once = deferred_frame(shot, UNSHADOWED, self.raster, self.device, 0, ready)[1][0]

        def measure(settings: Settings) -> Rung:
            levels = {name: level for name, level in settings.items() if name != "mode"}
            more = stated(light_map_size=self.args.deferred.shadow_resolution)
            options = DeferredOptions(**levels, **more, layers=())  # type: ignore[arg-type]
            image, (_, *seconds) = deferred_frame(shot, options, self.raster, self.device, 2, prepared)
            if not around:
                around.append(reading + self._writing(shot, image))
            error = {} if true is None else {"error": true.error(image).high}
            return self._rung(settings, max(seconds), around[0], once, **error)

        return measure

    def _path(self, shot: Shot, reading: float) -> list[Rung]:
        """Return rungs of path tracing: two pilots at some pixels tell time and noise of any number of samples."""
        bounces = 4 if self.args.bounces is None else self.args.bounces
        pixels, covered = covered_pixels(shot, self.raster, self.device)
        squares, times, image = list[float](), list[float](), None
        for samples in PATH_PILOTS:
            image, seconds = path_frame(shot, pixels, covered, samples, bounces, self.device)
            squares.append(noise_of(image, pixels) ** 2)
            times.append(max(seconds))
        assert image is not None
        (noise,) = fitted([[1.0 / samples] for samples in PATH_PILOTS], squares)
        once, each = fitted([[1.0, samples] for samples in PATH_PILOTS], times)
        around, spp = reading + self._writing(shot, image), self.args.path.spp
        return [
            self._rung({"mode": "path", "spp": n}, once + each * n, around, error=float(noise / n) ** 0.5)
            for n in (PATH_LADDER if spp is None else (spp,))
        ]

    def _rung(self, settings: Settings, draw: float, around: float, once: float = 0.0, **error: float) -> Rung:
        return Rung(settings=settings, seconds=once + self.frames * (draw + around), frame_seconds=draw, **error)

    def _writing(self, shot: Shot, image: RenderedImage) -> float:
        """Return how long it takes to write an image [s]."""
        with TemporaryDirectory() as folder:
            started = time.perf_counter()
            suffix = ".exr" if self.args.camera.capture is not None else self.args.output.out.suffix.lower()
            self.writer.write(Path(folder) / f"frame{'.exr' if suffix == '.exr' else '.png'}", shot, image)
            return time.perf_counter() - started


def with_settings(args: Render, chosen: Rung) -> Render:
    """Return the words with what a target chose."""
    levels: dict[str, Any] = dict(chosen.settings)
    mode = levels.pop("mode")
    if mode == "path":
        return replace(args, mode=mode, path=replace(args.path, **levels))
    bounces = levels.pop("bounces")
    return replace(args, mode=mode, bounces=bounces, deferred=replace(args.deferred, **levels))
