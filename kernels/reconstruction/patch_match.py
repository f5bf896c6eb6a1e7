"""Depth and normal of every pixel by photometric consistency: patches of planes that look alike in other views.

Every pixel holds a plane in its camera's axes. Half of the pixels, those of one colour of a chessboard, try the planes
of neighbours of the other colour and random changes of their own, and keep what makes the patch around them most alike
in the other views. Then the other half does, so that no thread reads what another one writes.

A plane is its unit normal, towards the camera, and the depth [m] of its point on the pixel's ray. A patch's likeness is
the correlation of brightness, so that exposure does not matter, weighted so that pixels of another surface count
little. A cost is one minus that: 0 for patches that are alike, 1 for unrelated ones.

Source: Galliani et al. 2015, "Massively Parallel Multiview Stereopsis by Surface Normal Diffusion" (the chessboard, the
mean of the best views); Schönberger et al. 2016, "Pixelwise View Selection for Unstructured Multi-View Stereo" (the
weighted correlation).
"""

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.common.sampling import hash_combine, unit_float

wp.set_module_options({"enable_backward": False})

REACH = wp.constant(5)
STEP = wp.constant(2)
SIDE = wp.constant(6)
SAMPLES = wp.constant(36)
"""Half the side of a patch, and the distance of its samples [pixel]; samples along a side, and in all."""

Samples = wp.types.vector(length=36, dtype=float)

SPREAD = wp.constant(4.0)
CONTRAST = wp.constant(0.12)
"""Distance [pixel] and difference of brightness at which a sample of a patch counts 1/e."""

LEAST_VARIANCE = wp.constant(2.0e-5)
"""Variance of brightness below which a patch says nothing: noise of half a step in a hundred."""

LEAST_FACING = wp.constant(0.15)
"""Cosine between a plane's normal and a ray below which a view does not see it."""

NEITHER = wp.constant(1.0)
"""Cost of what says nothing."""

WORST = wp.constant(2.0)

FARTHEST = wp.constant(3.0)
PER_PIXEL = wp.constant(0.15)
"""Most pixels by which a point that two views show may miss itself, to count; the cost of one."""


@wp.struct
class StereoView:
    """The view whose planes are sought."""

    focal: wp.vec2
    center: wp.vec2
    width: int
    height: int
    first_pixel: int
    nearest: float  # largest inverse depth [1/m]
    farthest: float  # smallest inverse depth


@wp.struct
class StereoNeighbor:
    """A view that planes are compared in; p in the first view's axes is ``turn`` p + ``shift`` in its own."""

    turn: wp.mat33
    shift: wp.vec3
    focal: wp.vec2
    center: wp.vec2
    width: int
    height: int
    first_pixel: int


@wp.func
def ray_through(view: StereoView, x: float, y: float) -> wp.vec3:
    """The ray of depth 1 through the middle of a pixel."""
    return wp.vec3((x + 0.5 - view.center[0]) / view.focal[0], (y + 0.5 - view.center[1]) / view.focal[1], 1.0)


@wp.struct
class Patch:
    """The samples around a pixel: brightness against the middle's, and weights; 0 outside the image."""

    values: Samples
    weights: Samples


@wp.func
def patch_around(levels: wp.array[float], view: StereoView, column: int, row: int) -> Patch:
    patch = Patch()
    own = levels[view.first_pixel + row * view.width + column]
    for k in range(SAMPLES):
        i = STEP * (k % SIDE) - REACH
        j = STEP * (k / SIDE) - REACH
        x = column + i
        y = row + j
        if x >= 0 and y >= 0 and x < view.width and y < view.height:
            value = levels[view.first_pixel + y * view.width + x] - own
            patch.values[k] = value
            patch.weights[k] = wp.exp(-wp.abs(value) / CONTRAST - wp.sqrt(float(i * i + j * j)) / SPREAD)
    return patch


@wp.func
def brightness(levels: wp.array[float], view: StereoNeighbor, x: float, y: float) -> float:
    """Bilinear brightness at a place at least half a pixel inside the image."""
    left = wp.min(int(x - 0.5), view.width - 2)
    top = wp.min(int(y - 0.5), view.height - 2)
    u = x - 0.5 - float(left)
    v = y - 0.5 - float(top)
    at = view.first_pixel + top * view.width + left
    upper = levels[at] * (1.0 - u) + levels[at + 1] * u
    lower = levels[at + view.width] * (1.0 - u) + levels[at + view.width + 1] * u
    return upper * (1.0 - v) + lower * v


