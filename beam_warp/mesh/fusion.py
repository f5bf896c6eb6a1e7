"""One surface from the depth images of several views: truncated signed distances in sparse blocks, marching cubes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from warp.geometry import sparse_marching_cubes_from_cells

from beam_warp.checks import require_number
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import LINEAR_REC709, linear_to_srgb
from beam_warp.kernels.mesh.tsdf import (
    NO_KEY,
    SIDE,
    TRUNCATION,
    VOXELS,
    launch_find_neighbors,
    launch_find_pixel_keys,
    launch_flag_cells,
    launch_flag_first_keys,
    launch_gather_colors,
    launch_integrate,
    launch_keep_keys,
    launch_spread_keys,
    launch_write_cells,
)
from beam_warp.mesh.depths import DepthImages, DepthView
from beam_warp.mesh.topology import face_parts

if TYPE_CHECKING:
    import trimesh

MAX_BLOCKS = 2**18
"""Most blocks of 8^3 voxels, 8 kB each: 2.1 GB of distances, weights and flags."""

COARSER = 1.25
"""An automatic voxel that needs too many blocks grows by this until they fit; their number falls with its square."""

SMALLEST_PART = 0.01
"""Parts of the surface with less area than this share of the largest one's are left out: floaters."""


def fuse_depths(
    views: Sequence[DepthView] | DepthImages,
    *,
    voxel: float | None = None,
    smallest_part: float = SMALLEST_PART,
    device: Any = None,
) -> trimesh.Trimesh:
    """Fuse depth images into a surface.

    Distances are kept where some view sees the surface within four voxels, and are weighted means over all views that
    see a voxel in front of the surface or up to four voxels behind: of distances from the plane that a pixel sees, with
    the weights of `DepthImages`, falling to 0 four voxels behind. Triangles are made only where all corners of a cell
    were observed: the surface is closed where it was seen, and open where it was not.

    The same input on the same device gives the same bits.

    Args:
        views: Depth images; once on a device, they can be fused again with another voxel.
        voxel: Edge of a voxel [m]. None takes the median width of a pixel at the surface, and a larger one if that
            needs more than `MAX_BLOCKS`: details smaller than a pixel were not seen.
        smallest_part: Connected parts with less area than this share of the largest one's are left out; in [0, 1].
        device: Warp device of ``views`` that are not on one yet.

    Returns:
        A mesh in the views' world [m], welded, counter-clockwise seen from outside, with vertex colours, display
        sRGB, where the views have colour. ``metadata["voxel"]`` is the voxel that was used.

    Raises:
        InvalidArrayError: Nothing is seen, or the distances have no surface.
        InvalidOptionError: ``voxel`` needs more than `MAX_BLOCKS`, or an option is out of range.

    Source: Curless and Levoy 1996; blocks as in Nießner et al. 2013, sorted instead of hashed; marching cubes of Warp.
    """
    images = views if isinstance(views, DepthImages) else DepthImages.of(views, device=device)
    require_number("smallest_part", smallest_part, 0.0, 1.0)
    width = images.footprint() if voxel is None else require_number("voxel", voxel, 1e-9, 1e9)
    with wp.ScopedDevice(images.device):
        keys = _find_blocks(images, width)
        while len(keys) > MAX_BLOCKS and voxel is None:
            width *= COARSER
            keys = _find_blocks(images, width)
        if not len(keys):
            raise InvalidArrayError(
                "depth must be seen in some view, got no pixel that counts. Check cameras, alpha and consistency."
            )
        if len(keys) > MAX_BLOCKS:
            raise InvalidOptionError(
                f"voxel must need at most {MAX_BLOCKS} blocks of {SIDE}^3 voxels, got {voxel:g} m, which needs "
                f"at least {len(keys)}. Choose a larger voxel."
            )
        points, faces = _extract(images, keys, width)
        points, faces = _largest_parts(points, faces, smallest_part)
        colors = _vertex_colors(images, points, width) if len(images.colors) else None
    import trimesh  # with networkx, which take long

    mesh = trimesh.Trimesh(points.astype(np.float64) + images.origin, faces, vertex_colors=colors, process=False)
    mesh.metadata["voxel"] = width
    return mesh


