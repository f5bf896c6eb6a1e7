"""The largest body that the silhouettes of all views allow: where reconstruction starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from warp.geometry import sparse_marching_cubes_from_cells

from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_count
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError
from beam_warp.image.metrics import block_means
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.reconstruction.silhouettes import launch_measure_silhouette
from beam_warp.kernels.reconstruction.visual_hull import (
    BLOCK,
    BLOCK_CELLS,
    BLOCK_POINTS,
    OUTSIDE,
    SURFACE,
    Grid,
    Silhouettes,
    launch_fill_blocks,
    launch_find_cells,
    launch_gather_cells,
    launch_judge_blocks,
)
from beam_warp.raster.layout import ViewLayout

if TYPE_CHECKING:
    import trimesh

MIN_RESOLUTION = 16
MAX_RESOLUTION = 1024

AUTO_RESOLUTION = (64, 256)
"""Least and most voxels along the longest side where the resolution follows the pixels."""

SEARCH_BLOCKS = 48
"""Blocks along the longest side of the box while the box is searched for."""

SEARCH_ROUNDS = 8
"""Most times that the box is drawn closer."""

ENOUGH = 0.8
"""Part of the longest side: a round of the search that leaves more of it is the last."""

SEARCH_SIDE = 320
"""Longest side of the masks [pixel] while the box is searched for: larger ones are reduced by whole factors."""

VOXEL_PIXELS = 2
"""Pixels across a voxel: masks with more are reduced, because finer ones cost more and add nothing."""

DISTANCE_LIMIT = 32.0
"""Largest distance to a silhouette that is measured [pixel]: where masks are reduced as above, the blocks of the search
and of the grid have a smaller radius."""


@dataclass(frozen=True, eq=False)
class VisualHull:
    """A visual hull.

    Attributes:
        vertices: Of its surface [m], ``(V, 3)`` float32.
        faces: Vertex indices, closed, outward, ``(F, 3)`` int32.
        voxel: Size of the cells that the surface was found on [m].
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    voxel: float

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The surface, for whoever measures or samples it."""
        import trimesh  # with networkx, which take longer to import than a hull to carve

        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def visual_hull(
    views: Sequence[CapturedView],
    *,
    resolution: int | Literal["auto"] = "auto",
    quorum: int | None = None,
    device: str | None = None,
) -> VisualHull:
    """Carve the visual hull out of the views' masks.

    A point is inside if every view that sees it (in its image, before its camera) has it inside its silhouette, where
    coverage is one half. Parts that a view's image crops away are left to the others, of which a ``quorum`` has to
    agree: beyond what most cameras look at, a few see nothing but each other's side of the room, where their cones
    share volume that is no subject's. A view whose mask is empty says nothing and is ignored.

    Depths in the cones are measured in metres from the silhouettes, to a part of a pixel, and marching cubes runs on
    their minimum: the surface is exact to a part of a voxel but for edges where cones meet, which it cuts by up to one.
    Space is taken away in blocks that the silhouettes prove to be on one side: cost goes with the surface.

    Args:
        views: At least two with masks, of any sizes.
        resolution: Voxels along the longest side of the box; ``"auto"`` makes them as large as a pixel is at the
            subject, within `AUTO_RESOLUTION`.
        quorum: Views that have to see a point inside, at least 2; None for more than half of those with masks.
        device: Warp device; the first GPU without, or the CPU where there is none.

    Returns:
        The hull; same device, same views: same bits.

    Raises:
        InvalidArrayError: Fewer than two views have masks, or their cones share no volume.
        InvalidOptionError: An option is out of range.
        DeviceError: The device is not there.

    Source: Laurentini 1994 (the hull); Lorensen and Cline 1987 (marching cubes).
    """
    if quorum is not None:
        require_count("quorum", quorum, 2)
    if resolution != "auto":
        require_count("resolution", resolution, MIN_RESOLUTION, MAX_RESOLUTION)
    target = resolve_device(device)
    used, ignored = masked_views(views)
    if len(used) < 2:
        names = ", ".join(view.name for view in ignored)
        raise InvalidArrayError(
            f"views must have at least two masks that show something, got {len(used)} of {len(views)}"
            f"{f' (no mask, or an empty one: {names})' if names else ''}. Pass views with alpha, or points to start "
            "from."
        )
    agreeing = len(used) // 2 + 1 if quorum is None else quorum
    longest = max(max(view.camera.width, view.camera.height) for view in used)
    lower, upper = _Cones(used, max(longest // SEARCH_SIDE, 1), agreeing, target).search()
    side = float((upper - lower).max())
    pixels = _pixels_per_metre(used, 0.5 * (lower + upper))
    count = int(np.clip(round(side * pixels), *AUTO_RESOLUTION)) if resolution == "auto" else resolution
    voxel = side / count
    lower, upper = lower - voxel, upper + voxel  # the grid's outermost points count as outside
    blocks = np.maximum(np.ceil((upper - lower) / (voxel * BLOCK) - 1e-6).astype(int), 1)
    smallest = min(min(view.camera.width, view.camera.height) for view in used)
    factor = int(np.clip(voxel * pixels / VOXEL_PIXELS, 1, smallest))
    cones = _Cones(used, factor, agreeing, target)
    surface = cones.carve(lower, voxel, blocks)
    if surface is None:
        raise _no_volume(cones, np.stack([lower, upper]))
    return VisualHull(*surface, voxel)


def masked_views(views: Sequence[CapturedView]) -> tuple[list[CapturedView], list[CapturedView]]:
    """Return the views whose masks show something, and the others."""
    used: list[CapturedView] = []
    ignored: list[CapturedView] = []
    for view in views:
        shown = view.alpha is not None and bool((view.alpha >= 0.5).any())
        (used if shown else ignored).append(view)
    return used, ignored


def viewing_focus(views: Sequence[CapturedView]) -> tuple[NDArray[np.float64], float]:
    """Return the point that the views' subjects are nearest to, and the distance of the farthest camera from it [m].

    A view's subject lies on the ray through the middle of its mask, or of its image where it has none. The point
    minimises the sum of distances to the rays, by reweighted least squares: a view that looks elsewhere counts little.
    """
    origins = np.array([view.camera.position for view in views])
    rays = np.array([_central_ray(view) for view in views])
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    spread = float(np.linalg.norm(origins - origins.mean(axis=0), axis=1).max())
    # Parallel rays meet nowhere: then the point stays as near to the cameras as it can.
    ridge = 1e-6 * np.eye(3)
    weights = np.ones(len(views))
    focus = origins.mean(axis=0)
    for _ in range(20):
        system = np.einsum("n,nij->ij", weights, across) + ridge * weights.sum()
        right = np.einsum("n,nij,nj->i", weights, across, origins) + ridge @ origins.mean(axis=0) * weights.sum()
        focus = np.linalg.solve(system, right)
        away = np.linalg.norm(np.einsum("nij,nj->ni", across, focus - origins), axis=1)
        weights = 1.0 / np.maximum(away, max(1e-3 * spread, 1e-9))
    return focus, float(np.linalg.norm(origins - focus, axis=1).max())


def _central_ray(view: CapturedView) -> NDArray[np.float64]:
    """Return the unit world direction through the middle of a view's mask, or of its image."""
    camera = view.camera
    x, y = 0.5 * camera.width, 0.5 * camera.height
    if view.alpha is not None and (view.alpha >= 0.5).any():
        inside = view.alpha >= 0.5
        columns, rows = inside.any(axis=0).nonzero()[0], inside.any(axis=1).nonzero()[0]
        x, y = 0.5 * (columns[0] + columns[-1] + 1), 0.5 * (rows[0] + rows[-1] + 1)
    local = np.array([(x - camera.center_x) / camera.focal_x, (y - camera.center_y) / camera.focal_y, 1.0])
    return camera.camera_to_world[:3, :3] @ (local / np.linalg.norm(local))


