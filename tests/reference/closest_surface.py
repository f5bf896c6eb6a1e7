"""The closest surface along rays in float64, and how far float32 may be off: a slow, obvious twin without hierarchy."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.trace.reference import ALPHA_MIN, FLOAT32_ROUNDOFF, RayPairs, ReferenceGaussians, candidate_pairs


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
    cloud,
    origins,
    directions,
    *,
    attributes=None,
    t_max=math.inf,
    threshold=0.5,
    stop=1e-3,
    front="peak",
    cull=False,
    response_degree=2,
    middle=(0.0, 0.0, 0.0),
    roundoff=FLOAT32_ROUNDOFF,
):
    """Sort each ray's hits by (t, row) and blend them: the twin of `beam_warp.trace.first_surface.closest_surface`.

    A surface is met below the transmittance ``threshold``, and blending of ``attributes`` (M, C) ends below ``stop``;
    all else is as `visibility_reference` and `visibility_enclosure` have it.
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
    gaussians = ReferenceGaussians.of(seen, base, response_degree)
    candidates = list(candidate_pairs(gaussians, o, d, roundoff))
    rays, indices = (np.concatenate([pair[k] for pair in candidates]) for k in (0, 1))
    rules = _Rules(threshold, stop, front, cull, roundoff)
    for ray in range(count):
        _blend_ray(
            result, ray, indices[rays == ray], rows, seen, gaussians, (o[ray], d[ray], reach[ray]), values, rules
        )
    return result


@dataclass(frozen=True)
class _Rules:
    """What counts, and where blending ends."""

    threshold: float
    stop: float
    front: str
    cull: bool
    roundoff: float


def _blend_ray(result, ray, index, rows, seen, gaussians, segment, values, rules):
    """Write one row of ``result``: the candidates ``index`` of a ray (origin, direction, reach), blended in order."""
    o, d, reach = segment
    start, way = (np.broadcast_to(x, (len(index), 3)) for x in (o, d))
    pair = RayPairs.of(gaussians, start, way, index, rules.roundoff)
    counting, possible, certain = pair.decide(np.broadcast_to(reach, len(index)), rules.front, rules.roundoff)
    if rules.cull:
        along = np.asarray(seen.normals, np.float64)[index] @ d
        counting &= along <= 0.0
        possible &= along <= 4.0 * rules.roundoff
        certain &= along <= -4.0 * rules.roundoff
    decided = True
    order = [k for k in np.lexsort((index, pair.t)) if counting[k]]
    transmittance, low, high = 1.0, 1.0, 1.0
    blended, weights, errors = [], [], []
    for k in order:
        decided &= (low < rules.stop) == (high < rules.stop)
        if transmittance < rules.stop:
            break
        blended.append(k)
        weights.append(transmittance * pair.alpha[k])
        # The weight is a product of as many factors as hits so far, each rounded twice.
        growth = 2.0 * rules.roundoff * (len(blended) + 1)
        errors.append(max(high * pair.alpha_high[k] - weights[-1], weights[-1] - low * pair.alpha_low[k]))
        errors[-1] += growth * weights[-1]
        transmittance *= 1.0 - pair.alpha[k]
        low *= (1.0 - pair.alpha_high[k]) * (1.0 - 2.0 * rules.roundoff)
        high *= (1.0 - pair.alpha_low[k]) * (1.0 + 2.0 * rules.roundoff)
        if result.gaussians[ray] < 0:
            decided &= (low < rules.threshold) == (high < rules.threshold)
            if transmittance < rules.threshold:
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
        return
    weight, error = np.array(weights), np.array(errors)
    which = index[blended]
    result.attributes[ray], result.attribute_error[ray] = _weighted_mean(
        values[rows[which]], weight, error, rules.roundoff
    )
    result.expected_depth[ray], moved = _weighted_mean(pair.t[blended], weight, error, rules.roundoff)
    result.expected_depth_error[ray] = moved + weight @ pair.t_error[blended] / weight.sum()
    normals, normal_errors = _entry_normals(gaussians, o, d, which, rules.roundoff)
    total = weight @ normals
    spread = error.sum() + weight @ normal_errors + (len(weight) + 4.0) * rules.roundoff * weight.sum()
    length = float(np.linalg.norm(total))
    result.normals[ray] = total / length if length > 0.0 else 0.0
    result.normal_error[ray] = 2.0 * spread / max(length, 1e-300) + 4.0 * rules.roundoff


def _weighted_mean(values, weights, errors, roundoff):
    """Return the weighted mean of rows, and how far errors of the weights and rounded sums may carry it."""
    mean = weights @ values / weights.sum()
    moved = errors @ np.abs(values - mean) / max(weights.sum() - errors.sum(), 1e-300)
    return mean, moved + (len(weights) + 4.0) * roundoff * (weights @ np.abs(values)) / weights.sum()


def _entry_normals(gaussians, o, d, index, roundoff):
    """Return the unit normals of ellipsoids where a ray enters them, R S^-1 y, and how far float32 may be off.

    With the errors of `RayPairs`: y = q - h v / |v|, q the peak, h half the chord; M^T carries its error to the normal
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
