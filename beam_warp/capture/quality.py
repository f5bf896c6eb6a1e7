"""How sharp and how noisy one image is, by itself: edges of the outline, and what neighbouring pixels differ by.

*Blur.* Across an outline, coverage or colour runs from 0 to 1 as e(s), and the integral of e (1 - e) over the way s is
the standard deviation of the blur times a number that hardly depends on its kind: 0.564 for a Gaussian, 0.577 for a
box. Its square, less that of the pixels themselves, is n' C n for the normal n and the blur's covariance C. The lower
quartile along the outline is taken, in each of some directions, since folds, hair and shading widen edges and nothing
narrows them: what is stated is a lower bound, by up to a third too low.

*Noise.* A second difference in rows and columns removes what varies smoothly. Across an edge between two colours, what
is left of red, green and blue is in proportion; that of noise is not. So the least eigenvalue of its covariance in a
small square is noise, and so is texture of more than two colours; the lower quartile over squares is taken. Noise is
taken to be that of photons, whose variance is in proportion to the value.

*Blots.* Before an even backdrop, a mask's island that shows nothing but that, and a hole at whose edge the image has
none, are in the wrong.

Sources: slanted-edge measurement of sharpness (ISO 12233); Immerkær 1996 (noise by second differences).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, convolve, distance_transform_edt, label, map_coordinates

from beam_warp.capture.records import CaptureRecord
from beam_warp.capture.views import CapturedView
from beam_warp.image.files import quantization_error
from beam_warp.image.film import is_film

SOLID = 0.5
"""The outline runs where coverage passes this value."""

WHOLE = 0.999
"""Coverage above which a pixel shows the subject alone."""

MOST_EDGES, MOST_SQUARES = 4096, 1024
"""Places along an outline, and squares within it, that are looked at: evenly chosen."""

REACH = 3.0
STEP = 0.5
"""How far edges are followed to each side, and how far apart they are sampled [pixel]."""

FLAT = 0.15
"""An edge counts if it begins and ends within this of its ends' means, over its contrast, and leaves them nowhere."""

LEAST_CONTRAST = 0.2
"""Difference of an edge's ends, over their sum, from which on it counts."""

SHAPE = 0.57
"""Integral of e (1 - e) over a standard deviation, between that of a Gaussian, 1/sqrt(pi), and that of a box,
1/sqrt(3)."""

OWN_VARIANCE = 0.22
"""Variance of an edge without blur [pixel²]: 1/12 of the pixel's area, and about 1/6 of the interpolation between
pixels, a little less as edges through the middle of pixels count for more."""

DIRECTIONS, FEWEST = 8, 12
"""Sectors of the normals' directions, and edges from which on one of them counts; half of them must."""

QUARTILE = 0.25
"""Quantile of edges, and of squares, that is taken for what is neither fold nor texture."""

NORMAL_SIDE = 9
NORMAL_BLUR = 1.5
"""Side of the window and standard deviation of the filter through which an outline's normals are seen [pixel]."""

SQUARE = 7
"""Side of the squares that noise is looked for in [pixel]; second differences are known in all but their border."""

SECOND_DIFFERENCE = np.outer((1.0, -2.0, 1.0), (1.0, -2.0, 1.0)) / 6.0
"""Weights whose sum of squares is 1: noise that is independent from pixel to pixel keeps its deviation."""

FEWEST_PIXELS = 1000
"""Pixels with a square of the subject around them from which on noise is told from texture."""

LEAST_OVER_VARIANCE = 0.278
"""Quartile, over squares of noise alone, of the least eigenvalue of their channels' covariance, over the variance:
by 40,000 draws."""

SPECK = 24
"""Parts of a mask of fewer pixels are not judged."""

BEYOND = 6.0
"""What lies further from the mask shows the backdrop [pixel]."""

EVEN, UNLIKE = 0.1, 0.2
"""Differences from a smooth backdrop, over its brightness, of pixels that show it, at most, and of others, at least."""

ROUNDS = 6
"""Rounds of reweighting."""

CONTINUOUS = 1.0 / 3.0
"""A hole shows the subject if its rim differs from what is beyond by less than this part of how the backdrop does."""

DARK = 0.05
"""Squares below this part of the image's median level are left out: their noise is not the photons'."""


