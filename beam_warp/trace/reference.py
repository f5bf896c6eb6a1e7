"""Slow, obvious float64 twins of the tracer, without hierarchy or packing: what the fast code is measured against.

`visibility_reference` is the number itself. `visibility_enclosure` adds what float32 may make of it: each quantity of a
ray and a Gaussian carries an interval that follows from counting the tracer's roundings, so a bound is derived for
every ray and fitted for none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import rotation_matrices

ALPHA_MAX, ALPHA_MIN = 0.99, 1.0 / 255.0
"""Cap and cut of one Gaussian's alpha (Kerbl et al. 2023)."""

QUARTIC_FALLOFF = 4.5 / 81.0
"""Response exp(-x^4 / 18) of degree 4 (3DGRT)."""

FLOAT32_ROUNDOFF = 2.0**-24
"""Largest relative error of one float32 operation, u."""

PAIRS_AT_ONCE = 1 << 16
"""Ray and Gaussian pairs that are looked at together: arrays of half a megabyte stay in a core's own cache."""


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

    Where an interval straddles a decision (in front or not, above the cut or not), both outcomes are allowed. All
    other arguments are those of `visibility_reference`.

    Args:
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
        gaussians = ReferenceGaussians.of(seen, base, response_degree)
        for ray, index in candidate_pairs(gaussians, o, d, roundoff):
            pair = RayPairs.of(gaussians, o[ray], d[ray], index, roundoff)
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
class ReferenceGaussians:
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
    def of(cls, cloud: GaussianCloud, middle: NDArray[np.float64], degree: int) -> ReferenceGaussians:
        """Return the Gaussians of a cloud whose opacities are all above the cut."""
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


def candidate_pairs(
    gaussians: ReferenceGaussians, o: NDArray[np.float64], d: NDArray[np.float64], roundoff: float
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield (ray, Gaussian) pairs that may count: the line passes the centre within the support's longest axis.

    With a whitened distance r, the line's distance from the centre is at most r sigma_max. The interval around r has
    half-width at most dp / sigma_min + 88 u r sigma_max / sigma_min (see `RayPairs`), hence the reach below.
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
class RayPairs:
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
        gaussians: ReferenceGaussians,
        o: NDArray[np.float64],
        d: NDArray[np.float64],
        index: NDArray[np.int64],
        roundoff: float,
    ) -> RayPairs:
        """Return pairs of rays ``(N, 3)`` and the Gaussians at ``index`` ``(N,)``."""
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
