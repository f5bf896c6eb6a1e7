"""One splat at one pixel: its response, its depth there, and which pixels of a row it reaches."""

from functools import cache

import warp as wp

from beam_warp.kernels.common.constants import ALPHA_MAX
from beam_warp.kernels.raster.project import LOG_CUT

EXTENT_MARGIN = wp.constant(0.01)
"""Pixels added to an extent, so that rounding in it never hides a pixel that passes the alpha cut."""

RELATIVE_MARGIN = wp.constant(1.0e-5)
"""Part of an extent added to it: single precision, a few operations, a margin of ten."""

MEDIAN = wp.constant(0.5)
"""The median depth is that of the last splat that more than this passes before."""

SMALLEST_FACING = wp.constant(1.0e-6)
"""Depth at a pixel whose ray runs along a Gaussian's surface, or away from it, is that of the ray that meets it so."""


@wp.struct
class Sight:
    """A splat as one pixel sees it."""

    offset: wp.vec2  # from the splat's centre to the pixel [pixel]
    e: wp.vec2  # the whitened offset
    log_alpha: float  # to the base 2


@wp.func
def squared_extent(log_opacity: float) -> float:
    """Squared length of the whitened offset at which alpha falls to 1/255."""
    return LOG_CUT + log_opacity


@wp.func
def reach_rows(shape: wp.vec4, squared: float) -> float:
    """Largest distance along y from the centre to where alpha is 1/255 [pixel]."""
    e = shape[1] * shape[2]
    reach = wp.sqrt(squared * (shape[0] * shape[0] + e * e)) / (shape[0] * shape[2])
    return reach * (1.0 + RELATIVE_MARGIN) + EXTENT_MARGIN


@wp.func
def reach_columns(shape: wp.vec4, squared: float, top: float, bottom: float) -> wp.vec2:
    """Least and greatest x of the ellipse where alpha is 1/255 between two y, all from the centre [pixel].

    The ellipse's ends along x lie at y = -s1 r and s1 r, r = reach / s0: if these are outside, the ends of what is
    between the two y are on the nearer of them.
    """
    e = shape[1] * shape[2]
    k = shape[0] * shape[0] + e * e
    end = wp.sqrt(squared) * shape[1] / shape[0]
    left_y = wp.clamp(-end, top, bottom)
    right_y = wp.clamp(end, top, bottom)
    c = shape[0] * shape[0] * shape[2] * shape[2]
    left = e * shape[2] * left_y - wp.sqrt(wp.max(k * squared - c * left_y * left_y, 0.0))
    right = e * shape[2] * right_y + wp.sqrt(wp.max(k * squared - c * right_y * right_y, 0.0))
    margin = RELATIVE_MARGIN * wp.max(wp.abs(left), wp.abs(right)) / k + EXTENT_MARGIN
    return wp.vec2(left / k - margin, right / k + margin)


@wp.struct
class RowReach:
    """Numbers, the same for all rows of pixels, from which the pixels that a splat reaches in a row follow."""

    lean: float  # x of their middle over y, both from the centre
    widest: float  # square of half their extent in the centre's row
    narrowing: float  # how much of it each squared y takes


@wp.func
def row_reach(shape: wp.vec4, squared: float) -> RowReach:
    e = shape[1] * shape[2]
    k = shape[0] * shape[0] + e * e
    found = RowReach()
    found.lean = e * shape[2] / k
    found.widest = squared / k
    sharpness = shape[0] * shape[2] / k
    found.narrowing = sharpness * sharpness
    return found


@wp.func
def reach_row(row: RowReach, y: float) -> wp.vec2:
    """Least and greatest x of the ellipse where alpha is 1/255 at a y, from the centre; `reach_columns` of one row."""
    middle = row.lean * y
    half = wp.sqrt(wp.max(row.widest - row.narrowing * y * y, 0.0))
    margin = RELATIVE_MARGIN * (wp.abs(middle) + half) + EXTENT_MARGIN
    return wp.vec2(middle - half - margin, middle + half + margin)


@wp.func
def first_pixel_from(edge: float, limit: int) -> int:
    """First of ``limit`` pixels whose centre is not before an edge; clamped as a float: no integer holds every one."""
    start = wp.clamp(edge - 0.5, 0.0, float(limit))
    whole = int(start)
    return whole + wp.where(float(whole) < start, 1, 0)


@wp.func
def end_pixel_at(edge: float, limit: int) -> int:
    """End of those of ``limit`` pixels whose centre is not beyond an edge."""
    return int(wp.clamp(edge + 0.5, 0.0, float(limit)))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float found;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(found) : "f"(x));
    return found;
#else
    return exp2f(x);
