"""Depths of points inside the cones of all silhouettes, and the blocks of a grid that the hull's surface may pass.

The depth of a point in one view's cone is the signed distance of its pixel to the silhouette, brought to metres at the
point's depth; inside all cones is where the least of them is positive. A block is judged by its enclosing ball: where
the ball's image is farther from the silhouette than its radius, every point of the block is on one side.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.raster.pinholes import camera_point, image_point, room_around
from beam_warp.kernels.raster.project import RasterView

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(4)
"""Cells of a block along each axis."""

BLOCK_POINTS = wp.constant(125)
"""Corners of a block's cells, (BLOCK + 1)^3."""

BLOCK_CELLS = wp.constant(64)

NEAR = wp.constant(0.01)
"""Depth [m] before which a camera sees nothing, as for the rasteriser."""

PIXEL_MARGIN = wp.constant(1.5)
"""Largest error of the measured distance between pixels [pixel]: interpolation over a cell's half diagonal, 0.71, and
the spacing of the silhouette's crossings, 0.5."""

OUTSIDE = wp.constant(0)
SURFACE = wp.constant(1)
INSIDE = wp.constant(2)


@wp.struct
class Silhouettes:
    """Signed distances to the silhouettes of views, and how many views have to see a point inside."""

    views: wp.array[RasterView]
    distances: wp.array[float]  # of all pixels, view by view [pixel]
    quorum: int


@wp.struct
class Grid:
    """Cubes from ``origin`` on: ``count`` blocks of a size, or the voxels of ``count`` blocks."""

    origin: wp.vec3
    size: float  # of a cube [m]
    count: wp.vec3i


@wp.func
def silhouette_distance(view: RasterView, distances: wp.array[float], pixel: wp.vec2) -> float:
    """Signed distance [pixel] at a place of the image, bilinear between centres; constant beyond the outermost."""
    column = wp.clamp(pixel[0] - 0.5, 0.0, float(view.width - 1))
    row = wp.clamp(pixel[1] - 0.5, 0.0, float(view.height - 1))
    left = wp.min(int(column), wp.max(view.width - 2, 0))
    top = wp.min(int(row), wp.max(view.height - 2, 0))
    right = wp.min(left + 1, view.width - 1)
    bottom = wp.min(top + 1, view.height - 1)
    s = column - float(left)
    t = row - float(top)
    upper = view.first_pixel + top * view.width
    lower = view.first_pixel + bottom * view.width
    above = distances[upper + left] * (1.0 - s) + distances[upper + right] * s
    below = distances[lower + left] * (1.0 - s) + distances[lower + right] * s
    return above * (1.0 - t) + below * t


@wp.func
def mean_focal(view: RasterView) -> float:
    return 0.5 * (view.focal[0] + view.focal[1])


@wp.func
def hull_depth(point: wp.vec3, silhouettes: Silhouettes, unseen: float) -> float:
    """Depth [m] in the cones: the least of all views that see the point.

    A point that fewer views than the quorum see is as far outside as ``unseen`` says.
    """
    least = float(wp.inf)
    seen = int(0)
    for i in range(silhouettes.views.shape[0]):
        view = silhouettes.views[i]
        p = camera_point(view, point)
        if p[2] > NEAR:
            pixel = image_point(view, p)
            if room_around(view, pixel) >= 0.0:
                seen += 1
                depth = silhouette_distance(view, silhouettes.distances, pixel) * p[2] / mean_focal(view)
                least = wp.min(least, depth)
    if seen < silhouettes.quorum:
        return -unseen
    return least


@wp.kernel
def judge_blocks_kernel(first: int, grid: Grid, silhouettes: Silhouettes, out_states: wp.array[int]):
    block = first + wp.tid()
    count = grid.count
    size = grid.size
    k = block % count[2]
    j = block / count[2] % count[1]
    i = block / (count[2] * count[1])
    center = grid.origin + size * (wp.vec3(float(i), float(j), float(k)) + wp.vec3(0.5, 0.5, 0.5))
    radius = 0.8660254037844386 * size
    possible = int(0)  # views that may see some of the block
    against = int(0)  # that see all of it outside
    agreeing = int(0)  # that see all of it inside
    for v in range(silhouettes.views.shape[0]):
        view = silhouettes.views[v]
        p = camera_point(view, center)
        z = p[2]
        if z > radius + NEAR:
            a = p[0] / z
            b = p[1] / z
            pixel = image_point(view, p)
            # A step e of the ball moves the image by (e_xy - (a, b) e_z) / (z + e_z).
            reach = wp.max(view.focal[0], view.focal[1]) * radius * wp.sqrt(1.0 + a * a + b * b) / (z - radius)
            room = room_around(view, pixel)
            if room > -reach:
                possible += 1
            if room > reach:
                distance = silhouette_distance(view, silhouettes.distances, pixel)
                if distance < -(reach + PIXEL_MARGIN):
                    against += 1
                elif distance > reach + PIXEL_MARGIN:
                    agreeing += 1
        elif z > -radius:
            possible += 1
    state = SURFACE
    if against > 0 or possible - against < silhouettes.quorum:
        state = OUTSIDE
    elif agreeing == possible:  # a quorum, by the line before
        state = INSIDE
    out_states[block] = state


