"""The total variation of radiance among neighbouring Gaussians, which counts in a fit as far as photographs are noisy.

Many radiances of Gaussians that lie over one another give the same images, and noise picks one of them. Of those, the
most even one is taken: each Gaussian is as its neighbours are, unless the photographs say otherwise.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from beam_warp.kernels.reconstruction.total_variation import launch_add_variation_gradients
from beam_warp.reconstruction.parameters import GaussianParameters

NEIGHBORS = 8
"""Gaussians around one that it is compared with: a ring, on a surface."""

ROUNDING = 0.05
"""Difference of radiance, all its harmonics together, below which it counts by its square: what is as small is no edge,
and has no direction."""

VARIATION_OF_NOISE = 1.0
"""Weight of the total variation, over the variance of the photographs' noise: the noisier they are, the more counts
what is likely without them."""

LEAST_VARIATION, MOST_VARIATION = 3e-4, 3e-3
"""Below the first, it does not count, as if photographs were clean. Above the second, fine paint fades: new views of a
noisy runner and of a painted ball became worse."""


def chosen_variation(weight: float | Literal["auto"], noise: NDArray[np.float64]) -> float:
    """Return the weight of the total variation in a fit.

    Args:
        weight: The weight; ``"auto"``: what noise asks for, see `VARIATION_OF_NOISE`.
        noise: Standard deviation of each photograph's noise, as a part of the value, ``(V,)``; NaN where it is not
            known.
    """
    if weight != "auto":
        return float(weight)
    known = noise[np.isfinite(noise)]
    found = min(VARIATION_OF_NOISE * float(np.median(known**2)), MOST_VARIATION) if len(known) else 0.0
    return found if found >= LEAST_VARIATION else 0.0


class RadianceVariation:
    """The sum over Gaussians and their neighbours of sqrt(d^2 + t^2), d how much their radiance differs, t `ROUNDING`.

    All harmonics and channels are differences of one vector: an edge of colour lets gloss change, too.

    Source: Rudin et al. 1992, total variation; Blomgren and Chan 1998, of vectors.
    """

    def __init__(self, parameters: GaussianParameters) -> None:
        """Take the Gaussians of a fit, and find their neighbours."""
        self._parameters = parameters
        self._neighbors = wp.empty((len(parameters), NEIGHBORS), dtype=int, device=parameters.device)
        self.find_neighbors()

    def find_neighbors(self) -> None:
        """Find the neighbours of all Gaussians as they lie now; a recorded step goes on with them."""
        rows = np.flatnonzero(self._parameters.alive())
        near = np.full(self._neighbors.shape, -1, np.int32)
        count = min(NEIGHBORS, len(rows) - 1)
        if count > 0:
            places = self._parameters.positions.numpy()[rows]
            found = cKDTree(places).query(places, k=count + 1, workers=-1)[1]
            near[rows, :count] = rows[found[:, 1:]]
        self._neighbors.assign(near)

    def add_gradients(self, weight: float) -> None:
        """Add the gradient times a weight to that of each Gaussian's radiance, its neighbours taken as they are."""
        parameters = self._parameters
        launch_add_variation_gradients(
            len(parameters),
            parameters.radiance,
            self._neighbors,
            weight,
            ROUNDING,
            parameters.gradient("radiance"),
            parameters.device,
        )
