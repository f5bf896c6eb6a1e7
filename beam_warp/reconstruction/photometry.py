"""Exposures, white balances and vignetting of a rig's cameras, from what they show of the same points of the surface.

A photograph of a matte surface tells its camera's gains; gloss does not look alike from everywhere, and shifts what a
camera seems to be off by. Where the light of a capture is known, gloss is known but for its roughness:

    c[v, i] = g[v] cos^n[v, i] (d[i] + sum over k of w[i, k] s[k, v, i])

with the colour c that view v shows of point i, its gains g, the cosine of the angle to the optical axis and the power n
of the rig's vignetting, the point's diffuse colour d, and the highlight s that a smooth surface there would show at
roughness k: the light, blurred by the lobe, in the mirrored direction, times the specular albedo of a dielectric. A
material of one roughness that nothing hides has a weight w of 1 for it and 0 for others. So the prior of the weights is
normal with the mean and covariance of such a choice, whose probabilities all points share: what is left to 1 is hidden.
All begin alike, and are then the mean of the points' weights. Gains are those of least squares with all points'
unknowns eliminated. Each point has a deviation of its own, so that fine texture, and places where the surface is wrong,
count little. Points are those whose neighbours' normals agree most.

How sure the gains are is asked twice. The bright and the dark half of the points must tell the same, for gloss is a
larger part of what a dark point shows: half of their difference is as large as the error. Of what the model of gloss
changes, half may be wrong. Exposures and white balances stay as they are unless they are beyond that, and exposures
beyond what halves share as well (an F test of the mean squares), each on its own evidence. Then they shrink by what the
error explains of them. So a sound capture stays as it is, to the bit. The mean over the cameras is held. The power of
vignetting is one number, so it is judged by its error alone, and is not among the unknowns unless it is beyond doubt: 0
holds of lenses whose images were corrected.

Sources: empirical Bayes, Efron and Morris 1973; random effects, Laird and Ware 1982; Cauchy's weights, Holland and
Welsch 1977; the split sum, Karis 2013; vignetting as a power of the cosine, the fourth for a thin lens, Horn 1986.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.special import chdtri, fdtri, ndtri

from beam_warp.capture.exposures import CameraExposure, RigExposures
from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device
from beam_warp.image.color import LUMINANCE
from beam_warp.image.metrics import root_mean_square
from beam_warp.light.ggx import specular_albedo
from beam_warp.light.prefiltered import LEVEL_ROUGHNESS, blurred_environment
from beam_warp.reconstruction.initial import view_samples
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud

FEWEST_CAMERAS = 6
"""Fewest cameras that are compared."""

LEVELS = (2, 5, 7, 9, 11)
"""Levels of `LEVEL_ROUGHNESS` whose highlights explain those of all others about: roughness 0.15 to 0.83."""

COSINES = np.linspace(0.0, 1.0, 65)
"""Cosines between which specular albedos are interpolated."""

NEIGHBORS = 8
"""Gaussians over which normals are averaged."""

CHANCE = 1e-3
"""Probability below which differences of gains are not chance."""


@dataclass(frozen=True)
class SharedErrors:
    """Errors that halves of the points share, because the surface or what is known of its gloss is wrong.

    Attributes:
        exposure: Of the logarithms of exposures, root mean square.
        balance: Of those of white balances, likewise.
        falloff: Of the power of vignetting.
    """

    exposure: float
    balance: float
    falloff: float


MODEL_ERRORS = SharedErrors(0.015, 0.0, 0.5)
"""Where the light is known: cameras of walker, runner and robot, whose exposures are equal, seem to differ by 0.005,
0.005 and 0.017. The power of their lenses, which are pinholes, seems to be 0.0 and 0.3; that of a round body that fills
the image, so that outlines are farthest off the axis, 0.4, and 1.2 under a low sun."""

MATTE_ERRORS = SharedErrors(0.06, 0.03, 0.3)
"""Where it is not, so that all looks matte: all cameras, or eight, of walker, runner and robot seem to differ by 0.02,
0.02 and 0.06 on their true surfaces, white balances by 0.005, 0.005 and 0.03, powers by 0.1, 0.3 and 0.3."""

FIRST_POINTS, MOST_POINTS = 1_024, 4_096
"""Most points that are compared, evenly chosen: at first, and where these say that something may be wrong."""

SMOOTHEST = 0.25
"""Part of the points that may be compared, those whose neighbours' normals agree most: where they do not, the surface
is wrong, and so is the gloss that is expected of it."""

FEWEST_POINTS, LEAST_OF_VIEW = 64, 0.1
"""Fewest points that tell gains, and the least part of those that the middle view sees which tell a view's: one that
looks into the shadow may see three of the bright half, and nothing would hold its gain."""

LARGEST_GAIN = 3.0
"""Largest logarithm of a gain: nearer to 0 than 1/20, no step leads back."""

LEAST_VIEWS, LEAST_MATTE_VIEWS = 4, 3
"""Views that a point is seen by at least where its gloss is looked for, and where it is not: two views could not tell
whether the surface is right."""

DARKEST = 0.03
"""Part of the median colour below which a point is left out: its noise and what it mirrors are as large as itself."""

ROUNDS = 30
"""Rounds of least squares at most."""

SETTLED = 2e-4
"""Change of the gains' logarithms at which rounds end."""