def _find_blocks(images: DepthImages, voxel: float) -> wp.array:
    """Return the sorted keys of all blocks within the truncation of a surface point.

    Where the surface itself lies in more than `MAX_BLOCKS`, only those, since these are too many already.
    """
    found = []
    largest = max(camera.width * camera.height for camera in images.cameras)
    keys, flags = wp.empty(largest, dtype=wp.int64), wp.empty(largest, dtype=int)
    for index, camera in enumerate(images.cameras):
        count = camera.width * camera.height
        launch_find_pixel_keys(images.pixels, images.view(index), voxel, keys, flags, images.device)
        found.append(_unique(_kept(keys, flags, count)))
    lowest = _unique(_joined(found))
    if not len(lowest) or len(lowest) > MAX_BLOCKS:
        return lowest
    if int(lowest[-1:].numpy()[0]) == NO_KEY:
        raise InvalidOptionError(
            f"voxel must be so large that {2**20} blocks reach across what is seen, got {voxel:g} m. "
            "Choose a larger one, or mask far depths."
        )
    spread = wp.empty(8 * len(lowest), dtype=wp.int64)
    launch_spread_keys(8 * len(lowest), lowest, spread, images.device)
    return _unique(spread)


def _kept(keys: wp.array, flags: wp.array, count: int) -> wp.array:
    """Return the flagged ones among the first ``count`` keys."""
    ends = wp.empty(count, dtype=int)
    wp.utils.array_scan(flags[:count], ends, inclusive=True)
    kept = wp.empty(int(ends[-1:].numpy()[0]), dtype=wp.int64)
    launch_keep_keys(keys, flags, ends, count, kept, keys.device)
    return kept


def _joined(parts: Sequence[wp.array]) -> wp.array:
    """Return arrays of keys as one."""
    joined = wp.empty(sum(len(part) for part in parts), dtype=wp.int64)
    start = 0
    for part in parts:
        if len(part):
            wp.copy(joined, part, dest_offset=start, count=len(part))
        start += len(part)
    return joined


def _unique(keys: wp.array) -> wp.array:
    """Return keys in ascending order, each once."""
    count = len(keys)
    if not count:
        return keys
    room, rows = wp.empty(2 * count, dtype=wp.int64), wp.empty(2 * count, dtype=int)  # sorting wants room for both
    wp.copy(room, keys, count=count)
    wp.utils.radix_sort_pairs(room, rows, count)
    flags = wp.empty(count, dtype=int)
    launch_flag_first_keys(room, count, flags, keys.device)
    return _kept(room, flags, count)


def _extract(images: DepthImages, keys: wp.array, voxel: float) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return vertices, counted from the images' origin, and faces of the surface in some blocks."""
    device = images.device
    voxel_count = VOXELS * len(keys)
    distances, weights = wp.empty(voxel_count, dtype=float), wp.empty(voxel_count, dtype=float)
    launch_integrate(keys, images.views, images.pixels, voxel, distances, weights, device)
    del weights
    neighbors = wp.empty(8 * len(keys), dtype=int)
    launch_find_neighbors(8 * len(keys), keys, neighbors, device)
    flags, ends = wp.empty(voxel_count, dtype=int), wp.empty(voxel_count, dtype=int)
    launch_flag_cells(len(flags), neighbors, distances, flags, device)
    wp.utils.array_scan(flags, ends, inclusive=True)
    cell_count = int(ends[-1:].numpy()[0])
    if not cell_count:
        raise InvalidArrayError(
            f"depth must show a surface that voxels of {voxel:g} m can hold, got none: no cell was seen from in front "
            "and up to behind the surface. Choose a smaller voxel, or more views."
        )
    cells, values = wp.empty(cell_count, dtype=wp.vec3i), wp.empty((cell_count, 8), dtype=float)
    launch_write_cells(keys, neighbors, distances, flags, ends, cells, values, device)
    points, indices = sparse_marching_cubes_from_cells(cells, values, cell_width=voxel, device=device)
    return points.numpy(), indices.numpy().reshape(-1, 3)


def _largest_parts(
    points: NDArray[np.float32], faces: NDArray[np.int32], smallest_part: float
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the connected parts whose area counts, with the vertices that they use, in their order."""
    parts = face_parts(faces, len(points))
    corners = points[faces].astype(np.float64)
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    of_parts = np.bincount(parts, areas)
    kept = faces[(of_parts >= smallest_part * of_parts.max())[parts]]
    used = np.zeros(len(points), bool)
    used[kept] = True
    numbers = np.cumsum(used) - 1
    return points[used], numbers[kept].astype(np.int32)


def _vertex_colors(images: DepthImages, points: NDArray[np.float32], voxel: float) -> NDArray[np.uint8]:
    """Return the colour that the views show at every vertex, as bytes of display sRGB; grey where none shows it."""
    found, places = wp.empty(len(points), dtype=wp.vec4), wp.array(points, dtype=wp.vec3)
    seen = (images.views, images.pixels, images.colors)
    launch_gather_colors(places, *seen, TRUNCATION * voxel, found, images.device)
    colors = found.numpy()
    straight = np.clip(colors[:, :3], 0.0, 1.0)
    if images.color_space == LINEAR_REC709:
        straight = linear_to_srgb(straight)
    straight = np.where(colors[:, 3:] > 0.0, straight, 0.5)
    return np.rint(straight * 255.0).astype(np.uint8)
