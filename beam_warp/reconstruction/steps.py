"""Steps that find the Gaussians of a frame: a key frame by fitting from its visual hull, the next ones by tracking."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from beam_warp.capture.capture import SparsePoints
from beam_warp.capture.corrections import RigCorrection
from beam_warp.capture.exposures import RigExposures
from beam_warp.capture.findings import Finding
from beam_warp.capture.mask_corrections import MaskCorrections
from beam_warp.capture.views import CapturedView
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.fit import PLENTY, FitOptions, fit_gaussians
from beam_warp.reconstruction.frames.protocols import StepProgress
from beam_warp.reconstruction.gains import ViewGains, judge_gains, matched, view_gains
from beam_warp.reconstruction.initial import initial_gaussians
from beam_warp.reconstruction.joints.image_motion import motion_in_pixels
from beam_warp.reconstruction.masks import mend_masks
from beam_warp.reconstruction.photometry import find_exposures, may_compare
from beam_warp.reconstruction.rig import refine_rig
from beam_warp.reconstruction.track import Track, TrackOptions, advance_track, begin_track, outward_normals
from beam_warp.reconstruction.unmasked import agreed_discs, seen_in_common, unmasked_gaussians
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud

COMPARED = 16_384
"""Most points of the surface of photographs without masks at which exposures are compared; a quarter counts, the
smoothest."""

MOST_UNPAIRED = 0.5
"""Part of the Gaussians seen by fewer than two views above which there is a finding: most of the surface."""

DOUBTFUL_TEAR = 0.005
"""Part of the joints that are torn above which there is a finding: where a limb was missed, the fit of the Gaussians
repaints it, and images tell little."""

STRUCTURE_REACH = 5
"""Half a window of structural similarity [pixel]: a Gaussian farther from its place has no gradient towards it. At the
coarsest level of tracking a pixel is as many as its reduction."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FitAndTrack:
    """The steps that `beam_warp.reconstruction.job.reconstruct` takes: fit key frames, track the others.

    Attributes:
        fitting: How key frames are fitted.
        tracking: How other frames follow from the one before; drawn and compared as `fitting` says.
        points: Known points of the surfaces, for images without masks; None if there are none.
        environment: The light of the capture, by which gloss is told from exposures and from shape; None if it is not
            known.
        device: Warp device; None takes the first CUDA device, or the CPU.
    """

    fitting: FitOptions = field(default_factory=FitOptions)
    tracking: TrackOptions = field(default_factory=TrackOptions)
    points: SparsePoints | None = None
    environment: EnvironmentMap | None = None
    device: str | None = None
    _begun: list[tuple[Sequence[CapturedView], tuple[Track, dict[str, Any]]]] = field(default_factory=list, init=False)

    def __getstate__(self) -> dict[str, Any]:
        """Return what other processes need: no images, and nothing that was fitted."""
        return {**vars(self), "_begun": []}

    @property
    def raster(self) -> RasterOptions:
        """How splats are drawn."""
        return self.fitting.raster

    @property
    def _tracking(self) -> TrackOptions:
        return self.tracking.following(self.fitting)

    def options(self) -> Mapping[str, Any]:
        """Return all that results depend on, but for the device; JSON-able."""
        return {
            "fitting": asdict(self.fitting),
            "tracking": asdict(self._tracking),
            "points": None if self.points is None else _digest(self.points.positions, self.points.colors),
            "environment": None if self.environment is None else _digest(self.environment.radiance),
        }

    def mend_masks(
        self, names: Sequence[str], views: Sequence[CapturedView], progress: StepProgress
    ) -> MaskCorrections:
        """Find how far the masks of cut-outs are off, from what they show at one moment."""
        return mend_masks(names, views, self.fitting, device=self.device, progress=progress)

    def refine_rig(
        self, names: Sequence[str], views: Sequence[CapturedView], progress: StepProgress
    ) -> RigCorrection | None:
        """Find what is wrong with the cameras of a rig, from what they show at one moment."""
        return refine_rig(names, views, self.fitting, device=self.device, progress=progress)

    def find_exposures(
        self, names: Sequence[str], views: Sequence[CapturedView], progress: StepProgress
    ) -> RigExposures | None:
        """Find exposures and white balances of a rig, from what its cameras show at one moment.

        With masks and a known light, they are compared at a key frame's surface. It is kept: where nothing is undone,
        the frame begins with the same. Without masks, they are compared where photographs agree on a surface.
        """
        if not may_compare(views):
            return None
        if views[0].alpha is None:
            compared = min(COMPARED, self.fitting.gaussian_count)
            surface = agreed_discs(views, compared, device=self.device, seed=self.fitting.seed)
            if surface is None:
                return None
            return find_exposures(names, views, surface, _faces(surface), self.environment, device=self.device)
        if self.environment is None:
            return None
        begun = self.begin(views, progress)
        self._begun.append((views, begun))
        track = begun[0]
        return find_exposures(names, views, track.cloud, track.normals(), self.environment, device=self.device)

    def begin(self, views: Sequence[CapturedView], progress: StepProgress) -> tuple[Track, dict[str, Any]]:
        """Fit a key frame from its images alone, their exposures matched; images just compared are not fitted again."""
        known = [begun for seen, begun in self._begun if seen is views]
        self._begun.clear()
        return known[0] if known else self._fitted(views, progress)

    def _fitted(self, views: Sequence[CapturedView], progress: StepProgress) -> tuple[Track, dict[str, Any]]:
        """Fit a key frame; see `begin`."""
        is_bare = self.points is None and all(view.alpha is None for view in views)
        fitting = _borne(self.fitting, len(views)) if is_bare else self.fitting
        start, findings, said = self._start(views, fitting.gaussian_count), [], {}
        if all(view.alpha is not None for view in views):  # else it is no surface, and does not say who sees what
            gains = view_gains(start, outward_normals(start, _faces(start)), views, device=self.device)
            findings = judge_gains(gains, views)
            if findings:
                views = matched(views, gains)
                start = self._start(views, fitting.gaussian_count)  # of colours that agree
            unpaired = float((gains.views_of_points < 2).mean())
            said = {**_exposures(gains), "unpaired": unpaired}
            if unpaired > MOST_UNPAIRED:
                what = (
                    f"{100.0 * unpaired:.0f} % of the surface are seen by fewer than two views: their depth is that of "
                    "outlines"
                )
                findings.append(Finding("warning", "few-cameras", what, remedy="Add cameras."))
        known = self.environment if all(view.alpha is not None for view in views) else None
        fit = fit_gaussians(views, start, fitting, environment=known, device=self.device, progress=progress)
        cloud = fit.cloud
        if is_bare:
            inner = np.flatnonzero(seen_in_common(views, cloud.positions))
            cloud = cloud.select(inner) if len(inner) else cloud
        track = begin_track(cloud, views, self._tracking, device=self.device)
        return track, {**fit.report, **said, "findings": [vars(finding) for finding in findings]}

    def advance(
        self, track: Track, views: Sequence[CapturedView], progress: StepProgress
    ) -> tuple[Track, dict[str, Any]]:
        """Track the frame after, exposures of its images matched."""
        gains = view_gains(track.cloud, track.normals(), views, device=self.device)
        findings = judge_gains(gains, views)
        views = matched(views, gains)
        following, report = advance_track(track, views, self._tracking, device=self.device, progress=progress)
        cameras = [view.camera for view in views]
        motion = motion_in_pixels(track.joints, following.joints, cameras)
        surprise = motion_in_pixels(2.0 * track.joints - track.previous_joints, following.joints, cameras)
        reach = STRUCTURE_REACH * max(self._tracking.joints.levels)
        found = report["start"] == "silhouettes" and not report["lost"]
        if not surprise.max() <= reach and not found:
            findings.append(
                Finding(
                    "warning",
                    "fast-motion",
                    f"a joint moved {surprise.max():.0f} pixels from where it was expected, where {reach} are found "
                    "for certain",
                    remedy="Record more frames a second, or plan shorter segments.",
                )
            )
        if not report["torn"] <= DOUBTFUL_TEAR and not report["lost"]:
            what = f"{100.0 * report['torn']:.1f} % of the joints are torn from a neighbour: a limb may be elsewhere"
            remedy = "Look at the frame, record more frames a second, or plan shorter segments."
            findings.append(Finding("warning", "doubtful-motion", what, remedy=remedy))
        if report["lost"]:
            covered = report["gap"] <= track.baseline[1] + self._tracking.largest_gap
            code = "tracking-lost" if covered else "new-surface"
            findings.append(Finding("warning", code, f"tracking is lost: {report['lost']}"))
        said = {
            **_exposures(gains),
            "motion": {"median": float(np.median(motion)), "largest": float(motion.max())},
            "surprise": float(surprise.max()),
            "findings": [vars(finding) for finding in findings],
        }
        return following, {**report, **said}

    def _start(self, views: Sequence[CapturedView], count: int) -> GaussianCloud:
        """Return the Gaussians that a fit begins with: of a visual hull, known points, or what photographs agree on."""
        seed = self.fitting.seed
        known = None if all(view.alpha is not None for view in views) else self.points  # a visual hull says more
        if known is None and len(views) > 1 and all(view.alpha is None for view in views):
            agreed = unmasked_gaussians(views, count, device=self.device, seed=seed)
            if agreed is not None:
                return agreed
        return initial_gaussians(
            views,
            count,
            points=None if known is None else known.positions,
            point_colors=None if known is None else known.colors,
            device=self.device,
            seed=seed,
        )

    def restore(self, arrays: dict[str, NDArray[np.generic]]) -> Track:
        """Return the track whose arrays these are."""
        return Track.from_arrays(arrays)


def _faces(discs: GaussianCloud) -> NDArray[np.float64]:
    """Return which way discs of a start face, ``(N, 3)``: outward, for they lie on a surface."""
    return Rotation.from_quat(discs.orientations).apply([0.0, 0.0, 1.0])


def _borne(options: FitOptions, view_count: int) -> FitOptions:
    """Return what photographs without masks bear: more Gaussians and steps would paint each of a few for itself."""
    share = min(1.0, view_count / PLENTY)
    names = ("gaussian_count", "color_iterations", "normal_iterations")
    return replace(options, **{name: math.ceil(share * getattr(options, name)) for name in names})


def _exposures(gains: ViewGains) -> dict[str, float]:
    """Return the largest difference of exposures [stop], as far as it is known."""
    off = np.abs(gains.stops)
    return {"exposure_spread": float(np.nanmax(off))} if np.isfinite(off).any() else {}


def _digest(*arrays: NDArray[Any] | None) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        if array is not None:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
