"""Cameras of a rig refined with the Gaussians of a key frame, before anything is fitted for good.

A capture's cameras are never exact, and a fit pays for each tenth of a pixel. What is done:

1. Gaussians are fitted for a moment to photographs of half the size, as key frames are, from the visual hull of the
   cameras as they are stated. What the photographs then say about their cameras, and how sure, is read off at once:
   see `beam_warp.reconstruction.alignment`.
2. If turns and focal lengths are within their errors over the whole rig, it is sound, and stays to the bit. Nothing
   more is paid.
3. Otherwise cameras are moved by what their photographs say, and Gaussians are fitted, in turns, until steps are within
   their errors. Only kinds of numbers move that the photographs say are wrong beyond doubt: turns first; then focal
   lengths, places and principal points, if what they explain beside the others is more than chance. Cameras that are
   off by pixels are found at a coarser level first.
4. The gauge is the rig's: of all corrections that a motion and a scale of the world explain, none is left, and the mean
   factor of the focal lengths is 1. So renders for other cameras are where they were. Then each camera's correction
   shrinks by what chance explains of it (James and Stein).
5. A camera whose photograph is met much worse than the others', fits another camera far better, or whose silhouette
   contradicts theirs where something is wrong, is left out and named, and all begins again without it. More than a
   third are refused.

A turn and a shift sideways look the same but for depth: an error of a part of a pixel that a view's surface shares is
one of millimetres in place. So an error of place is mended by a turn, until the photographs tell the two apart, and
`place_error` says how well they do.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.corrections import CameraCorrection, RigCorrection, move_between, moved_camera
from beam_warp.capture.findings import names_of
from beam_warp.capture.silhouettes import contradicting
from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import AssetFormatError, InvalidArrayError
from beam_warp.image.metrics import root_mean_square
from beam_warp.jobs.listeners import no_progress
from beam_warp.reconstruction.alignment import NUMBERS, Evidence, evidence, flow_of, rows_of, strength
from beam_warp.reconstruction.fit import OF_FEW_STEPS, FitOptions, Fitter, LearningRates
from beam_warp.reconstruction.frames.protocols import StepProgress
from beam_warp.reconstruction.initial import initial_gaussians
from beam_warp.reconstruction.labels import agreement_of
from beam_warp.reconstruction.targets import crop_views
from beam_warp.world.camera import Camera

FEWEST_CAMERAS = 8
"""Fewest cameras of a rig: of fewer, one or two see most of the surface, and another shape explains their errors.
Inspection warns of the same number."""

CERTAIN, CERTAIN_BESIDE = 1.5, 2.0
"""Turns that are so many times their standard errors, root mean square over the rig, are made, and what explains more
beside turns. In exact rigs that is about 1, by what the errors are; one of three kinds is easily above. The focal
lengths of a shrine with a polished ball at night, whose highlights move with the camera, were 1.54."""

CERTAIN_ALONE = 6.0
"""Those of one camera alone are made from here on."""

MOST_BEHIND = 6.0
"""A camera whose photograph is met by so much less than the middle one's is left out [dB]."""

ALIKE = 25.0
"""A photograph that is met by more than this is of the subject, however much better others are met [dB]."""

MOST_LEFT_OUT = 1.0 / 3.0
"""Part of a rig that may be left out: of more, nothing tells who is right."""

OVERSTEP = 1.6
"""Steps over what photographs say: Gaussians that were fitted to a photograph have followed its camera a part of
the way."""

SETTLED = 0.5
"""Rounds end when steps are so much smaller than the standard errors."""

FAR = 1.0
"""Steps beyond this are taken at a coarser level first [pixel of the level]."""

WORST_ERROR = 1.0
"""Where standard errors are larger than this over a rig, photographs contradict each other [pixel]."""

POOR = 20.0
"""Where the middle photograph is met by less, silhouettes are asked whether they are of one subject [dB]."""

UNMET = 16.0
"""Photographs whose middle one is met by less are not of one subject, or not from where cameras are stated [dB]. Those
of two balls in turns, half a radius apart, are met by 11 to 15, those of walker, runner and robot by 30 to 40."""

UNEXPLAINED = 0.1
"""If the others explain less of the middle photograph at the surface, and a fit does not meet it by `ALIKE` either,
cameras may not be where they are stated. Of balls whose labels are shuffled that is 0.00 to 0.02, and a fit meets them
by 23 dB; of sound rigs 0.5 to 0.97, and 0.25 without texture and shading. It is a warning, because of a black glossy
ball it is 0.01, too, and a fit meets that by 24 dB; of a black glossy figure 0.04, but a fit meets it by 33 dB."""

