"""Mattes from photographs: where the subject ends beside its mask's outline, and its colour without the backdrop.

A photograph with a mask shows on both sides of the outline what is there. Near each pixel of the outline, the subject's
colour F is a linear function of the position, fitted to pixels that are surely inside. The backdrop's colour B is one
fitted to pixels that are surely outside, or an image of the empty scene and such a function. A pixel of both,
I = a F + (1 - a) B, then shows the coverage a = (I - B).(F - B) / |F - B|². The sum of the mask minus a, over the
length of the outline, is how far the mask reaches beyond the subject, whether the outline is soft or hard.

How much F and B scatter about their functions, and change over the pixels from which they are extrapolated, says how
far to trust that. A mask is moved by what is beyond doubt alone: an exact one stays as it is, and where subject and
backdrop look alike nothing is known. Most of what is wrong with a mask is so all along its outline; where a part of it
seems to be off by more, the mask may be wrong there, or the subject be dark towards its limb, before a dark backdrop.
What is between the two outlines is told as a doubt, and left to other views. A mask that is wrong for sure is also made
as soft as the photograph shows the outline (`matte_edges`): one that is moved, that is all or nothing, or that another
softness explains better beyond doubt.

Then the most likely colours of subject and backdrop whose sum is the pixel (Chuang et al. 2001, "A Bayesian Approach to
Digital Matting") give the subject's part: I - (1 - a) B before a smooth backdrop, a F before a cluttered one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label, map_coordinates, maximum_filter, minimum_filter, uniform_filter
from scipy.spatial import cKDTree

from beam_warp.capture.matte_edges import AS_IT_IS, SOLID, Edge, EdgeEvidence

MOST_POINTS = 2**17
"""Masks with more pixels along their outlines are left as they are: they are noise."""

MARGINS = (2.5, 1.25)
"""Pixels this far from the outline are surely inside or outside [pixel]: at first, and from the moved outline."""

BAND = 7
"""Pixels up to this far from the outline are looked at [pixel]: the first margin, and the largest offset."""

FAINT = 0.02
"""Coverage within this of 0 or 1 is as good as it."""

BLUR = 1.5
"""Standard deviation of the filter through which an outline's normals are seen [pixel]."""

REACH = 5
SPREAD = 2.0
FEWEST = 8
RIDGE = 1e-6
"""Half the side of the window in which colours are fitted, the standard deviation of its weights [pixel], the fewest
samples from which one is known, and the share of the weights that holds slopes to 0 where samples do not tell."""

BRIGHTEST = 1e9
"""Larger values near an outline count as this one, so that their squares are finite."""

BLOCK = 4096
"""Windows that are fitted at a time."""

UNKNOWN = 1e12
"""Variance of a colour of which nothing is known."""

LITTLE = 0.4
"""Measured coverage within this of 0 or 1 counts as it, so that F and B may be wrong by so much of their difference."""

NOISE = 0.01
"""Colours of subject and backdrop are not known to a smaller part of their sum."""

WIDTH = 3.0
"""A colour that is wrong by all of the contrast moves the outline so far [pixel]."""

NEIGHBORS = 15
"""Pixels of the outline that share an offset."""

LEAST_ERROR, LEAST_LOCAL_ERROR = 0.03, 0.1
"""Standard errors of a mask's offset, and of that of a part of it, are at least this [pixel]: F is not quite linear."""

WORST_ERROR = 0.5
"""Beyond this standard error, nothing is known of a mask's offset [pixel]."""

KEY = 12.0
LEAST_KEY = 1e-4
"""A pixel is not of the plate if its squared difference, over its brightness and the mean one, is more than so many
times the median of all pixels, which noise is not, and at least this."""

SPECK = 24
"""Parts of fewer pixels are noise, and holes of fewer pixels where the subject looks like the plate."""

KEY_BLUR = 0.5
"""Standard deviation that gives the outline of keyed pixels the softness of a pixel's area [pixel]."""

BACKDROP_ERROR = 0.3
"""Standard error, as a part of the contrast, from which on a backdrop's colour is not known."""