LEAST_CHANCE, LEAST_VARIANCE = 0.01, 1e-4
"""Least chance of a roughness, so that none is ruled out for good, and what keeps covariances from being singular."""

LEAST_SPREAD = 0.01
"""Least standard deviation of a colour that is assumed, of itself: that of eight bits and of filters."""


EXPOSURE, BALANCE = np.full((3, 1), 1.0 / 3.0), np.eye(3) - 1.0 / 3.0
"""Exposure and white balance as linear functions of the logarithms of three gains, ``(3, 1)`` and ``(3, 3)``."""


@dataclass(frozen=True, eq=False)
class SolvedGains:
    """Natural logarithms of the gains of views, each of mean 0 over the views, ``(V, 3)``, and vignetting.

    Attributes:
        logs: Of red, green and blue.
        apart: Half the difference of what the bright and the dark half of the points tell, over views that both know.
        gloss: Half of what the model of gloss changes.
        falloff: Power of the cosine that darkens images off the axis.
        falloff_error: Its standard error.
        shared: Errors that neither of these tells.
    """

    logs: NDArray[np.float64]
    apart: NDArray[np.float64]
    gloss: NDArray[np.float64]
    falloff: float = 0.0
    falloff_error: float = 0.0
    shared: SharedErrors = MODEL_ERRORS

    def error(self, what: NDArray[np.float64]) -> float:
        """Return the standard error, root mean square, of linear functions of the logarithms, ``(3, k)``."""
        return float(np.sqrt(np.mean(np.square(self.apart @ what)) + np.mean(np.square(self.gloss @ what))))

    def may_be_wrong(self) -> bool:
        """Return whether exposures, white balances or vignetting are larger than their standard error."""
        return self.may_vignette or any(
            root_mean_square(self.logs @ what) > self.error(what) for what in (EXPOSURE, BALANCE)
        )

    @property
    def may_vignette(self) -> bool:
        """Whether images are darker off the axis by more than the standard error."""
        return self.falloff > self.falloff_error

    @property
    def vignettes(self) -> bool:
        """Whether images are darker off the axis beyond chance: none is brighter there."""
        return bool(self.falloff > -ndtri(CHANCE) * np.hypot(self.falloff_error, self.shared.falloff))


def may_compare(views: Sequence[CapturedView]) -> bool:
    """Return whether views are as many as it takes, and all or none show where the subject ends."""
    return len(views) >= FEWEST_CAMERAS and len({view.alpha is None for view in views}) == 1


