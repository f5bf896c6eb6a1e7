"""Exposures and white balances of a rig's cameras, from what they show of the same points of the surface.

A photograph of a matte surface tells its camera's gains; gloss does not look alike from everywhere, and shifts what a
camera seems to be off by. Where the light of a capture is known, gloss is known but for its roughness:

    c[v, i] = g[v] (d[i] + sum over k of w[i, k] s[k, v, i])

with the colour c that view v shows of point i, its gains g, the point's diffuse colour d, and the highlight s that a
smooth surface there would show at roughness k: the light, blurred by the lobe, in the mirrored direction, times the
specular albedo of a dielectric. The weights w of a material of one roughness are 1 for it and 0 for others, less what
hides the light. They have a normal prior that all points share, whose mean and covariance are found from the points
themselves, starting from that of an unknown roughness. Gains are those of least squares with all points' unknowns
eliminated; what does not fit counts little.

How sure they are comes from leaving out one part of the surface after the other: gloss that the model does not explain
differs from part to part. Exposures and white balances stay as they are unless they are beyond that chance (an F test
of the two mean squares), each on its own evidence. Then each shrinks by what chance explains of it. So a sound capture
stays as it is, to the bit. The mean over the cameras is held.

Sources: empirical Bayes, Efron and Morris 1973; EM for the prior of random effects, Laird and Ware 1982; robust weights,
Huber 1964; the jackknife, Efron and Stein 1981; the split sum, Karis 2013.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.cluster.vq import kmeans2
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from beam_warp.capture.exposures import CameraExposure, RigExposures
from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device
from beam_warp.jobs.listeners import no_progress
from beam_warp.light.ggx import specular_albedo
from beam_warp.light.prefiltered import LEVEL_ROUGHNESS, blurred_environment
from beam_warp.reconstruction.fit import FitOptions, fit_gaussians
from beam_warp.reconstruction.frames.protocols import StepProgress
from beam_warp.reconstruction.initial import initial_gaussians, view_samples
from beam_warp.reconstruction.track import outward_normals
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud

FEWEST_CAMERAS = 6
"""Fewest cameras that are compared."""

LEVELS = (2, 5, 7, 9, 11)
"""Levels of `LEVEL_ROUGHNESS` whose highlights explain those of all others about: roughness 0.15 to 0.83."""

COSINES = np.linspace(0.0, 1.0, 65)
"""Cosines between which specular albedos are interpolated."""

GLOSS_LEFT = 0.5
"""Part of the gloss model's effect on the gains that may be wrong: a standard error of its own. Parts of the surface
that are left out tell nothing of what all have in common, such as the hidden part of the light."""

NEIGHBORS = 8
"""Gaussians over which normals are averaged."""

CHANCE = 1e-3
"""Probability below which differences of gains are not chance."""

PARTS = 16
"""Parts of the surface of which one after the other is left out."""

MOST_POINTS = 1_024
"""Most points that are compared, evenly chosen."""

LEAST_VIEWS = 4
"""Views that a point is seen by at least: three numbers of its own are found."""

DARKEST = 0.03
"""Part of the median colour below which a point is left out: its noise and what it mirrors are as large as itself."""

ROUNDS = 30
"""Rounds of least squares at most."""

SETTLED = 2e-4
"""Change of the gains' logarithms at which rounds end."""

LEAST_SPREAD = 0.01
"""Least standard deviation of a colour that is assumed, of itself: that of eight bits and of filters."""

FIT_GAUSSIANS = 20_000
"""Most Gaussians of the surface at which views are compared."""

LARGEST_SIDE = 320
"""Pixels of a side at which views are compared, about."""


