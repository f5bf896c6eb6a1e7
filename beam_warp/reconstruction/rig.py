"""Cameras of a rig refined with the Gaussians of a key frame, before anything is fitted for good.

A capture's cameras are never exact, and a fit pays for each tenth of a pixel. What is done:

1. Gaussians are fitted to reduced photographs, as key frames are, but for the term of normals. In every step the camera
   that was looked through moves too, by the rasteriser's exact derivative (`Rasterizer.backward`), Adam, and steps that
   are counted in pixels: turn, shift and focal length by what they move in the image. Levels go from coarse to fine;
   each begins with a visual hull of the cameras so far, so that silhouettes have the first word.
2. This is done twice, for the black and the white fields of a chessboard on every photograph. The mean of both is the
   estimate. Half their difference is as large as its error, for they share no data.
3. The gauge is the rig's: of all corrections that a motion and a scale of the world explain, none is left, and the mean
   factor of the focal lengths is 1. So renders for other cameras are where they were.
4. Corrections are undone unless they are beyond chance (an F test of the two mean squares) and beyond `OWN_ERROR`, what
   the method finds in exact rigs. Then each camera's shrinks by what chance explains of it (James and Stein). An exact
   rig therefore stays as it is, to the bit.
5. A camera whose photograph is met much worse than the others' after the first half is left out and named, and all
   begins again without it.

What pixels see of a camera is its turn and shift together: a turn and a shift sideways look the same but for depth. So
places are found to a part of a pixel on the surface, not to a part of a millimetre where the camera stands. Principal
points are not moved: a turn does nearly the same, and images do not tell them apart. Nor is a lens.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy import stats

from beam_warp.capture.corrections import CameraCorrection, RigCorrection, move_between, moved_camera
from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device
from beam_warp.jobs.listeners import no_progress
from beam_warp.kernels.reconstruction.image_halves import launch_keep_half
from beam_warp.raster.records import CAMERA_PARAMETERS, GaussianGradients
from beam_warp.reconstruction.fit import FitOptions, Fitter
from beam_warp.reconstruction.frames.protocols import StepProgress
from beam_warp.reconstruction.initial import initial_gaussians
from beam_warp.reconstruction.targets import ViewTargets, crop_views
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

FEWEST_CAMERAS = 6
"""Fewest cameras of a rig: of fewer, one or two see most of the surface, and another shape explains their errors."""

OWN_ERROR = 0.3
"""Corrections up to this may be the method's own error [pixel, root mean square]: of exact rigs it finds 0.10 (runner),
0.12 (walker) and 0.23 (robot, whose facets shine)."""

CHANCE = 1e-3
"""Probability below which corrections are not chance."""

FREEDOM = 4
"""Independent numbers that an image tells of a camera's turn, shift and focal length, about."""

FIELD = 24
"""Side of the fields of the chessboard [pixel]: about twice the window of structural similarity."""

MOST_BEHIND = 6.0
"""A camera whose photograph is met by so much less than the middle one's is left out [dB]."""

FOCAL_EDGE = 0.3
"""Distance from an image's middle, in its widths, at which a change of the focal length is counted in pixels."""

SHIFT_SHARE = 0.5
"""Steps of shifts over those of turns, both in pixels: calibrations err more in where a camera looks."""

MOMENTS = (0.7, 0.9)
"""Decay of Adam's moments: a camera is looked through a dozen times, not thousands."""


FAR = 0.5
"""A coarse level that moved a camera by more is taken again with this one moved and the others where they were: steps
reach no farther than about twice that, and what is far off misleads the others [pixel of the level]."""

MOST_REPEATS = 3
"""How often levels are taken again, at most."""

FEWER_POINTS = 23
"""Every so many Gaussians are asked how far they move in an image: hundreds do."""

NO_FACTS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Level:
    """One of the rounds of refinement, from coarse to fine.

    Attributes:
        reduction: Pixels of the photograph along a side of those that are compared.
        share: Gaussians over those of the fit that follows.
        visits: How often each camera is looked through, after as many steps as `warm` without moving it.
        warm: Visits before cameras move.
        first_step: Size of the first steps [pixel of the level].
        last_step: Size of the last steps [pixel of the level].
    """

    reduction: int
    share: float
    visits: int
    warm: int
    first_step: float
    last_step: float


LEVELS = (Level(4, 1 / 4, 12, 2, 0.1, 0.01), Level(2, 1 / 2, 16, 2, 0.07, 0.004))
"""Levels of refinement. A body that is five pixels wide, at a reduction of 8, misleads more than it helps."""

FEWEST_GAUSSIANS, MOST_GAUSSIANS = 500, 20_000
"""Fewest and most Gaussians of a level."""

