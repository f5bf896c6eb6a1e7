"""Slow, obvious float64 twins of the tracer, without hierarchy or packing: what the fast code is measured against.

`visibility_reference` is the number itself. `visibility_enclosure` adds what float32 may make of it: each quantity of a
ray and a Gaussian carries an interval that follows from counting the tracer's roundings, so a bound is derived for
every ray and fitted for none.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.world.gaussians import GaussianCloud

ALPHA_MAX, ALPHA_MIN = 0.99, 1.0 / 255.0
"""Cap and cut of one Gaussian's alpha (Kerbl et al. 2023)."""

QUARTIC_FALLOFF = 4.5 / 81.0
"""Response exp(-x^4 / 18) of degree 4 (3DGRT)."""

FLOAT32_ROUNDOFF = 2.0**-24
"""Largest relative error of one float32 operation, u."""

PAIRS_AT_ONCE = 1 << 16
"""Ray and Gaussian pairs that are looked at together: arrays of half a megabyte stay in a core's own cache."""


def rotation_matrices(orientations: ArrayLike) -> NDArray[np.float64]:
    """Return rotation matrices ``(N, 3, 3)`` of quaternions xyzw ``(N, 4)``, normalised first."""
    q = np.asarray(orientations, dtype=np.float64)
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        axis=1,
    )


@dataclass(frozen=True)
class Enclosure:
    """Visibility of each ray, and between which values a float32 tracer that makes no mistake must land.

    Attributes:
        low: Smallest value that rounding can lead to, ``(N,)``.
        exact: Visibility in float64, never stopped early, ``(N,)``.
        high: Largest value, early stop included, ``(N,)``.
        hits: Gaussians that count, ``(N,)``.
    """

    low: NDArray[np.float64]
    exact: NDArray[np.float64]
    high: NDArray[np.float64]
    hits: NDArray[np.int64]

    @property
    def width(self) -> NDArray[np.float64]:
        """Largest error that rounding and the early stop can explain, ``(N,)``."""
        return np.maximum(self.high - self.exact, self.exact - self.low)


def visibility_reference(
    cloud: GaussianCloud,
    origins: ArrayLike,
    directions: ArrayLike,
    *,
    t_max: ArrayLike = math.inf,
    front: Literal["peak", "entry"] = "peak",
    cull: bool = False,
    response_degree: Literal[2, 4] = 2,
) -> NDArray[np.float64]:
    """Return the exact transmittance of each ray, never stopped early.

    Args:
        cloud: Occluders; scales of 0 are not allowed here. With ``cull`` it has normals.
        origins: Ray origins [m], ``(N, 3)``.
        directions: Unit directions, ``(N, 3)``.
        t_max: Reach of the rays [m], one number or ``(N,)``.
        front: A Gaussian counts if its ``"peak"`` lies in front of the origin, or its ``"entry"``.
        cull: Leave out Gaussians whose normal points along the ray.
        response_degree: 2 or 4.

    Returns:
        ``(N,)`` float64.

    Source: BEAM Eq. 7, with the cap 0.99 and the cut 1/255 of Kerbl et al. 2023.
    """
    return visibility_enclosure(
        cloud, origins, directions, t_max=t_max, front=front, cull=cull, response_degree=response_degree, roundoff=0.0
    ).exact


