"""Truncated signed distances in blocks of 8^3 voxels along a surface, and the cells of marching cubes in them.

A block is known by one 63-bit key, its three coordinates side by side. Blocks are a sorted list of keys without
repeats: found by sorting, looked up by bisection, so that no two threads write one place, and the same input gives the
same list. Distances are gathered: a voxel asks all views, in their order.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.mesh.depth_pixels import DepthCamera, is_background, pixel_point, project_point, sample_pixels

wp.set_module_options({"enable_backward": False})

SIDE = wp.constant(8)
"""Voxels along a block's side."""

VOXELS = wp.constant(SIDE**3)
TRUNCATION = wp.constant(4.0)
"""Truncation in voxels: half a block, so that the cube of that reach around a point lies in 2 x 2 x 2 blocks."""

KEY_BITS = 21
OFFSET = wp.constant(2**20)
"""Block coordinates are from -2^20 to 2^20 - 1."""

NO_KEY = 2**63 - 1
"""Sorts last: a point whose block has no key."""

LEAST_WEIGHT = wp.constant(1.0e-4)
"""Weight from which a voxel counts as observed: that of one view at the smallest cosine, 0.1."""

LEAST_DISTANCE = wp.constant(1.0e-3)
"""Smallest distance at a voxel, in voxels: vertices on a grid point would collapse triangles to nothing."""

BITS = wp.constant(wp.int64(KEY_BITS))
MISSING = wp.constant(wp.int64(NO_KEY))
MASK = wp.constant(wp.int64(2**KEY_BITS - 1))


@wp.func
def key_of(block: wp.vec3i) -> wp.int64:
    x = wp.int64(block[0] + OFFSET)
    y = wp.int64(block[1] + OFFSET)
    z = wp.int64(block[2] + OFFSET)
    return (x << (BITS + BITS)) | (y << BITS) | z


@wp.func
def block_of(key: wp.int64) -> wp.vec3i:
    x = int((key >> (BITS + BITS)) & MASK) - OFFSET
    y = int((key >> BITS) & MASK) - OFFSET
    z = int(key & MASK) - OFFSET
    return wp.vec3i(x, y, z)


@wp.func
def corner_of(corner: int) -> wp.vec3i:
    """Offset of corner 0 … 7 of a cell, in the order of Warp's marching cubes."""
    upper = corner / 4
    turn = corner % 4
    x = int(0)
    y = int(0)
    if turn == 1 or turn == 2:
        x = 1
    if turn >= 2:
        y = 1
    return wp.vec3i(x, y, upper)


@wp.func
def low_key(pixels: wp.array[wp.vec3], camera: DepthCamera, voxel: float, pixel: int) -> wp.int64:
    """Key of the lowest block that the surroundings of a pixel's surface point reach into; -1 where there is none."""
    value = pixels[camera.first_pixel + pixel]
    if not (value[2] > 0.0):
        return wp.int64(-1)
    x = float(pixel % camera.width) + 0.5
    y = float(pixel / camera.width) + 0.5
    low = pixel_point(camera, x, y, value[0]) / voxel - wp.vec3(TRUNCATION, TRUNCATION, TRUNCATION)
    # The blocks above, and marching cubes' corners above them, have keys too.
    limit = float(OFFSET - 4) * float(SIDE)
    if not (wp.max(wp.max(wp.abs(low[0]), wp.abs(low[1])), wp.abs(low[2])) < limit):
        return MISSING
    side = float(SIDE)
    return key_of(wp.vec3i(int(wp.floor(low[0] / side)), int(wp.floor(low[1] / side)), int(wp.floor(low[2] / side))))


@wp.kernel
def find_pixel_keys_kernel(
    first: int,
    pixels: wp.array[wp.vec3],
    camera: DepthCamera,
    voxel: float,
    out_keys: wp.array[wp.int64],
    out_flags: wp.array[int],
):
    """Flags the pixels whose key is not their left neighbour's: runs of one key are listed once."""
    pixel = first + wp.tid()
    key = low_key(pixels, camera, voxel, pixel)
    out_keys[pixel] = key
    flag = int(0)
    if key >= wp.int64(0):
        flag = 1
        if pixel % camera.width > 0:
            if low_key(pixels, camera, voxel, pixel - 1) == key:
                flag = 0
    out_flags[pixel] = flag


