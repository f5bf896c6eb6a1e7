"""Agreement of the depth images of several views: how far, where, and which pixels no other view confirms."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_count, require_number
from beam_warp.kernels.mesh.depth_agreement import launch_compare_depths, launch_flag_agreed
from beam_warp.mesh.depths import DepthImages

TOLERANCE = 2.0
"""Distance [pixel] within which two views see one point: each knows its surface to about a pixel."""


@dataclass(frozen=True)
class ViewConsistency:
    """Agreement of one view's depth with the others'.

    Attributes:
        pixel_count: Pixels that show a surface and are neither grazing nor at an edge.
        seen: Share of them at which some other view has a say: it confirms or contradicts.
        confirmed: Share of the seen ones that at least one view confirms, and no more contradict.
        contradicted: Share of the seen ones that more views contradict than confirm.
        mean_residual: Mean distance between the surfaces where they confirm each other [m].
    """

    pixel_count: int
    seen: float
    confirmed: float
    contradicted: float
    mean_residual: float


@dataclass(frozen=True, eq=False)
class DepthConsistency:
    """Result of `depth_consistency`; arrays are on the device, of all views' pixels, one view after the other.

    Attributes:
        confirmed: How many other views show a surface at the point of each pixel, -1 where it has no
            weight of its own, ``(P,)`` int.
        contradicted: How many look through it, ``(P,)`` int.
        residuals: Mean distance from the confirming views' surfaces [m], 0 where none does, ``(P,)`` float.
        views: A summary of each view.
    """

    confirmed: wp.array
    contradicted: wp.array
    residuals: wp.array
    views: tuple[ViewConsistency, ...]

    def mask(self, confirmations: int = 1) -> wp.array:
        """Return 1 for pixels that enough views confirm, and no more contradict, ``(P,)`` int; for `DepthImages.keep`.

        Args:
            confirmations: Least number of confirming views. With 0, what no other view sees is kept.
        """
        require_count("confirmations", confirmations, 0)
        flags = wp.empty(len(self.confirmed), dtype=int, device=self.confirmed.device)
        launch_flag_agreed(len(flags), self.confirmed, self.contradicted, confirmations, flags, flags.device)
        return flags

    def as_dict(self) -> dict[str, Any]:
        """Return the summary for a report: shares over all views, and the worst view."""
        weights = np.array([view.pixel_count for view in self.views], np.float64)
        seen = weights * [view.seen for view in self.views]

        def mean(values: list[float], shares: NDArray[np.float64]) -> float:
            return float(np.dot(values, shares) / shares.sum()) if shares.sum() > 0.0 else 0.0

        confirmed = [view.confirmed for view in self.views]
        return {
            "pixels": int(weights.sum()),
            "seen": mean([view.seen for view in self.views], weights),
            "confirmed": mean(confirmed, seen),
            "contradicted": mean([view.contradicted for view in self.views], seen),
            "mean_residual": mean([view.mean_residual for view in self.views], seen * confirmed),
            "worst_view": int(np.argmin(confirmed)),
            "worst_view_confirmed": float(np.min(confirmed)),
        }


def depth_consistency(images: DepthImages, *, tolerance: float = TOLERANCE) -> DepthConsistency:
    """Look up every pixel's point in all other views.

    A view confirms a point if its surface passes it within ``tolerance``, contradicts it if it looks through it, at a
    surface behind or at background a pixel wide around, and says nothing if a surface is in front (the point is hidden
    there), if the point is outside the image, or if its own pixel is grazing or at an edge.

    Distances are from the plane that the other view's pixel sees, so that a tilted surface is not held against it.

    Args:
        images: Depth of at least one view.
        tolerance: In widths of a pixel at the surface, of the coarser view.

    Raises:
        InvalidOptionError: ``tolerance`` is out of range.
    """
    require_number("tolerance", tolerance, 0.0, 1e6)
    total = len(images.pixels)
    found = [wp.empty(total, dtype=dtype, device=images.device) for dtype in (int, int, float)]
    for index, camera in enumerate(images.cameras):
        pixel_count = camera.width * camera.height
        launch_compare_depths(index, pixel_count, images.views, images.pixels, tolerance, *found, device=images.device)
    parts = itertools.starmap(slice, itertools.pairwise(images.first_pixels))
    views = tuple(_summary(*(array[part].numpy() for array in found)) for part in parts)
    return DepthConsistency(*found, views=views)


def _summary(
    confirmed: NDArray[np.int32], contradicted: NDArray[np.int32], residuals: NDArray[np.float32]
) -> ViewConsistency:
    """Sum up the pixels of one view that count."""
    usable = confirmed >= 0
    confirmed, contradicted, residuals = confirmed[usable], contradicted[usable], residuals[usable]
    seen = confirmed + contradicted > 0
    count = max(int(seen.sum()), 1)
    agreed = (confirmed > 0) & (contradicted <= confirmed)
    return ViewConsistency(
        len(confirmed),
        float(seen.sum() / max(len(confirmed), 1)),
        float(agreed.sum() / count),
        float((contradicted > confirmed).sum() / count),
        float(residuals[confirmed > 0].mean(dtype=np.float64)) if (confirmed > 0).any() else 0.0,
    )
