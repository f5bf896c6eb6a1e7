"""Lat-long environment maps on the device: direction ↔ (u, v), and lookup.

The NumPy twin is `beam_warp.world.environment`.

For a world direction d (z up): u = 0.5 - atan2(d.y, d.x) / 2π, v = acos(d.z) / π from the top row. The centre of the
image is +x, its left quarter +y.
"""

import warp as wp

from beam_warp.kernels.common.constants import PI


@wp.func
def direction_to_latlong(d: wp.vec3) -> wp.vec2:
    return wp.vec2(0.5 - wp.atan2(d[1], d[0]) / (2.0 * PI), wp.acos(wp.clamp(d[2], -1.0, 1.0)) / PI)


@wp.func
def latlong_to_direction(u: float, v: float) -> wp.vec3:
    phi = (0.5 - u) * 2.0 * PI
    theta = v * PI
    s = wp.sin(theta)
    return wp.vec3(s * wp.cos(phi), s * wp.sin(phi), wp.cos(theta))


@wp.func
def latlong_wrap(row: int, column: int, height: int, width: int) -> wp.vec2i:
    """Row and column of a texel that may lie one step outside: around in azimuth, and across the poles."""
    r = row
    c = column
    if r < 0:
        r = -1 - r
        c += width / 2
    elif r >= height:
        r = 2 * height - 1 - r
        c += width / 2
    if c < 0:  # one step and half a turn at most: a remainder would cost a division
        c += width
    elif c >= width:
        c -= width
    return wp.vec2i(r, c)


@wp.func
def latlong_texel(texels: wp.array2d[wp.vec3], row: int, column: int) -> wp.vec3:
    place = latlong_wrap(row, column, texels.shape[0], texels.shape[1])
    return texels[place[0], place[1]]


@wp.func
def latlong_nearest(texels: wp.array2d[wp.vec3], d: wp.vec3) -> wp.vec3:
    """Radiance of the texel that holds direction d: the piecewise-constant map, which sampling densities refer to."""
    uv = direction_to_latlong(d)
    row = wp.min(int(wp.floor(uv[1] * float(texels.shape[0]))), texels.shape[0] - 1)
    return latlong_texel(texels, row, int(wp.floor(uv[0] * float(texels.shape[1]))))


@wp.func
def latlong_bilinear(texels: wp.array2d[wp.vec3], d: wp.vec3) -> wp.vec3:
    """Radiance in direction d, bilinear between texel centres: for smooth maps such as irradiance."""
    uv = direction_to_latlong(d)
    x = uv[0] * float(texels.shape[1]) - 0.5
    y = uv[1] * float(texels.shape[0]) - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - float(column)
    fy = y - float(row)
    top = latlong_texel(texels, row, column) * (1.0 - fx) + latlong_texel(texels, row, column + 1) * fx
    bottom = latlong_texel(texels, row + 1, column) * (1.0 - fx) + latlong_texel(texels, row + 1, column + 1) * fx
    return top * (1.0 - fy) + bottom * fy
