"""Rendering of many images: which ones are missing, one after the other, and what an interruption leaves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from beam_warp.digests import code_digest
from beam_warp.errors import OutputError
from beam_warp.image.files import read_image
from beam_warp.image.video import VideoOptions, require_encoder, write_mp4
from beam_warp.jobs.listeners import CountProgress, NotedProgress
from beam_warp.render.pictures import PictureWriter
from beam_warp.stage.output import Film, FrameLog, FramePattern, Still, require_folder
from beam_warp.stage.shot_digests import ShotDigests
from beam_warp.stage.stage import Stage
from beam_warp.world.camera import Camera
from beam_warp.world.shot import RenderedImage, Shot


@dataclass(frozen=True)
class FrameContext:
    """Facts about a frame that a renderer may use besides the shot.

    Attributes:
        number: Number of the frame in its sequence.
        checkpoint: File in which the renderer may keep an unfinished image.
        report: Called with (samples done, samples at most) while a frame takes long.
    """

    number: int
    checkpoint: Path
    report: CountProgress


class FrameRenderer(Protocol):
    """Renders the frames of a sequence."""

    @property
    def decisive(self) -> tuple[Any, ...]:
        """Plain data that, with the shots, decides the images."""
        ...

    def draw(self, shot: Shot, context: FrameContext) -> RenderedImage:
        """Render one frame."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameRequest:
    """One image to render.

    Attributes:
        number: Number of the image in its sequence.
        time: Time on the stage [s].
        width: Width of the image [pixel].
        height: Height of the image [pixel].
        camera: Camera to use instead of the stage's own.
    """

    number: int
    time: float
    width: int
    height: int
    camera: Camera | None = None

    def shot(self, stage: Stage) -> Shot:
        """Return what is rendered."""
        shot = stage.shot(self.time, self.width, self.height)
        return shot if self.camera is None else replace(shot, camera=self.camera)


@dataclass(eq=False)
class RenderTally:
    """Images that a job rendered, and those that it kept.

    Attributes:
        rendered: Numbers of the frames that were rendered now, in order.
        kept: Numbers of the frames that were there already.
        gaussian_count: Largest number of Gaussians in an image that was rendered now.
    """

    rendered: list[int] = field(default_factory=list)
    kept: list[int] = field(default_factory=list)
    gaussian_count: int = 0


class RenderInterruptedError(KeyboardInterrupt):
    """Somebody stopped a render; its message says what is there and how to go on."""


class RenderJob:
    """Renders frames of a stage with one renderer into files of one kind."""

    def __init__(self, stage: Stage, renderer: FrameRenderer, writer: PictureWriter, report: NotedProgress) -> None:
        """Take the stage, the renderer, the writer of images, and a callback for progress."""
        self._stage, self._renderer, self._writer, self._report = stage, renderer, writer, report
        self._digests = ShotDigests(code_digest(), renderer.decisive, writer.options)

    def render_stills(self, images: Sequence[tuple[FrameRequest, Path]]) -> RenderTally:
        """Render single images, writing over what is there; frames in the order of time are read once.

        Raises:
            OutputError: One cannot be written.
            RenderInterruptedError: Interrupted; images are whole or not there.
        """
        tally = RenderTally()
        try:
            for frame, path in images:
                require_folder(Still(path))
                self._draw(frame, path, tally)
                self._report("render", len(tally.rendered), len(images))
        except KeyboardInterrupt as error:
            done = f"{len(tally.rendered)} of {len(images)} images are written"
            if any(_checkpoint(path).exists() for _, path in images):
                done += "; of the next one what is done is kept, and the same command goes on from there"
            raise RenderInterruptedError(done) from error
        return tally

    def render_frames(
        self, pattern: FramePattern, frames: Sequence[FrameRequest], *, overwrite: bool = False
    ) -> RenderTally:
        """Render numbered images; those that are there and of this render are kept.

        Raises:
            OutputError: Frames of another render are there and may not be overwritten, or one cannot be written.
            RenderInterruptedError: Interrupted; the same call goes on.
        """
        require_folder(pattern)
        log = FrameLog(pattern)
        planned = {frame.number: frame for frame in frames}
        with _resumable(str(pattern), tally := RenderTally(), len(planned)):
            compared = count(1)

            def digest_of(number: int) -> str:
                self._report("compare", next(compared), len(planned))
                return self._digests.of(self._shot(planned[number]))

            todo = log.missing(planned, digest_of, overwrite=overwrite)
            tally.kept = [number for number in planned if number not in set(todo)]
            self._report("render", len(tally.kept), len(planned))
            for number in todo:
                shot = self._shot(planned[number])
                log.write(
                    number,
                    self._digests.of(shot),
                    lambda path, number=number, shot=shot: self._draw(planned[number], path, tally, shot),
                )
                self._report("render", len(tally.kept) + len(tally.rendered), len(planned))
        return tally

    def render_film(
        self, film: Film, frames: Sequence[FrameRequest], options: VideoOptions, *, ffmpeg: str, overwrite: bool = False
    ) -> RenderTally:
        """Render the frames of a film beside it, and encode them when all are there.

        Raises:
            OutputError: There is a film and it may not be overwritten, or see `render_frames` and `write_mp4`.
            RenderInterruptedError: Interrupted; the same call goes on.
        """
        require_folder(film)
        if film.path.exists() and not overwrite:
            raise OutputError(
                f"out must be a new file, got {film.path}, which is there. Pass --overwrite, or choose another name."
            )
        require_encoder(ffmpeg)
        tally = self.render_frames(film.work, frames, overwrite=True)  # whatever lies there is ours
        with _resumable(str(film.path), tally, len(frames)):
            write_mp4(film.path, self._pictures(film.work, frames), options, ffmpeg=ffmpeg)
        film.discard_work()
        return tally

    def _pictures(self, work: FramePattern, frames: Sequence[FrameRequest]) -> Iterator[NDArray[np.uint8]]:
        """Read the frames of a film back."""
        for done, frame in enumerate(frames, start=1):
            yield np.rint(read_image(work.path(frame.number)).rgb() * 255.0).astype(np.uint8)
            self._report("encode", done, len(frames))

    def _shot(self, frame: FrameRequest) -> Shot:
        return frame.shot(self._stage)

    def _draw(self, frame: FrameRequest, path: Path, tally: RenderTally, shot: Shot | None = None) -> None:
        """Render an image and write it."""
        seen = self._shot(frame) if shot is None else shot
        total = len(tally.rendered) + len(tally.kept)
        context = FrameContext(
            frame.number,
            _checkpoint(path),
            lambda done, most: self._report("samples", done, most, f"image {total + 1}"),
        )
        self._writer.write(path, seen, self._renderer.draw(seen, context))
        tally.rendered.append(frame.number)
        tally.gaussian_count = max(tally.gaussian_count, len(seen.cloud))


def _checkpoint(path: Path) -> Path:
    """Return where a renderer keeps what is done of an image."""
    return path.with_name(f".{path.name}.checkpoint")


@contextmanager
def _resumable(name: str, tally: RenderTally, total: int) -> Iterator[None]:
    """Turn an interruption into words about what is there."""
    try:
        yield
    except KeyboardInterrupt as error:
        whole = len(tally.rendered) + len(tally.kept)
        raise RenderInterruptedError(
            f"{whole} of {total} images are whole in {name}; the same command goes on from there"
        ) from error
