"""Record that the steps of the main job share once the light is known."""

from __future__ import annotations

from dataclasses import dataclass

from beam_warp.jobs.progress import JobLog
from beam_warp.materials.options import RunOptions
from beam_warp.materials.steps.archive import FrameArchive
from beam_warp.materials.steps.capture_light import CaptureLight
from beam_warp.materials.steps.source import Source


@dataclass(frozen=True, eq=False, kw_only=True)
class JobPlan:
    """Input, light and options of a job.

    Attributes:
        source: The frames.
        light: The light of the capture.
        options: How frames are measured.
        persistent: Whether row i is the same Gaussian in every frame.
        key: Key of the code, the options and the light.
        archive: Finished frames.
        log: Told how far and how long steps take.
    """

    source: Source
    light: CaptureLight
    options: RunOptions
    persistent: bool
    key: str
    archive: FrameArchive
    log: JobLog