@wp.kernel
def flag_first_keys_kernel(first: int, keys: wp.array[wp.int64], out_flags: wp.array[int]):
    i = first + wp.tid()
    flag = int(1)
    if i > 0:
        if keys[i - 1] == keys[i]:
            flag = 0
    out_flags[i] = flag


@wp.kernel
def keep_keys_kernel(
    first: int, keys: wp.array[wp.int64], flags: wp.array[int], ends: wp.array[int], out_keys: wp.array[wp.int64]
):
    i = first + wp.tid()
    if flags[i] == 1:
        out_keys[ends[i] - 1] = keys[i]


@wp.kernel
def spread_keys_kernel(first: int, keys: wp.array[wp.int64], out_keys: wp.array[wp.int64]):
    """The eight blocks from the lowest one up."""
    i = first + wp.tid()
    out_keys[i] = key_of(block_of(keys[i / 8]) + corner_of(i % 8))


@wp.kernel
def find_neighbors_kernel(first: int, keys: wp.array[wp.int64], out_neighbors: wp.array[int]):
    """Find each block and the seven above it, as a cell's corners are counted; -1 where there is none."""
    i = first + wp.tid()
    key = key_of(block_of(keys[i / 8]) + corner_of(i % 8))
    place = wp.lower_bound(keys, key)
    found = int(-1)
    if place < keys.shape[0]:
        if keys[place] == key:
            found = place
    out_neighbors[i] = found


@wp.func
def local_of(voxel: int) -> wp.vec3i:
    return wp.vec3i(voxel / (SIDE * SIDE), (voxel / SIDE) % SIDE, voxel % SIDE)


@wp.func
def grid_of(keys: wp.array[wp.int64], index: int) -> wp.vec3i:
    """Grid coordinates of a voxel."""
    return block_of(keys[index / VOXELS]) * SIDE + local_of(index % VOXELS)


@wp.kernel
def integrate_kernel(
    first: int,
    keys: wp.array[wp.int64],
    cameras: wp.array[DepthCamera],
    pixels: wp.array[wp.vec3],
    voxel: float,
    out_distances: wp.array[float],
    out_weights: wp.array[float],
):
    """Mean of the views' distances [voxel].

    Behind a surface a view counts less and less, down to nothing at the truncation, where it cannot know. Past an edge
    it would still see solid where there is air: what more views look through, at background, than see from behind a
    surface, is not solid, and counts as not observed.
    """
    index = first + wp.tid()
    grid = grid_of(keys, index)
    point = wp.vec3(float(grid[0]), float(grid[1]), float(grid[2])) * voxel
    total = float(0.0)
    weights = float(0.0)
    solid = int(0)
    for view in range(cameras.shape[0]):
        camera = cameras[view]
        at = project_point(camera, point)
        if at[2] > 0.0:
            pixel = sample_pixels(pixels, camera, at[0], at[1])
            if pixel[2] > 0.0:
                distance = (1.0 / pixel[0] - at[2]) * pixel[1] / voxel
                if distance > -TRUNCATION:
                    weight = pixel[2] * wp.min(1.0, (distance + TRUNCATION) / (TRUNCATION - 1.0))
                    total += weight * wp.min(distance, TRUNCATION)
                    weights += weight
                    if distance < 0.0:
                        solid += 1
            elif is_background(pixels, camera, at[0], at[1]):
                solid -= 1
    mean = float(0.0)
    if weights >= LEAST_WEIGHT and (total >= 0.0 or solid >= 0):
        mean = total / weights
        if wp.abs(mean) < LEAST_DISTANCE:
            mean = wp.where(mean < 0.0, -LEAST_DISTANCE, LEAST_DISTANCE)
    out_distances[index] = mean  # 0 is none: not observed
    out_weights[index] = weights


@wp.func
def corner_distance(neighbors: wp.array[int], distances: wp.array[float], index: int, corner: int) -> float:
    """Distance at a corner of the cell above a voxel; 0 where it is not observed."""
    block = index / VOXELS
    at = local_of(index % VOXELS) + corner_of(corner)
    over = wp.vec3i(at[0] / SIDE, at[1] / SIDE, at[2] / SIDE)
    # Corners of a square are counted around it: 0, 1, 2, 3 are (0, 0), (1, 0), (1, 1), (0, 1).
    side = over[0] + 3 * over[1] - 2 * over[0] * over[1]
    found = neighbors[8 * block + 4 * over[2] + side]
    if found < 0:
        return 0.0
    local = at - over * SIDE
    return distances[found * VOXELS + (local[0] * SIDE + local[1]) * SIDE + local[2]]


