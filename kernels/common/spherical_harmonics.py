"""Captured colour from spherical harmonics on the device; the NumPy twin is beam_warp.world.harmonics."""

import warp as wp

C0 = wp.constant(0.28209479177387814)
C1 = wp.constant(0.4886025119029199)
C2_XY = wp.constant(1.0925484305920792)
C2_ZZ = wp.constant(0.31539156525252005)
C3_3 = wp.constant(0.5900435899266435)
C3_2 = wp.constant(2.890611442640554)
C3_1 = wp.constant(0.4570457994644658)
C3_0 = wp.constant(0.3731763325901154)
C4_4 = wp.constant(2.5033429417967046)
C4_3 = wp.constant(1.7701307697799304)
C4_2 = wp.constant(0.9461746957575601)
C4_1 = wp.constant(0.6690465435572892)
C4_0 = wp.constant(0.10578554691520431)


@wp.func
def sh_sum(coefficients: wp.array2d[wp.vec3], row: int, d: wp.vec3) -> wp.vec3:
    """Sum of Y_k(d) c_k over the (degree + 1)^2 coefficients of a row; degree 0 to 4, told from the row's length."""
    count = coefficients.shape[1]
    result = coefficients[row, 0] * C0
    x = d[0]
    y = d[1]
    z = d[2]
    if count > 1:
        result += (coefficients[row, 2] * z - coefficients[row, 1] * y - coefficients[row, 3] * x) * C1
    if count > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        result += (
            coefficients[row, 4] * (x * y)
            - coefficients[row, 5] * (y * z)
            - coefficients[row, 7] * (x * z)
            + coefficients[row, 8] * (0.5 * (xx - yy))
        ) * C2_XY
        result += coefficients[row, 6] * (C2_ZZ * (2.0 * zz - xx - yy))
        if count > 9:
            result -= coefficients[row, 9] * (C3_3 * y * (3.0 * xx - yy))
            result += coefficients[row, 10] * (C3_2 * x * y * z)
            result -= coefficients[row, 11] * (C3_1 * y * (4.0 * zz - xx - yy))
            result += coefficients[row, 12] * (C3_0 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy))
            result -= coefficients[row, 13] * (C3_1 * x * (4.0 * zz - xx - yy))
            result += coefficients[row, 14] * (0.5 * C3_2 * z * (xx - yy))
            result -= coefficients[row, 15] * (C3_3 * x * (xx - 3.0 * yy))
        if count > 16:
            result += coefficients[row, 16] * (C4_4 * x * y * (xx - yy))
            result -= coefficients[row, 17] * (C4_3 * y * z * (3.0 * xx - yy))
            result += coefficients[row, 18] * (C4_2 * x * y * (7.0 * zz - 1.0))
            result -= coefficients[row, 19] * (C4_1 * y * z * (7.0 * zz - 3.0))
            result += coefficients[row, 20] * (C4_0 * (35.0 * zz * zz - 30.0 * zz + 3.0))
            result -= coefficients[row, 21] * (C4_1 * x * z * (7.0 * zz - 3.0))
            result += coefficients[row, 22] * (0.5 * C4_2 * (xx - yy) * (7.0 * zz - 1.0))
            result -= coefficients[row, 23] * (C4_3 * x * z * (xx - 3.0 * yy))
            result += coefficients[row, 24] * (0.25 * C4_4 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)))
    return result


@wp.func
def srgb_to_linear(value: float) -> float:
    """IEC 61966-2-1, of a value in [0, 1]."""
    result = value / 12.92
    if value > 0.04045:
        result = wp.pow((value + 0.055) / 1.055, 2.4)
    return result


@wp.func
def captured_radiance(coefficients: wp.array2d[wp.vec3], row: int, direction: wp.vec3, display_srgb: int) -> wp.vec3:
    """Scene-linear radiance seen along ``direction`` (from camera to Gaussian); display colour is cut to [0, 1]."""
    color = sh_sum(coefficients, row, direction) + wp.vec3(0.5, 0.5, 0.5)
    for c in range(3):
        color[c] = wp.max(color[c], 0.0)
        if display_srgb == 1:
            color[c] = srgb_to_linear(wp.min(color[c], 1.0))
    return color


@wp.func
def seen_color(coefficients: wp.array2d[wp.vec3], row: int, direction: wp.vec3) -> wp.vec3:
    """Colour seen along ``direction`` (from camera to Gaussian) in the coefficients' own colour space, at least 0."""
    color = sh_sum(coefficients, row, direction)
    return wp.vec3(wp.max(color[0] + 0.5, 0.0), wp.max(color[1] + 0.5, 0.0), wp.max(color[2] + 0.5, 0.0))
