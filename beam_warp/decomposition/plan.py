"""Record that the steps of the main job share once the light is known."""

from __future__ import annotations

from dataclasses import dataclass

from beam_warp.decomposition.archive import FrameArchive
from beam_warp.decomposition.capture_light import CaptureLight
from beam_warp.decomposition.source import Source


@dataclass(frozen=True, eq=False, kw_only=True)
class JobPlan:
    """Input and light of a job.

    Attributes:
        source: The frames, and how they are measured.
        light: The light of the capture.
        archive: Finished frames.
    """

    source: Source
    light: CaptureLight
    archive: FrameArchive