@wp.kernel
def flag_cells_kernel(first: int, neighbors: wp.array[int], distances: wp.array[float], out_flags: wp.array[int]):
    """Flags cells that the surface passes through, with eight observed corners."""
    index = first + wp.tid()
    flag = int(0)
    if distances[index] != 0.0:
        low = float(wp.inf)
        high = -float(wp.inf)
        known = bool(True)
        for corner in range(8):
            value = corner_distance(neighbors, distances, index, corner)
            known = known and value != 0.0
            low = wp.min(low, value)
            high = wp.max(high, value)
        if known and low < 0.0 and high > 0.0:
            flag = 1
    out_flags[index] = flag


@wp.kernel
def write_cells_kernel(
    first: int,
    keys: wp.array[wp.int64],
    neighbors: wp.array[int],
    distances: wp.array[float],
    flags: wp.array[int],
    ends: wp.array[int],
    out_cells: wp.array[wp.vec3i],
    out_values: wp.array2d[float],
):
    index = first + wp.tid()
    if flags[index] == 1:
        cell = ends[index] - 1
        out_cells[cell] = grid_of(keys, index)
        for corner in range(8):
            out_values[cell, corner] = corner_distance(neighbors, distances, index, corner)


@wp.kernel
def gather_colors_kernel(
    first: int,
    points: wp.array[wp.vec3],
    cameras: wp.array[DepthCamera],
    pixels: wp.array[wp.vec3],
    colors: wp.array[wp.vec3],
    reach: float,
    out_colors: wp.array[wp.vec4],
):
    """Mean colour in the views that see a point, and the sum of their weights."""
    index = first + wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    weights = float(0.0)
    for view in range(cameras.shape[0]):
        camera = cameras[view]
        at = project_point(camera, points[index])
        if at[2] > 0.0:
            pixel = sample_pixels(pixels, camera, at[0], at[1])
            if pixel[2] > 0.0:
                if wp.abs(1.0 / pixel[0] - at[2]) * pixel[1] <= reach:
                    place = camera.first_pixel + int(at[1]) * camera.width + int(at[0])
                    total += pixel[2] * colors[place]
                    weights += pixel[2]
    if weights > 0.0:
        total /= weights
    out_colors[index] = wp.vec4(total[0], total[1], total[2], weights)


def launch_find_pixel_keys(pixels, camera, voxel, keys, flags, device):
    """Find the lowest block of every pixel of a view, and which of them begin a run."""
    inputs = [pixels, camera, voxel]
    launch(find_pixel_keys_kernel, camera.width * camera.height, inputs=inputs, outputs=[keys, flags], device=device)


def launch_flag_first_keys(keys, count, flags, device):
    """Flag where sorted keys change."""
    launch(flag_first_keys_kernel, count, inputs=[keys], outputs=[flags], device=device)


def launch_keep_keys(keys, flags, ends, count, kept, device):
    """Write flagged keys side by side."""
    launch(keep_keys_kernel, count, inputs=[keys, flags, ends], outputs=[kept], device=device)


launch_spread_keys = launcher(spread_keys_kernel)
"""Write the eight blocks of every lowest one."""


launch_find_neighbors = launcher(find_neighbors_kernel)
"""Find the blocks above every block."""


def launch_integrate(keys, cameras, pixels, voxel, distances, weights, device):
    """Write distance and weight of every voxel of all blocks."""
    inputs = [keys, cameras, pixels, voxel]
    launch(integrate_kernel, VOXELS * len(keys), inputs=inputs, outputs=[distances, weights], device=device)


launch_flag_cells = launcher(flag_cells_kernel)
"""Flag the cells that marching cubes visits."""


def launch_write_cells(keys, neighbors, distances, flags, ends, cells, values, device):
    """Write place and corners of the flagged cells."""
    inputs = [keys, neighbors, distances, flags, ends]
    launch(write_cells_kernel, len(flags), inputs=inputs, outputs=[cells, values], device=device)


def launch_gather_colors(points, cameras, pixels, colors, reach, out_colors, device):
    """Write the colour of points of the surface."""
    inputs = [points, cameras, pixels, colors, reach]
    launch(gather_colors_kernel, len(points), inputs=inputs, outputs=[out_colors], device=device)
