"""The reconstruction that `beam stability` tries: the steps of `beam reconstruct` at two sizes."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from beam_warp.capture.capture import Capture
from beam_warp.capture.findings import Finding
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.frames.protocols import FrameSteps
from beam_warp.reconstruction.job import reconstruct
from beam_warp.reconstruction.steps import FitAndTrack
from beam_warp.reconstruction.track import TrackOptions
from beam_warp.stability.capture_cases.alterations import training_cameras
from beam_warp.stability.capture_cases.case import (
    CAMERA_EXPOSURE,
    FAST_MOTION,
    FEW_CAMERAS,
    FRAME_LACKS_CAMERAS,
    TRACKING_LOST,
    Detection,
    detections_of,
)
from beam_warp.stability.capture_cases.studio import StressStudio
from beam_warp.stability.captures import Reconstruct, Reconstructed
from beam_warp.world.gaussians import GaussianSequence

TOLD = {FRAME_LACKS_CAMERAS: "reconstructed from the cameras that there are", FEW_CAMERAS: "told", FAST_MOTION: "told"}
"""What is done about findings after which the input stays as it is."""


LEVELS = (4, 2, 1)
"""Reductions of small images: beyond them, motion is less than a pixel."""


@dataclass(frozen=True, kw_only=True)
class StressEffort:
    """How much is spent on each case.

    Attributes:
        size: Side of the images [pixel].
        camera_count: Training cameras.
        frame_count: Frames; more than three, as every third is tried too.
        samples: Paths per pixel.
        gaussian_count: Most Gaussians.
        fit: Steps of a key frame, without and with normals; None for the defaults.
        levels: Steps of the joints at each of `LEVELS`; None for the defaults.
        refinement: Steps of a tracked frame's Gaussians; None for the default.
    """

    size: int
    camera_count: int
    frame_count: int = 4
    samples: int = 16
    gaussian_count: int
    fit: tuple[int, int] | None = None
    levels: tuple[int, ...] | None = None
    refinement: int | None = None

    def studio(self, folder: Path, device: str | None) -> StressStudio:
        """Return where captures of this size come from."""
        return StressStudio(
            folder,
            frame_count=self.frame_count,
            camera_count=self.camera_count,
            size=self.size,
            samples=self.samples,
            device=device,
        )

    def steps(self, device: str | None) -> FitAndTrack:
        """Return how they are reconstructed."""
        fitting, tracking = FitOptions(gaussian_count=self.gaussian_count), TrackOptions()
        if self.fit is not None:
            fitting = replace(fitting, color_iterations=self.fit[0], normal_iterations=self.fit[1])
        if self.levels is not None:
            tracking = replace(tracking, joints=replace(tracking.joints, levels=LEVELS, iterations=self.levels))
        if self.refinement is not None:
            tracking = replace(tracking, refinement=replace(tracking.refinement, normal_iterations=self.refinement))
        return FitAndTrack(fitting=fitting, tracking=tracking, device=device)


QUICK = StressEffort(size=72, camera_count=10, gaussian_count=800, fit=(40, 40), levels=(10, 10, 20), refinement=20)
"""Minutes on two CPU cores: what is detected is found before or without long fits."""

LARGE = StressEffort(size=256, camera_count=16, frame_count=6, samples=64, gaussian_count=20_000)
"""The default schedule; minutes on a GPU, hours without."""


def reconstructing(steps: FrameSteps, folder: Path) -> Reconstruct:
    """Return what `beam_warp.stability.captures` tries: `beam_warp.reconstruction.job.reconstruct`, its report
    understood.

    Args:
        steps: How the Gaussians of a frame are found.
        folder: Where results are put while they are needed.
    """

    def run(capture: Capture) -> Reconstructed:
        with tempfile.TemporaryDirectory(dir=folder) as place:
            result = reconstruct(capture, Path(place) / "out", steps)
            clouds = [result.sequence[index] for index in range(len(result.sequence))]
        cameras = training_cameras(capture)
        frames = result.report["frames"]
        return Reconstructed(
            sequence=GaussianSequence.from_clouds(clouds),
            detections=detections_in(result.report, cameras),
            done=done_in(result.report, cameras),
            key_frames=[index for index, entry in enumerate(frames) if entry["kind"] == "key"],
            raster=steps.raster,
        )

    return run


def detections_in(report: Mapping[str, Any], cameras: Sequence[str]) -> tuple[Detection, ...]:
    """Return what the report of a reconstruction says was found: of the capture, then of its frames."""
    found = list(detections_of((Finding(**entry) for entry in report["findings"]), cameras))
    for entry in report["frames"]:
        # Of a frame, cameras are named in ``where``: a view that shows what is lost is not to blame for it.
        said = detections_of((replace(Finding(**finding), what="") for finding in entry["findings"]), cameras)
        if entry["lost"] and not said:
            said = (Detection(TRACKING_LOST),)
        found += [replace(detection, frame=entry["frame"]) for detection in said]
    return tuple(found)


def done_in(report: Mapping[str, Any], cameras: Sequence[str]) -> tuple[str, ...]:
    """Return what the report of a reconstruction says was done about it, in words."""
    absent = len(cameras) - report["input"]["cameras"]
    of_frames = {finding["code"] for entry in report["frames"] for finding in entry["findings"]}
    codes = [finding["code"] for finding in report["findings"]] + sorted(of_frames)
    done = [f"{absent} of {len(cameras)} cameras left out"] if absent else []
    done += ["exposure matched"] if CAMERA_EXPOSURE in of_frames else []
    done += [f"new key frame at {entry['frame']}" for entry in report["frames"] if entry["lost"]]
    return (*done, *dict.fromkeys(TOLD[code] for code in codes if code in TOLD))
