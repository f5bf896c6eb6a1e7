"""Gaussians on a known surface, coloured by photographs: geometry without error, to measure the steps that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from beam_warp.capture.capture import Capture
from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_array, require_count
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.sources import upload_gaussians
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.world.curve import morton_order
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.mesh import vertex_normals
from beam_warp.world.shapes import TiledSurface, tile

SHARP = RasterOptions(antialiased=True, low_pass=0.1)
"""How Gaussians on a true surface are drawn."""

OPACITY = 0.99
"""Opacity of every Gaussian, the rasteriser's cap of alpha: overlapping neighbours let 0.1 % of the light through."""

FLATNESS = 0.02
"""Thickness over width: thinner than the surface's bend over a Gaussian, so that silhouettes stay where they are."""

COLOR_STEPS = 6
"""Steps of conjugate gradients: with the pull below, each halves the residual or better."""

PULL = 0.1
"""Weight of the pull towards the mean colour of the pixels around, in parts of the pixels that a Gaussian is worth, or
that the median Gaussian is worth if that is more. No image shows detail finer than a pixel; least squares alone fills
it with noise."""

NEIGHBORS = 8
"""Gaussians over which that mean is taken."""

UNSEEN_PIXELS = 1e-2
"""Gaussians worth fewer pixels than this, with their neighbours, take the colour of the nearest that is worth more."""

GROUP_SPLATS = 2**22
"""Most splats, Gaussians times views, that are kept drawn together unless one view has more."""

_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])
"""Powers of the inverse of the plastic number, whose multiples fill the square evenly (Roberts 2018)."""


def gaussians_on_mesh(
    vertices: ArrayLike, faces: ArrayLike, count: int, *, rest: ArrayLike | None = None
) -> GaussianCloud:
    """Tile a mesh with flat Gaussians, spread evenly over its area, each along the mesh's normal there.

    Faces are gone through along a Morton curve and points set at equal steps of their area, so that neither holes nor
    heaps are as deep as those of independent points.

    Args:
        vertices: ``(V, 3)`` [m].
        faces: ``(F, 3)``, counter-clockwise seen from outside.
        count: Number of Gaussians.
        rest: Vertices of another pose, over whose area Gaussians are spread: row i is then the same place of the
            surface in every pose. None spreads them over the mesh itself.

    Returns:
        Gaussians with normals, in the axes of the mesh, which are taken for the internal world's.

    Raises:
        InvalidArrayError: The mesh has no area.
    """
    require_count("count", count, 1, 1 << 24)
    posed = require_array("vertices", vertices, (None, 3)).astype(np.float64)
    points = posed if rest is None else require_array("rest", rest, posed.shape).astype(np.float64)
    corners = np.asarray(faces, np.int64)
    crossed = np.cross(points[corners[:, 1]] - points[corners[:, 0]], points[corners[:, 2]] - points[corners[:, 0]])
    areas = 0.5 * np.linalg.norm(crossed, axis=1)
    if not (areas.sum() > 0.0):
        raise InvalidArrayError("mesh must have an area above 0, got 0. Give one with faces.")
    along = _along_curve(points[corners].mean(axis=1))
    reached = np.cumsum(areas[along])
    at = (np.arange(count) + 0.5) / count * reached[-1]
    chosen = along[np.minimum(np.searchsorted(reached, at), len(along) - 1)]
    square = (np.arange(1, count + 1)[:, None] * _PLASTIC) % 1.0
    square = np.where(square.sum(axis=1, keepdims=True) > 1.0, 1.0 - square, square)
    weights = np.column_stack([1.0 - square.sum(axis=1), square])
    normals = np.einsum("nk,nkc->nc", weights, vertex_normals(posed, corners)[corners[chosen]])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    flat = crossed[chosen] / np.maximum(2.0 * areas[chosen, None], 1e-300)
    normals = np.where(lengths > 1e-6, normals / np.maximum(lengths, 1e-6), flat)
    places = np.einsum("nk,nkc->nc", weights, posed[corners[chosen]])
    tiles = tile((TiledSurface(places, normals, float(np.sqrt(reached[-1] / count))),))
    scales = tiles.scales.copy()
    scales[:, 2] = FLATNESS * scales[:, 0]
    return tiles.with_arrays(scales=scales, opacities=np.full(count, OPACITY, np.float32))


def surface_of_capture(
    capture: Capture, frame: int, count: int, *, options: RasterOptions | None = None, device: str | None = None
) -> tuple[GaussianCloud, list[CapturedView]]:
    """Return Gaussians on the true surface of a capture's frame, coloured by its photographs, and those.

    Args:
        capture: With its true surface; the views of its split "train" are read.
        frame: Number of the frame.
        count: Number of Gaussians.
        options: How splats are drawn.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Raises:
        MissingFileError: The capture has no true surface.
    """
    mesh = read_truth_mesh(capture, frame)
    views = [record.view() for record in capture.select(split="train", frames={frame})]
    bare = gaussians_on_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), count)
    return colored_by_views(bare, views, options=options, device=device), views