#endif
""")
def quick_exp2(x: float) -> float:
    """A power of two; on CUDA within 2 ulp, without what `exp2f` does for denormal numbers: no alpha is one."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float inverse;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(y));
    return __fmul_rn(x, inverse);
#else
    return x / y;
#endif
""")
def quick_divide(x: float, y: float) -> float:
    """A quotient; on CUDA within 2 ulp, 0 where the divisor is beyond 2^126, and that by 0 where it is below 2^-126."""
    ...


@wp.func
def offset_from(center: wp.vec4, position: wp.vec2) -> wp.vec2:
    """Way from a centre to a pixel [pixel]."""
    return wp.vec2(position[0] - center[0], position[1] - center[1])


@wp.func
def whiten(shape: wp.vec4, offset: wp.vec2) -> wp.vec2:
    """A whitened offset: (e0, e1) of `kernels.raster.project.Splats`."""
    return wp.vec2(offset[0] * shape[0], (offset[1] - shape[1] * offset[0]) * shape[2])


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __fmaf_rn(-e[1], e[1], __fmaf_rn(-e[0], e[0], log_opacity));
#else
    return log_opacity - (e[0] * e[0] + e[1] * e[1]);
#endif
""")
def log_of_response(log_opacity: float, e: wp.vec2) -> float:
    """Logarithm to the base 2 of opacity times response at a whitened offset.

    It says which splats count for a pixel. On CUDA it leaves no choice of which product to fuse: a kernel that draws
    and one that goes back must find the same splats. Pixels below each other share what e0 takes.
    """
    ...


@wp.func
def log_alpha_of(center: wp.vec4, e: wp.vec2) -> float:
    """Logarithm to the base 2 of opacity times response."""
    return log_of_response(center[2], e)


@wp.func
def sight_of(center: wp.vec4, shape: wp.vec4, position: wp.vec2) -> Sight:
    """The splat as a pixel at a position sees it."""
    sight = Sight()
    sight.offset = offset_from(center, position)
    sight.e = whiten(shape, sight.offset)
    sight.log_alpha = log_alpha_of(center, sight.e)
    return sight


@wp.func
def alpha_of(log_alpha: float) -> float:
    """Alpha of a splat that passes the cut."""
    return wp.min(quick_exp2(log_alpha), ALPHA_MAX)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __fmaf_rn(-alpha, transmittance, transmittance);
#else
    return transmittance * (1.0f - alpha);
#endif
""")
def behind(transmittance: float, alpha: float) -> float:
    """What passes a splat, of what passes before it."""
    ...


@wp.func
def facing_at(slope: wp.vec4, offset: wp.vec2) -> float:
    """The factor l of `kernels.raster.project` at an offset from the centre."""
    return 1.0 + slope[0] * offset[0] + slope[1] * offset[1]


@wp.func
def bend_at(slope: wp.vec4, bend: float, offset: wp.vec2) -> float:
    """The form e of `kernels.raster.project` at an offset from the centre."""
    x = offset[0]
    y = offset[1]
    return slope[2] * x * x + 2.0 * slope[3] * x * y + bend * y * y


@wp.func
def nearness_limits(center: wp.vec4, shape: wp.vec4, near: float) -> wp.vec2:
    """Nearness, as of `nearness_function`, of a Gaussian's greatest depth and of its least one."""
    least = wp.max(center[3] - shape[3], near)
    return wp.vec2(quick_divide(center[3], center[3] + shape[3]), quick_divide(center[3], least))


@cache
def nearness_function(exact: bool):
    """Return the function that tells how near a splat is at an offset: its centre's depth over that there.

    It is that of the plane, or in exact mode that of the largest response. Beyond the plane's horizon it is negative.
    """

    @wp.func
    def nearness_at(slope: wp.vec4, bend: float, offset: wp.vec2) -> float:
        nearness = facing_at(slope, offset)
        if wp.static(exact):
            facing = wp.max(nearness, SMALLEST_FACING)
            nearness = facing + quick_divide(bend_at(slope, bend, offset), facing)
        return nearness

    return nearness_at


@wp.func
def limited_depth(depth: float, limits: wp.vec2, nearness: float) -> float:
    """Depth of a splat where it is so near, between its limits; at the far one where nearness is not a number."""
    return quick_divide(depth, wp.clamp(nearness, limits[0], limits[1]))


@cache
def depth_function(exact: bool):
    """Return the function (center, shape, slope, bend, near, offset) that gives a splat's depth at a pixel."""
    nearness_at = nearness_function(exact)

    @wp.func
    def depth_at(center: wp.vec4, shape: wp.vec4, slope: wp.vec4, bend: float, near: float, offset: wp.vec2) -> float:
        return limited_depth(center[3], nearness_limits(center, shape, near), nearness_at(slope, bend, offset))

    return depth_at
