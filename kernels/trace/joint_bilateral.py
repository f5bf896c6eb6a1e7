"""Noise taken off images by averaging over the surface around each pixel: an edge-avoiding a-trous filter.

Five rounds of a 5 x 5 B-spline whose taps lie 1, 2, 4, 8 and 16 pixels apart (Dammertz et al. 2010). A tap counts by
how well its normal agrees, by how near it is to the pixel's tangent plane, and by how few of its standard errors its
value is off, which are filtered along (Schied et al. 2017). Pixels that show no surface neither give nor take.
"""

import warp as wp

from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.common.luminance import luminance

wp.set_module_options({"enable_backward": False})

ROUNDS = 5

NORMAL_POWER = wp.constant(64.0)
"""Power of the cosine between normals: a tap counts half at 8 degrees."""

PLANE_PIXELS = wp.constant(1.0)
"""Distance from the tangent plane at which a tap counts exp(-1), in pixels of its distance."""

VALUE_ERRORS = wp.constant(3.0)
"""Standard errors of a difference at which a tap counts exp(-1)."""

FIREFLY = wp.constant(5.0)
"""A pixel is cut, before filtering, to this many times the mean of its 24 neighbours on the surface, by the largest
channel."""

TINY = wp.constant(1.0e-12)

Spline = wp.types.vector(length=5, dtype=float)
SPLINE = wp.constant(Spline(0.0625, 0.25, 0.375, 0.25, 0.0625))


@wp.struct
class Guides:
    """What is known of the surface without noise, ``(H * W,)``."""

    normals: wp.array[wp.vec3]  # unit; 0 where there is no surface
    depth: wp.array[float]
    width: int
    height: int
    focal: wp.vec2
    center: wp.vec2
    world_to_camera: wp.mat33


@wp.func
def is_surface(guides: Guides, x: int, y: int) -> bool:
    if x < 0 or y < 0 or x >= guides.width or y >= guides.height:
        return False
    return wp.length_sq(guides.normals[y * guides.width + x]) > 0.0


@wp.func
def surface_point(guides: Guides, x: int, y: int) -> wp.vec3:
    """The surface's point at a pixel, in camera axes."""
    ray = wp.vec3(
        (float(x) + 0.5 - guides.center[0]) / guides.focal[0],
        (float(y) + 0.5 - guides.center[1]) / guides.focal[1],
        1.0,
    )
    return guides.depth[y * guides.width + x] * ray


@wp.kernel
def clamp_fireflies_kernel(first: int, guides: Guides, values: wp.array[wp.vec3], out_values: wp.array[wp.vec3]):
    pixel = first + wp.tid()
    x = pixel % guides.width
    y = pixel / guides.width
    value = values[pixel]
    if is_surface(guides, x, y):
        total = float(0.0)
        count = float(0.0)
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                if (dx != 0 or dy != 0) and is_surface(guides, x + dx, y + dy):
                    total += wp.max(values[(y + dy) * guides.width + x + dx])
                    count += 1.0
        limit = FIREFLY * total
        own = wp.max(value) * count
        if count > 0.0 and own > limit:
            value = value * (limit / own)
    out_values[pixel] = value


@wp.kernel
def square_errors_kernel(first: int, errors: wp.array[float], out_variances: wp.array[float]):
    pixel = first + wp.tid()
    out_variances[pixel] = errors[pixel] * errors[pixel]


@wp.kernel
def smooth_variances_kernel(first: int, guides: Guides, variances: wp.array[float], out_variances: wp.array[float]):
    """A sample's own estimate of its error is noisy where samples are few: the mean of 3 x 3 pixels is less so."""
    pixel = first + wp.tid()
    x = pixel % guides.width
    y = pixel / guides.width
    total = float(0.0)
    count = float(0.0)
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if is_surface(guides, x + dx, y + dy):
                total += variances[(y + dy) * guides.width + x + dx]
                count += 1.0
    out_variances[pixel] = total / wp.max(count, 1.0)


@wp.kernel
def filter_round_kernel(
    first: int,
    guides: Guides,
    step: int,
    values: wp.array[wp.vec3],
    variances: wp.array[float],
    out_values: wp.array[wp.vec3],
    out_variances: wp.array[float],
):
    pixel = first + wp.tid()
    x = pixel % guides.width
    y = pixel / guides.width
    if not is_surface(guides, x, y):
        out_values[pixel] = values[pixel]
        out_variances[pixel] = variances[pixel]
        return
    point = surface_point(guides, x, y)
    normal = guides.normals[pixel]
    local = guides.world_to_camera * normal
    reach = PLANE_PIXELS * point[2] * float(step) / wp.max(guides.focal[0], guides.focal[1])
    own = luminance(values[pixel])
    total = wp.vec3()
    spread = float(0.0)
    weight_sum = float(0.0)
    for j in range(5):
        for i in range(5):
            column = x + (i - 2) * step
            row = y + (j - 2) * step
            if is_surface(guides, column, row):
                other = row * guides.width + column
                cosine = wp.max(wp.dot(normal, guides.normals[other]), 0.0)
                height = wp.dot(local, surface_point(guides, column, row) - point) / reach
                off = luminance(values[other]) - own
                errors = VALUE_ERRORS * VALUE_ERRORS * (variances[pixel] + variances[other]) + TINY
                weight = SPLINE[i] * SPLINE[j] * wp.pow(cosine, NORMAL_POWER)
                weight *= wp.exp(-height * height - off * off / errors)
                total += weight * values[other]
                spread += weight * weight * variances[other]
                weight_sum += weight
    out_values[pixel] = total / weight_sum  # the pixel itself counts 9/64 at least
    out_variances[pixel] = spread / (weight_sum * weight_sum)


launch_clamp_fireflies = launcher(clamp_fireflies_kernel)
"""Cut pixels that are far brighter than all around them."""


launch_square_errors = launcher(square_errors_kernel)
"""Turn standard errors into variances."""


launch_smooth_variances = launcher(smooth_variances_kernel)
"""Average variances over 3 x 3 pixels of the surface."""


launch_filter_round = launcher(filter_round_kernel)
"""One round, with taps ``step`` pixels apart."""
