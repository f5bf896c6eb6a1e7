"""Tracking from one frame to the next: joints find the coarse motion, the Gaussians that they carry find the rest.

A track keeps identities: row i is the same Gaussian in all of its frames. Where the photographs can no longer be met so
- too much worse than in the key frame, a part of the subject that nothing covers, joints torn apart - it says that it
is lost, and why: then a new key frame begins a new track.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_choice, require_count, require_number
from beam_warp.device.arrays import resolve_device
from beam_warp.image.color import LINEAR_REC709
from beam_warp.jobs.listeners import no_progress
from beam_warp.raster.sources import upload_gaussians
from beam_warp.reconstruction.far_motion import Silhouette, pose_on_hull, squares_outside
from beam_warp.reconstruction.fit import NO_PSNR, OF_FEW_STEPS, PRESETS, FitOptions, Fitter, LearningRates, mean_psnr
from beam_warp.reconstruction.frames.protocols import StepProgress
from beam_warp.reconstruction.joint_tracking import JointOptions, JointPose, JointTracker
from beam_warp.reconstruction.joints.graph import JointGraph, torn_fraction
from beam_warp.reconstruction.joints.selection import select_joints
from beam_warp.reconstruction.joints.skinning import Anchors
from beam_warp.reconstruction.parameters import require_scene_linear, require_something
from beam_warp.reconstruction.targets import TargetSet, chosen_samples
from beam_warp.world.gaussians import ATTRIBUTES, GaussianCloud, sh_degree_of

GAUSSIANS_PER_JOINT = 25
"""Gaussians for each joint, as far as `JOINT_LIMITS` allow."""

JOINT_LIMITS = (60, 4_000)
"""Fewest and most joints."""

NOISE_PSNR = 44.0
"""PSNR that the noise of good photographs allows [dB]: encoded colours are off by 1.6 of 255."""

SMALLEST_COSINE = 0.2
"""Least cosine between the normals of neighbours on a body: two limbs in contact are not one."""


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """Options of tracking a frame from the one before.

    Attributes:
        joint_count: Number of joints; None for one for every `GAUSSIANS_PER_JOINT` Gaussians.
        joints: How they are moved.
        reach: Pixels of the most reduced images over which photographs pull joints. Where joints would begin farther
            outside silhouettes, the visual hull says where they have gone; infinity: never.
        refinement: How the Gaussians that they carried are fitted; counts, refinements and the degree of the radiance,
            which is the key frame's, are not used.
        largest_drop: A frame whose PSNR is further below the key frame's is lost [dB].
        largest_gap: A frame is lost where a larger connected part of the subject, beyond the key frame's, stays
            uncovered in a view.
        largest_tear: A frame is lost where a larger part of the joints is torn from a neighbour.

    Raises:
        InvalidOptionError: An option is out of range.
    """

    joint_count: int | None = None
    joints: JointOptions = field(default_factory=JointOptions)
    reach: float = 1.5
    refinement: FitOptions = field(
        default_factory=lambda: FitOptions(
            color_iterations=0,
            normal_iterations=400,
            rates=LearningRates(1e-4, 1e-3, 2e-3, 1e-2, 5e-3, 2.5e-4, final_positions=0.1, final_others=1.0),
            temporal=1e-3,
            **OF_FEW_STEPS,
        )
    )
    largest_drop: float = 6.0
    largest_gap: float = 0.03
    largest_tear: float = 0.1

    @classmethod
    def of_preset(cls, preset: str) -> TrackOptions:
        """Return the options that go with a preset of `FitOptions.of_preset`.

        Raises:
            InvalidOptionError: There is no such preset.
        """
        require_choice("preset", preset, PRESETS)
        if preset != "draft":
            return cls()
        joints = JointOptions(levels=(4, 2, 1), iterations=(40, 40, 60))
        return cls(joints=joints, refinement=replace(cls().refinement, normal_iterations=80))

    def following(self, fitting: FitOptions) -> TrackOptions:
        """Return the options for key frames that were fitted so: drawn in the same way, met by the same terms."""
        refinement = replace(
            self.refinement,
            weights=fitting.weights,
            sh_degree=fitting.sh_degree,
            samples=fitting.samples,
            raster=fitting.raster,
            seed=fitting.seed,
        )
        return replace(self, refinement=refinement)

    def __post_init__(self) -> None:
        """Check every option once."""
        if self.joint_count is not None:
            require_count("joint_count", self.joint_count)
        for name in ("reach", "largest_drop", "largest_gap", "largest_tear"):
            require_number(name, getattr(self, name), 0.0)


@dataclass(frozen=True, eq=False)
class Track:
    """The state of tracking in one frame: what the next frame needs of it.

    Attributes:
        cloud: This frame's Gaussians; row i is the same one in every frame of the track.
        anchors: Anchors of the Gaussians to the joints, from the key frame.
        graph: Graph of the joints, from the key frame.
        local_normals: Which way the surface faces, in each Gaussian's own axes, ``(N, 3)`` float32; 0 where unknown.
        key_joints: Where the joints were in the key frame, ``(M, 3)`` float32 [m].
        joints: Where the joints are, ``(M, 3)``.
        previous_joints: Where the joints were a frame before, ``(M, 3)``; where they are, in a key frame.
        turns: Turns of the joints since the frame before, quaternions xyzw, ``(M, 4)``.
        baseline: PSNR [dB] and largest gap in the key frame, ``(2,)`` float64.
    """

    cloud: GaussianCloud
    anchors: Anchors
    graph: JointGraph
    local_normals: NDArray[np.float32]
    key_joints: NDArray[np.float32]
    joints: NDArray[np.float32]
    previous_joints: NDArray[np.float32]
    turns: NDArray[np.float32]
    baseline: NDArray[np.float64]

    OWN = ("local_normals", "key_joints", "joints", "previous_joints", "turns", "baseline")
    ANCHORS = ("joints", "weights")
    GRAPH = ("neighbors", "weights", "incoming", "incoming_starts")

    def normals(self) -> NDArray[np.float32]:
        """Return which way the surface faces now, ``(N, 3)``; 0 where it is not known."""
        return Rotation.from_quat(self.cloud.orientations).apply(self.local_normals).astype(np.float32)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything as arrays by name, from which `from_arrays` makes the same track."""
        return {
            **self.cloud.arrays(),
            **{f"track_{name}": getattr(self, name) for name in self.OWN},
            **{f"anchor_{name}": getattr(self.anchors, name) for name in self.ANCHORS},
            **{f"graph_{name}": getattr(self.graph, name) for name in self.GRAPH},
            "graph_spacing": np.array(self.graph.spacing),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> Track:
        """Return the track of which these are `arrays`."""
        fields: dict[str, Any] = {name: array for name, array in arrays.items() if name in ATTRIBUTES}
        return cls(
            GaussianCloud(**fields, radiance_color_space=LINEAR_REC709),
            Anchors(**{name: arrays[f"anchor_{name}"] for name in cls.ANCHORS}),
            JointGraph(**{name: arrays[f"graph_{name}"] for name in cls.GRAPH}, spacing=float(arrays["graph_spacing"])),
            *(arrays[f"track_{name}"] for name in cls.OWN),
        )


def begin_track(
    cloud: GaussianCloud, views: Sequence[CapturedView], options: TrackOptions, *, device: str | None = None
) -> Track:
    """Choose joints in a key frame, and anchor its Gaussians to them.

    Args:
        cloud: What was fitted to the key frame, with scene-linear radiance and ids.
        views: Its photographs.
        options: See `TrackOptions`.
        device: Warp device; None takes the first CUDA device, or the CPU.

    Raises:
        InvalidArrayError: There is no view or no Gaussian, or the cloud's radiance is not scene-linear Rec.709.
        DeviceError: There is no such device.

    Source: Jiang et al. 2024, DualGS; `docs/tracking.md` lists what differs.
    """
    require_something("cloud", cloud, views)
    require_scene_linear("cloud", cloud)
    count = options.joint_count or int(np.clip(len(cloud) // GAUSSIANS_PER_JOINT, *JOINT_LIMITS))
    rows = select_joints(cloud.positions, min(count, len(cloud)), opacities=cloud.opacities)
    target, chosen = resolve_device(device), options.refinement
    targets = TargetSet(views, len(cloud), chosen.raster, chosen_samples(chosen.samples, cloud, views), target)
    gaussians = upload_gaussians(cloud, target, radiance=cloud.radiance)
    psnr, _ = targets.make_room(gaussians)
    normals = outward_normals(cloud, targets.seen_directions(gaussians))
    joints = cloud.positions[rows]
    graph = JointGraph.build(joints, normals=normals[rows], smallest_cosine=SMALLEST_COSINE)
    anchors = Anchors.fit(
        cloud.positions, joints, normals=normals, joint_normals=normals[rows], smallest_cosine=SMALLEST_COSINE
    )
    still = _unturned(len(joints))
    baseline = np.array([mean_psnr(psnr), targets.gaps(gaussians).max()])
    local = Rotation.from_quat(cloud.orientations).apply(normals, inverse=True).astype(np.float32)
    return Track(cloud, anchors, graph, local, joints, joints, joints, still, baseline)


def advance_track(
    track: Track,
    views: Sequence[CapturedView],
    options: TrackOptions,
    *,
    device: str | None = None,
    progress: StepProgress = no_progress,
) -> tuple[Track, dict[str, Any]]:
    """Find the Gaussians of the next frame.

    Args:
        track: Track of the frame before.
        views: The photographs of the frame.
        options: The options that the track began with.
        device: The device that the track began on.
        progress: Called with (done, total, facts).

    Returns:
        The track of the frame, and a report, JSON-able: ``psnr`` of the training views' crops [dB], ``gap``,
        ``torn``, ``start`` (what joints began with: ``"continued"`` or ``"ended"`` motion, or ``"silhouettes"``),
        ``gaussians``, ``samples``, ``seconds``, and ``lost``: why the track is lost, empty if it is not.

    Raises:
        InvalidArrayError: There is no view.
        DeviceError: There is no such device.
    """
    require_something("cloud", track.cloud, views)
    began = time.perf_counter()
    target = resolve_device(device)
    chosen = options.refinement
    samples = chosen_samples(chosen.samples, track.cloud, views)
    tracker = JointTracker(track.cloud, track.anchors, track.graph, track.joints, options.joints, chosen.raster, target)
    starts = _starts(track, views, options, target)
    targets = TargetSet(views, len(track.cloud), chosen.raster, samples, target)
    pose, begun = tracker.find(views, starts, samples, chosen.seed, targets)
    carried = tracker.carried(track.cloud)
    refinement = replace(
        chosen,
        gaussian_count=len(carried),
        refine_every=0,
        sh_degree=sh_degree_of(require_scene_linear("cloud", carried).shape[1]),  # the key frame's
        samples=samples,
        sampling_filter=False,  # it is in the scales already
    )
    fitter = Fitter(views, carried, refinement, target, targets)
    fitter.run(progress)
    cloud = fitter.parameters.cloud().with_arrays(ids=track.cloud.ids)
    psnr, gaps = fitter.psnr(), fitter.gaps()
    torn = torn_fraction(track.graph, track.key_joints, pose.positions)
    following = replace(track, cloud=cloud, joints=pose.positions, previous_joints=track.joints, turns=pose.rotations)
    report = {
        "psnr": mean_psnr(psnr),
        "view_psnr": float(np.nanmin(psnr, initial=NO_PSNR)),
        "gap": float(gaps.max()),
        "torn": torn,
        "start": begun,
        "gaussians": len(cloud),
        "samples": samples,
        "lost": _why_lost(track, mean_psnr(psnr), gaps, torn, views, options),
        "seconds": time.perf_counter() - began,
    }
    return following, report


def _starts(track: Track, views: Sequence[CapturedView], options: TrackOptions, device: Any) -> dict[str, JointPose]:
    """Return poses that a frame may begin with: its motion went on, or ended, or is seen in silhouettes alone."""
    # Where joints will be if they go on as they went: turned once more by their last turn.
    starts = {"continued": JointPose(track.turns, 2.0 * track.joints - track.previous_joints)}
    if (track.joints != track.previous_joints).any():
        starts["ended"] = JointPose(_unturned(len(track.joints)), track.joints)
    silhouettes = [found for view in views if (found := Silhouette.of(view, options.joints.levels[0])) is not None]
    away = {name: squares_outside(start.positions, silhouettes) for name, start in starts.items()}
    nearest = min(away, key=away.__getitem__)
    if away[nearest] > options.reach:
        subject = track.cloud, track.normals(), track.anchors, track.joints
        found = pose_on_hull(*subject, starts[nearest], views, SMALLEST_COSINE, device)
        starts |= {} if found is None else {"silhouettes": found}
    return starts


def _unturned(count: int) -> NDArray[np.float32]:
    """Return rotations that do nothing, ``(count, 4)``."""
    return np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (count, 1))


def outward_normals(cloud: GaussianCloud, sides: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the thin axes of Gaussians, turned to a side, ``(N, 3)``; 0 where it is not known.

    Args:
        cloud: Gaussians; those whose thin axis is more than half of the next have no normal.
        sides: On which side of each the outside is, ``(N, 3)`` of any length; 0 where that is not known.
    """
    picked, order = np.arange(len(cloud)), np.argsort(cloud.scales, axis=1, kind="stable")
    thin, next_one = order[:, 0], order[:, 1]
    normals = Rotation.from_quat(cloud.orientations).as_matrix()[picked, :, thin]
    normals *= np.sign((normals * sides).sum(axis=1))[:, None]
    normals[~(cloud.scales[picked, thin] <= 0.5 * cloud.scales[picked, next_one])] = 0.0
    return normals.astype(np.float32)


def _why_lost(
    track: Track,
    psnr: float,
    gaps: NDArray[np.float64],
    torn: float,
    views: Sequence[CapturedView],
    options: TrackOptions,
) -> str:
    """Return why a frame is not the same subject moved on, or nothing."""
    before, gap = track.baseline
    reasons = []
    # Above that, a key frame is fitted to the noise of its own photographs, which no other frame has.
    if not psnr >= min(before, NOISE_PSNR) - options.largest_drop:
        reasons.append(f"PSNR fell from {before:.1f} dB in the key frame to {psnr:.1f} dB")
    if not gaps.max() <= gap + options.largest_gap:
        name = views[int(gaps.argmax())].name
        reasons.append(f"{100.0 * gaps.max():.0f} % of the subject are not covered in {name}")
    if not torn <= options.largest_tear:
        reasons.append(f"{100.0 * torn:.0f} % of the joints are torn from a neighbour")
    return "; ".join(reasons)