SURE = 3.0
"""What is less than this many standard errors from 0 counts as 0."""

ALL_OF_A_MASK, ALL_OF_A_PART = 4.0, 6.0
"""Offsets beyond so many standard errors are undone in full: of a whole mask, which chance makes of an exact one in
16,000, and of a part, whose error may be that of a dark limb."""


@dataclass(frozen=True)
class MaskOffset:
    """How far a mask reaches beyond the subject, as a photograph shows it, and how soft its outline should be.

    Attributes:
        pixels: Mean of the closest half along the outline [pixel]; negative for a mask that is too small.
        error: Its standard error [pixel].
        edge: How the outline is redrawn.
    """

    pixels: float
    error: float
    edge: Edge = AS_IT_IS


@dataclass(frozen=True, eq=False)
class Uncut:
    """A photograph before its subject is cut out, and what is behind the subject.

    Attributes:
        scene: Scene-linear Rec.709 of subject and backdrop, ``(H, W, 3)`` float32; of the subject alone where the
            backdrop is not known.
        behind: The backdrop alone, ``(H, W, 3)`` float32; 0 where it is not known.
    """

    scene: NDArray[np.float32]
    behind: NDArray[np.float32]

    def mapped(self, of: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> Uncut:
        """Return both images after the same operation."""
        return Uncut(of(self.scene), of(self.behind))


@dataclass(frozen=True, eq=False)
class Matte:
    """A subject without its backdrop.

    Attributes:
        color: Scene-linear, premultiplied by coverage, ``(H, W, 3)`` float32.
        alpha: Coverage in [0, 1], ``(H, W)`` float32.
        offset: How far the given mask reaches beyond the subject; None where the photograph does not tell.
        doubt: How much is not known of a pixel, 0 to 1, ``(H, W)`` float32: coverage and colour are a guess there.
        uncut: The photograph before the subject was cut out of it; None if the mask stays as it is, or nothing is known
            of the backdrop.
    """

    color: NDArray[np.float32]
    alpha: NDArray[np.float32]
    offset: MaskOffset | None
    doubt: NDArray[np.float32]
    uncut: Uncut | None = None


def matte(
    photograph: NDArray[np.float32], mask: NDArray[np.float32], plate: NDArray[np.float32] | None = None
) -> Matte:
    """Move a mask to where the subject ends in a photograph, and take the backdrop out of the colour.

    Args:
        photograph: Image of subject and backdrop, scene-linear, ``(H, W, 3)``.
        mask: Coverage in [0, 1], ``(H, W)``; its outline is at most some two pixels off.
        plate: The same camera's image without the subject, scene-linear, ``(H, W, 3)``; None if there is none.

    Returns:
        The subject alone. Coverage away from the outline is the mask's.
    """
    outline = _outline(mask)
    if outline is None:
        return Matte(photograph * mask[..., None], mask, None, np.zeros_like(mask))
    at = tuple(outline.near.T)
    empty = np.float32(0.0) if plate is None else plate
    seen = np.clip(photograph, -BRIGHTEST, BRIGHTEST)
    softness = _softness(mask[at], outline.distances)
    excess = error = np.zeros(len(outline.points))
    for margin in np.add(MARGINS, softness):
        distance = outline.distances + excess[outline.nearest]
        place = outline.everywhere(distance)
        inner = _fit(seen, outline, place < -margin, margin)
        outer = _fit(seen - empty, outline, place > margin, margin)
        outer.values += np.broadcast_to(empty, photograph.shape)[at]
        shown = _coverage(seen[at], inner.values, outer.values)
        known = np.where(np.abs(distance) <= margin, shown, distance < 0.0)
        excess, error = _excess(outline, mask[at], known, inner, outer)
    offset, own = _believed(excess, error)
    common, edge = 0.0, AS_IT_IS
    contrast = np.square(inner.values - outer.values).sum(axis=1)
    if offset is not None:
        worth = contrast / (inner.variances + outer.variances + 1e-10)[outline.nearest]
        common, edge = _mended(mask, outline, offset, EdgeEvidence(at, outline.distances, shown, worth))
        offset = replace(offset, edge=edge)
    whole = edge.redrawn(_moved_evenly(mask, outline, common), at)
    parts = edge.redrawn(_moved(mask, outline, common + own), at) if own.any() else whole
    alpha = (0.5 * (whole + parts)).astype(np.float32)
    color = photograph * alpha[..., None]
    color[at] = _subject(seen[at], alpha[at], inner, outer, outline.nearest)
    uncut = None
    if common != 0.0 or own.any() or edge != AS_IT_IS:  # a mask that is right says more than colours do
        sure = 3.0 * outer.variances[outline.nearest] < BACKDROP_ERROR**2 * contrast
        known = tuple(outline.near[sure].T)
        scene, behind = color.copy(), np.zeros_like(color)
        scene[known], behind[known] = seen[known], np.maximum(outer.values[sure], 0.0)
        uncut = Uncut(scene, behind) if sure.any() else None
    return Matte(color, alpha, offset, np.abs(whole - parts), uncut)


def moved_mask(mask: NDArray[np.float32], pixels: float) -> NDArray[np.float32]:
    """Take a mask in on all sides, or let it out if ``pixels`` is negative.

    Args:
        mask: Coverage in [0, 1], ``(H, W)``.
        pixels: How far, at most the 3 that are looked at around an outline [pixel].
    """
    outline = _outline(mask)
    return mask if outline is None else _moved_evenly(mask, outline, pixels)


def keyed(photograph: NDArray[np.float32], plate: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a mask of what differs from an image of the empty scene: a start for `matte`.

    Exposures that differ are matched. Shadows and reflections of the subject on what surrounds it differ too.

    Args:
        photograph: Image of subject and backdrop, scene-linear, ``(H, W, 3)``; the subject is less than half of it.
        plate: The same camera's image without the subject, scene-linear, ``(H, W, 3)``.

    Returns:
        Coverage, ``(H, W)``, within about a pixel.
    """
    level = np.maximum(plate, 1e-3 * max(float(plate.mean()), 1e-6))
    gain = np.median(photograph / level, axis=(0, 1))
    sides: Any = (3, 3, 1)
    difference = uniform_filter(np.clip(photograph, -BRIGHTEST, BRIGHTEST) - gain * plate, sides)
    excess = (difference**2 / (level * level.mean())).sum(axis=-1)
    found = excess > max(KEY * float(np.median(excess)), LEAST_KEY)
    solid = ~_without_specks(~_without_specks(found))
    return np.clip(gaussian_filter(solid.astype(np.float32), KEY_BLUR), 0.0, 1.0).astype(np.float32)


def _without_specks(found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return pixels without connected parts of fewer than `SPECK`."""
    labelled: Any = label(found)  # its types say that it may be a number
    parts: NDArray[np.int32] = labelled[0]
    large = np.bincount(parts.ravel()) >= SPECK
    large[0] = False
    return large[parts]


@dataclass(frozen=True, eq=False)
class _Outline:
    """The outline of a mask.

    Attributes:
        inside: Whether each pixel is rather the subject than not, ``(H, W)``.
        points: Row and column of pixels inside that are beside one outside, ``(K, 2)``.
        normals: Directions away from the subject there, ``(K, 2)``.
        lengths: Length of outline that belongs to each of them [pixel], ``(K,)``.
        near: Row and column of the pixels near the outline, ``(P, 2)``.
        nearest: Index of the point nearest to each of them, ``(P,)``.
        distances: Their distances from the outline, negative inside [pixel], ``(P,)``.
    """

    inside: NDArray[np.bool_]
    points: NDArray[np.int64]
    normals: NDArray[np.float64]
    lengths: NDArray[np.float64]
    near: NDArray[np.int64]
    nearest: NDArray[np.int64]
    distances: NDArray[np.float64]

    def everywhere(self, distances: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return distances of near pixels with those of all others, which are infinite, ``(H, W)``."""
        found = np.where(self.inside, np.float32(-np.inf), np.float32(np.inf))
        found[tuple(self.near.T)] = distances
        return found


@dataclass(eq=False)
class _Colors:
    """Colours of the subject or the backdrop at the pixels near an outline.

    Attributes:
        values: Scene-linear, ``(P, 3)``.
        variances: Variance of each of the three, at the points of the outline, ``(K,)``; or `UNKNOWN`.
    """

    values: NDArray[np.float64]
    variances: NDArray[np.float64]


def _outline(mask: NDArray[np.float32]) -> _Outline | None:
    """Return the outline of a mask; None where it has none, or one that is noise."""
    inside = mask > SOLID
    padded = np.pad(inside, 1, mode="edge")
    enclosed = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    points = np.argwhere(inside & ~enclosed)
    if not 0 < len(points) <= MOST_POINTS:
        return None
    low = np.maximum(points.min(axis=0) - BAND, 0)
    box = tuple(slice(first, last + BAND + 1) for first, last in zip(low, points.max(axis=0), strict=True))
    at = tuple((points - low).T)
    smooth = np.pad(gaussian_filter(mask[box], BLUR, mode="nearest"), 1, mode="edge")
    slopes = 0.5 * np.stack([smooth[:-2, 1:-1] - smooth[2:, 1:-1], smooth[1:-1, :-2] - smooth[1:-1, 2:]])
    edge = np.zeros(mask[box].shape, dtype=bool)
    edge[at] = True
    near = np.argwhere(maximum_filter(edge, 2 * BAND + 1))
    distances, nearest = cKDTree(points - low).query(near)
    steepness = np.linalg.norm(slopes, axis=0)
    nearby = tuple(near.T)
    return _Outline(
        inside=inside,
        points=points,
        normals=(slopes[:, *at] / np.maximum(steepness[at], 1e-6)).T,
        lengths=np.bincount(nearest, steepness[nearby], len(points)).astype(np.float64),
        near=near + low,
        nearest=nearest,
        distances=np.where(inside[box][nearby], -distances, distances) - (mask[box][at] - SOLID)[nearest],
    )


def _softness(mask: NDArray[np.float32], distances: NDArray[np.float64]) -> float:
    """Return how much further from its outline a mask is soft than one that is sharp [pixel]."""
    soft = np.abs(distances[(mask > FAINT) & (mask < 1.0 - FAINT)])
    return max(float(np.quantile(soft, 0.9)) - 1.0, 0.0) if len(soft) else 0.0


def _fit(image: NDArray[np.float32], outline: _Outline, sure: NDArray[np.bool_], margin: float) -> _Colors:
    """Fit linear functions of the position to the sure pixels of an image around each point of an outline.

    Between these and the outline, over the margin, slopes across the outline may change by as much as they are.
    """
    blocks = [
        _fit_block(image, outline.points[start : start + BLOCK], sure) for start in range(0, len(outline.points), BLOCK)
    ]
    coefficients, variances = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    ways = (outline.near - outline.points[outline.nearest]).astype(np.float64)
    across = (coefficients[:, 1:] * outline.normals[:, :, None]).sum(axis=1)
    variances += margin**2 * np.square(across).mean(axis=1)
    of = coefficients[outline.nearest]
    return _Colors(of[:, 0] + ways[:, :1] * of[:, 1] + ways[:, 1:] * of[:, 2], variances)


def _fit_block(
    image: NDArray[np.float32], points: NDArray[np.int64], sure: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return values and slopes at some points, ``(K, 3, 3)``, and variances of the values, ``(K,)``."""
    side = np.arange(-REACH, REACH + 1)
    ways = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    height, width = sure.shape
    row, column = points[:, :1] + ways[:, 0], points[:, 1:] + ways[:, 1]
    within = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    index = np.where(within, row * width + column, 0)
    weights = (within & sure.ravel()[index]) * np.exp(-(ways**2).sum(axis=1, dtype=np.float32) / (2.0 * SPREAD**2))
    basis = np.column_stack([np.ones(len(ways)), ways]).astype(np.float32)
    moments = (weights @ (basis[:, :, None] * basis[:, None]).reshape(-1, 9)).reshape(-1, 3, 3).astype(np.float64)
    known = (weights > 0.0).sum(axis=1) >= FEWEST
    moments[~known] = np.eye(3)
    moments[:, (1, 2), (1, 2)] += RIDGE * SPREAD**2 * moments[:, :1, 0]
    samples = image.reshape(-1, 3)[index] - image[tuple(points.T)][:, None]  # centred: float32 is enough
    products = (weights[:, None] * basis.T) @ samples
    inverse = np.linalg.inv(moments)
    coefficients = inverse @ products
    squares = ((weights[:, None] @ samples**2)[:, 0]).sum(axis=1) - (coefficients * products).sum(axis=(1, 2))
    variances = np.maximum(squares, 0.0) / 3.0 * inverse[:, 0, 0]
    coefficients[:, 0] += image[tuple(points.T)]
    return coefficients * known[:, None, None], np.where(known, variances, UNKNOWN)


def _coverage(
    pixels: NDArray[np.float32], inner: NDArray[np.float64], outer: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how much of each pixel is the subject, ``(P,)``, as its colour shows it; not clipped."""
    contrast = inner - outer
    return ((pixels - outer) * contrast).sum(axis=1) / np.maximum((contrast**2).sum(axis=1), 1e-12)


def _excess(
    outline: _Outline, mask: NDArray[np.float32], shown: NDArray[np.float64], inner: _Colors, outer: _Colors
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far a mask reaches beyond the subject around each point, and the standard errors [pixel], ``(K,)``.

    Args:
        outline: The mask's outline.
        mask: Its coverage at the pixels near the outline, ``(P,)``.
        shown: The subject's coverage there, ``(P,)``.
        inner: The subject's colours.
        outer: The backdrop's colours.
    """
    count = len(outline.points)
    area = np.bincount(outline.nearest, _sharpened(mask) - _sharpened(shown), count)
    pixels = np.bincount(outline.nearest, minlength=count)
    contrast, level = (
        np.bincount(outline.nearest, (color**2).sum(axis=1), count) / pixels
        for color in (inner.values - outer.values, inner.values + outer.values)
    )
    scatter = inner.variances + outer.variances + NOISE**2 * level + 1e-10
    variance = WIDTH**2 * scatter / np.maximum(contrast, 1e-12) + LEAST_LOCAL_ERROR**2
    _, around = cKDTree(outline.points).query(outline.points, range(1, min(NEIGHBORS, count) + 1))
    precision = np.maximum((outline.lengths / variance)[around].sum(axis=1), 1e-30)
    excess = (area / variance)[around].sum(axis=1) / precision
    return np.clip(excess, -MARGINS[0], MARGINS[0]), np.sqrt(outline.lengths[around].sum(axis=1) / precision)


def _sharpened(coverage: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return coverage with what is nearly 0 or 1 made so; the area within an outline, soft or not, stays the same."""
    return np.clip((coverage.astype(np.float64) - LITTLE) / (1.0 - 2.0 * LITTLE), 0.0, 1.0)


def _believed(excess: NDArray[np.float64], error: NDArray[np.float64]) -> tuple[MaskOffset | None, NDArray[np.float64]]:
    """Return a mask's offset, and by how much more to take in each point: what is beyond doubt."""
    weights = 1.0 / error**2
    middle = _middle_of_most(excess, weights)
    spread = max(1.4826 * _median(np.abs(excess - middle), weights), _median(error, weights))
    independent = weights.sum() ** 2 / (weights**2).sum() / NEIGHBORS
    of_all = float(np.hypot(LEAST_ERROR, 1.2533 * spread / np.sqrt(max(independent, 1.0))))  # 1.2533: of a median
    if not of_all <= WORST_ERROR:
        return None, np.zeros_like(excess)
    return MaskOffset(middle, of_all), _beyond(excess - middle, error, ALL_OF_A_PART)


def _mended(
    mask: NDArray[np.float32], outline: _Outline, offset: MaskOffset, evidence: EdgeEvidence
) -> tuple[float, Edge]:
    """Return by how much to take a mask in [pixel], and how to redraw its outline: neither, if it may be sound.

    Source of the shrinkage: James and Stein 1961, its positive part.
    """
    pixels, error = offset.pixels, offset.error
    coverage = mask[evidence.at]
    is_hard = not ((coverage > FAINT) & (coverage < 1.0 - FAINT)).any()
    _, better = evidence.best_edge(_moved_evenly(mask, outline, pixels), pixels)
    if better > ALL_OF_A_MASK:  # it is wrong for sure, so that nothing speaks for the place that it has
        common = pixels * max(1.0 - error**2 / max(pixels**2, 1e-12), 0.0)
    else:
        common = float(_beyond(np.array(pixels), np.array(error), ALL_OF_A_MASK))
        if common == 0.0 and not is_hard:
            return 0.0, AS_IT_IS
    return common, evidence.best_edge(_moved_evenly(mask, outline, common), common)[0]


def _middle_of_most(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Return the weighted mean of the closest half of values.

    A subject that darkens towards its limb looks too small there, and nothing makes others look too large by as much:
    what is wrong lies on one side, so that the median is drawn towards it, and the densest half is less.

    Source: Andrews et al. 1972, the shorth.
    """
    order = np.argsort(values, kind="stable")
    values, weights = values[order], weights[order]
    total = np.concatenate([[0.0], np.cumsum(weights)])
    last = np.searchsorted(total[1:], total[:-1] + 0.5 * total[-1]).clip(max=len(values) - 1)
    first = np.flatnonzero(total[last + 1] - total[:-1] >= 0.5 * total[-1] * (1.0 - 1e-12))
    at = first[np.argmin(values[last[first]] - values[first])]
    half = slice(at, last[at] + 1)
    return float(np.average(values[half], weights=weights[half]))


def _median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Return the weighted median."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])


def _beyond(values: NDArray[np.float64], error: NDArray[np.float64], whole: float) -> NDArray[np.float64]:
    """Return values, those within `SURE` errors as 0, those beyond ``whole`` as they are (Gao and Bruce 1997)."""
    return values * np.clip((np.abs(values) / error - SURE) / (whole - SURE), 0.0, 1.0)


def _moved(mask: NDArray[np.float32], outline: _Outline, moves: NDArray[np.float64]) -> NDArray[np.float32]:
    """Take a mask in by some way at each point of its outline [pixel], ``(K,)``.

    It is interpolated by cubic splines, within the range of the pixels around, so that soft outlines stay as steep.
    """
    is_moved = moves[outline.nearest] != 0.0
    near, nearest = outline.near[is_moved], outline.nearest[is_moved]
    alpha = mask.copy()
    if not len(near):
        return alpha
    low = np.maximum(near.min(axis=0) - BAND, 0)
    part = mask[tuple(slice(first, last + BAND + 1) for first, last in zip(low, near.max(axis=0), strict=True))]
    places = (near + moves[nearest, None] * outline.normals[nearest] - low).T
    least, most = (
        map_coordinates(of(part, 3), places, order=0, mode="nearest") for of in (minimum_filter, maximum_filter)
    )
    alpha[tuple(near.T)] = np.clip(map_coordinates(part, places, order=3, mode="nearest"), least, most)
    return alpha


def _moved_evenly(mask: NDArray[np.float32], outline: _Outline, pixels: float) -> NDArray[np.float32]:
    return _moved(mask, outline, np.full(len(outline.points), pixels))


def _subject(
    pixels: NDArray[np.float32], alpha: NDArray[np.float32], inner: _Colors, outer: _Colors, nearest: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the subject's part of pixels, premultiplied: the most likely one, given colours and variances."""
    coverage = alpha[:, None].astype(np.float64)
    own, other = coverage**2 * inner.variances[nearest, None], (1.0 - coverage) ** 2 * outer.variances[nearest, None]
    share = (own + 1e-12) / (own + other + 1e-12)
    subject = coverage * inner.values
    subject += share * (pixels - subject - (1.0 - coverage) * outer.values)
    return np.where(coverage > 0.0, np.maximum(subject, 0.0), 0.0)
