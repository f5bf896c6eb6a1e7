"""Base colour of all Gaussians of a frame at once: the one of which the views' pixels are the blend.

Solved for itself, each Gaussian explains the colour that its views show of it (`beam_warp.materials.direct`). But
images show blends: colours that lie over one another can be off against each other without a pixel that says so, and
each takes its noise for paint. Here the pixels decide, and where they do not, a Gaussian has the colour of its
neighbours:

    min over x  sum over views v and pixels p of m_vp |(W_v (D_v x - y_v))_p|^2
                + sum over neighbours of w_ij |x_i - x_j|^2

with blending weights W, what a white Gaussian would send by diffusion D, and what views show of each less its
highlights y. Weights are those of the solution that it begins with: Cauchy's for pixels, and for neighbours those of
the total variation, which keeps edges, and less of what differs by far.

What views show of each Gaussian has what images show beyond the fit already, at the resolution of the fit. So that no
image is read here, and a sample a pixel is enough: both sides are drawn alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from beam_warp.device.arrays import upload
from beam_warp.jobs.listeners import CountProgress
from beam_warp.kernels.common.row_sums import launch_add_rows
from beam_warp.kernels.materials.blended_color import (
    LitView,
    launch_add_differences,
    launch_add_said,
    launch_add_worth,
    launch_weigh_explained,
    launch_weigh_unexplained,
    launch_write_explained,
    launch_write_unexplained,
)
from beam_warp.materials.bounded_solve import solve_bounded
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.materials.light_rays import LitPoints
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.resolution import reduced_camera, reduced_options, reduction_factor
from beam_warp.raster.sources import upload_gaussians
from beam_warp.world.gaussians import GaussianCloud

NEIGHBORS = 8
"""Gaussians around one that it is compared with: a ring, on a surface."""

SMOOTHNESS = 3e-4
"""What neighbours that differ by as much as the subject's mean base colour count, over what images say of a typical
Gaussian."""

EDGE = 0.1
"""Difference of neighbours, over the subject's mean base colour, below which it counts by its square: what is as small
is no edge."""

CONTRAST = 2.0
"""Difference of neighbours, over the subject's mean base colour, at which it counts half: what differs by as much is
other paint, and must not bleed."""

PASSES = 8
"""Passes over the views: more of them change base colour of the captures by less than a tenth of a decibel."""

BRIGHTEST = 2.0
"""Base colour that solving begins with, at most: above 1 only a light that is stated too dim would ask for it."""

COLUMNS = 4
"""Columns of arrays: three channels, and room for what pixels count."""


def solve_blended(
    cloud: GaussianCloud,
    views: ViewEvidence,
    measured: LitPoints,
    separate: NDArray[np.floating[Any]],
    *,
    progress: CountProgress | None = None,
) -> NDArray[np.float32]:
    """Return base colour by what all pixels say together, unbounded, ``(M, 3)``.

    Args:
        cloud: The Gaussians.
        views: What views with images show of all of them.
        measured: Those whose light is known, with that light.
        separate: Base colour of each of these by itself, ``(M, 3)``; NaN for what has no evidence, which is returned.
        progress: Called with (views drawn, views to draw in all passes) after each.
    """
    known = np.asarray(np.isfinite(separate).all(axis=1))
    if known.sum() < 2:
        return np.asarray(separate, np.float32)
    start = np.clip(np.where(known[:, None], separate, 0.0), 0.0, BRIGHTEST).astype(np.float32)
    values = upload(np.pad(start, ((0, 0), (0, COLUMNS - 3))), float, measured.surface.normals.device)
    blends = _BlendedViews(cloud, views, measured, values, known, progress)
    blends.connect(_connections(cloud.positions[measured.rows], start, known, blends.typical_worth()))
    solve_bounded(blends, values, bounds=(-np.inf, np.inf), passes=PASSES, tolerance=0.0)
    return np.where(known[:, None], values.numpy()[:, :3], np.nan).astype(np.float32)


def _connections(
    positions: NDArray[np.floating[Any]], colors: NDArray[np.float32], known: NDArray[np.bool_], worth: float
) -> Any:
    """Return how much neighbours count for each other, a symmetric sparse matrix ``(M, M)``.

    That of the total variation where base colour is now, 1 / sqrt(d^2 + e^2), d being how far two differ, times
    1 / (1 + d^2 / c^2).
    """
    rows = np.flatnonzero(known)
    count = min(NEIGHBORS, len(rows) - 1)
    near = rows[cKDTree(positions[rows]).query(positions[rows], k=count + 1, workers=-1)[1][:, 1:]].ravel()
    own = np.repeat(rows, count)
    level = max(float(colors[rows].mean()), 1e-3)
    apart = np.square((colors[own] - colors[near]).astype(np.float64) / level).sum(axis=1)
    weights = SMOOTHNESS * worth / level**2 / np.sqrt(apart + EDGE**2) / (1.0 + apart / CONTRAST**2)
    pairs = coo_array((weights, (own, near)), shape=(len(known), len(known)))
    return (pairs + pairs.T).tocsr()


class _BlendedViews:
    """The problem as `beam_warp.materials.bounded_solve` takes it; a view is drawn at a time."""

    def __init__(
        self,
        cloud: GaussianCloud,
        views: ViewEvidence,
        measured: LitPoints,
        start: wp.array,
        known: NDArray[np.bool_],
        progress: CountProgress | None,
    ) -> None:
        """Draw every view once, and find what its pixels count and say of the start, ``(M, COLUMNS)``."""
        self.device = device = start.device
        self._progress, self._drawn, self._to_draw = progress, 0, (1 + PASSES) * len(views.cameras)
        count, points = len(cloud), len(measured.rows)
        self._values = wp.zeros((count, COLUMNS), dtype=float, device=device)
        self._rows = wp.empty((count, COLUMNS), dtype=float, device=device)
        gaussians = upload_gaussians(cloud, device)._replace(values=self._values, radiance=None)
        factor = reduction_factor(cloud, views.cameras, near=views.raster.near)
        cameras = [reduced_camera(camera, factor) for camera in views.cameras]
        places = np.full(count, -1, np.int32)
        places[measured.rows[known]] = np.flatnonzero(known)
        lit = LitView()
        lit.views, lit.light, lit.surface = measured.views, measured.light, measured.surface
        lit.points = upload(places, int, device)
        lit.gaussians = upload(np.where(known, measured.rows, -1).astype(np.int32), int, device)
        self._lit = lit
        how: dict[str, Any] = {
            "value_count": COLUMNS,
            "options": reduced_options(views.raster, factor),
            "device": device,
        }
        largest = max(cameras, key=lambda camera: camera.width * camera.height)
        room = Rasterizer(count, [largest], **how)  # all views draw into its images
        self._gradient, self._worth = (wp.zeros((points, COLUMNS), dtype=float, device=device) for _ in range(2))
        self._views: list[tuple[Rasterizer, wp.array]] = []
        for index, camera in enumerate(cameras):
            lit.view = index
            launch_write_unexplained(count, lit, views.colors, start, self._values, device)
            rasterizer = Rasterizer(count, [camera], images_of=room, **how)
            pixels = rasterizer.draw(gaussians).channels[0]
            weights = wp.empty(len(pixels), dtype=float, device=device)
            launch_weigh_unexplained(len(pixels), pixels, weights, device)
            rasterizer.back_project(pixels, self._rows)
            launch_add_said(points, lit, self._rows, -1.0, self._gradient, device)
            launch_add_worth(points, lit, self._rows, self._worth, device)
            self._views.append((rasterizer, weights))
            self._report()
        self._graph: tuple[wp.array, ...] = ()
        self._scaling = self._worth

    def typical_worth(self) -> float:
        """Return how much images say of a typical point."""
        worth = self._worth.numpy()[:, :3]
        return float(np.median(worth[worth > 0.0])) if (worth > 0.0).any() else 0.0

    def connect(self, graph: Any) -> None:
        """Let neighbours count for each other, by a symmetric sparse matrix."""
        ends, others = (upload(array.astype(np.int32), int, self.device) for array in (graph.indptr, graph.indices))
        self._graph = ends, others, upload(graph.data.astype(np.float32), float, self.device)
        scaling = self._worth.numpy().copy()  # on the CPU it is the same memory
        scaling[:, :3] += 2.0 * np.asarray(graph.sum(axis=1))[:, None]  # Gershgorin 1931
        self._scaling = upload(scaling, float, self.device)

    def scaling(self) -> wp.array:
        """Return sums that no eigenvalue exceeds: by Cauchy and Schwarz for pixels, where weights add up to 1."""
        return self._scaling

    def add_gradient(self, values: wp.array, out: wp.array) -> None:
        """Add A x - b where solving begins: it is asked for nowhere else."""
        launch_add_rows(out.size, self._gradient, out, self.device)
        self._add_differences(values, out)

    def apply(self, values: wp.array, out: wp.array) -> None:
        """Write A x."""
        out.zero_()
        for index, (rasterizer, weights) in enumerate(self._views):
            self._lit.view = index
            launch_write_explained(len(self._values), self._lit, values, self._values, self.device)
            pixels = rasterizer.redraw_values().channels[0]
            launch_weigh_explained(len(pixels), weights, pixels, self.device)
            rasterizer.back_project(pixels, self._rows)
            launch_add_said(len(values), self._lit, self._rows, 1.0, out, self.device)
            self._report()
        self._add_differences(values, out)

    def _report(self) -> None:
        """Count another view that is drawn."""
        self._drawn += 1
        if self._progress is not None:
            self._progress(self._drawn, self._to_draw)

    def _add_differences(self, values: wp.array, out: wp.array) -> None:
        launch_add_differences(len(values), values, *self._graph, out, self.device)