FEWER_POINTS = 23
"""Every so many Gaussians are asked how far they move in an image: hundreds do."""

LEAST_DISTORTION = 0.05
"""Distortion from which on it is told [pixel]: fits of few Gaussians show 0.03 of walker, whose pinholes are exact."""

MOVED_KINDS = ("turn", "focal", "shift", "center")
"""Kinds of numbers that are moved where the photographs say so, most likely first."""

NO_FACTS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Level:
    """One of the levels of refinement.

    Attributes:
        reduction: Pixels of the photograph along a side of those that are compared.
        share: Gaussians over those of the fit that follows.
        warm: How often each camera is looked through before it is first judged.
        visits: How often between two rounds.
        rounds: Most rounds.
    """

    reduction: int
    share: float
    warm: int
    visits: int
    rounds: int

    @property
    def total(self) -> int:
        """Most visits of each camera."""
        return self.warm + self.visits * self.rounds


LEVELS = (Level(4, 1 / 4, 8, 4, 4), Level(2, 1 / 2, 6, 4, 6))
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
        InvalidArrayError: The masks have no volume in common, and no few of them are to blame.
        AssetFormatError: Too many cameras contradict the others, or nothing tells which ones do.
        DeviceError: There is no such device.
    """
    if len(views) < FEWEST_CAMERAS or any(view.alpha is None for view in views):
        return None
    given, fitter = [view.camera for view in views], None
    try:
        fitter = _fitted(views, options, resolve_device(device), progress)
        is_bad = fitter.contradicting(views)
    except InvalidArrayError:  # the masks share no volume
        is_bad = contradicting(views)
        if not is_bad.any():
            raise
    if fitter is not None and not is_bad.any():
        return _credible(judged(names, given, fitter), fitter)
    psnr = np.zeros(len(views)) if fitter is None else np.nan_to_num(fitter.quality)
    bad = {names[k]: float(psnr[k]) for k in np.flatnonzero(is_bad).tolist()}
    if len(bad) > MOST_LEFT_OUT * len(views):
        raise AssetFormatError(
            f"cameras must show one subject from where they are stated, got {len(bad)} of {len(views)} that contradict "
            f"the others at {names_of(bad)}. Check that no two captures are mixed, and the calibration."
        )
    others = np.flatnonzero(~is_bad).tolist()  # they were misled
    kept = [names[k] for k in others]
    rest = refine_rig(kept, [views[k] for k in others], options, device=device, progress=progress)
    return _left_out(bad, kept, rest)


def _credible(found: RigCorrection, fitter: RigFitter) -> RigCorrection:
    """Return corrections, and whether photographs have little in common, unless they contradict each other too much."""
    quality, explained = float(np.nanmedian(fitter.quality)), float(np.median(fitter.agreement.explained))
    if not quality >= UNMET:
        raise AssetFormatError(
            f"photographs must show one subject from where their cameras are stated, got {quality:.0f} dB between them "
            "and what they agree on. Check that no two captures are mixed, and which camera took which."
        )
    if not (quality >= ALIKE or explained >= UNEXPLAINED):
        found = replace(found, explained=explained, distortion=0.0)
    if found.is_applied and found.error > WORST_ERROR:
        worst = max(found.cameras, key=lambda camera: camera.pixels)
        raise AssetFormatError(
            f"cameras must agree on one subject, got corrections of {found.pixels:.1f} ± {found.error:.1f} pixels, "
            f"most at {worst.camera}. Check that no two captures are mixed, and the calibration; or keep the cameras "
            "as they are stated."
        )
    return found


def _fitted(views: Sequence[CapturedView], options: FitOptions, device: Any, progress: StepProgress) -> RigFitter:
    """Return the finest level after its last look, from coarser ones where cameras are far off."""
    cameras = [view.camera for view in views]
    *coarse, finest = levels_of(cameras)
    steps = _Steps(progress, sum(level.total for level in (*coarse, finest)) * len(views))
    fitter = RigFitter(views, cameras, finest, options, device, steps)
    fitter.settle(finest.warm)
    if not fitter.kinds and fitter.behind().any():
        fitter.settle(finest.total)  # it may only not be there yet
    if not fitter.is_lost():
        fitter.refine()
        return fitter
    if contradicting(views).any():  # which misleads the others, and is no matter of pixels
        return fitter
    if not (fitter.is_far() or fitter.behind().any()):
        fitter.refine()
        return fitter
    for level in coarse:
        fitter = RigFitter(views, cameras, level, options, device, steps)
        fitter.settle(level.warm)
        cameras = fitter.refine()
    fitter = RigFitter(views, cameras, finest, options, device, steps)
    fitter.settle(finest.warm)
    fitter.refine()
    return fitter


class _Steps:
    """A listener to steps of several fits, of which there are at most so many in all."""

    def __init__(self, progress: StepProgress, total: int) -> None:
        """Begin with none."""
        self._progress, self._total, self._done = progress, total, 0

    def __call__(self, done: int, total: int, facts: Mapping[str, float] = NO_FACTS) -> None:
        """Note steps of the fit under way."""
        self._progress(min(self._done + done, self._total), self._total, facts)
        if done == total:
            self._done += total


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


class RigFitter(Fitter):
    """One level of refinement: Gaussians are fitted for a while, cameras are moved by what the photographs say.

    Attributes:
        cameras: The cameras so far, of the photographs' own size.
        kinds: Kinds of numbers that the photographs say are wrong.
        found: What each photograph says about its camera, as of the last look.
        quality: PSNR with which each photograph was met then [dB], ``(V,)``; NaN where it shows nothing.
        agreement: How far photographs agree on the surface that the level begins with.
    """

    def __init__(
        self,
        views: Sequence[CapturedView],
        cameras: Sequence[Camera],
        level: Level,
        options: FitOptions,
        device: Any,
        progress: StepProgress = no_progress,
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
            normal_iterations=0,
            rates=LearningRates(),  # the preset's go with its own number of steps
            samples=1,
            temporal=0.0,
            refine_every=0,
            **OF_FEW_STEPS,
        )
        super().__init__(reduced, start, fitting, device)
        self.cameras = list(cameras)
        self.kinds: tuple[str, ...] = ()
        self.found: list[Evidence] = []
        self.quality = np.full(len(views), np.nan)
        self._level, self._progress = level, progress
        self.agreement = agreement_of(reduced, start, device=str(device))
        self._reduced = [view.camera for view in reduced]
        self._corners = [_corner(view, part) for view, part in zip(reduced, crop_views(reduced), strict=True)]

    def settle(self, visits: int) -> None:
        """Fit the Gaussians, each camera looked through so often, and look what the photographs say then."""
        self.options = replace(self.options, color_iterations=visits * len(self.cameras))
        self.run(self._progress)
        self.parameters.activate()
        self.found = [self._evidence(view) for view in range(len(self.cameras))]
        if not self.kinds:
            self.kinds = wrong_kinds(self.found)

    def refine(self) -> list[Camera]:
        """Move cameras and fit Gaussians in turns, until steps are within their errors; return the cameras."""
        for _ in range(self._level.rounds if self.kinds else 0):
            steps = self.steps()
            for view, step in enumerate(steps):
                self._move(view, OVERSTEP * step)
            self.settle(self._level.visits)
            if self._is_settled(steps):
                more = wrong_kinds(self.found, self.kinds)
                if more == self.kinds:
                    break
                self.kinds = more
        return self.cameras

    def behind(self) -> NDArray[np.bool_]:
        """Return which photographs are met much worse than the others, ``(V,)``."""
        return self.quality < min(float(np.nanmedian(self.quality)) - MOST_BEHIND, ALIKE)

    def contradicting(self, views: Sequence[CapturedView]) -> NDArray[np.bool_]:
        """Return which of all views contradict the others, by what they show or where it ends, ``(V,)``."""
        return self.behind() | self.agreement.swapped | (contradicting(views) if self.is_lost() else False)

    def is_lost(self) -> bool:
        """Tell whether a camera is too far off, or too little is known, for steps to lead anywhere."""
        is_poor = float(np.nanmedian(self.quality)) < POOR
        return is_poor or self.is_far() or bool(self.behind().any()) or root_mean_square(self.errors()) > WORST_ERROR

    def steps(self) -> list[NDArray[np.float64]]:
        """Return what the photographs say is wrong with each camera, ``(11,)`` each."""
        return [found.solved(self.kinds)[0] for found in self.found]

    def surface(self) -> NDArray[np.float64]:
        """Return some points of the subject's surface, ``(N, 3)`` [m]."""
        return self.parameters.cloud().positions[::FEWER_POINTS].astype(np.float64)

    def is_far(self) -> bool:
        """Tell whether a camera is so far off that a coarser level has to find it."""
        points = self.surface()
        moved = [pixels_of(*pair, points) for pair in zip(self.cameras, self.steps(), strict=True)]
        return max(moved) > FAR * self._level.reduction

    def _is_settled(self, steps: Sequence[NDArray[np.float64]]) -> bool:
        """Tell whether steps were within their errors."""
        points = self.surface()
        moved = [pixels_of(*pair, points) for pair in zip(self.cameras, steps, strict=True)]
        return root_mean_square(moved) < SETTLED * root_mean_square(self.errors())

    def errors(self) -> list[float]:
        """Return how well each photograph tells what is moved of its camera [pixel]."""
        points, kinds = self.surface(), self.kinds or MOVED_KINDS[:1]
        return [
            error_of(camera, found.solved(kinds)[1], points)
            for camera, found in zip(self.cameras, self.found, strict=True)
        ]

    def _evidence(self, view: int) -> Evidence:
        """Return what a photograph says about its camera, in numbers of the photograph's own size."""
        group, index = self._targets[view]
        group.draw(index, self.parameters.drawn)
        self.quality[view] = group.psnr(index)
        drawn, photograph, depth = group.compared(index)
        camera = self._reduced[view].cropped(*self._corners[view], group.width, group.height)
        return evidence(drawn, photograph, depth, camera)

    def _move(self, view: int, step: NDArray[np.float64]) -> None:
        """Move a camera."""
        self.cameras[view] = moved_camera(self.cameras[view], step[:9])
        self._reduced[view] = moved_camera(self._reduced[view], step[:9])
        group, index = self._targets[view]
        cropped = self._reduced[view].cropped(*self._corners[view], group.width, group.height)
        group.move_camera(index, cropped)