@wp.kernel
def fill_blocks_kernel(
    first: int, blocks: wp.array[wp.vec3i], grid: Grid, silhouettes: Silhouettes, out_depths: wp.array[float]
):
    item = first + wp.tid()
    corner = item % BLOCK_POINTS
    block = blocks[item / BLOCK_POINTS]
    side = BLOCK + 1
    i = block[0] * BLOCK + corner / (side * side)
    j = block[1] * BLOCK + corner / side % side
    k = block[2] * BLOCK + corner % side
    voxel = grid.size
    point = grid.origin + voxel * wp.vec3(float(i), float(j), float(k))
    depth = hull_depth(point, silhouettes, voxel)
    # The grid ends outside, so that the surface is closed where the box cuts it.
    ends = grid.count * BLOCK
    if i == 0 or j == 0 or k == 0 or i == ends[0] or j == ends[1] or k == ends[2]:
        depth = wp.min(depth, -voxel)
    out_depths[item] = depth


@wp.func
def corner_index(cell: int, corner: int) -> int:
    """Which of a block's points is a corner of one of its cells, in Warp's order of a cube's corners."""
    side = BLOCK + 1
    i = cell / (BLOCK * BLOCK)
    j = cell / BLOCK % BLOCK
    k = cell % BLOCK
    if corner == 1 or corner == 2 or corner == 5 or corner == 6:
        i += 1
    if corner == 2 or corner == 3 or corner == 6 or corner == 7:
        j += 1
    if corner >= 4:
        k += 1
    return (i * side + j) * side + k


@wp.kernel
def find_cells_kernel(first: int, depths: wp.array[float], out_crossed: wp.array[int]):
    item = first + wp.tid()
    start = item / BLOCK_CELLS * BLOCK_POINTS
    low = float(wp.inf)
    high = float(-wp.inf)
    for corner in range(8):
        depth = depths[start + corner_index(item % BLOCK_CELLS, corner)]
        low = wp.min(low, depth)
        high = wp.max(high, depth)
    crossed = int(0)
    if low <= 0.0 and high >= 0.0:
        crossed = 1
    out_crossed[item] = crossed


@wp.kernel
def gather_cells_kernel(
    first: int,
    blocks: wp.array[wp.vec3i],
    depths: wp.array[float],
    ends: wp.array[int],
    out_cells: wp.array[wp.vec3i],
    out_depths: wp.array2d[float],
):
    item = first + wp.tid()
    before = int(0)
    if item > 0:
        before = ends[item - 1]
    if ends[item] > before:
        block = item / BLOCK_CELLS
        cell = item % BLOCK_CELLS
        offset = wp.vec3i(cell / (BLOCK * BLOCK), cell / BLOCK % BLOCK, cell % BLOCK)
        out_cells[before] = blocks[block] * BLOCK + offset
        for corner in range(8):
            out_depths[before, corner] = depths[block * BLOCK_POINTS + corner_index(cell, corner)]


launch_judge_blocks = launcher(judge_blocks_kernel)
"""Write which blocks of a grid are outside, inside, or may hold surface."""


def launch_fill_blocks(blocks: Any, grid: Grid, silhouettes: Silhouettes, out_depths: Any, device: Any) -> None:
    """Write the depths at all points of some blocks, ``BLOCK_POINTS`` each; the grid's cubes are voxels."""
    inputs = [blocks, grid, silhouettes]
    launch(fill_blocks_kernel, len(out_depths), inputs=inputs, outputs=[out_depths], device=device)


launch_find_cells = launcher(find_cells_kernel)
"""Write 1 for cells that the surface may pass, 0 for others."""


launch_gather_cells = launcher(gather_cells_kernel)
"""Write the subscripts and corner depths of crossed cells; ``ends`` are inclusive sums of their flags."""