def colored_by_views(
    cloud: GaussianCloud,
    views: Sequence[CapturedView],
    *,
    options: RasterOptions | None = None,
    steps: int = COLOR_STEPS,
    device: str | None = None,
) -> GaussianCloud:
    """Give Gaussians the colours, the same from everywhere, whose drawing comes nearest to what views show.

    Least squares over all pixels, each Gaussian pulled a little towards the mean of what pixels show around it, by
    conjugate gradients, preconditioned by the pixels that it is worth; geometry stays as it is.

    Args:
        cloud: Gaussians in the internal world.
        views: Scene-linear and premultiplied, at least one.
        options: How splats are drawn.
        steps: Steps of conjugate gradients.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Returns:
        The cloud with scene-linear radiance of degree 0, not below 0.

    Raises:
        InvalidArrayError: There is no view.

    Source: Hestenes and Stiefel 1952.
    """
    if not views:
        raise InvalidArrayError("views must hold at least one view, got none. Pass what the cameras saw.")
    drawn = _DrawnViews.of(cloud, views, options, resolve_device(device))
    shown = drawn.spread([view.color.reshape(-1, 3) for view in views])
    worth = drawn.normal_matrix(np.ones((len(cloud), 3)))  # with these sums of its rows, one colour comes back as it is
    colors = _mean_around(cloud.positions, shown, worth)
    seen = worth[worth > UNSEEN_PIXELS]
    pull = PULL * np.maximum(worth, np.median(seen) if len(seen) else 1.0)
    diagonal = worth + pull
    residual = shown - drawn.normal_matrix(colors)  # at the mean itself the pull is 0
    scaled = residual / diagonal
    direction, energy = scaled, (residual * scaled).sum(axis=0)
    for _ in range(steps):
        image = drawn.normal_matrix(direction) + pull * direction
        step = energy / np.maximum((direction * image).sum(axis=0), 1e-30)
        colors = colors + step * direction
        residual = residual - step * image
        scaled = residual / diagonal
        following = (residual * scaled).sum(axis=0)
        direction = scaled + following / np.maximum(energy, 1e-30) * direction
        energy = following
    colors = np.maximum(colors, 0.0)
    radiance = ((colors[:, None] - 0.5) / SH_C0).astype(np.float32)
    return cloud.with_arrays(radiance=radiance, radiance_color_space=LINEAR_REC709)


def _mean_around(
    positions: NDArray[np.float32], shown: NDArray[np.float64], worth: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the mean of what pixels show of each Gaussian and its neighbours; the nearest one's where they show none.

    A Gaussian that neighbours hide from nearly all views would take its colour from a few pixels' noise.
    """
    near = (
        cKDTree(positions).query(positions, k=min(NEIGHBORS, len(positions)), workers=-1)[1].reshape(len(positions), -1)
    )
    total = worth[near].sum(axis=1)
    seen = total[:, 0] > UNSEEN_PIXELS
    mean = np.where(seen[:, None], shown[near].sum(axis=1) / np.maximum(total, UNSEEN_PIXELS), 0.0)
    if 0 < seen.sum() < len(seen):
        mean[~seen] = mean[seen][cKDTree(positions[seen]).query(positions[~seen], workers=-1)[1]]
    return mean


@dataclass(frozen=True, eq=False)
class _DrawnViews:
    """Views of Gaussians whose values change: drawing them is W x, spreading pixels back is W^T y.

    Attributes:
        groups: A rasteriser of some views, the values it draws, and which views these are.
        count: Number of Gaussians.
    """

    groups: list[tuple[Rasterizer, wp.array, range]]
    count: int

    @classmethod
    def of(
        cls, cloud: GaussianCloud, views: Sequence[CapturedView], options: RasterOptions | None, device: Any
    ) -> _DrawnViews:
        """Draw every view once."""
        gaussians = upload_gaussians(cloud, device, values=np.zeros((len(cloud), 3), np.float32))
        at_once = max(1, GROUP_SPLATS // max(len(cloud), 1))
        groups = []
        for start in range(0, len(views), at_once):
            part = range(start, min(start + at_once, len(views)))
            cameras = [views[i].camera for i in part]
            rasterizer = Rasterizer(len(cloud), cameras, value_count=3, options=options, device=device)
            rasterizer.draw(gaussians)
            assert gaussians.values is not None
            groups.append((rasterizer, gaussians.values, part))
        return cls(groups, len(cloud))

    def spread(self, pixels: Sequence[NDArray[np.float32]]) -> NDArray[np.float64]:
        """Return W^T y of images ``(P, 3)``, one a view."""
        total = np.zeros((self.count, 3))
        for rasterizer, _, part in self.groups:
            padded = np.zeros((rasterizer.first_pixels[-1], 4), np.float32)
            padded[:, :3] = np.concatenate([pixels[i] for i in part])
            total += self._back(rasterizer, wp.array(padded, dtype=float, device=rasterizer.device))
        return total

    def normal_matrix(self, colors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return W^T W x."""
        total = np.zeros((self.count, 3))
        for rasterizer, values, _ in self.groups:
            values.assign(colors.astype(np.float32))
            images = rasterizer.redraw()
            total += self._back(rasterizer, images.channels[0])
        return total

    def _back(self, rasterizer: Rasterizer, pixels: wp.array) -> NDArray[np.float64]:
        rows = wp.empty((len(rasterizer.cameras) * self.count, 4), dtype=float, device=rasterizer.device)
        sums = wp.empty((self.count, 4), dtype=float, device=rasterizer.device)
        rasterizer.back_project(pixels, rows)
        rasterizer.sum_views(rows, sums)
        return sums.numpy()[:, :3].astype(np.float64)


def _along_curve(points: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the order of points along a Morton curve through their box, 10 bits a side."""
    low, high = points.min(axis=0), points.max(axis=0)
    return morton_order(((points - low) / np.maximum(high - low, 1e-30) * 1023.0).astype(np.uint32))