SHORTEST_SIDE = 32
"""Levels whose photographs would be smaller than this are left out [pixel]."""


def refine_rig(
    names: Sequence[str],
    views: Sequence[CapturedView],
    options: FitOptions,
    *,
    device: str | None = None,
    progress: StepProgress = no_progress,
) -> RigCorrection | None:
    """Find what is wrong with the cameras of a rig.

    Args:
        names: Names of the cameras.
        views: The photograph of each of them at one moment, with masks.
        options: How key frames are fitted.
        device: Warp device; None takes the first CUDA device, or the CPU.
        progress: Called with (done, total, facts), in steps.

    Returns:
        Corrections; None where there are fewer than `FEWEST_CAMERAS`, or a view has no mask.

    Raises:
        InvalidArrayError: The masks have no volume in common.
        DeviceError: There is no such device.
    """
    if len(views) < FEWEST_CAMERAS or any(view.alpha is None for view in views):
        return None
    target = resolve_device(device)
    first = _half_found(views, options, 0, target, progress)
    psnr = first.psnr()
    is_bad = psnr < np.nanmedian(psnr) - MOST_BEHIND
    if is_bad.any():  # it has misled the others
        others = [k for k in range(len(views)) if not is_bad[k]]
        kept = [names[k] for k in others]
        rest = refine_rig(kept, [views[k] for k in others], options, device=device, progress=progress)
        bad = {name: float(psnr[k]) for k, name in enumerate(names) if is_bad[k]}
        return _left_out(bad, kept, rest)
    given, cloud = [view.camera for view in views], first.parameters.cloud()
    if (sound := _sound(names, given, first.found, cloud, psnr)) is not None:
        return sound
    second = _half_found(views, options, 1, target, progress)
    return judged(names, given, [first.found, second.found], cloud, psnr)


def _sound(
    names: Sequence[str],
    given: Sequence[Camera],
    found: Sequence[Camera],
    cloud: GaussianCloud,
    psnr: NDArray[np.float64],
) -> RigCorrection | None:
    """Return that a rig is sound, which needs no second half, if the first found less than may be its own error."""
    points, center = _points_of(cloud)
    ends = in_gauge(given, found, center)
    moved = np.array([pixels_between(one, other, points) for one, other in zip(given, ends, strict=True)])
    if float(np.mean(np.square(moved))) > OWN_ERROR**2:
        return None
    return RigCorrection(
        tuple(
            CameraCorrection(name, pixels=float(pixels), error=OWN_ERROR, psnr=float(np.nan_to_num(quality)))
            for name, pixels, quality in zip(names, moved, psnr, strict=True)
        ),
        is_applied=False,
        confidence=0.0,
    )


def _points_of(cloud: GaussianCloud) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return some points of a subject's surface, ``(N, 3)``, and its middle, ``(3,)`` [m]."""
    positions = cloud.positions.astype(np.float64)
    return positions[::FEWER_POINTS], np.median(positions, axis=0)


def _half_found(
    views: Sequence[CapturedView], options: FitOptions, half: int, device: Any, progress: StepProgress
) -> RigFitter:
    """Refine the cameras by one half of the pixels, from coarse to fine; return the finest level."""
    cameras = [view.camera for view in views]
    waiting, repeats = levels_of(cameras), MOST_REPEATS
    total = 2 * sum(step_count(level, len(views)) for level in waiting)
    taken = half * total // 2
    while True:
        level = waiting[0]

        fitter = RigFitter(views, cameras, level, options, half, device)
        fitter.run(_part_of(progress, taken, total))
        points = fitter.parameters.cloud().positions[::FEWER_POINTS].astype(np.float64)
        limit = FAR * level.reduction
        far = [pixels_between(*pair, points) > limit for pair in zip(cameras, fitter.found, strict=True)]
        if repeats and len(waiting) > 1 and any(far):  # the others gave way to these
            cameras = [new if is_far else old for old, new, is_far in zip(cameras, fitter.found, far, strict=True)]
            repeats -= 1
            continue
        cameras = fitter.found
        taken += step_count(level, len(views))
        waiting = waiting[1:]
        if not waiting:
            return fitter


def _part_of(progress: StepProgress, before: int, steps: int) -> StepProgress:
    """Return a listener to the steps of one level, ``before`` of all ``steps`` taken."""

    def report(done: int, total: int, facts: Mapping[str, float] = NO_FACTS) -> None:
        progress(before + done, steps, facts)

    return report


