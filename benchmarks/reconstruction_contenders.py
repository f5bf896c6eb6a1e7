"""The contenders of the reconstruction benchmark: the only place where it calls fitting, tracking and meshing.

Settings of others are ours run with their choices where these can be made here: they say what the choices are worth,
not how fast other people's programs are.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import trimesh
import warp as wp

from beam_warp.capture.capture import Capture
from beam_warp.capture.findings import Finding
from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device
from beam_warp.raster.records import RasterOptions
from beam_warp.stability.capture_cases.alterations import training_cameras
from beam_warp.stability.capture_cases.case import TRACKING_LOST, Detection, detections_of
from beam_warp.stability.captures import Reconstructed
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence


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
        name: In tables.
        steps: Fits and tracks; a track has its ``cloud``.
        mesh: Extracts the surface of a cloud as some cameras see it.
        options: How its Gaussians are drawn.
    """

    name: str
    steps: StepsLike
    mesh: Callable[[GaussianCloud, Sequence[Camera]], trimesh.Trimesh]
    options: RasterOptions | None = None


def ours(gaussian_count: int, device: str | None, **fitting: Any) -> Contender:
    """Return this package's reconstruction, with its defaults but for what is given."""
    return _of_preset("ours", "fast", gaussian_count, device, fitting)


def rade_gs_like(gaussian_count: int, device: str | None, iterations: int | None = None) -> Contender:
    """Return ours with RaDe-GS's choices; ``iterations`` in all, half of them with normals, if not the preset's."""
    changes: dict[str, Any] = {}
    if iterations is not None:
        changes = {"color_iterations": iterations // 2, "normal_iterations": iterations - iterations // 2}
    return _of_preset("RaDe-GS-like settings", "rade", gaussian_count, device, changes)


def _of_preset(name: str, preset: str, count: int, device: str | None, changes: dict[str, Any]) -> Contender:
    from beam_warp.mesh.extract import mesh_of_gaussians
    from beam_warp.reconstruction.fit import FitOptions
    from beam_warp.reconstruction.steps import FitAndTrack

    options = FitOptions.of_preset(preset, gaussian_count=count, **changes)
    return Contender(
        name,
        FitAndTrack(fitting=options, device=device),
        lambda cloud, cameras: mesh_of_gaussians(cloud, cameras, options=options.raster, device=device),
        options.raster,
    )


@dataclass(frozen=True)
class ModelledFrame:
    """A frame that a contender has reconstructed.

    Attributes:
        frame: Its number in the capture.
        cloud: Its Gaussians.
        seconds: From images in memory to Gaussians on the device's host.
        report: What the step said.
        samples: Side of the square of samples that a pixel was the mean of, in the key frame's fit.
    """

    frame: int
    cloud: GaussianCloud
    seconds: float
    report: dict[str, Any]
    samples: int


def follow(
    contender: Contender,
    capture: Capture,
    frames: Sequence[int],
    device: Any,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[ModelledFrame]:
    """Fit the first of some frames and track the others; reading images is not timed."""
    track, samples = None, 1
    for frame in frames:
        views = [record.view() for record in capture.select(split="train", frames=[frame])]
        started = time.perf_counter()
        if track is None:
            track, report = contender.steps.begin(views, _nobody)
            samples = int(report.get("samples", 1))
        else:
            track, report = contender.steps.advance(track, views, _nobody)
        if device.is_cuda:
            wp.synchronize_device(device)
        seconds = time.perf_counter() - started
        say(f"{contender.name}, frame {frame}: {len(track.cloud):,} Gaussians, {seconds:.1f} s")
        yield ModelledFrame(frame, track.cloud, seconds, report, samples)


def reconstruct_stressed(contender: Contender, device: str | None) -> Callable[[Capture], Reconstructed]:
    """Return what `beam_warp.stability.captures` tries: inspect, leave out what cannot be used, fit and track."""

    def reconstruct(capture: Capture) -> Reconstructed:
        from beam_warp.capture.inspect import require_reconstructable

        ready = require_reconstructable(capture)
        detections = list(
            detections_of((f for f in ready.fallbacks if f.severity != "note"), training_cameras(capture))
        )
        clouds, key_frames, track = [], [], None
        for index, frame in enumerate(ready.capture.frames):
            views = [record.view() for record in ready.capture.select(split="train", frames=[frame])]
            report: dict[str, Any] = {"lost": "start"}
            if track is not None:
                track, report = contender.steps.advance(track, views, _nobody)
                detections += _said(report, training_cameras(capture), frame)
            if report.get("lost"):
                track, report = contender.steps.begin(views, _nobody)
                detections += _said(report, training_cameras(capture), frame)
                key_frames.append(index)
            clouds.append(track.cloud)
        return Reconstructed(
            sequence=GaussianSequence.from_clouds(clouds),
            detections=detections,
            key_frames=key_frames,
            raster=contender.options,
        )

    resolve_device(device)
    return reconstruct


def _said(report: dict[str, Any], cameras: Sequence[str], frame: int) -> list[Detection]:
    """Return what a step noticed in a frame; a view that shows what is lost is not to blame for it."""
    said = detections_of((replace(Finding(**entry), what="") for entry in report.get("findings", [])), cameras)
    if report.get("lost") and not said:
        said = (Detection(TRACKING_LOST),)
    return [replace(detection, frame=frame) for detection in said]


def _nobody(done: int, total: int, facts: Any = None) -> None:
    """Report to nobody."""
