"""Ways to reconstruct: the only place where benchmarks call fitting, tracking and meshing.

Others' choices are made in our code where it has them: that says what the choices are worth, not how fast or how good
other people's programs are.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import trimesh
import warp as wp
from parts import say

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.capture.views import CapturedView
from beam_warp.jobs.listeners import no_progress
from beam_warp.mesh.extract import mesh_of_gaussians
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.steps import FitAndTrack
from beam_warp.reconstruction.track import TrackOptions
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.metadata import capture_frames_metadata

READING_THREADS = 8
"""Images that are decoded at a time, as in a job."""


class StepsLike(Protocol):
    """Steps that find the Gaussians of a frame; see `beam_warp.reconstruction.frames.protocols.FrameSteps`."""

    def begin(self, views: Sequence[CapturedView], progress: Any) -> tuple[Any, dict[str, Any]]:
        """Fit a key frame."""
        ...

    def advance(self, track: Any, views: Sequence[CapturedView], progress: Any) -> tuple[Any, dict[str, Any]]:
        """Track the frame after."""
        ...


@dataclass(frozen=True)
class Contender:
    """One way to reconstruct.

    Attributes:
        steps: Fits and tracks; a track has its ``cloud``.
        mesh: Extracts the surface of a cloud as some cameras see it.
        options: How its Gaussians are drawn.
    """

    steps: StepsLike
    mesh: Callable[[GaussianCloud, Sequence[Camera]], trimesh.Trimesh]
    options: RasterOptions | None = None


def ours(gaussian_count: int, device: str | None, **fitting: Any) -> Contender:
    """Return this package's reconstruction, with its defaults but for what is given."""
    return of_options(FitOptions(gaussian_count=gaussian_count, **fitting), device)


def of_options(fitting: FitOptions, device: str | None, tracking: TrackOptions | None = None) -> Contender:
    """Return the way of some options."""
    return Contender(
        FitAndTrack(fitting=fitting, tracking=tracking or TrackOptions(), device=device),
        lambda cloud, cameras: mesh_of_gaussians(cloud, cameras, options=fitting.raster, device=device),
        fitting.raster,
    )


@dataclass(frozen=True)
class ModelledFrame:
    """A frame that a contender has reconstructed.

    Attributes:
        frame: Its number in the capture.
        track: What the next frame follows from; its ``cloud`` are the Gaussians.
        seconds: From images in memory to Gaussians in the host's memory.
        report: What the step said.
        samples: Side of the square of samples that a pixel was the mean of.
    """

    frame: int
    track: Any
    seconds: float
    report: dict[str, Any]
    samples: int

    @property
    def cloud(self) -> GaussianCloud:
        """The frame's Gaussians."""
        return self.track.cloud


def follow(
    contender: Contender, capture: Capture, frames: Sequence[int], device: Any, *, track: Any = None
) -> Iterator[ModelledFrame]:
    """Fit the first of some frames, unless there is a track already, and track the others; reading is not timed.

    Ours is told the capture's light, as jobs tell it.
    """
    steps = contender.steps
    if isinstance(steps, FitAndTrack) and capture.environment_path is not None:
        steps = replace(steps, environment=EnvironmentMap.read(capture.environment_path))
    for frame in frames:
        views = _read(capture, frame)
        started = time.perf_counter()
        if track is None:
            track, report = steps.begin(views, no_progress)
        else:
            track, report = steps.advance(track, views, no_progress)
        if device.is_cuda:
            wp.synchronize_device(device)
        seconds = time.perf_counter() - started
        del views  # the images of a frame are not kept while it is scored, nor while the next ones are read
        say(f"{capture.folder.name}, frame {frame}: {len(track.cloud):,} Gaussians, {seconds:.1f} s")
        yield ModelledFrame(frame, track, seconds, report, int(report.get("samples", 1)))


def _read(capture: Capture, frame: int) -> list[CapturedView]:
    with ThreadPoolExecutor(READING_THREADS) as pool:
        return list(pool.map(lambda record: record.view(), capture.select(split="train", frames=[frame])))


def write_sequence(path: Path, capture: Capture, modelled: Sequence[ModelledFrame], options: RasterOptions) -> None:
    """Write reconstructed frames as an asset, as a job does: drawn as they were fitted, frames numbered as captured."""
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {
        "radiance_meaning": "captured",
        "source_axes": WORLD_AXES,
        **options.as_metadata(),
        **capture_frames_metadata([entry.frame for entry in modelled]),
    }
    clouds = [replace(entry.cloud, axes=WORLD_AXES) for entry in modelled]
    rate = capture.frames_per_second or 30.0
    converters.write(GaussianSequence.from_clouds(clouds, frames_per_second=rate, metadata=metadata), path)
