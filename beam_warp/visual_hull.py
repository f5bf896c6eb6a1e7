"""The largest body that the silhouettes of all views allow: where reconstruction starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import trimesh
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from warp.geometry import sparse_marching_cubes_from_cells

from beam_warp.captured_views import CapturedView
from beam_warp.checks import require_array, require_count, require_finite
from beam_warp.devices import resolve_device, upload
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.project import View
from beam_warp.kernels.silhouettes import launch_measure_silhouette
from beam_warp.kernels.visual_hull import (
    BLOCK,
    BLOCK_CELLS,
    BLOCK_POINTS,
    MOST_TOLERATED,
    OUTSIDE,
    SURFACE,
    launch_fill_blocks,
    launch_find_cells,
    launch_gather_cells,
    launch_judge_blocks,
)
from beam_warp.raster_layout import ViewLayout

MIN_RESOLUTION = 16
MAX_RESOLUTION = 1024

AUTO_RESOLUTION = (64, 256)
"""Least and most voxels along the longest side where the resolution follows the pixels."""

SEARCH_BLOCKS = 48
"""Blocks along each side of the box while it is searched for."""

SEARCH_ROUNDS = 8
"""Most times that the box is drawn closer."""

SEARCH_MARGIN = 0.1
"""What the box is grown by before each round, as a part of its longest side: it follows a piece that reaches out of it.
A round that moves no side by more was the last one."""

SUPPORT = 0.5
"""A piece of the hull counts if some of it is seen inside by this part of the most views that see any of it inside."""

DISTANCE_LIMIT = (24.0, 12)
"""Distances to a silhouette are measured up to so many pixels, or the longer side divided by so many if that is more:
a block of the search covers a few per cent of the image."""


@dataclass(frozen=True, eq=False)
class VisualHull:
    """A visual hull.

    Attributes:
        mesh: Its surface [m], closed, faces outward.
        voxel: Size of the cells that it was found on [m].
        box: Corners of their grid [m], ``(2, 3)`` float64.
        used: Names of the views whose masks count.
        ignored: Names of the views that have no mask, or an empty one.
    """

    mesh: trimesh.Trimesh
    voxel: float
    box: NDArray[np.float64]
    used: tuple[str, ...]
    ignored: tuple[str, ...]


def visual_hull(
    views: Sequence[CapturedView],
    *,
    resolution: int | Literal["auto"] = "auto",
    box: ArrayLike | None = None,
    tolerance: int = 0,
    device: str | None = None,
) -> VisualHull:
    """Carve the visual hull out of the views' masks.

    A point is inside if every view that sees it (in its image, before its camera) has it inside its silhouette, where
    coverage is one half; all but ``tolerance`` of them, if some masks are not to be trusted, but two at least. Parts
    that a view's image crops away are left to the others. A view whose mask is empty says nothing and is ignored.

    Depths in the cones are measured in metres from the silhouettes, to a part of a pixel, and marching cubes runs on
    their minimum: the surface is exact to a part of a voxel but for edges where cones meet, which it cuts by up to one.
    Space is taken away in blocks that the silhouettes prove to be on one side: cost goes with the surface.

    Args:
        views: At least two with masks, of any sizes.
        resolution: Voxels along the longest side of the box; ``"auto"`` makes them as large as a pixel is at the
            subject, within `AUTO_RESOLUTION`.
        box: Where to carve, lowest and highest corner [m], ``(2, 3)``; the surface is closed where it cuts. None
            searches for the hull in what all cameras look at.
        tolerance: Views that a point may contradict, at most 3.
        device: Warp device; the first GPU without, or the CPU where there is none.

    Returns:
        The hull; same device, same views: same bits.

    Raises:
        InvalidArrayError: Fewer than two views have masks, or their cones share no volume.
        InvalidOptionError: An option is out of range.
        DeviceError: The device is not there.

    Source: Laurentini 1994 (the hull); Lorensen and Cline 1987 (marching cubes).
    """
    require_count("tolerance", tolerance, 0, MOST_TOLERATED)
    if resolution != "auto":
        require_count("resolution", resolution, MIN_RESOLUTION, MAX_RESOLUTION)
    target = resolve_device(device)
    used, ignored = masked_views(views)
    if len(used) < 2:
        raise InvalidArrayError(
            f"views must have at least two masks that show something, got {len(used)} of {len(views)}"
            f"{_listed(' (no mask, or an empty one: ', ignored)}. Pass views with alpha, or points to start from."
        )
    cones = _Cones(used, tolerance, target)
    lower, upper = cones.search() if box is None else _corners(box)
    if box is None:
        side = float((upper - lower).max())
        count = _auto_resolution(used, 0.5 * (lower + upper), side) if resolution == "auto" else resolution
        voxel = side / count
        lower, upper = lower - voxel, upper + voxel  # the grid's outermost points count as outside
    else:
        side = float((upper - lower).max())
        count = _auto_resolution(used, 0.5 * (lower + upper), side) if resolution == "auto" else resolution
        voxel = side / count
    blocks = np.maximum(np.ceil((upper - lower) / (voxel * BLOCK) - 1e-6).astype(int), 1)
    mesh = cones.carve(lower, voxel, blocks)
    if mesh.is_empty:
        raise _no_volume(used, cones, np.stack([lower, upper]))
    return VisualHull(
        mesh,
        voxel,
        np.stack([lower, lower + voxel * BLOCK * blocks]),
        tuple(view.name for view in used),
        tuple(view.name for view in ignored),
    )


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


def _auto_resolution(views: Sequence[CapturedView], middle: NDArray[np.float64], side: float) -> int:
    """Return how many pixels the side covers in the median view."""
    pixels = [
        0.5
        * (view.camera.focal_x + view.camera.focal_y)
        / max(float(np.linalg.norm(view.camera.position - middle)), 1e-9)
        for view in views
    ]
    return int(np.clip(round(side * float(np.median(pixels))), *AUTO_RESOLUTION))


def _corners(box: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    corners = require_array("box", box, (2, 3), np.float64)
    require_finite("box", corners)
    if not (corners[1] > corners[0]).all():
        raise InvalidOptionError(
            f"box must hold its lowest and its highest corner, got {corners.tolist()}. Order them along every axis."
        )
    return corners[0], corners[1]


def _listed(start: str, views: Sequence[CapturedView]) -> str:
    return f"{start}{', '.join(view.name for view in views)})" if views else ""


def _blocks(box: NDArray[np.float64]) -> tuple[float, NDArray[np.int_]]:
    """Return the size of the search's blocks in a box, and how many there are along each axis."""
    sides = box[1] - box[0]
    size = float(sides.max()) / SEARCH_BLOCKS
    return size, np.maximum(np.ceil(sides / size - 1e-6).astype(int), 1)


