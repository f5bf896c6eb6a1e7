"""Protocols of a reconstruction: the steps that find the Gaussians of frames, and listeners to progress."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Protocol

from numpy.typing import NDArray

from beam_warp.capture.corrections import RigCorrection
from beam_warp.capture.exposures import RigExposures
from beam_warp.capture.mask_corrections import MaskCorrections
from beam_warp.capture.views import CapturedView
from beam_warp.raster.records import RasterOptions
from beam_warp.world.gaussians import GaussianCloud


class StepProgress(Protocol):
    """Hears how far the iterations of a frame are."""

    def __call__(self, done: int, total: int, facts: Mapping[str, float] = MappingProxyType({})) -> None:
        """Take ``done`` of ``total`` iterations; of the facts, ``psnr`` [dB] and ``gaussians`` are shown."""


class FrameTrack(Protocol):
    """The state of tracking in one frame: what the next frame needs of it."""

    @property
    def cloud(self) -> GaussianCloud:
        """This frame's Gaussians: axes "rfu", scene-linear radiance, ids in [0, 2^32) that persist in a segment."""
        ...

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything, so that `FrameSteps.restore` gives the same track again."""
        ...


class FrameSteps(Protocol):
    """Steps that find the Gaussians of a frame; the same input gives the same bits.

    Reports are JSON-able. Their ``psnr`` and ``gaussians`` are shown and summed up. The report of a tracked frame says
    in ``lost`` why tracking is lost; the text is empty if it is not. ``findings`` holds the findings about the frame,
    each as the fields of a `beam_warp.capture.findings.Finding`. Every entry must be repeatable but ``seconds``, which
    is not kept.
    """

    @property
    def device(self) -> str | None:
        """Warp device; None takes the first CUDA device, or the CPU."""
        ...

    @property
    def raster(self) -> RasterOptions | None:
        """Raster options of the splats; None for the defaults."""
        ...

    def options(self) -> Mapping[str, Any]:
        """Return all that results depend on, but for the device; JSON-able."""
        ...

    def mend_masks(
        self, names: Sequence[str], views: Sequence[CapturedView], progress: StepProgress
    ) -> MaskCorrections:
        """Find how far the masks of the cameras that have these names and took these views are off."""
        ...

    def refine_rig(
        self, names: Sequence[str], views: Sequence[CapturedView], progress: StepProgress
    ) -> RigCorrection | None:
        """Find what is wrong with the cameras that these names have and took these views; None for nothing to say."""
        ...

    def find_exposures(
        self, names: Sequence[str], views: Sequence[CapturedView], progress: StepProgress
    ) -> RigExposures | None:
        """Find exposures and white balances of the cameras that took these views; None for nothing to say."""
        ...

    def begin(self, views: Sequence[CapturedView], progress: StepProgress) -> tuple[FrameTrack, dict[str, Any]]:
        """Fit a key frame from its images alone."""
        ...

    def advance(
        self, track: Any, views: Sequence[CapturedView], progress: StepProgress
    ) -> tuple[FrameTrack, dict[str, Any]]:
        """Track the frame after."""
        ...

    def restore(self, arrays: dict[str, NDArray[Any]]) -> FrameTrack:
        """Return the track whose `FrameTrack.arrays` these are."""
        ...
