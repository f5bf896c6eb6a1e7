"""The rasteriser in float64 NumPy: every pixel, no tiles.

Drawing is two steps. `decide` takes every decision that makes an image jump or bend: what is culled, the order, the
alpha cut and cap, where a pixel stops, the side of each clamp, which splat gives the median. `replay` computes the
image with those decisions held still, so that it is smooth in every parameter (`reference.raster_differences`).
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from reference.raster_splats import (
    LEAST_AHEAD,
    LEAST_SCALE,
    REACH,
    RasterScene,
    SplatDecisions,
    inverse_depth,
    local_positions,
    ray_forms,
    response,
    see,
    shifted_color,
    slope_range,
)

ALPHA_MIN, ALPHA_MAX, STOP, HALF = 1.0 / 255.0, 0.99, 1e-4, 0.5

TIE = 1e-4
"""A decision closer to its threshold than this, relative, may fall otherwise in float32: a pixel coordinate below 64 is
rounded by 4e-6 twice, and ln(alpha) has a slope of at most sqrt(2 ln 255 / 0.3) = 6 per pixel where alpha is 1/255."""

STOP_TIE = 1e-3
"""The same for a transmittance of 1e-4, which is a product of many."""

SORT_TIE = 1e-6
"""Relative difference of depths below which float32 may sort otherwise: eight roundings of 6e-8, twice."""


@dataclass(frozen=True)
class RasterImage:
    """What every pixel sees; also a gradient with respect to it, where ``last`` means nothing."""

    alpha: Any  # (H, W)
    depth: Any  # (H, W), 0 where alpha is
    median_depth: Any  # (H, W), 0 where alpha is
    channels: Any  # (H, W, K), sums
    normals: Any  # (H, W, 3), sums, world axes
    last: Any = None  # (H, W) index of the last contributor, -1 without


@dataclass(frozen=True)
class Decisions:
    """Every decision. Pairs are a splat and a pixel that it contributes to, splat by splat, front to back."""

    splats: SplatDecisions
    splat: Any  # (M,)
    pixel: Any  # (M,) flat
    capped: Any  # (M,)
    behind: Any  # (M,) l clamped in exact depth
    depth_side: Any  # (M,) -1 at the far end, 0, 1 at the near end
    median: Any  # (H W,) pair, -1 without
    near_jump: Any  # (H, W) pixels where float32 may decide otherwise and then shows another image
    near_bend: Any  # (H, W) pixels where it may decide otherwise and then has another slope only


@dataclass(frozen=True)
class LooseSplats:
    """Splats whose decisions float32 may take otherwise."""

    visible: Any  # (N,)
    bends: Any  # (N,) side of the Jacobian's clamp, or of a colour's
    reach: Any  # (N,) what limits its depth: matters where depth is clamped


def rasterize(cloud, camera, values, *, antialiased=False):
    """Composite ``values`` (N, K); returns alpha, and the sums of depth and of values weighted by visibility."""
    arrays = (cloud.positions, cloud.orientations, cloud.scales, cloud.opacities)
    image = draw(RasterScene(*arrays, camera, values=values, antialiased=antialiased))
    return image.alpha, image.alpha * image.depth, image.channels


def draw(scene):
    return replay(scene, decide(scene))


def decide(scene):
    """Take every decision."""
    chosen, loose = decide_splats(scene)
    splats = see(scene, chosen)
    pixels = pixel_centers(scene.camera)
    transmittance, depth_before = np.ones(len(pixels)), np.zeros(len(pixels))
    median = np.full(len(pixels), -1)
    near_jump, near_bend = np.zeros((2, len(pixels)), bool)
    pairs, count = [], 0
    for i in np.argsort(splats.depth, kind="stable"):
        if not chosen.visible[i]:
            continue
        alpha = response(splats, i, pixels)
        counts = (alpha >= ALPHA_MIN) & (transmittance >= STOP)
        jump = close(alpha, ALPHA_MIN) | close(transmittance, STOP, STOP_TIE) | (loose.visible[i] & (alpha > 0.0))
        near_jump |= jump & (transmittance > STOP * (1.0 - STOP_TIE))
        here = np.flatnonzero(counts)
        forms = ray_forms(scene, splats, i, pixels[here])
        behind = ~(forms[0] > LEAST_AHEAD)
        inverse = inverse_depth(scene, splats, i, forms, behind)
        side = (inverse > splats.nearest[i]).astype(int) - (inverse < splats.farthest[i])
        step = splats.depth[i] - depth_before[here]
        near_jump[here] |= close(transmittance[here], HALF) | ((step > 0.0) & (step < SORT_TIE * splats.depth[i]))
        near_jump[here] |= (np.abs(forms[0]) < TIE) & (scene.depth_mode == "exact")
        bend = close(inverse, splats.nearest[i]) | close(inverse, splats.farthest[i])
        bend |= close(alpha[here], ALPHA_MAX) | loose.bends[i] | (loose.reach[i] & (side != 0))
        near_bend[here] |= bend
        above = transmittance[here] > HALF
        median[here[above]] = count + np.flatnonzero(above)
        pairs.append((np.full(len(here), i), here, alpha[here] > ALPHA_MAX, behind, side))
        count += len(here)
        depth_before[here] = splats.depth[i]
        transmittance[here] *= 1.0 - np.minimum(alpha[here], ALPHA_MAX)
    empty = [np.zeros(0, kind) for kind in (int, int, bool, bool, int)]
    columns = [np.concatenate(column) for column in zip(empty, *pairs, strict=True)]
    shape = (scene.camera.height, scene.camera.width)
    return Decisions(chosen, *columns, median, near_jump.reshape(shape), near_bend.reshape(shape))


def decide_splats(scene):
    """Decisions of splats, and which of them are loose."""
    local = local_positions(scene)
    visible = local[:, 2] > scene.near
    p = np.where(visible[:, None], local, (0.0, 0.0, 1.0))
    low, high = slope_range(scene)
    slopes = p[:, :2] / p[:, 2:]
    color = shifted_color(scene, visible) if scene.radiance is not None else np.ones((len(p), 0))
    small, large = np.sort(scene.scales, axis=1)[:, 1:].T
    chosen = SplatDecisions(
        visible=visible,
        slope_side=(slopes > high).astype(int) - (slopes < low),
        floored=~(scene.scales > LEAST_SCALE),
        largest=scene.scales.argmax(axis=1),
        near_side=~(p[:, 2] - REACH * large > scene.near),
        positive=color > 0.0,
    )
    edge = np.minimum(np.abs(slopes - low), np.abs(slopes - high)) < TIE * (high - low)
    loose = LooseSplats(
        visible=close(local[:, 2], scene.near),
        bends=edge.any(axis=1) | (np.abs(color) < TIE).any(axis=1),
        reach=(large - small <= TIE * large) | (np.abs(p[:, 2] - REACH * large - scene.near) < TIE * p[:, 2]),
    )
    return chosen, loose


def close(value, threshold, tolerance=TIE):
    return np.abs(value / threshold - 1.0) < tolerance


def replay(scene, decisions):
    """Draw with decisions taken before, perhaps for a slightly different scene."""
    splats = see(scene, decisions.splats)
    alpha, depth = pair_terms(scene, splats, decisions)
    size, kind = scene.camera.height * scene.camera.width, np.result_type(alpha, depth, splats.channels)
    alpha_sum, depth_sum, transmittance = np.zeros(size, kind), np.zeros(size, kind), np.ones(size, kind)
    channel_sum, normal_sum = np.zeros((size, splats.channels.shape[1]), kind), np.zeros((size, 3), kind)
    last = np.full(size, -1)
    edges = [0, *(np.flatnonzero(np.diff(decisions.splat)) + 1), len(decisions.splat)]
    for begin, end in pairwise(edges):
        i, at = decisions.splat[begin:end][:1], decisions.pixel[begin:end]  # one splat, each pixel once
        weight = alpha[begin:end] * transmittance[at]
        alpha_sum[at] += weight
        depth_sum[at] += weight * depth[begin:end]
        channel_sum[at] += weight[:, None] * splats.channels[i]
        normal_sum[at] += weight[:, None] * splats.normal[i]
        transmittance[at] *= 1.0 - alpha[begin:end]
        last[at] = i
    covered = last >= 0
    median_depth = np.zeros(size, kind)
    median_depth[covered] = depth[decisions.median[covered]]
    shape = (scene.camera.height, scene.camera.width)
    return RasterImage(
        alpha=alpha_sum.reshape(shape),
        depth=np.divide(depth_sum, alpha_sum, out=np.zeros(size, kind), where=covered).reshape(shape),
        median_depth=median_depth.reshape(shape),
        channels=channel_sum.reshape(*shape, -1),
        normals=normal_sum.reshape(*shape, 3),
        last=last.reshape(shape),
    )


def pair_terms(scene, splats, decisions):
    """Alpha and depth of every pair, (M,)."""
    i, pixels = decisions.splat, pixel_centers(scene.camera)[decisions.pixel]
    alpha = np.where(decisions.capped, ALPHA_MAX, response(splats, i, pixels))
    inverse = inverse_depth(scene, splats, i, ray_forms(scene, splats, i, pixels), decisions.behind)
    inverse = np.where(decisions.depth_side > 0, splats.nearest[i], inverse)
    inverse = np.where(decisions.depth_side < 0, splats.farthest[i], inverse)
    return alpha, 1.0 / inverse


def pixel_centers(camera):
    """(H W, 2)."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.stack([x.ravel(), y.ravel()], axis=-1)