@dataclass(frozen=True)
class ImageQuality:
    """Sharpness and noise of an image; NaN where nothing tells.

    Attributes:
        blur: Least and largest standard deviation of the blur over all directions [pixel].
        noise: Standard deviation of a colour channel, over its value, in the middle of the subject's levels.
        loss: How far JPEG may have moved its luminance, root mean square [level of 255]; 0 of other formats.
        by_coverage: Whether blur was seen in the coverage, whose edges are those of the lens alone, and not in colours.
        blots: Pixels of islands of the mask that show the backdrop, and of holes that show the subject.
    """

    blur: tuple[float, float]
    noise: float
    loss: float
    by_coverage: bool
    blots: int = 0


def quality_of(record: CaptureRecord, view: CapturedView) -> ImageQuality:
    """Measure how sharp and how noisy an image is.

    Args:
        record: The record of the image, which is read again where the subject stands before a backdrop.
        view: What `CaptureRecord.view` returned.

    Raises:
        MissingFileError, AssetFormatError: The image cannot be read any more.
    """
    loss = 0.0 if is_film(record.image_path) else quantization_error(record.image_path)
    noise = relative_noise(view.color, subject_pixels(view))
    if view.alpha is None:
        return ImageQuality((np.nan, np.nan), noise, loss, by_coverage=False)
    is_photograph = view.mask_offset is not None or record.mask_path is not None or record.plate_path is not None
    shown = record.image().linear_rgba()[..., :3] if is_photograph else view.alpha[..., None]
    blots = blotted(shown, view.alpha) if is_photograph else 0
    return ImageQuality(edge_blur(shown, view.alpha), noise, loss, by_coverage=not is_photograph, blots=blots)


def blotted(image: NDArray[np.float32], alpha: NDArray[np.float32]) -> int:
    """Return of how many pixels the parts of a mask are that are in the wrong.

    Args:
        image: Photograph of subject and backdrop, scene-linear, ``(H, W, 3)``.
        alpha: Coverage, ``(H, W)``.

    Returns:
        Pixels of islands that show the backdrop and of holes that show the subject; 0 where the backdrop is not even.
    """
    covered = alpha > SOLID
    islands, gaps = _labels(covered), _labels(~covered)
    open_gaps = {0, *np.concatenate([gaps[0], gaps[-1], gaps[:, 0], gaps[:, -1]]).tolist()}
    main = int(np.argmax(np.bincount(islands[covered]))) if covered.any() else 0
    strays, holes = _parts(islands, {0, main}), _parts(gaps, open_gaps)
    distance: Any = distance_transform_edt(~covered)  # its types say that it may be None
    beyond = distance > BEYOND
    if not (strays or holes) or beyond.sum() < FEWEST_PIXELS:
        return 0
    backdrop = _smooth(image, beyond)
    brightness = np.maximum(backdrop.mean(axis=-1), 1e-9)
    off = np.abs(image - backdrop).max(axis=-1) / brightness
    if not np.quantile(off[beyond], 1.0 - QUARTILE) < EVEN:
        return 0
    found = 0
    for part in strays:
        apart = (image - backdrop)[_eroded(part)].mean(axis=0)
        found += int(part.sum()) * bool(np.abs(apart).max() < EVEN * brightness[part].mean())
    nearest: Any = distance_transform_edt(~_eroded(covered), return_distances=False, return_indices=True)
    for part in holes:
        rim = _eroded(part) & ~_eroded(part, 3)
        across = np.abs(image[rim] - image[tuple(nearest[:, rim])]).max(axis=-1) / brightness[rim]
        found += int(part.sum()) * bool(np.median(off[rim]) > max(UNLIKE, float(np.median(across)) / CONTINUOUS))
    return found