def visibility_enclosure(
    cloud: GaussianCloud,
    origins: ArrayLike,
    directions: ArrayLike,
    *,
    t_max: ArrayLike = math.inf,
    front: Literal["peak", "entry"] = "peak",
    cull: bool = False,
    response_degree: Literal[2, 4] = 2,
    stop: float = 0.0,
    middle: ArrayLike = (0.0, 0.0, 0.0),
    roundoff: float = FLOAT32_ROUNDOFF,
) -> Enclosure:
    """Return the exact transmittance of each ray and the interval that float32 must stay in.

    Where an interval straddles a decision (in front or not, above the cut or not), both outcomes are allowed.

    Args:
        cloud: As `visibility_reference`.
        origins: As `visibility_reference`.
        directions: As `visibility_reference`.
        t_max: As `visibility_reference`.
        front: As `visibility_reference`.
        cull: As `visibility_reference`.
        response_degree: As `visibility_reference`.
        stop: Transmittance below which the tracer may stop.
        middle: Point that the tracer's coordinates are relative to [m]: its distances are what is rounded.
        roundoff: Relative error of one operation; 0 encloses nothing but the exact value.
    """
    base = np.asarray(middle, np.float64)
    o = np.asarray(origins, np.float64).reshape(-1, 3) - base
    d = np.asarray(directions, np.float64).reshape(-1, 3)
    reach = np.broadcast_to(np.asarray(t_max, np.float64), len(o))
    low, exact, high = np.ones(len(o)), np.ones(len(o)), np.ones(len(o))
    hits = np.zeros(len(o), np.int64)
    seen = cloud.select(np.flatnonzero(cloud.opacities > np.float32(ALPHA_MIN)))
    if len(seen):
        gaussians = _Gaussians.of(seen, base, response_degree)
        for ray, index in _candidates(gaussians, o, d, roundoff):
            pair = _Pairs.of(gaussians, o[ray], d[ray], index, roundoff)
            counting, possible, certain = pair.decide(reach[ray], front, roundoff)
            if cull:
                along = np.einsum("nk,nk->n", np.asarray(seen.normals, np.float64)[index], d[ray])
                counting &= along <= 0.0
                possible &= along <= 4.0 * roundoff
                certain &= along <= -4.0 * roundoff
            np.multiply.at(exact, ray, np.where(counting, 1.0 - pair.alpha, 1.0))
            np.multiply.at(low, ray, np.where(possible, 1.0 - pair.alpha_high, 1.0))
            np.multiply.at(high, ray, np.where(certain, 1.0 - pair.alpha_low, 1.0))
            hits += np.bincount(ray[counting], minlength=len(o))
    # Each factor is rounded once as 1 - alpha and once as it is multiplied.
    growth = 2.0 * roundoff * hits
    return Enclosure(low * (1.0 - growth), exact, np.maximum(high * (1.0 + growth), min(stop, 1.0)), hits)


@dataclass(frozen=True)
class SurfaceReference:
    """What rays see front to back, in float64, and how far float32 may be off where no decision is in doubt.

    Attributes:
        depth, expected_depth, normals, attributes, transmittance, gaussians, hit_counts: As
            `beam_warp.trace.first_surface.SurfaceHits` has them.
        decided: Whether rounding can change neither which Gaussians are hit, nor their order, nor where blending ends
            or the threshold is met, ``(N,)``. The errors below hold for these rays.
        depth_error, expected_depth_error, transmittance_error: ``(N,)``.
        normal_error: Largest length of the difference, ``(N,)``.
        attribute_error: ``(N, C)``.
    """

    depth: NDArray[np.float64]
    expected_depth: NDArray[np.float64]
    normals: NDArray[np.float64]
    attributes: NDArray[np.float64]
    transmittance: NDArray[np.float64]
    gaussians: NDArray[np.int64]
    hit_counts: NDArray[np.int64]
    decided: NDArray[np.bool_]
    depth_error: NDArray[np.float64]
    expected_depth_error: NDArray[np.float64]
    transmittance_error: NDArray[np.float64]
    normal_error: NDArray[np.float64]
    attribute_error: NDArray[np.float64]


