"""How the Gaussians of a frame are found: the first one from a visual hull, by fitting; the next ones by tracking."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.captured_views import CapturedView
from beam_warp.captures import SparsePoints
from beam_warp.gaussian_fitting import FitOptions, fit_gaussians
from beam_warp.initialization import initial_gaussians
from beam_warp.raster_records import RasterOptions
from beam_warp.reconstruction import StepProgress
from beam_warp.tracking import Track, TrackOptions, advance_track, begin_track


@dataclass(frozen=True, eq=False, kw_only=True)
class FitAndTrack:
    """The steps that `beam_warp.reconstruction.reconstruct` takes; see `beam_warp.reconstruction.FrameSteps`.

    Attributes:
        fitting: How key frames are fitted.
        tracking: How other frames follow from the one before. They are drawn as key frames are, and sampled as finely:
            its ``raster`` and its refinement's ``samples`` are not used.
        points: What is known of the surfaces before, for images without masks; None if nothing is.
        device: Warp device; None takes the first CUDA device, or the CPU.
    """

    fitting: FitOptions = field(default_factory=FitOptions)
    tracking: TrackOptions = field(default_factory=TrackOptions)
    points: SparsePoints | None = None
    device: str | None = None

    @property
    def raster(self) -> RasterOptions:
        """How splats are drawn."""
        return self.fitting.raster

    def options(self) -> Mapping[str, Any]:
        """Return all that results depend on, but for the device; JSON-able."""
        return {
            "fitting": asdict(self.fitting),
            "tracking": asdict(self.tracking),
            "points": None if self.points is None else _digest(self.points),
        }

    def begin(self, views: Sequence[CapturedView], progress: StepProgress) -> tuple[Track, dict[str, Any]]:
        """Fit a key frame from its images alone."""
        chosen = self.fitting
        known = None if all(view.alpha is not None for view in views) else self.points  # a visual hull says more
        start = initial_gaussians(
            views,
            chosen.gaussian_count,
            points=None if known is None else known.positions,
            point_colors=None if known is None else known.colors,
            device=self.device,
            seed=chosen.seed,
        )
        fit = fit_gaussians(views, start, chosen, device=self.device, progress=progress)
        return begin_track(fit.cloud, views, self._tracking(), device=self.device), dict(fit.report)

    def advance(
        self, track: Track, views: Sequence[CapturedView], progress: StepProgress
    ) -> tuple[Track, dict[str, Any]]:
        """Track the frame after."""
        return advance_track(track, views, self._tracking(), device=self.device, progress=progress)

    def _tracking(self) -> TrackOptions:
        """Return how frames follow a key frame that was fitted so: drawn otherwise, it would look worse than it is."""
        refinement = replace(self.tracking.refinement, samples=self.fitting.samples)
        return replace(self.tracking, raster=self.fitting.raster, refinement=refinement)

    def restore(self, arrays: dict[str, NDArray[np.generic]]) -> Track:
        """Return the track whose arrays these are."""
        return Track.from_arrays(arrays)


def _digest(points: SparsePoints) -> str:
    digest = hashlib.blake2b(np.ascontiguousarray(points.positions).tobytes(), digest_size=16)
    if points.colors is not None:
        digest.update(np.ascontiguousarray(points.colors).tobytes())
    return digest.hexdigest()