def _labels(covered: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return the number of the part that each pixel belongs to, from 1 on; 0 of none, ``(H, W)``."""
    found: Any = label(covered)
    return found[0]


def _eroded(part: NDArray[np.bool_], times: int = 1) -> NDArray[np.bool_]:
    """Return a part without its outermost pixels."""
    return np.asarray(binary_erosion(part, iterations=times), bool)


def _parts(labels: NDArray[np.int32], known: set[int]) -> list[NDArray[np.bool_]]:
    """Return parts that are neither known nor specks, ``(H, W)`` each; those whose middle is left by an erosion."""
    sizes = np.bincount(labels.ravel())
    parts = (labels == k for k in np.flatnonzero(sizes >= SPECK).tolist() if k not in known)
    return [part for part in parts if _eroded(part, 2).any()]


def _smooth(image: NDArray[np.float32], chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return an image that varies by a polynomial of the second degree, fitted to the chosen pixels, ``(H, W, 3)``."""
    y, x = (np.linspace(-1.0, 1.0, length) for length in chosen.shape)
    terms = np.stack([np.outer(y**k, x**j) for k in range(3) for j in range(3 - k)], axis=-1)
    at = tuple(_some(np.argwhere(chosen), MOST_EDGES).T)
    known, seen = terms[at], image[at].astype(np.float64)
    found, weights = np.zeros((known.shape[1], 3)), np.ones(len(seen))
    for _ in range(ROUNDS):  # of least absolute differences: what stands before the backdrop does not count
        root = np.sqrt(weights)[:, None]
        found = np.linalg.lstsq(root * known, root * seen, rcond=None)[0]
        weights = 1.0 / np.maximum(np.abs(seen - known @ found).max(axis=1), max(1e-3 * float(np.median(seen)), 1e-12))
    return terms @ found


def edge_blur(image: NDArray[np.float32], alpha: NDArray[np.float32]) -> tuple[float, float]:
    """Return the least and the largest standard deviation of an image's blur [pixel].

    Args:
        image: What shows the outline: colour of subject and backdrop, or coverage, ``(H, W, C)``.
        alpha: Coverage, which says where the outline is, ``(H, W)``.

    Returns:
        Square roots of the eigenvalues of the blur's covariance, 0 for those below 0; NaN if too few edges tell.
    """
    points, normals = _outline(alpha)
    ways = np.arange(-REACH, REACH + 0.5 * STEP, STEP)
    places = points[:, None] + ways[:, None] * normals[:, None]
    within = ((places >= 0.0) & (places <= np.array(alpha.shape) - 1.0)).all(axis=(1, 2))
    places, normals = places[within], normals[within]
    seen = np.stack([map_coordinates(c, places.reshape(-1, 2).T, order=1) for c in np.moveaxis(image, -1, 0)], axis=-1)
    seen = seen.reshape(*places.shape[:2], image.shape[-1]).astype(np.float64)
    inner, outer = seen[:, :3].mean(axis=1), seen[:, -3:].mean(axis=1)
    contrast = inner - outer
    strength = (contrast**2).sum(axis=1)
    edge = ((seen - outer[:, None]) * contrast[:, None]).sum(axis=-1) / np.maximum(strength, 1e-30)[:, None]
    good = strength > np.maximum(LEAST_CONTRAST**2 * ((inner + outer) ** 2).sum(axis=1), 1e-30)
    good &= (np.abs(edge - np.clip(edge, 0.0, 1.0)) < FLAT).all(axis=1)
    good &= (edge[:, :3] > 1.0 - FLAT).all(axis=1) & (edge[:, -3:] < FLAT).all(axis=1)
    edge, normals = edge[good], normals[good]
    variances = np.square((edge * (1.0 - edge)).sum(axis=1) * STEP / SHAPE) - OWN_VARIANCE
    return _deviations(variances, normals)


def _deviations(variances: NDArray[np.float64], normals: NDArray[np.float64]) -> tuple[float, float]:
    """Return the deviations along the axes of the covariance that edges' variances ask for; see `edge_blur`."""
    angles = np.arctan2(normals[:, 0], normals[:, 1]) % np.pi
    sector = (angles * (DIRECTIONS / np.pi)).astype(int) % DIRECTIONS
    told = [index for index in range(DIRECTIONS) if (sector == index).sum() >= FEWEST]
    if len(told) < DIRECTIONS // 2:
        return np.nan, np.nan
    least = [np.quantile(variances[sector == index], QUARTILE) for index in told]
    row, column = (function((np.array(told) + 0.5) * (np.pi / DIRECTIONS)) for function in (np.sin, np.cos))
    yy, xy, xx = np.linalg.lstsq(np.stack([row**2, 2.0 * row * column, column**2], axis=1), least, rcond=None)[0]
    # directions without edges say nothing: no variance is larger than that of the widest edges that were seen
    small, large = np.sqrt(np.clip(np.linalg.eigvalsh([[yy, xy], [xy, xx]]), 0.0, max(*least, 0.0)))
    return float(small), float(large)


def _outline(alpha: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels along an outline, evenly chosen, and unit directions away from the subject, ``(K, 2)`` each."""
    inside = np.pad(alpha > SOLID, 1, mode="edge")
    enclosed = inside[:-2, 1:-1] & inside[2:, 1:-1] & inside[1:-1, :-2] & inside[1:-1, 2:]
    points = _some(np.argwhere(inside[1:-1, 1:-1] & ~enclosed), MOST_EDGES)
    ways = np.arange(NORMAL_SIDE) - NORMAL_SIDE // 2
    bell = np.exp(-0.5 * (ways / NORMAL_BLUR) ** 2)
    windows = _windows(alpha[..., None], points, NORMAL_SIDE)[..., 0]
    slopes = np.stack(
        [np.einsum("kij,i,j->k", windows, -ways * bell, bell), np.einsum("kij,i,j->k", windows, bell, -ways * bell)],
        axis=-1,
    )
    lengths = np.linalg.norm(slopes, axis=1)
    steep = lengths > 1e-6
    return points[steep].astype(np.float64), slopes[steep] / lengths[steep, None]


def photon_noise(color: NDArray[np.float32], solid: NDArray[np.bool_]) -> float:
    """Return the variance of a pixel's colour channel over its value.

    Args:
        color: Scene-linear, ``(H, W, 3)``.
        solid: Which pixels show the subject alone, ``(H, W)``.

    Returns:
        Variance over value, in the units of the colour; NaN if hardly a square of pixels shows the subject alone, or
        all are dark.
    """
    every = np.flatnonzero(solid)
    places = np.stack(np.divmod(_some(every, MOST_SQUARES), solid.shape[1]), axis=1)
    whole = _windows(solid[..., None], places, SQUARE).all(axis=(1, 2, 3))
    squares = _windows(color, places[whole], SQUARE).astype(np.float64)
    level = squares.mean(axis=(1, 2))
    lit = level.min(axis=1) > DARK * np.median(level) if len(level) else np.zeros(0, bool)
    if lit.sum() * len(every) < FEWEST_PIXELS * max(len(places), 1):
        return np.nan
    scaled = squares[lit] / np.sqrt(level[lit, None, None])
    differences = convolve(scaled, SECOND_DIFFERENCE[None, ..., None])[:, 1:-1, 1:-1].reshape(lit.sum(), -1, 3)
    covariances = np.einsum("kpc,kpd->kcd", differences, differences) / differences.shape[1]
    least = np.linalg.eigvalsh(covariances)[:, 0]
    return float(np.quantile(least, QUARTILE) / LEAST_OVER_VARIANCE)


def subject_pixels(view: CapturedView) -> NDArray[np.bool_]:
    """Return which pixels show the subject alone, ``(H, W)``: all of them where coverage is not known."""
    return np.ones(view.color.shape[:2], bool) if view.alpha is None else view.alpha > WHOLE


def relative_noise(color: NDArray[np.float32], solid: NDArray[np.bool_]) -> float:
    """Return the standard deviation of a pixel's colour channel over its value, in the middle of the subject's levels.

    Args:
        color: Scene-linear, ``(H, W, 3)``.
        solid: Which pixels show the subject alone, ``(H, W)``.

    Returns:
        A part of the value; NaN as for `photon_noise`.
    """
    level = float(np.median(color[solid])) if solid.any() else 0.0
    return float(np.sqrt(np.maximum(photon_noise(color, solid), 0.0) / level)) if level > 0.0 else np.nan


def noise_of_views(views: Sequence[CapturedView]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return how many pixels of each view show the subject alone, and their `relative_noise`, ``(V,)`` each."""
    subjects = [subject_pixels(view) for view in views]
    noise = [relative_noise(view.color, subject) for view, subject in zip(views, subjects, strict=True)]
    return np.array([np.count_nonzero(subject) for subject in subjects]), np.array(noise)


def _some(places: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return places, evenly chosen from too many."""
    return places[np.linspace(0, len(places) - 1, min(len(places), most)).astype(int)]


def _windows(image: NDArray[Any], places: NDArray[np.int64], side: int) -> NDArray[Any]:
    """Return the squares of pixels around places, ``(K, side, side, C)``; the border's pixels go on beyond it."""
    ways = np.arange(side) - side // 2
    row, column = (np.clip(places[:, axis, None] + ways, 0, length - 1) for axis, length in enumerate(image.shape[:2]))
    return image[row[:, :, None], column[:, None, :]]