@dataclass(frozen=True, eq=False)
class SolvedGains:
    """Gains of views against each other.

    Attributes:
        logs: Natural logarithms of the gains of red, green and blue, of mean 0 over views, ``(V, 3)``.
        left_out: The same with one part of the surface left out, ``(P, V, 3)``.
        matte: The same if nothing shone, ``(V, 3)``.
    """

    logs: NDArray[np.float64]
    left_out: NDArray[np.float64]
    matte: NDArray[np.float64]

    def errors(self, what: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return standard errors, ``(V, k)``, of linear functions of the logarithms, ``(3, k)``."""
        found, gloss = self.left_out @ what, GLOSS_LEFT * ((self.logs - self.matte) @ what)
        return np.sqrt((len(found) - 1) * found.var(axis=0) + np.mean(np.square(gloss)))


def find_exposures(
    names: Sequence[str],
    views: Sequence[CapturedView],
    environment: EnvironmentMap,
    options: FitOptions,
    *,
    device: str | None = None,
    progress: StepProgress = no_progress,
) -> RigExposures | None:
    """Find exposures and white balances of the cameras of a rig.

    Args:
        names: Names of the cameras.
        views: The photograph of each of them at one moment, with masks.
        environment: The light of the capture, in units of the photographs.
        options: How key frames are fitted.
        device: Warp device; None takes the first CUDA device, or the CPU.
        progress: Called with (done, total, facts), in steps.

    Returns:
        What was found; None where there are fewer than `FEWEST_CAMERAS`, a view has no mask, or the views share too
        little.

    Raises:
        InvalidArrayError: The masks have no volume in common.
        DeviceError: There is no such device.
    """
    if len(views) < FEWEST_CAMERAS or any(view.alpha is None for view in views):
        return None
    reduced = [view.reduced(max(1, min(view.camera.width, view.camera.height) // LARGEST_SIDE)) for view in views]
    cloud, normals = _surface(reduced, options, device, progress)
    samples = view_samples(reduced, cloud, normals, device=device).numpy()
    rows = np.flatnonzero(((samples[..., 3] > 0.0).sum(axis=0) >= LEAST_VIEWS) & normals.any(axis=1))
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), 2 * MOST_POINTS)).astype(int)]
    if len(rows) < 4 * PARTS:
        return None
    positions = cloud.positions[rows].astype(np.float64)
    away = np.stack([view.camera.position for view in views])[:, None] - positions
    away /= np.linalg.norm(away, axis=2, keepdims=True)
    gloss = highlights(normals[rows].astype(np.float64), away, environment, device)
    parts = kmeans2(positions, PARTS, seed=options.seed, minit="++")[1]
    solved = solve_gains(samples[:, rows], gloss, parts)
    return None if solved is None else judged(names, solved)


def _surface(
    views: Sequence[CapturedView], options: FitOptions, device: str | None, progress: StepProgress
) -> tuple[GaussianCloud, NDArray[np.float32]]:
    """Return Gaussians that a quick fit brings to the surface, and their normals, 0 where these are not known."""
    count = min(options.gaussian_count, FIT_GAUSSIANS)
    start = initial_gaussians(views, count, device=device, seed=options.seed)
    fitting = FitOptions.of_preset("draft", gaussian_count=count, raster=options.raster, samples=1, seed=options.seed)
    cloud = fit_gaussians(views, start, fitting, device=device, progress=progress).cloud
    outward = Rotation.from_quat(start.orientations).apply([0.0, 0.0, 1.0])
    nearest = cKDTree(start.positions).query(cloud.positions, workers=-1)[1]
    normals = outward_normals(cloud, outward[nearest])
    near = cKDTree(cloud.positions).query(cloud.positions, k=min(NEIGHBORS, len(cloud)), workers=-1)[1]
    mean = normals[near.reshape(len(cloud), -1)].sum(axis=1)
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    return cloud, np.divide(mean, length, out=np.zeros_like(mean), where=length > 0.0)


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
    samples: NDArray[np.floating], gloss: NDArray[np.floating], parts: NDArray[np.integer]
) -> SolvedGains | None:
    """Solve for the gains of views.

    Args:
        samples: Scene-linear colour and weight of each point in each view, 0 where it is not seen, ``(V, N, 4)``.
        gloss: Highlights of a smooth dielectric for each roughness, ``(V, N, 3, K)``.
        parts: Part of the surface that each point belongs to, from 0 on, ``(N,)``.

    Returns:
        The gains; None where the points do not tell them.
    """
    colors, weights = samples[..., :3].astype(np.float64), samples[..., 3].astype(np.float64)
    weights = np.where(colors.min(axis=2) > 0.0, weights, 0.0)
    totals = weights.sum(axis=0)
    means = (colors * weights[..., None]).sum(axis=0) / np.maximum(totals, 1e-300)[:, None]
    known = (weights > 0.0).sum(axis=0) >= LEAST_VIEWS
    if not known.any():
        return None
    known &= (means > DARKEST * np.median(means[known], axis=0)).all(axis=1)
    rows = np.flatnonzero(known)
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_POINTS)).astype(int)]
    seen = weights[:, rows].sum(axis=1) > 0.0
    if len(rows) < 4 * PARTS or not seen.all():
        return None
    scale = means[rows, None, :]
    relative = colors[:, rows].transpose(1, 0, 2) / scale
    shine = gloss[:, rows].transpose(1, 0, 2, 3) / scale[..., None]
    matte = _Solver(relative, weights[:, rows].T, shine[..., :0], parts[rows]).solve()
    found = _Solver(relative, weights[:, rows].T, shine, parts[rows]).solve()
    return replace(found, matte=matte.logs)


class _Solver:
    """Rounds of least squares over points ``(N,)`` and rows ``(3 V,)``, the channels of views."""

    def __init__(
        self,
        colors: NDArray[np.float64],
        weights: NDArray[np.float64],
        gloss: NDArray[np.float64],
        parts: NDArray[np.integer],
    ) -> None:
        count, views, _, kinds = gloss.shape
        self._colors = colors.reshape(count, -1)
        self._weights = np.repeat(weights, 3, axis=1)
        own = np.broadcast_to(np.tile(np.eye(3), (views, 1)), (count, 3 * views, 3))
        self._basis = np.concatenate([own, gloss.reshape(count, 3 * views, kinds)], axis=2)
        self._parts = parts
        self._prior_mean = np.full(kinds, 1.0 / max(kinds, 1))
        self._prior = np.eye(kinds) / max(kinds, 1)
        self._factors = self._weights / LEAST_SPREAD
        self._logs = np.zeros(3 * views)
        self._held = np.eye(3 * views) - np.kron(np.full((views, views), 1.0 / views), np.eye(3))

    def solve(self) -> SolvedGains:
        """Return the gains of the last round, and those that each part less would have given."""
        matrices, rights = self._round()
        for _ in range(ROUNDS):
            change = self._step(matrices.sum(axis=0), rights.sum(axis=0))
            self._logs = self._logs + change
            matrices, rights = self._round()
            if np.abs(change).max() < SETTLED:
                break
        matrix, right = matrices.sum(axis=0), rights.sum(axis=0)
        less = [self._logs + self._step(matrix - m, right - r) for m, r in zip(matrices, rights, strict=True)]
        logs = self._logs.reshape(-1, 3)
        return SolvedGains(logs, np.stack(less).reshape(len(less), -1, 3), logs)

    def _step(self, matrix: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the change of least squares whose mean over views is 0."""
        return np.linalg.lstsq(self._held @ matrix @ self._held, self._held @ right, rcond=1e-9)[0]

    def _round(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Fit the points at the gains so far; return the normal equations of each part for a change of the gains.

        The points' unknowns are eliminated. Then the prior and the weights are brought up to date.
        """
        basis = self._basis * np.exp(self._logs)[None, :, None]
        weighted = basis * self._factors[..., None]
        precision = np.zeros((basis.shape[2],) * 2)
        precision[3:, 3:] = np.linalg.inv(self._prior)
        spread = np.linalg.inv(weighted.transpose(0, 2, 1) @ basis + precision + 1e-9 * np.eye(len(precision)))
        given = np.concatenate([np.zeros(3), precision[3:, 3:] @ self._prior_mean])
        found = (spread @ ((weighted.transpose(0, 2, 1) @ self._colors[..., None])[..., 0] + given)[..., None])[..., 0]
        model = (basis @ found[..., None])[..., 0]
        left = self._colors - model
        matrices, rights = self._normal_equations(model, left, weighted, spread)
        self._learn(found[:, 3:], spread[:, 3:, 3:], left)
        return matrices, rights

    def _normal_equations(
        self,
        model: NDArray[np.float64],
        left: NDArray[np.float64],
        weighted: NDArray[np.float64],
        spread: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        half = (weighted * model[..., None]) @ np.linalg.cholesky(spread)
        matrices, rights = [], []
        for part in np.unique(self._parts):
            chosen = self._parts == part
            rows = half[chosen].transpose(0, 2, 1).reshape(-1, model.shape[1])
            matrices.append(np.diag((self._factors * model**2)[chosen].sum(axis=0)) - rows.T @ rows)
            rights.append((self._factors * model * left)[chosen].sum(axis=0))
        return np.stack(matrices), np.stack(rights)

    def _learn(self, found: NDArray[np.float64], spread: NDArray[np.float64], left: NDArray[np.float64]) -> None:
        """Take the prior of all points' weights of gloss, and the weights of all samples, from what was found."""
        self._prior_mean = np.maximum(found.mean(axis=0), 0.0)
        apart = found - self._prior_mean
        self._prior = apart.T @ apart / len(found) + spread.mean(axis=0) + 1e-6 * np.eye(found.shape[1])
        off = np.abs(left) * np.sqrt(self._weights)
        deviation = max(1.4826 * float(np.median(off[self._weights > 0.0])), LEAST_SPREAD)
        self._factors = self._weights / (deviation**2 * np.maximum(1.0, off / deviation))


def judged(names: Sequence[str], solved: SolvedGains) -> RigExposures:
    """Return the exposures and white balances of cameras, undone as far as they are beyond chance.

    Args:
        names: Names of the cameras.
        solved: Their gains.
    """
    mean = np.full((3, 1), 1.0 / 3.0)
    exposures, chroma = solved.logs @ mean, solved.logs @ (np.eye(3) - 1.0 / 3.0)
    exposure_errors, chroma_errors = solved.errors(mean), solved.errors(np.eye(3) - 1.0 / 3.0)
    freedom, parts = len(names) - 1, len(solved.left_out) - 1
    kept_exposure = _beyond_chance(exposures, exposure_errors, freedom, parts)
    kept_chroma = _beyond_chance(chroma, chroma_errors, 2 * freedom, parts)
    gains = np.exp(kept_exposure * exposures + kept_chroma * chroma)
    log_two = float(np.log(2.0))
    return RigExposures(
        tuple(
            CameraExposure(
                camera=name,
                stops=float(exposure[0]) / log_two,
                error=float(error[0]) / log_two,
                balance=tuple(balance),
                balance_error=float(np.sqrt(np.mean(np.square(balance_error)))),
                gains=tuple(gain),
            )
            for name, exposure, error, balance, balance_error, gain in zip(
                names, exposures, exposure_errors, chroma, chroma_errors, gains, strict=True
            )
        ),
        exposure_undone=bool(kept_exposure.any()),
        balance_undone=bool(kept_chroma.any()),
    )


def _beyond_chance(
    found: NDArray[np.float64], errors: NDArray[np.float64], freedom: int, error_freedom: int
) -> NDArray[np.float64]:
    """Return the part of each row that is no chance, ``(V, 1)``: nothing of all unless an F test finds differences."""
    signal, noise = float(np.mean(np.square(found))), float(np.mean(np.square(errors)))
    if not signal > noise * stats.f.isf(CHANCE, freedom, error_freedom):
        return np.zeros((len(found), 1))
    true = signal - noise
    return true / (true + np.mean(np.square(errors), axis=1, keepdims=True))
