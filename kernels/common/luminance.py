"""Luminance of linear Rec.709 light."""

import warp as wp

LUMINANCE = wp.constant(wp.vec3(0.2126, 0.7152, 0.0722))
"""Weights of linear R, G and B in luminance."""


@wp.func
def luminance(rgb: wp.vec3) -> float:
    return 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2]