def closest_surface_reference(
    cloud: GaussianCloud,
    origins: ArrayLike,
    directions: ArrayLike,
    *,
    attributes: ArrayLike | None = None,
    t_max: ArrayLike = math.inf,
    threshold: float = 0.5,
    stop: float = 1e-3,
    front: Literal["peak", "entry"] = "peak",
    cull: bool = False,
    response_degree: Literal[2, 4] = 2,
    middle: ArrayLike = (0.0, 0.0, 0.0),
    roundoff: float = FLOAT32_ROUNDOFF,
) -> SurfaceReference:
    """Sort each ray's hits by (t, row) and blend them: the twin of `beam_warp.trace.first_surface.closest_surface`.

    Args:
        cloud: As `visibility_reference`.
        origins: As `visibility_reference`.
        directions: As `visibility_reference`.
        attributes: Values to blend, ``(M, C)``; None for none.
        t_max: As `visibility_reference`.
        threshold: Transmittance below which a surface is met.
        stop: Transmittance below which blending ends.
        front: As `visibility_reference`.
        cull: As `visibility_reference`.
        response_degree: As `visibility_reference`.
        middle: As `visibility_enclosure`.
        roundoff: As `visibility_enclosure`.
    """
    base = np.asarray(middle, np.float64)
    o = np.asarray(origins, np.float64).reshape(-1, 3) - base
    d = np.asarray(directions, np.float64).reshape(-1, 3)
    values = np.zeros((len(cloud), 0)) if attributes is None else np.asarray(attributes, np.float64)
    reach = np.broadcast_to(np.asarray(t_max, np.float64), len(o))
    count, channels = len(o), values.shape[1]
    result = SurfaceReference(
        depth=np.full(count, np.inf),
        expected_depth=np.full(count, np.inf),
        normals=np.zeros((count, 3)),
        attributes=np.zeros((count, channels)),
        transmittance=np.ones(count),
        gaussians=np.full(count, -1),
        hit_counts=np.zeros(count, np.int64),
        decided=np.ones(count, np.bool_),
        depth_error=np.zeros(count),
        expected_depth_error=np.zeros(count),
        transmittance_error=np.zeros(count),
        normal_error=np.zeros(count),
        attribute_error=np.zeros((count, channels)),
    )
    rows = np.flatnonzero(cloud.opacities > np.float32(ALPHA_MIN))
    if not len(rows) or not count:
        return result
    seen = cloud.select(rows)
    gaussians = _Gaussians.of(seen, base, response_degree)
    candidates = list(_candidates(gaussians, o, d, roundoff))
    rays, indices = (np.concatenate([pair[k] for pair in candidates]) for k in (0, 1))
    for ray in range(count):
        index = indices[rays == ray]
        start, way = (np.broadcast_to(x[ray], (len(index), 3)) for x in (o, d))
        pair = _Pairs.of(gaussians, start, way, index, roundoff)
        counting, possible, certain = pair.decide(np.broadcast_to(reach[ray], len(index)), front, roundoff)
        if cull:
            along = np.asarray(seen.normals, np.float64)[index] @ d[ray]
            counting &= along <= 0.0
            possible &= along <= 4.0 * roundoff
            certain &= along <= -4.0 * roundoff
        decided = True
        order = [k for k in np.lexsort((index, pair.t)) if counting[k]]
        transmittance, low, high = 1.0, 1.0, 1.0
        blended, weights, errors = [], [], []
        for k in order:
            decided &= (low < stop) == (high < stop)
            if transmittance < stop:
                break
            blended.append(k)
            weights.append(transmittance * pair.alpha[k])
            # The weight is a product of as many factors as hits so far, each rounded twice.
            growth = 2.0 * roundoff * (len(blended) + 1)
            errors.append(max(high * pair.alpha_high[k] - weights[-1], weights[-1] - low * pair.alpha_low[k]))
            errors[-1] += growth * weights[-1]
            transmittance *= 1.0 - pair.alpha[k]
            low *= (1.0 - pair.alpha_high[k]) * (1.0 - 2.0 * roundoff)
            high *= (1.0 - pair.alpha_low[k]) * (1.0 + 2.0 * roundoff)
            if result.gaussians[ray] < 0:
                decided &= (low < threshold) == (high < threshold)
                if transmittance < threshold:
                    result.gaussians[ray] = rows[index[k]]
                    result.depth[ray], result.depth_error[ray] = pair.t[k], pair.t_error[k]
        first, last = pair.t - pair.t_error, pair.t + pair.t_error
        looked_at = order[: len(blended) + 1]
        decided &= all(last[one] < first[other] for one, other in itertools.pairwise(looked_at))
        end = last[blended[-1]] if len(blended) < len(order) else np.inf
        decided &= bool(((possible == certain) | (first > end)).all())
        result.transmittance[ray] = transmittance
        result.transmittance_error[ray] = max(high - transmittance, transmittance - low)
        result.hit_counts[ray] = len(blended)
        result.decided[ray] = decided
        if not blended:
            continue
        weight, error = np.array(weights), np.array(errors)
        which = index[blended]
        result.attributes[ray], result.attribute_error[ray] = _weighted_mean(
            values[rows[which]], weight, error, roundoff
        )
        result.expected_depth[ray], moved = _weighted_mean(pair.t[blended], weight, error, roundoff)
        result.expected_depth_error[ray] = moved + weight @ pair.t_error[blended] / weight.sum()
        normals, normal_errors = _entry_normals(gaussians, o[ray], d[ray], which, roundoff)
        total = weight @ normals
        spread = error.sum() + weight @ normal_errors + (len(weight) + 4.0) * roundoff * weight.sum()
        length = float(np.linalg.norm(total))
        result.normals[ray] = total / length if length > 0.0 else 0.0
        result.normal_error[ray] = 2.0 * spread / max(length, 1e-300) + 4.0 * roundoff
    return result


