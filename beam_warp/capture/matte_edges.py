"""How soft a mask's outline is in its photograph, and masks redrawn as soft.

A mask may be feathered, all or nothing, or interpolated as it was resized or grown; then its coverage is wrong along
the whole outline, wherever that lies. Pixels that the subject shares with its backdrop show their coverage. So a mask
is filtered and made steeper, in the way out of a few that explains most of these pixels best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

SOLID = 0.5
"""The outline runs where coverage passes this value."""

BLURS = (0.0, 0.5, 0.7, 1.0, 1.4)
GAINS = tuple(1.0 + step / 8.0 for step in range(17))
"""Standard deviations of the filter that a mask passes first [pixel], and how many times steeper it is made then."""

NEAR = 1.5
"""Pixels so near to the outline show how soft it is [pixel]; errors of neighbours across it are one."""

UNLIKE = 0.3
"""Coverage that is off by more is wrong for another reason than softness."""


@dataclass(frozen=True)
class Edge:
    """How coverage along an outline is redrawn.

    Attributes:
        blur: Standard deviation of a filter [pixel].
        gain: How many times steeper coverage is made after it.
    """

    blur: float = 0.0
    gain: float = 1.0

    def redrawn(self, mask: NDArray[np.float32], at: tuple[NDArray[np.int64], ...]) -> NDArray[np.float32]:
        """Return a mask, ``(H, W)``, with coverage redrawn at some pixels: their rows and columns."""
        if self == AS_IT_IS:
            return mask
        redrawn = mask.copy()
        redrawn[at] = _steeper(_softer(mask, self.blur)[at], self.gain)
        return redrawn


AS_IT_IS = Edge()
"""The edge that a mask has."""


@dataclass(frozen=True, eq=False)
class EdgeEvidence:
    """Coverage near an outline, as a photograph shows it.

    Attributes:
        at: Rows and columns of pixels, ``(P,)`` each.
        distances: Their distances from the outline, negative inside [pixel], ``(P,)``.
        shown: Coverage that their colour shows, not clipped, ``(P,)``.
        worth: The contrast of subject and backdrop, squared, over the variance of their colours, ``(P,)``.
    """

    at: tuple[NDArray[np.int64], ...]
    distances: NDArray[np.float64]
    shown: NDArray[np.float64]
    worth: NDArray[np.float64]

    def best_edge(self, mask: NDArray[np.float32], pixels: float) -> tuple[Edge, float]:
        """Return the edge that explains pixels best, and by how many standard errors better than the mask's own.

        Args:
            mask: Coverage after its outline was moved, ``(H, W)``.
            pixels: By how much it was taken in [pixel].
        """
        near = np.abs(self.distances + pixels) <= NEAR
        if not near.any():
            return AS_IT_IS, 0.0
        best = near & (self.worth >= np.median(self.worth[near]))
        at = tuple(index[best] for index in self.at)
        edges = [Edge(blur, gain) for blur in BLURS for gain in GAINS]
        softer = {blur: _softer(mask, blur)[at] for blur in BLURS}
        misfits = [_misfit(self.shown[best], _steeper(softer[edge.blur], edge.gain)) for edge in edges]
        found = int(np.argmin([misfit.mean() for misfit in misfits]))
        better = misfits[edges.index(AS_IT_IS)] - misfits[found]
        error = better.std() * np.sqrt(2.0 * NEAR / len(better))
        return edges[found], float(better.mean() / max(error, 1e-12))


def _misfit(shown: NDArray[np.float64], coverage: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.minimum(np.square(shown - coverage), UNLIKE**2)


def _softer(coverage: NDArray[np.float32], blur: float) -> NDArray[np.floating]:
    return gaussian_filter(coverage, blur, mode="nearest") if blur else coverage


def _steeper(coverage: NDArray[np.floating], gain: float) -> NDArray[np.floating]:
    return np.clip(SOLID + gain * (coverage - SOLID), 0.0, 1.0)
