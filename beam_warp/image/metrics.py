"""Scores of a render against its truth, by the paper's protocol and on solid pixels alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import linear_to_srgb

SOLID_ALPHA = 0.999
"""Pixels are solid if the truth's alpha is above this."""

SUBJECT_ALPHA = 0.5
"""Pixels belong to the subject if alpha is above this."""

SMALLEST_ERROR = 1e-12
"""Mean squared error below which images count as equal: 120 dB."""


@dataclass(frozen=True)
class Score:
    """Scores of one channel of one view, composited on black.

    Attributes:
        psnr: Peak signal-to-noise ratio inside the subject's bounding box [dB].
        ssim: Structural similarity there, with a Gaussian window of sigma 1.5 and data range 1.
        solid_psnr: Peak signal-to-noise ratio where the truth's alpha is above `SOLID_ALPHA`; holes lower it [dB].
    """

    psnr: float
    ssim: float
    solid_psnr: float


def root_mean_square(values: ArrayLike) -> float:
    """Return the root mean square of numbers of any shape, summed in float64."""
    return float(np.sqrt(np.square(values, dtype=np.float64).mean()))


def psnr(image: ArrayLike, truth: ArrayLike, mask: NDArray[np.bool_] | None = None) -> float:
    """Return the peak signal-to-noise ratio for a peak of 1 [dB], over all pixels or those of a mask ``(H, W)``.

    Raises:
        InvalidArrayError: There is no pixel.
    """
    difference = np.asarray(image, np.float64) - np.asarray(truth, np.float64)
    if mask is not None:
        difference = difference[mask]
    if difference.size == 0:
        raise InvalidArrayError("mask must leave at least one pixel, got none. Check the truth's alpha.")
    return float(-10.0 * np.log10(max(float(np.mean(difference**2)), SMALLEST_ERROR)))


def ssim(image: ArrayLike, truth: ArrayLike) -> float:
    """Return the structural similarity of two images ``(H, W)`` or ``(H, W, 3)`` in [0, 1] (Wang et al. 2004)."""
    from skimage.metrics import structural_similarity  # takes long to import, and most of a job needs no score

    a, b = np.asarray(image, np.float64), np.asarray(truth, np.float64)
    return float(
        structural_similarity(  # type: ignore[arg-type]  # it returns one number unless asked for more
            a,
            b,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            channel_axis=-1 if a.ndim == 3 else None,
        )
    )


def bounding_box(alpha: ArrayLike) -> tuple[slice, slice]:
    """Return the rows and columns of the box around the pixels whose alpha is above `SUBJECT_ALPHA`."""
    rows, columns = np.nonzero(np.asarray(alpha) > SUBJECT_ALPHA)
    if len(rows) == 0:
        raise InvalidArrayError("alpha must show a subject, got none above 0.5. Check the camera.")
    return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)


@dataclass(frozen=True, eq=False)
class Compared:
    """One channel of one view in the form in which it is compared.

    Attributes:
        image: Pixels inside the subject's bounding box, composited on black, colours encoded as sRGB; float64.
        truth: The same pixels of the truth.
        solid_psnr: Peak signal-to-noise ratio over the whole image where the truth's alpha is above `SOLID_ALPHA` [dB].
    """

    image: NDArray[np.float64]
    truth: NDArray[np.float64]
    solid_psnr: float

    def score(self) -> Score:
        """Return the scores of this channel."""
        return Score(psnr(self.image, self.truth), ssim(self.image, self.truth), self.solid_psnr)


def as_compared(
    image: ArrayLike, truth: ArrayLike, *, alpha: ArrayLike, truth_alpha: ArrayLike, is_color: bool, premultiplied: bool
) -> Compared:
    """Bring one channel of one view to the form in which it is compared.

    Args:
        image: Channel, ``(H, W)`` or ``(H, W, 3)``; colours are linear, and encoded here.
        truth: Channel of the truth, in the same shape.
        alpha: Coverage of the image, ``(H, W)``.
        truth_alpha: Coverage of the truth.
        is_color: True clips both to [0, 1] and encodes them as sRGB.
        premultiplied: True if the channels are multiplied by alpha already (radiance); otherwise they are composited
            on black here.

    Raises:
        InvalidArrayError: The truth shows no subject.

    Source: BEAM §4 (bounding box of the subject, black background).
    """
    a, b = np.asarray(image, np.float64), np.asarray(truth, np.float64)
    solid = np.asarray(truth_alpha) > SOLID_ALPHA
    if is_color:
        a, b = linear_to_srgb(np.clip(a, 0.0, 1.0)), linear_to_srgb(np.clip(b, 0.0, 1.0))
    if not premultiplied:
        extra = (...,) + (None,) * (a.ndim - 2)
        a, b = a * np.asarray(alpha, np.float64)[extra], b * np.asarray(truth_alpha, np.float64)[extra]
    box = bounding_box(truth_alpha)
    return Compared(a[box], b[box], psnr(a, b, solid))


def compare(
    image: ArrayLike, truth: ArrayLike, *, alpha: ArrayLike, truth_alpha: ArrayLike, is_color: bool, premultiplied: bool
) -> Score:
    """Score one channel of one view; see `as_compared`."""
    return as_compared(
        image, truth, alpha=alpha, truth_alpha=truth_alpha, is_color=is_color, premultiplied=premultiplied
    ).score()


def least_squares_scale(image: ArrayLike, truth: ArrayLike, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the factor of each channel that brings an image ``(H, W, 3)`` closest to its truth on a mask, ``(3,)``."""
    a, b = np.asarray(image, np.float64)[mask], np.asarray(truth, np.float64)[mask]
    return (a * b).sum(axis=0) / np.maximum((a * a).sum(axis=0), 1e-12)


def angles_between(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return angles between vectors ``(N, 3)`` [degree]; a vector of length 0 is at a right angle to all others."""
    one, two = (v.astype(np.float64) / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9) for v in (a, b))
    return np.degrees(np.arccos(np.clip((one * two).sum(axis=1), -1.0, 1.0)))


def mean_scores(scores: Mapping[str, list[Score]]) -> dict[str, dict[str, float]]:
    """Return the mean scores of every channel over its views, JSON-able."""
    return {
        name: {
            field: float(np.mean([getattr(score, field) for score in views]))
            for field in ("psnr", "ssim", "solid_psnr")
        }
        for name, views in scores.items()
    }


def block_means(image: NDArray[Any], side: int) -> NDArray[np.floating]:
    """Return the means of blocks of ``side`` x ``side`` samples, ``(H side, W side, ...)`` to ``(H, W, ...)``."""
    if side == 1:
        return image
    height, width = image.shape[0] // side, image.shape[1] // side
    rows = image.reshape(height, side, -1).sum(axis=1).reshape(height, width, side, -1)
    total = rows[:, :, 0].copy()
    for column in range(1, side):  # NumPy's own sum over so short an axis takes several times as long
        total += rows[:, :, column]
    return (total / side**2).reshape(height, width, *image.shape[2:])