def find_exposures(
    names: Sequence[str],
    views: Sequence[CapturedView],
    cloud: GaussianCloud,
    normals: NDArray[np.floating],
    environment: EnvironmentMap | None,
    *,
    device: str | None = None,
) -> RigExposures | None:
    """Find exposures, white balances and vignetting of the cameras of a rig.

    Args:
        names: Names of the cameras.
        views: The photograph of each of them at one moment.
        cloud: The Gaussians of that moment.
        normals: Which way the surface faces, ``(N, 3)``; 0 where it is not known.
        environment: The light of the capture, in units of the photographs; without, the surface is taken as matte, and
            gloss as a larger error.
        device: Warp device; None takes the first CUDA device, or the CPU.

    Returns:
        What was found; None where the views share too little.

    Raises:
        DeviceError: There is no such device.
    """
    normals, agreement = smoothed(cloud.positions, normals)
    samples = view_samples(views, cloud, normals, device=device).numpy()
    least = LEAST_MATTE_VIEWS if environment is None else LEAST_VIEWS
    rows = smoothest(np.where((samples[..., 3] > 0.0).sum(axis=0) >= least, agreement, 0.0))
    solved = None
    for most in (FIRST_POINTS, MOST_POINTS):
        chosen = rows[np.linspace(0, len(rows) - 1, min(len(rows), 2 * most)).astype(int)]
        away = np.stack([view.camera.position for view in views])[:, None] - cloud.positions[chosen].astype(np.float64)
        away /= np.linalg.norm(away, axis=2, keepdims=True)
        gloss = np.zeros((*away.shape, 0))
        if environment is not None:
            gloss = highlights(normals[chosen].astype(np.float64), away, environment, device)
        axes = np.stack([view.camera.forward for view in views])
        cosines = -(away * axes[:, None]).sum(axis=2)
        solved = solve_gains(samples[:, chosen], gloss, cosines, most)
        if solved is not None and solved.may_vignette:
            darkened = solve_gains(samples[:, chosen], gloss, cosines, most, vignetting=True)
            solved = darkened if darkened is not None and darkened.vignettes else solved
        if solved is None or not solved.may_be_wrong():
            break
    return None if solved is None else judged(names, solved)


def smoothed(
    positions: NDArray[np.floating], normals: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.floating]]:
    """Return the mean direction of the nearest normals, and how far they agree, in [0, 1]; 0 where there is none."""
    near = cKDTree(positions).query(positions, k=min(NEIGHBORS, len(positions)), workers=-1)[1]
    mean = normals[near.reshape(len(positions), -1)].mean(axis=1)
    length = np.linalg.norm(mean, axis=1)
    return np.divide(mean, length[:, None], out=np.zeros_like(mean), where=length[:, None] > 0.0), length