def _weighted_mean(
    values: NDArray[np.float64], weights: NDArray[np.float64], errors: NDArray[np.float64], roundoff: float
) -> tuple[Any, Any]:
    """Return the weighted mean of rows, and how far errors of the weights and rounded sums may carry it."""
    mean = weights @ values / weights.sum()
    moved = errors @ np.abs(values - mean) / max(weights.sum() - errors.sum(), 1e-300)
    return mean, moved + (len(weights) + 4.0) * roundoff * (weights @ np.abs(values)) / weights.sum()


def _entry_normals(
    gaussians: _Gaussians, o: NDArray[np.float64], d: NDArray[np.float64], index: NDArray[np.int64], roundoff: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the unit normals of ellipsoids where a ray enters them, R S^-1 y, and how far float32 may be off.

    With the errors of `_Pairs`: y = q - h v / |v|, q the peak, h half the chord; M^T carries its error to the normal
    with at most 1 / sigma_min.
    """
    whitening, smallest = gaussians.whitening[index], gaussians.smallest[index]
    radius = gaussians.radii[index]
    p = o - gaussians.centers[index]
    q, v = whitening @ p[:, :, None], whitening @ d
    q = q[:, :, 0]
    speed = np.linalg.norm(v, axis=1)
    t = -np.einsum("nk,nk->n", q, v) / np.square(speed)
    peak = q + v * t[:, None]
    distance = np.linalg.norm(peak, axis=1)
    half = np.sqrt(np.maximum(np.square(radius) - np.square(distance), 0.0))
    y = peak - v * (half / speed)[:, None]
    normals = np.einsum("nji,nj->ni", whitening, y)
    length = np.linalg.norm(normals, axis=1)
    reach = np.linalg.norm(o) + np.linalg.norm(gaussians.centers[index], axis=1) + 2.0 * np.linalg.norm(p, axis=1)
    closest = np.linalg.norm(p - d * (p @ d)[:, None], axis=1)
    shift = np.abs(t + p @ d)
    peak_error = roundoff * (reach + 25.0 * closest + 24.0 * shift) / smallest + 4.0 * roundoff * radius
    near, far = np.maximum(distance - peak_error, 0.0), distance + peak_error
    wide = np.sqrt(np.maximum(np.square(radius) * (1.0 + 8.0 * roundoff) - np.square(near), 0.0))
    narrow = np.sqrt(np.maximum(np.square(radius) * (1.0 - 8.0 * roundoff) - np.square(far), 0.0))
    y_error = peak_error + wide - narrow + half * 48.0 * roundoff / (smallest * speed)
    return normals / length[:, None], 2.0 * (y_error + 24.0 * roundoff * radius) / (smallest * length)


@dataclass(frozen=True)
class _Gaussians:
    """A cloud as float64 arrays, relative to the tracer's middle."""

    centers: NDArray[np.float64]
    whitening: NDArray[np.float64]
    scales: NDArray[np.float64]
    smallest: NDArray[np.float64]
    largest: NDArray[np.float64]
    opacities: NDArray[np.float64]
    radii: NDArray[np.float64]
    degree: int

    @classmethod
    def of(cls, cloud: GaussianCloud, middle: NDArray[np.float64], degree: int) -> _Gaussians:
        scales = cloud.scales.astype(np.float64)
        opacities = cloud.opacities.astype(np.float64)
        levels = np.log(opacities / ALPHA_MIN)
        return cls(
            centers=cloud.positions.astype(np.float64) - middle,
            whitening=rotation_matrices(cloud.orientations).transpose(0, 2, 1) / scales[:, :, None],
            scales=scales,
            smallest=scales.min(axis=1),
            largest=scales.max(axis=1),
            opacities=opacities,
            radii=np.sqrt(2.0 * levels) if degree == 2 else (levels / QUARTIC_FALLOFF) ** 0.25,
            degree=degree,
        )

    def alpha(self, index: NDArray[np.int64], distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Alpha at a whitened distance from the centre."""
        squared = np.square(distance)
        exponent = -0.5 * squared if self.degree == 2 else -QUARTIC_FALLOFF * np.square(squared)
        return np.minimum(ALPHA_MAX, self.opacities[index] * np.exp(exponent))


def _candidates(
    gaussians: _Gaussians, o: NDArray[np.float64], d: NDArray[np.float64], roundoff: float
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield (ray, Gaussian) pairs that may count: the line passes the centre within the support's longest axis.

    With a whitened distance r, the line's distance from the centre is at most r sigma_max. The interval around r has
    half-width at most dp / sigma_min + 88 u r sigma_max / sigma_min (see `_Pairs`), hence the reach below.
    """
    centers = gaussians.centers
    ratio = gaussians.largest / gaussians.smallest
    spread = 88.0 * roundoff * ratio
    own = gaussians.radii * gaussians.largest
    center_squared = np.einsum("nk,nk->n", centers, centers)
    step = max(1, PAIRS_AT_ONCE // len(centers))
    for start in range(0, len(o), step):
        part = slice(start, start + step)
        ray_squared = np.einsum("nk,nk->n", o[part], o[part])
        dd = np.einsum("nk,nk->n", d[part], d[part])
        along = np.einsum("nk,nk->n", o[part], d[part])[:, None] - d[part] @ centers.T
        distance_squared = ray_squared[:, None] + center_squared - 2.0 * (o[part] @ centers.T)
        # Squares of float64 cancel here: a part in 10^14 of what they are made of is added to the reach.
        slack = 1e-14 * (ray_squared.max() + center_squared)
        far = np.sqrt(ray_squared.max()) + np.sqrt(center_squared)
        with np.errstate(divide="ignore"):
            reach = np.where(spread < 0.5, (own + ratio * 8.0 * roundoff * far) / (1.0 - spread), np.inf)
        near = distance_squared - np.square(along) / dd[:, None] <= np.square(reach) * (1.0 + 1e-9) + slack
        ray, index = np.nonzero(near)
        # A pile of Gaussians makes many pairs for few rays.
        for first in range(0, len(ray), PAIRS_AT_ONCE):
            piece = slice(first, first + PAIRS_AT_ONCE)
            yield ray[piece] + start, index[piece]


@dataclass(frozen=True)
class _Pairs:
    """Rays against Gaussians, one pair a row: exact values, and how far float32 may be off.

    With u the roundoff, o and c the coordinates of ray and centre, p = o - c, p' the point of the line nearest to the
    centre, q = M p', v = M d: the tracer rounds o, c, p, d t and p' once each, so that p' is off the line by at most
    dp = u (|o| + |c| + |p| + |t| + |p'|); what lies along the line does not matter. The rows of M come from about 16
    roundings of a unit quaternion's products and a division, and its product with a vector rounds thrice: as if
    p' were off by another 24 u |p'|, and d by 24 u. M carries these to q and v, and only what is perpendicular to
    v changes the distance r = |q x v| / |v|: the leverage of M there is at most 1 / sigma_min, and for a disc that
    is crossed steeply about 1 / sigma_max. An error of v turns the line about the nearest point, by the shift from
    there to the peak. Products in q x v round as they are large. The parameter t of the peak is bounded likewise.
    """

    alpha: NDArray[np.float64]
    alpha_low: NDArray[np.float64]
    alpha_high: NDArray[np.float64]
    distance: NDArray[np.float64]
    distance_error: NDArray[np.float64]
    radius: NDArray[np.float64]
    t: NDArray[np.float64]
    t_error: NDArray[np.float64]
    speed: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        gaussians: _Gaussians,
        o: NDArray[np.float64],
        d: NDArray[np.float64],
        index: NDArray[np.int64],
        roundoff: float,
    ) -> _Pairs:
        whitening, c = gaussians.whitening[index], gaussians.centers[index]
        smallest, scales = gaussians.smallest[index], gaussians.scales[index]
        p = o - c
        t_closest = -np.einsum("nk,nk->n", p, d)
        closest = p + d * t_closest[:, None]
        q = np.einsum("nij,nj->ni", whitening, closest)
        v = np.einsum("nij,nj->ni", whitening, d)
        vv = np.einsum("nk,nk->n", v, v)
        shift = -np.einsum("nk,nk->n", q, v) / vv
        speed = np.sqrt(vv)
        distance = np.linalg.norm(np.cross(q, v), axis=1) / speed
        lengths = {"p": p, "closest": closest, "q": q, "o": o, "c": c}
        size = {name: np.linalg.norm(value, axis=1) for name, value in lengths.items()}
        point_error = roundoff * (size["o"] + size["c"] + size["p"] + np.abs(t_closest) + 25.0 * size["closest"])
        squares = np.square(v / speed[:, None])
        across = squares[:, [1, 2, 0]] + squares[:, [2, 0, 1]]  # 1 - squares, without cancellation
        leverage = np.minimum(1.0 / smallest, np.sqrt((across / np.square(scales)).sum(axis=1)))
        one, other = [1, 2, 0], [2, 0, 1]
        products = np.abs(q[:, one] * v[:, other]) + np.abs(q[:, other] * v[:, one])
        distance_error = (
            (point_error + np.abs(shift) * 24.0 * roundoff) * leverage
            + 2.0 * roundoff * products.sum(axis=1) / speed
            + 4.0 * roundoff * distance
        )
        v_error = 24.0 * roundoff / smallest
        t_error = (
            roundoff * (size["o"] + size["c"] + 4.0 * size["p"])
            + (point_error / smallest + 3.0 * roundoff * size["q"]) / speed
            + 3.0 * size["q"] * v_error / vv
        )
        alpha = gaussians.alpha(index, distance)
        lower = gaussians.alpha(index, distance + distance_error)
        upper = gaussians.alpha(index, np.maximum(distance - distance_error, 0.0))
        return cls(
            alpha=alpha,
            alpha_low=lower
            * (1.0 - 24.0 * roundoff),  # exponent and exp: about 24 roundings of the exponent, at most 5.6
            alpha_high=np.minimum(upper * (1.0 + 24.0 * roundoff), ALPHA_MAX + roundoff),
            distance=distance,
            distance_error=distance_error + 8.0 * roundoff * gaussians.radii[index],
            radius=gaussians.radii[index],
            t=t_closest + shift,
            t_error=t_error,
            speed=speed,
        )

    def decide(
        self, reach: NDArray[np.float64], front: str, roundoff: float
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which pairs count, which may count after rounding, and which certainly do."""
        nearest = np.maximum(self.distance - self.distance_error, 0.0)
        farthest = self.distance + self.distance_error
        start = latest = earliest = self.t
        if front == "entry":
            start = self.t - self._half_chord(self.distance)
            latest = self.t - self._half_chord(farthest) * (1.0 - 8.0 * roundoff)
            earliest = self.t - self._half_chord(nearest) * (1.0 + 8.0 * roundoff)
        counting = (self.distance < self.radius) & (start > 0.0) & (self.t < reach)
        possible = (nearest < self.radius) | (self.alpha_high >= ALPHA_MIN)
        possible &= (latest + self.t_error > 0.0) & (self.t - self.t_error < reach)
        certain = (farthest < self.radius) & (self.alpha_low >= ALPHA_MIN)
        certain &= (earliest - self.t_error > 0.0) & (self.t + self.t_error < reach)
        return counting, possible | counting, certain

    def _half_chord(self, distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Half the length [m] of the line inside the support at a whitened distance."""
        return np.sqrt(np.maximum(np.square(self.radius) - np.square(distance), 0.0)) / self.speed
