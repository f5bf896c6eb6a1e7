"""Masks of cut-outs: how far they are off, from what all views agree on and from colour that ends before its mask.

A cut-out has no colour beyond its mask, so that no backdrop tells where the subject ends. A short fit to all views is a
compromise between their masks: what it draws of one view tells how far this view's mask is off relative to the others,
to a hundredth of a pixel, but not how far all of them are. An upper bound for each view does: where a mask reaches
beyond the subject, there is a ring that is darker than the subject for want of colour; where it does not, nothing is
seen. So the offset that all have in common is the largest that keeps every view within its bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_gradient_magnitude, minimum_filter, uniform_filter

from beam_warp.capture.mattes import SOLID, MaskOffset, matte, moved_mask
from beam_warp.capture.views import CapturedView

WINDOW = 7
"""Side of the windows whose pixels share an offset [pixel]."""

TIGHTEST = 0.2
"""The common offset is where this part of the views would be beyond their bounds: some bounds are too low by noise."""

MOST_PIXELS = 3.0
"""No mask is moved further [pixel]."""

SOLID_COLOR = 0.99
"""Colour is the subject's alone where coverage is more, before and after its outline is moved."""


def relative_offset(mask: NDArray[np.float32], drawn: NDArray[np.float32]) -> MaskOffset | None:
    """Return how far a mask reaches beyond what is drawn of the view, median along the outline.

    Args:
        mask: Coverage in [0, 1], ``(H, W)``.
        drawn: Coverage as a fit to all views draws it, ``(H, W)``.

    Returns:
        The offset; None where the mask has no outline.
    """
    length = uniform_filter(gaussian_gradient_magnitude(mask.astype(np.float64), 1.0), WINDOW)
    edge = (mask > SOLID) & (minimum_filter(mask, 3, mode="nearest") <= SOLID) & (length > 0.5 / WINDOW)
    if not edge.any():
        return None
    offsets = uniform_filter(mask.astype(np.float64) - drawn, WINDOW)[edge] / length[edge]
    middle = float(np.median(offsets))
    spread = 1.4826 * float(np.median(np.abs(offsets - middle)))
    return MaskOffset(middle, 1.2533 * spread / float(np.sqrt(max(edge.sum() / WINDOW, 1.0))))


def largest_offset(view: CapturedView) -> MaskOffset | None:
    """Return how far a cut-out's mask can reach beyond the subject: as far as colour is missing within its outline.

    This is half a pixel too little where the file's straight colour is the subject's in all pixels that it touches.

    Returns:
        The bound; None where the view has no mask with an outline, or the subject is as dark as nothing.
    """
    return None if view.alpha is None else matte(view.color, view.alpha, np.zeros_like(view.color)).offset


def agreed_offsets(
    relative: Sequence[MaskOffset | None], largest: Sequence[MaskOffset | None]
) -> list[MaskOffset | None]:
    """Return how far each view's mask is off.

    If all masks are too small by the same, nothing shows it, and they count as exact.

    Args:
        relative: What `relative_offset` found in each view.
        largest: What `largest_offset` found in each view.

    Returns:
        Offsets, those of views without a relative one None; all as they are relatively if no view has a bound.
    """
    pairs = [
        (own, bound) for own, bound in zip(relative, largest, strict=True) if own is not None and bound is not None
    ]
    common = MaskOffset(0.0, 0.0)
    if pairs:
        rooms = np.array([max(bound.pixels, 0.0) - own.pixels for own, bound in pairs])
        order = np.argsort(rooms)
        tight = pairs[order[int(TIGHTEST * len(order))]]
        pixels = float(rooms[order[int(TIGHTEST * len(order))]])
        common = MaskOffset(pixels, float(np.hypot(tight[0].error, tight[1].error)))
    return [
        None if own is None else MaskOffset(own.pixels + common.pixels, float(np.hypot(own.error, common.error)))
        for own in relative
    ]


def moved_view(view: CapturedView, pixels: float) -> CapturedView:
    """Take a cut-out's mask in by so many pixels, or let it out if negative.

    Colour along the outline, which the file does not have or has with too little light, is that of the nearest pixels
    that are the subject's alone.
    """
    if view.alpha is None or pixels == 0.0:
        return view
    alpha = moved_mask(view.alpha, float(np.clip(pixels, -MOST_PIXELS, MOST_PIXELS)))
    solid = np.minimum(alpha, view.alpha) > SOLID_COLOR
    if not solid.any():
        return replace(view, alpha=alpha, color=np.minimum(view.color, alpha[..., None]))
    nearest: Any = distance_transform_edt(~solid, return_distances=False, return_indices=True)
    return replace(view, alpha=alpha, color=view.color[tuple(nearest)] * np.where(solid, 1.0, alpha)[..., None])