@wp.func
def unlikeness(
    levels: wp.array[float], view: StereoView, other: StereoNeighbor, patch: Patch, middle: wp.vec3, plane: wp.vec4
) -> float:
    """Cost of the plane of the pixel with the ray ``middle`` in one other view."""
    normal = wp.vec3(plane[0], plane[1], plane[2])
    seen = other.turn * (middle * plane[3]) + other.shift
    if not (wp.dot(other.turn * normal, wp.normalize(seen)) < -LEAST_FACING):
        return WORST
    # The plane's points on rays are projected by a homography; rays of a patch are evenly spaced.
    maps = other.turn + wp.outer(other.shift, normal) / (plane[3] * wp.dot(normal, middle))
    start = maps * middle
    right = maps * wp.vec3(1.0 / view.focal[0], 0.0, 0.0)
    down = maps * wp.vec3(0.0, 1.0 / view.focal[1], 0.0)
    total = float(0.0)
    sum_a = float(0.0)
    sum_b = float(0.0)
    sum_aa = float(0.0)
    sum_bb = float(0.0)
    sum_ab = float(0.0)
    for k in range(SAMPLES):
        weight = patch.weights[k]
        if weight > 0.0:
            p = start + float(STEP * (k % SIDE) - REACH) * right + float(STEP * (k / SIDE) - REACH) * down
            u = other.focal[0] * p[0] / p[2] + other.center[0]
            v = other.focal[1] * p[1] / p[2] + other.center[1]
            inside = u >= 0.5 and v >= 0.5 and u <= float(other.width) - 0.5 and v <= float(other.height) - 0.5
            if not (p[2] > 0.0 and inside):
                return WORST
            a = patch.values[k]
            b = brightness(levels, other, u, v)
            total += weight
            sum_a += weight * a
            sum_b += weight * b
            sum_aa += weight * a * a
            sum_bb += weight * b * b
            sum_ab += weight * a * b
    aa = sum_aa / total - (sum_a / total) * (sum_a / total)
    bb = sum_bb / total - (sum_b / total) * (sum_b / total)
    if not (aa > LEAST_VARIANCE and bb > LEAST_VARIANCE):
        return NEITHER
    return 1.0 - (sum_ab / total - (sum_a / total) * (sum_b / total)) / wp.sqrt(aa * bb)


@wp.func
def miss(
    depths: wp.array[float], view: StereoView, other: StereoNeighbor, column: int, row: int, plane: wp.vec4
) -> float:
    """Distance [pixel] at which the point that another view shows where this pixel's is lies in this view."""
    p = other.turn * (ray_through(view, float(column), float(row)) * plane[3]) + other.shift
    if not (p[2] > 0.0):
        return FARTHEST
    u = other.focal[0] * p[0] / p[2] + other.center[0]
    v = other.focal[1] * p[1] / p[2] + other.center[1]
    if not (u >= 0.0 and v >= 0.0 and u < float(other.width) and v < float(other.height)):
        return FARTHEST
    depth = depths[other.first_pixel + int(v) * other.width + int(u)]
    q = wp.transpose(other.turn) * (p * (depth / p[2]) - other.shift)
    if not (q[2] > 0.0):
        return FARTHEST
    x = view.focal[0] * q[0] / q[2] + view.center[0] - 0.5 - float(column)
    y = view.focal[1] * q[1] / q[2] + view.center[1] - 0.5 - float(row)
    return wp.min(wp.sqrt(x * x + y * y), FARTHEST)


@wp.func
def cost_of(
    levels: wp.array[float],
    depths: wp.array[float],
    view: StereoView,
    others: wp.array[StereoNeighbor],
    patch: Patch,
    column: int,
    row: int,
    plane: wp.vec4,
) -> float:
    """Mean cost of a pixel's plane in the two views that show it best: it may be hidden in others."""
    middle = ray_through(view, float(column), float(row))
    facing = -wp.dot(wp.vec3(plane[0], plane[1], plane[2]), middle) / wp.length(middle)
    inverse = 1.0 / plane[3]
    if not (facing > LEAST_FACING and inverse <= view.nearest and inverse >= view.farthest):
        return WORST
    best = float(WORST)
    second = float(WORST)
    for i in range(others.shape[0]):
        cost = unlikeness(levels, view, others[i], patch, middle, plane)
        if depths.shape[0] > 0:
            cost += PER_PIXEL * miss(depths, view, others[i], column, row, plane)
        if cost < best:
            second = best
            best = cost
        elif cost < second:
            second = cost
    if others.shape[0] == 1:
        return best
    return 0.5 * (best + second)


@wp.func
def random_normal(stream: wp.uint32) -> wp.vec3:
    """A uniform direction on the side of the camera."""
    z = unit_float(hash_combine(stream, wp.uint32(11)))
    turn = 6.2831853 * unit_float(hash_combine(stream, wp.uint32(12)))
    across = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    return wp.vec3(across * wp.cos(turn), across * wp.sin(turn), -z)


