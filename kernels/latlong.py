"""Lat-long environment maps on the device: direction ↔ (u, v), and lookup. The NumPy twin is in beam_warp.environments.

For a world direction d (z up): u = 0.5 - atan2(d.y, d.x) / 2π, v = acos(d.z) / π from the top row. The centre of the
image is +x, its left quarter +y.
"""

import warp as wp

PI = wp.constant(3.14159265358979323846)


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
def latlong_texel(texels: wp.array2d[wp.vec3], row: int, column: int) -> wp.vec3:
    """Wraps around in azimuth and stops at the poles."""
    height = texels.shape[0]
    width = texels.shape[1]
    r = wp.clamp(row, 0, height - 1)
    c = column % width
    if c < 0:
        c += width
    return texels[r, c]


@wp.func
def latlong_nearest(texels: wp.array2d[wp.vec3], d: wp.vec3) -> wp.vec3:
    """Radiance of the texel that holds direction d: the piecewise-constant map, which sampling densities refer to."""
    uv = direction_to_latlong(d)
    return latlong_texel(
        texels, int(wp.floor(uv[1] * float(texels.shape[0]))), int(wp.floor(uv[0] * float(texels.shape[1])))
    )


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