def _bounds(lower: NDArray[np.float64], size: float, kept: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """Return the corners of the box around some blocks of a grid, ``(2, 3)``; None if there are none."""
    found = np.argwhere(kept)
    if not len(found):
        return None
    return lower + size * np.stack([found.min(axis=0), found.max(axis=0) + 1])


class _Cones:
    """The silhouettes on a device, and what can be asked of them."""

    def __init__(self, views: Sequence[CapturedView], tolerance: int, device: Any) -> None:
        self.captured = list(views)
        self.tolerance = tolerance
        self.device = device
        pixels = sum(view.camera.width * view.camera.height for view in views)
        if pixels > 2**31 - 1:
            raise InvalidArrayError(
                f"masks must have at most {2**31 - 1} pixels in all, got {pixels}. Reduce the views."
            )
        self.records = ViewLayout.of([view.camera for view in views]).views
        self.views = wp.array(self.records, dtype=View, device=device)
        self.distances = wp.empty(pixels, dtype=float, device=device)
        for view, record in zip(views, self.records, strict=True):
            shape = (view.camera.height, view.camera.width)
            column_gaps, row_gaps = (wp.empty(shape, dtype=float, device=device) for _ in range(2))
            limit = max(DISTANCE_LIMIT[0], max(shape) / DISTANCE_LIMIT[1])
            alpha = upload(np.asarray(view.alpha), float, device)
            launch_measure_silhouette(alpha, limit, column_gaps, row_gaps, record.first_pixel, self.distances, device)

    def search(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the corners of a box that holds the hull, with up to a block of a late round to spare.

        What most views support comes first; the box then follows what hangs together with it, at ever smaller blocks.
        """
        middle, reach = viewing_focus(self.captured)
        reach = max(reach, 1e-3)
        root = np.stack([middle - reach, middle + reach])
        size, count = _blocks(root)
        states, support = self.judge(root[0], size, count)
        found = _bounds(root[0], size, (states != OUTSIDE) & (support >= SUPPORT * support.max()))
        if found is None:
            raise _no_volume(self.captured, self, root)
        for _ in range(SEARCH_ROUNDS):
            margin = SEARCH_MARGIN * (found[1] - found[0]).max()
            box = np.stack([np.maximum(found[0] - margin, root[0]), np.minimum(found[1] + margin, root[1])])
            size, count = _blocks(box)
            closer = _bounds(box[0], size, self.subject(box[0], size, count) != OUTSIDE)
            if closer is None:
                raise _no_volume(self.captured, self, box)
            settled = (np.abs(closer - found) <= SEARCH_MARGIN * (closer[1] - closer[0]).max()).all()
            found = closer
            if settled:
                break
        return found[0], found[1]

    def judge(
        self, lower: NDArray[np.float64], size: float, count: NDArray[Any]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the states of a grid of blocks, and how many views may see some of each inside; 0 if it is outside."""
        states, support = (wp.empty(int(np.prod(count)), dtype=int, device=self.device) for _ in range(2))
        launch_judge_blocks(
            wp.vec3(*lower),
            size,
            wp.vec3i(*count),
            self.views,
            self.distances,
            self.tolerance,
            states,
            support,
            self.device,
        )
        found = states.numpy().reshape(count)
        return found, np.where(found == OUTSIDE, 0, support.numpy().reshape(count))

    def subject(self, lower: NDArray[np.float64], size: float, count: NDArray[Any]) -> NDArray[np.int32]:
        """Return the states of a grid of blocks, `OUTSIDE` for pieces that hardly any view shows.

        Behind most cameras, a few look at each other's background: there cones may share volume that no one shows.
        """
        states, support = self.judge(lower, size, count)
        pieces, piece_count = ndimage.label(states != OUTSIDE, np.ones((3, 3, 3)))
        strongest = ndimage.maximum(support, pieces, np.arange(piece_count + 1))
        return np.where((strongest >= SUPPORT * support.max())[pieces], states, OUTSIDE)

    def carve(self, lower: NDArray[np.float64], voxel: float, count: NDArray[Any]) -> trimesh.Trimesh:
        """Return the surface on a grid of blocks of voxels."""
        states = self.subject(lower, voxel * BLOCK, count)
        for axis in range(3):  # the grid's outermost points count as outside, so that there is surface next to them
            outermost = np.moveaxis(states, axis, 0)[[0, -1]]
            np.moveaxis(states, axis, 0)[[0, -1]] = np.where(outermost == OUTSIDE, OUTSIDE, SURFACE)
        blocks = np.argwhere(states == SURFACE).astype(np.int32)
        if not len(blocks):
            return trimesh.Trimesh()
        device = self.device
        subscripts = upload(blocks, wp.vec3i, device)
        depths = wp.empty(len(blocks) * BLOCK_POINTS, dtype=float, device=device)
        origin = wp.vec3(*lower)
        launch_fill_blocks(
            subscripts,
            origin,
            voxel,
            wp.vec3i(*count),
            self.views,
            self.distances,
            self.tolerance,
            depths,
            device,
        )
        crossed = wp.empty(len(blocks) * BLOCK_CELLS, dtype=int, device=device)
        launch_find_cells(depths, crossed, device)
        wp.utils.array_scan(crossed, crossed, inclusive=True)
        cell_count = int(crossed[-1:].numpy()[0])
        if cell_count == 0:
            return trimesh.Trimesh()
        cells = wp.empty(cell_count, dtype=wp.vec3i, device=device)
        corners = wp.empty((cell_count, 8), dtype=float, device=device)
        launch_gather_cells(subscripts, depths, crossed, cells, corners, device)
        vertices, faces = sparse_marching_cubes_from_cells(cells, corners, origin, voxel, device=device)
        # Depth grows inwards, so Warp's faces, which turn towards larger values, turn in.
        return trimesh.Trimesh(vertices.numpy(), faces.numpy().reshape(-1, 3)[:, ::-1], process=False)


def _no_volume(views: Sequence[CapturedView], cones: _Cones, box: NDArray[np.float64]) -> InvalidArrayError:
    """Say that nothing is left, and which views are to blame where leaving out one is enough."""
    size, count = _blocks(box)
    blamed = []
    for i in range(len(views) if len(views) > 2 else 0):
        cones.views = wp.array(cones.records[:i] + cones.records[i + 1 :], dtype=View, device=cones.device)
        if (cones.judge(box[0], size, count)[0] != OUTSIDE).any():
            blamed.append(views[i].name)
    if blamed:
        found = f"cones that share no volume unless {' or '.join(blamed)} is left out"
    else:
        found = f"cones that share no volume: {', '.join(view.name for view in views)}"
    return InvalidArrayError(f"masks must show one subject, got {found}. Correct poses or masks, or raise tolerance.")