def smoothest(agreement: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return the rows of points that are compared: of those with any agreement the part that has most; ascending."""
    rows = np.flatnonzero(agreement > 0.0)
    count = max(round(SMOOTHEST * len(rows)), 2 * FIRST_POINTS)
    return np.sort(rows[np.argsort(-agreement[rows], kind="stable")[:count]])


def highlights(
    normals: NDArray[np.float64], away: NDArray[np.float64], environment: EnvironmentMap, device: Any = None
) -> NDArray[np.float64]:
    """Return what smooth dielectric surfaces mirror of a light that nothing hides.

    Args:
        normals: Unit normals, ``(N, 3)``.
        away: Unit directions towards the views, ``(V, N, 3)``.
        environment: The light.
        device: Warp device that blurs it; None takes the first CUDA device, or the CPU.

    Returns:
        Radiance for each roughness of `LEVELS`, ``(V, N, 3, K)``; 0 from behind.
    """
    cosine = (away * normals).sum(axis=2)
    x, y, z = np.moveaxis(2.0 * cosine[..., None] * normals - away, 2, 0)
    u, v = 0.5 - np.arctan2(y, x) / (2.0 * np.pi), np.arccos(np.clip(z, -1.0, 1.0)) / np.pi
    light = blurred_environment(environment, resolve_device(device))
    texels, heights, offsets = light.texels.numpy(), light.heights.numpy(), light.offsets.numpy()
    seen = []
    for level in LEVELS:
        rows = int(heights[level])
        image = texels[offsets[level] : offsets[level] + 2 * rows * rows].reshape(rows, 2 * rows, 3)
        place = np.stack([np.clip(v * rows - 0.5, 0.0, rows - 1.0), u * 2 * rows - 0.5])
        albedo = np.interp(cosine, COSINES, specular_albedo(COSINES, LEVEL_ROUGHNESS[level]))
        mirrored = [map_coordinates(image[..., hue], place, order=1, mode="grid-wrap") for hue in range(3)]
        seen.append(np.stack(mirrored, axis=-1) * (albedo * (cosine > 0.0))[..., None])
    return np.stack(seen, axis=-1)


def solve_gains(
    samples: NDArray[np.floating],
    gloss: NDArray[np.floating],
    cosines: NDArray[np.floating],
    most: int = FIRST_POINTS,
    *,
    vignetting: bool = False,
) -> SolvedGains | None:
    """Solve for the gains of views.

    Args:
        samples: Scene-linear colour and weight of each point in each view, 0 where it is not seen, ``(V, N, 4)``.
        gloss: Highlights of a smooth dielectric for each roughness, ``(V, N, 3, K)``; K = 0 where they are not known.
        cosines: Of the angle between each point and the optical axis of each view, ``(V, N)``.
        most: Most points that are compared, evenly chosen.
        vignetting: Whether vignetting is among the unknowns; if not, gains are those of lenses without, and its power
            is what a step of Newton's from there finds, a third to all of it.

    Returns:
        The gains, 0 of views that share nothing with others; None where there are fewer than `FEWEST_POINTS`.
    """
    colors, weights = samples[..., :3].astype(np.float64), samples[..., 3].astype(np.float64)
    weights = np.where(colors.min(axis=2) > 0.0, weights, 0.0)
    totals = weights.sum(axis=0)
    means = (colors * weights[..., None]).sum(axis=0) / np.maximum(totals, 1e-300)[:, None]
    is_matte = gloss.shape[3] == 0
    known = (weights > 0.0).sum(axis=0) >= (LEAST_MATTE_VIEWS if is_matte else LEAST_VIEWS)
    known &= (means > DARKEST * np.median(means[known], axis=0)).all(axis=1) if known.any() else known
    rows = np.flatnonzero(known)
    if len(rows) < FEWEST_POINTS:
        return None
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)]
    scale = means[rows, None, :]
    relative, seen = colors[:, rows].transpose(1, 0, 2) / scale, weights[:, rows].T
    shine = gloss[:, rows].transpose(1, 0, 2, 3) / scale[..., None]
    # A point that a view does not see may be behind it.
    falls = np.log(np.where(seen > 0.0, cosines[:, rows].T, 1.0))
    levels = means[rows] @ LUMINANCE
    is_bright = levels > np.median(levels)
    all_of_them = np.ones(len(rows), bool)
    told = np.logical_and(*(_tell(seen[half]) for half in (is_bright, ~is_bright)))
    asked = ((all_of_them, shine), (all_of_them, shine[..., :0]), (is_bright, shine), (~is_bright, shine))
    with ThreadPoolExecutor(len(asked)) as pool:
        every, matte, bright, dark = pool.map(
            lambda it: _Solver(relative[it[0]], seen[it[0]], it[1][it[0]], falls[it[0]]).solve(vignetting), asked
        )
    apart, of_gloss = (0.5 * (one - other) for one, other in ((bright, dark), (every, matte)))
    views = len(samples)
    if not told.any():
        return None
    logs, apart_logs, gloss_logs = (numbers[:-1].reshape(views, 3) for numbers in (every, apart, of_gloss))
    return SolvedGains(
        logs,
        np.where(told[:, None], apart_logs, 0.0) * np.sqrt(views / told.sum()),
        gloss_logs,
        falloff=float(every[-1]),
        falloff_error=float(np.hypot(apart[-1], of_gloss[-1])),
        shared=MATTE_ERRORS if is_matte else MODEL_ERRORS,
    )


def _tell(weights: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which views see enough points to have gains, of weights of points in views, ``(N, V)``."""
    counts = (weights > 0.0).sum(axis=0)
    return counts >= max(1.0, LEAST_OF_VIEW * float(np.median(counts)))


class _Solver:
    """Rounds of least squares over points, ``(N,)``, and the channels of views, ``(3 V,)``."""

    def __init__(
        self,
        colors: NDArray[np.float64],
        weights: NDArray[np.float64],
        gloss: NDArray[np.float64],
        falls: NDArray[np.float64],
    ) -> None:
        count, views, _, kinds = gloss.shape
        self._colors = colors.reshape(count, -1)
        weights = np.where(_tell(weights), weights, 0.0)
        self._weights = np.repeat(weights, 3, axis=1)
        own = np.broadcast_to(np.tile(np.eye(3), views), (count, 3, 3 * views))
        self._basis = np.concatenate([own, gloss.reshape(count, 3 * views, kinds).transpose(0, 2, 1)], axis=1)
        self._chances = np.full(kinds, 1.0 / (kinds + 1))
        seen = (self._weights > 0.0).sum(axis=1)
        self._middle = np.stack([(seen - 1) // 2, seen // 2], axis=1)
        self._factors = self._weights / LEAST_SPREAD**2
        self._falls = np.repeat(falls, 3, axis=1)
        self._logs, self._falloff = np.zeros(3 * views), 0.0
        self._known = np.append(np.flatnonzero(self._weights.any(axis=0)), 3 * views)
        shared = len(self._known) // 3
        self._held = np.eye(len(self._known))
        self._held[:-1, :-1] -= np.kron(np.full((shared, shared), 1.0 / max(shared, 1)), np.eye(3))

    def solve(self, vignetting: bool) -> NDArray[np.float64]:
        """Return the logarithms of the gains, 0 of views that see nothing, and the power of vignetting, ``(3 V + 1,)``.

        Without ``vignetting``, that is the power of one step beyond gains of lenses without.
        """
        moved = slice(None) if vignetting else slice(-1)
        for _ in range(ROUNDS):
            matrix, right = self._round()
            change = self._step(matrix, right, moved)
            self._logs[self._known[:-1]] += change[: len(self._known) - 1]
            self._logs = np.clip(self._logs, -LARGEST_GAIN, LARGEST_GAIN)
            self._falloff += change[-1] if vignetting else 0.0
            if np.abs(change).max(initial=0.0) < SETTLED:
                break
        if not vignetting:
            self._falloff = float(self._step(*self._round(), slice(None))[-1])
        return np.array([*self._logs, self._falloff])

    def _step(self, matrix: NDArray[np.float64], right: NDArray[np.float64], moved: slice) -> NDArray[np.floating]:
        """Return the change of those numbers that are known and moved, the gains' mean held."""
        held, known = self._held[moved, moved], self._known[moved]
        return np.linalg.lstsq(held @ matrix[np.ix_(known, known)] @ held, held @ right[known], rcond=1e-9)[0]

    def _round(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return normal equations for a change of gains and vignetting, points' unknowns eliminated at those so far.

        Then the chances of roughnesses and the weights are brought up to date.
        """
        gains, basis = np.exp(self._logs + self._falloff * self._falls), self._basis
        weighted = basis * (self._factors * gains**2)[:, None]
        precision = np.diag(np.full(basis.shape[1], 1e-9))
        precision[3:, 3:] = np.linalg.inv(
            np.diag(self._chances + LEAST_VARIANCE) - np.outer(self._chances, self._chances)
        )
        spread = np.linalg.inv(weighted @ basis.transpose(0, 2, 1) + precision)
        given = np.concatenate([np.zeros(3), precision[3:, 3:] @ self._chances])
        found = spread @ (weighted @ (self._colors / gains)[..., None] + given[:, None])
        plain = (found.transpose(0, 2, 1) @ basis)[:, 0]
        model = plain * gains
        left = self._colors - model
        weighted *= plain[:, None]
        weighted = np.dstack([weighted, (weighted * self._falls[:, None]).sum(axis=2)])
        rows = (np.linalg.cholesky(spread).transpose(0, 2, 1) @ weighted).reshape(-1, weighted.shape[2])
        own, force = self._factors * model**2, self._factors * model * left
        matrix = np.diag(np.append(own.sum(axis=0), (own * self._falls**2).sum()))
        matrix[-1, :-1] = matrix[:-1, -1] = (own * self._falls).sum(axis=0)
        matrix -= rows.T @ rows
        right = np.append(force.sum(axis=0), (force * self._falls).sum())
        self._learn(found[:, 3:, 0], left)
        return matrix, right

    def _learn(self, found: NDArray[np.float64], left: NDArray[np.float64]) -> None:
        """Take the chances of roughnesses and the weights of samples from points' weights of gloss and what is left."""
        chances = np.maximum(found.mean(axis=0), LEAST_CHANCE)
        self._chances = chances / max(float(chances.sum()), 1.0)
        off = np.abs(left) * np.sqrt(self._weights)
        ordered = np.sort(np.where(self._weights > 0.0, off, np.inf), axis=1)
        middle = 0.5 * np.take_along_axis(ordered, self._middle, axis=1).sum(axis=1, keepdims=True)
        deviation = np.maximum(1.4826 * middle, LEAST_SPREAD)
        self._factors = self._weights / (deviation**2 + off**2)


def judged(names: Sequence[str], solved: SolvedGains) -> RigExposures:
    """Return exposures, white balances and vignetting of cameras, undone as far as they are beyond chance.

    Args:
        names: Names of the cameras.
        solved: Their gains.
    """
    exposures, balances = solved.logs @ EXPOSURE, solved.logs @ BALANCE
    exposure_error, balance_error = solved.error(EXPOSURE), solved.error(BALANCE)
    kept = _part_beyond_chance(exposures, exposure_error, solved.shared.exposure, len(names) - 1)
    kept_balance = _part_beyond_chance(balances, balance_error, solved.shared.balance, 2 * (len(names) - 1))
    gains = np.exp(kept * exposures + kept_balance * balances)
    stops = exposures[:, 0] / np.log(2.0)
    return RigExposures(
        tuple(
            CameraExposure(name, float(stop), tuple(balance.tolist()), tuple(gain.tolist()))
            for name, stop, balance, gain in zip(names, stops, balances, gains, strict=True)
        ),
        exposure_error=exposure_error / float(np.log(2.0)),
        balance_error=balance_error,
        exposure_undone=kept > 0.0,
        balance_undone=kept_balance > 0.0,
        falloff=solved.falloff,
        falloff_error=solved.falloff_error,
        falloff_undone=solved.vignettes,
    )


def _part_beyond_chance(found: NDArray[np.float64], error: float, shared: float, freedom: int) -> float:
    """Return the part of what was found that an error does not explain.

    It is 0 unless tests say that the error, with what halves of the points share, is not all: an F test of the error,
    which is known from as many numbers, a chi-square test of what is shared.
    """
    signal = float(np.mean(np.square(found)))
    chance = error**2 / fdtri(freedom, freedom, CHANCE)  # F's upper quantile, of equal freedoms
    if not signal > chance + shared**2 * chdtri(freedom, CHANCE) / freedom:
        return 0.0
    return 1.0 - error**2 / signal