def _left_out(bad: Mapping[str, float], kept: Sequence[str], rest: RigCorrection | None) -> RigCorrection:
    """Return the corrections of a rig some of whose cameras are left out, given those of the others, if they are known.

    Args:
        bad: The quality that the photographs of the cameras that are left out were met with [dB], by name.
        kept: Names of the others.
        rest: Corrections of the others; None if they are too few for any.
    """
    others = rest or RigCorrection(tuple(CameraCorrection(name) for name in kept), is_applied=False, confidence=0.0)
    left_out = (CameraCorrection(name, psnr=quality, is_used=False) for name, quality in bad.items())
    return replace(others, cameras=(*others.cameras, *left_out))


def levels_of(cameras: Sequence[Camera]) -> list[Level]:
    """Return the levels whose photographs are large enough, at least the finest."""
    side = min(min(camera.width, camera.height) for camera in cameras)
    return [level for level in LEVELS[:-1] if side // level.reduction >= SHORTEST_SIDE] + [LEVELS[-1]]


def step_count(level: Level, view_count: int) -> int:
    """Return the steps of a level."""
    return (level.visits + level.warm) * view_count


class RigFitter(Fitter):
    """The steps of one level of refinement, which move cameras with the Gaussians.

    Attributes:
        found: The cameras so far, of the photographs' own size.
    """

    def __init__(
        self,
        views: Sequence[CapturedView],
        cameras: Sequence[Camera],
        level: Level,
        options: FitOptions,
        half: int,
        device: Any,
    ) -> None:
        """Prepare a level, from the cameras that the one before found."""
        moved = [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]
        reduced = [view.reduced(level.reduction) for view in moved]
        count = int(np.clip(options.gaussian_count * level.share, FEWEST_GAUSSIANS, MOST_GAUSSIANS))
        start = initial_gaussians(reduced, count, device=str(device), seed=options.seed)
        fitting = replace(
            options,
            gaussian_count=len(start),
            target_psnr=None,
            color_iterations=step_count(level, len(views)),
            normal_iterations=0,
            samples=1,
            temporal=0.0,
            refine_every=0,
        )
        super().__init__(reduced, start, fitting, device)
        self.found = list(cameras)
        self._level, self._half = level, half
        self._reduced = [view.camera for view in reduced]
        self._corners = [_corner(view, part) for view, part in zip(reduced, crop_views(reduced), strict=True)]
        center = np.median(start.positions, axis=0).astype(np.float64)
        self._units = np.stack([units_of(view.camera, center) for view in reduced])
        self._moves = np.zeros((len(views), 7))
        self._moments = np.zeros((2, len(views), 7))
        self._visits = np.zeros(len(views), int)
        self._to_camera = wp.zeros((1, len(CAMERA_PARAMETERS)), dtype=float, device=device)

    def _renew(self) -> float:
        """Bring everything up to date; allocate what derivatives to cameras need, which a recording must not."""
        psnr = super()._renew()
        for group in dict.fromkeys(self._targets[view][0] for view in range(len(self._targets))):
            group.rasterizer.backward(self._to_camera)
        return psnr

    def _differentiated(self, group: ViewTargets, index: int) -> GaussianGradients:
        """Compare one half of a view with what was drawn, and differentiate to its camera as well."""
        group.add_losses(index, self._weights)
        adjoints = group.rasterizer.adjoints()
        for array in (*adjoints.channels, adjoints.alpha):
            rows = array.reshape((array.shape[0], -1)) if array.ndim == 1 else array
            launch_keep_half(group.width, FIELD, self._half, rows, self.device)
        return group.rasterizer.backward(self._to_camera)

    def _stepped(self, view: int) -> None:
        """Move the camera that was looked through, by Adam."""
        level, visits = self._level, self._visits
        visits[view] += 1
        step = visits[view] - level.warm
        if step <= 0:
            return
        size = level.first_step * (level.last_step / level.first_step) ** ((step - 1) / max(level.visits - 1, 1))
        camera, row = self._reduced[view], self._to_camera.numpy()[0].astype(np.float64)
        slope = np.array([*row[:6], row[6] * camera.focal_x + row[7] * camera.focal_y]) * self._units[view]
        for moment, decay, value in zip(self._moments[:, view], MOMENTS, (slope, slope * slope), strict=True):
            moment += (1.0 - decay) * (value - moment)
        mean, square = (m / (1.0 - decay**step) for m, decay in zip(self._moments[:, view], MOMENTS, strict=True))
        change = -size * mean / np.maximum(np.sqrt(square), 1e-30) * self._units[view]
        self.found[view] = moved_camera(self.found[view], change)
        self._reduced[view] = moved_camera(camera, change)
        group, index = self._targets[view]
        cropped = self._reduced[view].cropped(*self._corners[view], group.width, group.height)
        group.move_camera(index, cropped)


def _corner(view: CapturedView, part: CapturedView) -> tuple[int, int]:
    """Return the column and row of a view at which a part of it begins."""
    whole, cut = view.camera, part.camera
    return round(whole.center_x - cut.center_x), round(whole.center_y - cut.center_y)


def units_of(camera: Camera, center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what of each number of a move is a step of a pixel, ``(7,)``."""
    focal, distance = camera.focal_x, float(np.linalg.norm(camera.position - center))
    shift = SHIFT_SHARE * distance / focal
    return np.array([*[1.0 / focal] * 3, *[shift] * 3, 1.0 / (FOCAL_EDGE * camera.width)])


def in_gauge(given: Sequence[Camera], found: Sequence[Camera], center: NDArray[np.float64]) -> list[Camera]:
    """Return found cameras without what a motion and a scale of the world explain of their corrections.

    A motion of the world moves each camera's view of it by a twist that is linear in the motion's seven numbers, turn,
    shift and scale about a centre. The one of least squares, in pixels, is undone; so is the mean factor of the focal
    lengths.

    Args:
        given: Cameras as the capture states them.
        found: The same, corrected.
        center: Middle of the subject [m], ``(3,)``.
    """
    moves = np.stack([move_between(one, other) for one, other in zip(given, found, strict=True)])
    units = np.stack([units_of(camera, center)[:6] for camera in given])
    effects = np.stack([_world_motion(camera, center) for camera in given])
    world = np.linalg.lstsq(
        (effects / units[:, :, None]).reshape(-1, 7), (moves[:, :6] / units).reshape(-1), rcond=None
    )[0]
    focal = moves[:, 6].mean()
    return [moved_camera(camera, [*(-effect @ world), -focal]) for camera, effect in zip(found, effects, strict=True)]


def _world_motion(camera: Camera, center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the twists of a camera, ``(6, 7)``, that turn, shift and scale of the world about a centre look like."""
    to_camera, away = camera.camera_to_world[:3, :3].T, camera.position - center
    x, y, z = away
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    effect = np.zeros((6, 7))
    effect[:3, :3] = to_camera
    effect[3:, :3] = -to_camera @ across
    effect[3:, 3:6] = to_camera
    effect[3:, 6] = to_camera @ away
    return effect


def judged(
    names: Sequence[str],
    given: Sequence[Camera],
    found: Sequence[Sequence[Camera]],
    cloud: GaussianCloud,
    psnr: NDArray[np.float64],
) -> RigCorrection:
    """Return the corrections that two refinements agree on, with their errors.

    Args:
        names: Names of the cameras.
        given: Cameras as the capture states them.
        found: What each of the two refinements found.
        cloud: Gaussians of the subject.
        psnr: Quality with which each photograph was met [dB]; NaN where it shows nothing.
    """
    points, center = _points_of(cloud)
    ends = [in_gauge(given, cameras, center) for cameras in found]
    first, second = (
        np.stack([move_between(one, other) for one, other in zip(given, end, strict=True)]) for end in ends
    )
    means = 0.5 * (first + second)
    moved = np.array([pixels_between(c, moved_camera(c, m), points) for c, m in zip(given, means, strict=True)])
    errors = 0.5 * np.array([pixels_between(one, other, points) for one, other in zip(ends[0], ends[1], strict=True)])
    noise, signal = float(np.mean(np.square(errors))), float(np.mean(np.square(moved)))
    confidence = signal / max(noise, 1e-12)
    freedom = FREEDOM * len(given)
    is_applied = bool(signal > OWN_ERROR**2 and confidence > stats.f.isf(CHANCE, freedom, freedom))
    kept = np.maximum(0.0, 1.0 - noise / np.maximum(np.square(moved), 1e-30)) if is_applied else np.zeros(len(moved))
    return RigCorrection(
        tuple(
            CameraCorrection(
                camera=name,
                turn=tuple(move[:3]),
                shift=tuple(move[3:6]),
                log_focal=float(move[6]),
                pixels=float(pixels),
                error=float(np.hypot(error, np.sqrt(noise)) / np.sqrt(2.0)),
                psnr=float(np.nan_to_num(quality)),
            )
            for name, move, pixels, error, quality in zip(
                names, means * kept[:, None], moved, errors, psnr, strict=True
            )
        ),
        is_applied,
        confidence,
    )


def pixels_between(camera: Camera, other: Camera, points: NDArray[np.float64]) -> float:
    """Return the root mean square distance of what two cameras show of the same points [pixel]; 0 if that is none."""
    apart = camera.project(points)[:, :2] - other.project(points)[:, :2]
    squares = np.square(apart).sum(axis=1)
    seen = np.isfinite(squares)
    return float(np.sqrt(squares[seen].mean())) if seen.any() else 0.0