def wrong_kinds(found: Sequence[Evidence], known: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the kinds of numbers that photographs say are wrong: those that are known, and what surely is beside them.

    Args:
        found: What each photograph says.
        known: Kinds that are moved already.
    """
    first, *others = MOVED_KINDS
    if not known and is_certain(strength(found, [first], first)):
        return (first,)
    base = tuple(known) or (first,)
    sizes = {kind: strength(found, [*base, kind], kind) for kind in others if kind not in base}
    certain = {kind: root_mean_square(size) for kind, size in sizes.items() if is_certain(size, CERTAIN_BESIDE)}
    return (*base, max(certain, key=lambda kind: certain[kind])) if certain else tuple(known)


def is_certain(strengths: NDArray[np.float64], least: float = CERTAIN) -> bool:
    """Tell whether corrections that are so many standard errors are beyond doubt, together or one alone."""
    return bool(root_mean_square(strengths) > least or strengths.max() > CERTAIN_ALONE)


def _corner(view: CapturedView, part: CapturedView) -> tuple[int, int]:
    """Return the column and row of a view at which a part of it begins."""
    whole, cut = view.camera, part.camera
    return round(whole.center_x - cut.center_x), round(whole.center_y - cut.center_y)


def in_gauge(
    given: Sequence[Camera],
    moves: NDArray[np.float64],
    points: NDArray[np.float64],
    kinds: Collection[str] = ("turn", "shift"),
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return corrections without what a motion and a scale of the world explain of them.

    A motion of the world by seven small numbers, turn, shift and scale about the points' middle, moves what cameras
    show as corrections do. That which explains most of what the corrections move, in pixels, is undone by the numbers
    that were corrected; so is the mean factor of the focal lengths.

    Args:
        given: Cameras as the capture states them.
        moves: Corrections, ``(V, 11)``.
        points: Of the subject's surface [m], ``(N, 3)``.
        kinds: Kinds of numbers that were corrected.

    Returns:
        The corrections, ``(V, 11)``, and what was undone: turn [rad], shift [m] and the logarithm of scale, ``(7,)``.
    """
    chosen, center = rows_of(kinds), points.mean(axis=0)
    result = moves.copy()
    result[:, 6] -= moves[:, 6].mean()  # first: the world's scale does nearly the same
    flows = [flow_of(camera, points).reshape(NUMBERS, -1).T for camera in given]
    worlds = [part @ _world_motion(camera, center) for part, camera in zip(flows, given, strict=True)]
    seen = np.concatenate([part @ move for part, move in zip(flows, result, strict=True)])
    world = np.linalg.lstsq(np.concatenate(worlds), seen, rcond=None)[0]
    for row, part, effect in zip(result, flows, worlds, strict=True):
        if len(part):
            row[chosen] -= np.linalg.lstsq(part[:, chosen], effect @ world, rcond=None)[0]
    return result, world.astype(np.float64)


def _world_motion(camera: Camera, center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the numbers of a camera, ``(11, 7)``, that turn, shift and scale of the world about a centre look like."""
    to_camera, away = camera.camera_to_world[:3, :3].T, camera.position - center
    x, y, z = away
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    effect = np.zeros((NUMBERS, 7))
    effect[:3, :3] = to_camera
    effect[3:6, :3] = -to_camera @ across
    effect[3:6, 3:6] = to_camera
    effect[3:6, 6] = to_camera @ away
    return effect


def judged(names: Sequence[str], given: Sequence[Camera], fitter: RigFitter) -> RigCorrection:
    """Return the corrections that a fit found, with their errors.

    Args:
        names: Names of the cameras.
        given: Cameras as the capture states them.
        fitter: The finest level, after its last look.
    """
    points, psnr = fitter.surface(), fitter.quality
    is_applied = bool(fitter.kinds)
    kinds = fitter.kinds or MOVED_KINDS[:1]
    if is_applied:
        moves = np.array([[*move_between(*pair), 0.0, 0.0] for pair in zip(given, fitter.cameras, strict=True)])
    else:
        moves = np.stack([found.solved(kinds)[0] for found in fitter.found])
    moves[:, ~np.isin(np.arange(NUMBERS), rows_of(kinds))] = 0.0  # but for rounding
    moves, world = in_gauge(given, moves, points, kinds)
    covariances = [found.solved(kinds)[1] for found in fitter.found]
    moved = np.array([pixels_of(*pair, points) for pair in zip(given, moves, strict=True)])
    errors = np.array([error_of(*pair, points) for pair in zip(given, covariances, strict=True)])
    kept = np.maximum(0.0, 1.0 - np.square(errors) / np.maximum(np.square(moved), 1e-30)) * is_applied
    places = [found.solved({*kinds, "shift"})[1][3:6, 3:6] for found in fitter.found]
    return RigCorrection(
        tuple(
            CameraCorrection(
                camera=name,
                turn=tuple(move[:3]),
                shift=tuple(move[3:6]),
                log_focal=float(move[6]),
                center=tuple(move[7:9]),
                pixels=float(pixels),
                error=float(error),
                place_error=float(np.sqrt(np.trace(place))),
                psnr=float(np.nan_to_num(quality)),
            )
            for name, move, pixels, error, place, quality in zip(
                names, moves * kept[:, None], moved, errors, places, psnr, strict=True
            )
        ),
        is_applied,
        confidence=float(np.mean(np.square(moved)) / max(np.mean(np.square(errors)), 1e-12)),
        kinds=kinds if is_applied else (),
        world=tuple(world) if is_applied else (0.0,) * 7,
        distortion=0.0 if is_applied else distortion_of(given, fitter.found, points),
    )


def distortion_of(given: Sequence[Camera], found: Sequence[Evidence], points: NDArray[np.float64]) -> float:
    """Return how far lenses move the surface in images beyond what is stated, root mean square [pixel].

    It is 0 where that is chance, or less than `LEAST_DISTORTION`.

    Args:
        given: Cameras as the capture states them.
        found: What each photograph says.
        points: Of the subject's surface [m], ``(N, 3)``.
    """
    kinds = (MOVED_KINDS[0], "radial")
    if not is_certain(strength(found, kinds, "radial")):
        return 0.0
    moves = np.stack([says.solved(kinds)[0] for says in found])
    moves[:, rows_of(kinds[:1])] = 0.0
    pixels = root_mean_square([pixels_of(*pair, points) for pair in zip(given, moves, strict=True)])
    return pixels if pixels > LEAST_DISTORTION else 0.0


def pixels_of(camera: Camera, move: NDArray[np.float64], points: NDArray[np.float64]) -> float:
    """Return how far a correction moves points in an image, root mean square [pixel]; 0 if it shows none of them."""
    moved = np.tensordot(move, flow_of(camera, points), axes=1)
    return float(np.sqrt(np.square(moved).sum(axis=0).mean())) if moved.size else 0.0


def error_of(camera: Camera, covariance: NDArray[np.float64], points: NDArray[np.float64]) -> float:
    """Return the standard error of where an image shows points [pixel], from the covariance of its camera's numbers."""
    part = flow_of(camera, points)
    return float(np.sqrt(np.einsum("iap,ij,jap->p", part, covariance, part).mean())) if part.size else 0.0