def _pixels_per_metre(views: Sequence[CapturedView], middle: NDArray[np.float64]) -> float:
    """Return how many pixels a metre at a point covers in the median view."""
    focal = np.array([0.5 * (view.camera.focal_x + view.camera.focal_y) for view in views])
    distances = np.array([np.linalg.norm(view.camera.position - middle) for view in views])
    return float(np.median(focal / np.maximum(distances, 1e-9)))


def _blocks(box: NDArray[np.float64]) -> tuple[float, NDArray[np.int_]]:
    """Return the size of the search's blocks in a box, and how many there are along each axis."""
    sides = box[1] - box[0]
    size = float(sides.max()) / SEARCH_BLOCKS
    return size, np.maximum(np.ceil(sides / size - 1e-6).astype(int), 1)


def _grid(lower: NDArray[np.float64], size: float, count: NDArray[Any]) -> Grid:
    grid = Grid()
    grid.origin, grid.size, grid.count = wp.vec3(*lower), size, wp.vec3i(*count)
    return grid


class _Cones:
    """The silhouettes of views on a device: the box that they allow, and the surface inside it."""

    def __init__(self, views: Sequence[CapturedView], factor: int, quorum: int, device: Any) -> None:
        self.captured = list(views)
        self.device = device
        cameras = [view.camera.reduced(factor) for view in views]
        masks = [
            block_means(np.asarray(view.alpha)[: camera.height * factor, : camera.width * factor], factor)
            for view, camera in zip(views, cameras, strict=True)
        ]
        pixels = sum(mask.size for mask in masks)
        if pixels > 2**31 - 1:
            raise InvalidArrayError(
                f"masks must have at most {2**31 - 1} pixels in all, got {pixels}. Reduce the views."
            )
        self.records = ViewLayout.of(cameras).views
        self.silhouettes = Silhouettes()
        self.silhouettes.views = wp.array(self.records, dtype=RasterView, device=device)
        self.silhouettes.distances = wp.empty(pixels, dtype=float, device=device)
        self.silhouettes.quorum = quorum
        for mask, record in zip(masks, self.records, strict=True):
            column_gaps, row_gaps = (wp.empty(mask.shape, dtype=float, device=device) for _ in range(2))
            alpha, distances = upload(mask, float, device), self.silhouettes.distances
            launch_measure_silhouette(
                alpha, DISTANCE_LIMIT, column_gaps, row_gaps, record.first_pixel, distances, device
            )

    def search(self) -> NDArray[np.float64]:
        """Return the corners of a box that holds the hull, ``(2, 3)``, with up to two small blocks to spare."""
        middle, reach = viewing_focus(self.captured)
        reach = max(reach, 1e-3)
        box = np.stack([middle - reach, middle + reach])
        for _ in range(SEARCH_ROUNDS):
            size, count = _blocks(box)
            kept = np.argwhere(self.judge(box[0], size, count) != OUTSIDE)
            if not len(kept):
                raise _no_volume(self, box)
            closer = box[0] + size * np.stack([kept.min(axis=0), kept.max(axis=0) + 1])
            settled = (closer[1] - closer[0]).max() > ENOUGH * (box[1] - box[0]).max()
            box = closer
            if settled:
                break
        return box

    def judge(self, lower: NDArray[np.float64], size: float, count: NDArray[Any]) -> NDArray[np.int32]:
        """Return the states of a grid of blocks."""
        states = wp.empty(int(np.prod(count)), dtype=int, device=self.device)
        launch_judge_blocks(len(states), _grid(lower, size, count), self.silhouettes, states, self.device)
        return states.numpy().reshape(count)

    def carve(
        self, lower: NDArray[np.float64], voxel: float, count: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]] | None:
        """Return vertices and faces of the surface on a grid of blocks of voxels; None if there is none."""
        states = self.judge(lower, voxel * BLOCK, count)
        for axis in range(3):  # the grid's outermost points count as outside, so that there is surface next to them
            outermost = np.moveaxis(states, axis, 0)[[0, -1]]
            np.moveaxis(states, axis, 0)[[0, -1]] = np.where(outermost == OUTSIDE, OUTSIDE, SURFACE)
        blocks = np.argwhere(states == SURFACE).astype(np.int32)
        if not len(blocks):
            return None
        device = self.device
        subscripts = upload(blocks, wp.vec3i, device)
        depths = wp.empty(len(blocks) * BLOCK_POINTS, dtype=float, device=device)
        grid = _grid(lower, voxel, count)
        launch_fill_blocks(subscripts, grid, self.silhouettes, depths, device)
        crossed = wp.empty(len(blocks) * BLOCK_CELLS, dtype=int, device=device)
        launch_find_cells(len(crossed), depths, crossed, device)
        wp.utils.array_scan(crossed, crossed, inclusive=True)
        cell_count = int(crossed[-1:].numpy()[0])
        if cell_count == 0:
            return None
        cells = wp.empty(cell_count, dtype=wp.vec3i, device=device)
        corners = wp.empty((cell_count, 8), dtype=float, device=device)
        launch_gather_cells(len(crossed), subscripts, depths, crossed, cells, corners, device)
        vertices, faces = sparse_marching_cubes_from_cells(cells, corners, grid.origin, voxel, device=device)
        # Depth grows inwards, so Warp's faces, which turn towards larger values, turn in.
        return vertices.numpy(), faces.numpy().reshape(-1, 3)[:, ::-1]


def _no_volume(cones: _Cones, box: NDArray[np.float64]) -> InvalidArrayError:
    """Return the error that nothing is left; it names the views of which leaving out one is enough."""
    size, count = _blocks(box)
    views = cones.captured
    left = np.zeros(len(views), np.int64)
    cones.silhouettes.quorum = len(views) - 1
    for i in range(len(views) if len(views) > 2 else 0):
        others = cones.records[:i] + cones.records[i + 1 :]
        cones.silhouettes.views = wp.array(others, dtype=RasterView, device=cones.device)
        left[i] = np.count_nonzero(cones.judge(box[0], size, count) != OUTSIDE)
    # Blocks are judged with a margin: those along one cone's side may be left without any view.
    blamed = [view.name for view, blocks in zip(views, left, strict=True) if blocks > 0.5 * left.max()]
    if blamed:
        found = f"cones that share no volume unless {' or '.join(blamed)} is left out"
    else:
        found = f"cones that share no volume: {', '.join(view.name for view in views)}"
    return InvalidArrayError(f"masks must show one subject, got {found}. Correct poses or masks.")
