"""Cut-outs, colour over nothing: a ring without light where a mask is too large, and masks that are moved.

A cut-out shows nothing beyond its mask, so that no backdrop tells where the subject ends. Two kinds of file are told
apart by what their masks reach of too much. Where colour was multiplied by the true coverage, it fades to nothing
within a pixel. Where straight colour was kept, each pixel that the subject touches shows it in full, and the next one
nothing. In both, the first pixels without light are about half a pixel beyond the true outline. A mask that is too
small shows nothing of the kind.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, gaussian_filter

from beam_warp.capture.matte_edges import SOLID
from beam_warp.capture.mattes import moved_mask
from beam_warp.capture.views import CapturedView

MOST_PIXELS = 3.0
"""No mask is moved further [pixel]: as wide is the band along an outline that is searched for a ring."""

SQUARE = np.ones((3, 3), dtype=bool)
BAND = 3.07
"""Width of what a cross, a square and a cross take from an outline, mean over directions [pixel]: 2 x 0.9 + 1.27."""

SPREAD = 2.5
"""Standard deviation of the filter through which the subject's light within the band is seen [pixel]."""

KNOWN = 0.01
"""Weight of that filter below which the subject's light is not known: its limb is thinner than the bands."""

DARK, DIM = 0.1, 0.5
"""A pixel with less of the subject's light has none, or is partly covered."""

NEAR, MOST = 2, 0.5
"""A ring lies within so many pixels of more than this share of the outline; less is a dark part of the subject."""

FADES = 0.25
"""Share of dim pixels among those beside a ring above which colour fades: about 0.1 where it does not, 0.4 where it
does (walker and robot, masks 0.8 to 2 pixels too large)."""

LEAST_COVERAGE = 0.05
"""Coverage below which a straight colour means nothing."""

SOLID_COLOR = 0.99
"""Where coverage is more, before and after an outline is moved, the subject's own light is sought."""


@dataclass(frozen=True)
class Ring:
    """What is without light along the inside of an outline.

    Attributes:
        width: Mean along the outline [pixel]; 0 where there is none.
        dim: Share of the pixels beside it that are partly covered.
    """

    width: float = 0.0
    dim: float = 0.0


def ring_of(view: CapturedView) -> Ring:
    """Measure the ring without light along the inside of a view's outline.

    A pixel has no light if it has a tenth of what the subject shows three pixels further in. So a dark subject, or a
    dark side, is no ring; nor are dark parts here and there.
    """
    if view.alpha is None or not (view.alpha > SOLID).any():
        return Ring()
    box = tuple(
        slice(max(int(found[0]) - 1, 0), int(found[-1]) + 2)
        for found in (np.flatnonzero((view.alpha > SOLID).any(axis=axis)) for axis in (1, 0))
    )
    alpha = view.alpha[box]
    solid = alpha > SOLID
    light = view.color[box].sum(axis=-1) / np.maximum(alpha, LEAST_COVERAGE)
    deep = solid
    for shape in (None, SQUARE, None):
        deep = np.asarray(binary_erosion(deep, shape, border_value=1), dtype=bool)
    weight = gaussian_filter(deep.astype(np.float32), SPREAD)
    inner = gaussian_filter(np.where(deep, light, 0.0).astype(np.float32), SPREAD) / np.maximum(weight, KNOWN)
    band = solid & ~deep & (weight > KNOWN)
    ring = band & (light < DARK * inner)
    core, around = np.asarray(binary_erosion(solid, border_value=1), bool), np.asarray(binary_dilation(ring), bool)
    beside, edge = around & band & ~ring, band & ~core
    if not (beside.any() and binary_dilation(ring, SQUARE, NEAR)[edge].mean() > MOST):
        return Ring()
    return Ring(BAND * float(ring.sum() / band.sum()), float((light < DIM * inner)[beside].mean()))


def taken_in(view: CapturedView, pixels: float) -> CapturedView:
    """Take a view's mask in by so many pixels, or let it out if negative; 0 returns the view.

    Colour that fades within a mask that is too large is multiplied by the true coverage already, and stays. Elsewhere
    straight colour is the subject's in each pixel that has light, and beyond those that of the nearest one.
    """
    if view.alpha is None or pixels == 0.0:
        return view
    alpha = moved_mask(view.alpha, float(np.clip(pixels, -MOST_PIXELS, MOST_PIXELS)))
    straight = view.color / np.maximum(view.alpha, LEAST_COVERAGE)[..., None]
    within = np.minimum(alpha, view.alpha)
    if not (within > SOLID_COLOR).any():
        return replace(view, alpha=alpha, color=np.minimum(view.color, alpha[..., None]), is_recut=True)
    if pixels > 0.0:
        inner = _spread(straight, within > SOLID_COLOR).sum(axis=-1)
        alpha[straight.sum(axis=-1) < DARK * inner] = 0.0
        if ring_of(view).dim > FADES:
            return replace(view, alpha=alpha, is_recut=True)
    lit = (within > 2.0 * LEAST_COVERAGE) & (alpha > 0.0)
    color = (_spread(straight, lit) * alpha[..., None]).astype(np.float32)
    return replace(view, alpha=alpha, color=color, is_recut=True)


def _spread(image: NDArray[np.floating], known: NDArray[np.bool_]) -> NDArray[np.floating]:
    """Return an image with pixels that are not known as the nearest known ones; some must be."""
    nearest: Any = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return image[tuple(nearest)]