@wp.func
def as_plane(normal: wp.vec3, depth: float) -> wp.vec4:
    return wp.vec4(normal[0], normal[1], normal[2], depth)


@wp.kernel
def begin_planes_kernel(
    first: int,
    levels: wp.array[float],
    depths: wp.array[float],
    view: StereoView,
    others: wp.array[StereoNeighbor],
    coarse: wp.array[wp.vec4],
    coarse_width: int,
    seed: wp.uint32,
    out_planes: wp.array[wp.vec4],
    out_costs: wp.array[float],
):
    """A pixel begins with the plane of a level of half the size, or with a random one."""
    pixel = first + wp.tid()
    column = pixel % view.width
    row = pixel / view.width
    stream = hash_combine(seed, wp.uint32(pixel))
    part = unit_float(hash_combine(stream, wp.uint32(1)))
    plane = as_plane(random_normal(stream), 1.0 / (view.farthest + part * (view.nearest - view.farthest)))
    if coarse_width == view.width:
        plane = coarse[pixel]
    elif coarse_width > 0:
        height = coarse.shape[0] / coarse_width
        plane = coarse[wp.min(row / 2, height - 1) * coarse_width + wp.min(column / 2, coarse_width - 1)]
    patch = patch_around(levels, view, column, row)
    out_planes[pixel] = plane
    out_costs[pixel] = cost_of(levels, depths, view, others, patch, column, row, plane)


@wp.kernel
def improve_planes_kernel(
    first: int,
    levels: wp.array[float],
    depths: wp.array[float],
    view: StereoView,
    others: wp.array[StereoNeighbor],
    color: int,
    spread: float,
    seed: wp.uint32,
    out_planes: wp.array[wp.vec4],
    out_costs: wp.array[float],
):
    """Pixels of one colour try their neighbours' planes, then changes of their own by up to ``spread``."""
    item = first + wp.tid()
    half = (view.width + 1) / 2
    row = item / half
    column = 2 * (item % half) + (row + color) % 2
    if column >= view.width:
        return
    pixel = row * view.width + column
    middle = ray_through(view, float(column), float(row))
    patch = patch_around(levels, view, column, row)
    plane = out_planes[pixel]
    cost = out_costs[pixel]
    for k in range(8):
        away = 1
        if k >= 4:
            away = 5
        x = column + wp.where(k % 4 == 0, away, 0) - wp.where(k % 4 == 1, away, 0)
        y = row + wp.where(k % 4 == 2, away, 0) - wp.where(k % 4 == 3, away, 0)
        if x >= 0 and y >= 0 and x < view.width and y < view.height:
            near = out_planes[y * view.width + x]
            normal = wp.vec3(near[0], near[1], near[2])
            depth = near[3] * wp.dot(normal, ray_through(view, float(x), float(y))) / wp.dot(normal, middle)
            trial = as_plane(normal, depth)
            found = cost_of(levels, depths, view, others, patch, column, row, trial)
            if found < cost:
                plane = trial
                cost = found
    for k in range(3):
        stream = hash_combine(hash_combine(seed, wp.uint32(pixel)), wp.uint32(k))
        normal = wp.vec3(plane[0], plane[1], plane[2])
        inverse = 1.0 / plane[3]
        change = 2.0 * unit_float(hash_combine(stream, wp.uint32(1))) - 1.0
        if k == 0:
            inverse *= 1.0 + 0.3 * spread * change
            normal = wp.normalize(normal + random_normal(stream) * spread)
        elif k == 1:
            inverse *= 1.0 + 0.05 * spread * change
        else:
            normal = wp.normalize(normal + 0.3 * spread * (random_normal(stream) - wp.vec3(0.0, 0.0, -0.5)))
        trial = as_plane(normal, 1.0 / inverse)
        found = cost_of(levels, depths, view, others, patch, column, row, trial)
        if found < cost:
            plane = trial
            cost = found
    out_planes[pixel] = plane
    out_costs[pixel] = cost


def launch_begin_planes(levels, depths, view, others, coarse, coarse_width, seed, planes, costs, device) -> None:
    """Write the planes that a view's search begins with, and their costs; of a coarser level if its width is not 0."""
    inputs = [levels, depths, view, others, coarse, coarse_width, wp.uint32(seed)]
    launch(begin_planes_kernel, len(planes), inputs=inputs, outputs=[planes, costs], device=device, min_chunk=256)


def launch_improve_planes(levels, depths, view, others, spread, seed, planes, costs, device) -> None:
    """Improve all planes of a view once, one colour of the chessboard after the other."""
    for color in range(2):
        inputs = [levels, depths, view, others, color, spread, wp.uint32(seed)]
        count = view.height * ((view.width + 1) // 2)
        launch(improve_planes_kernel, count, inputs=inputs, outputs=[planes, costs], device=device, min_chunk=256)
