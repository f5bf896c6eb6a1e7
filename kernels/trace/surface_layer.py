"""The layer of Gaussians around a point: at which height along its normal it is seen, and how thick it is."""

import warp as wp

from beam_warp.kernels.common.constants import ALPHA_MIN
from beam_warp.kernels.trace.gaussian import Gaussians, whitening_times


@wp.struct
class SurfaceLayer:
    """Running sums over the Gaussians that contain a point."""

    total: float
    height: float
    within: float
    count: float
    first_moment: float
    second_moment: float


@wp.func
def extent_along(gaussians: Gaussians, index: int, n: wp.vec3) -> float:
    """n^T Sigma n: variance of the whole Gaussian along n; row k of the whitening is axis k over scale k."""
    total = float(0.0)
    for k in range(3):
        row = gaussians.whitening_0[index]
        if k == 1:
            row = gaussians.whitening_1[index]
        if k == 2:
            row = gaussians.whitening_2[index]
        axis = wp.vec3(row[0], row[1], row[2])
        along = wp.dot(axis, n) / wp.dot(axis, axis)
        total += along * along
    return total


@wp.func
def add_to_layer(layer: SurfaceLayer, gaussians: Gaussians, index: int, p: wp.vec3, n: wp.vec3) -> SurfaceLayer:
    """Add a Gaussian, if it contains ``p``, to the layer seen along ``n``.

    On the line p + h n a Gaussian's response is again a Gaussian in h. Those that contain the point, weighted by
    their peak alpha on the line, give the height at which the surface is seen there. Thickness joins two variances: of
    each Gaussian along the normal as a whole, so that a tilted flat one counts with the height of its edges, and of
    the heights among each other.
    """
    packed = gaussians.center_opacity[index]
    q = whitening_times(gaussians, index, p - wp.vec3(packed[0], packed[1], packed[2]))
    result = layer
    if wp.dot(q, q) < gaussians.whitening_0[index][3]:
        d = whitening_times(gaussians, index, n)
        dd = wp.dot(d, d)
        height = -wp.dot(q, d) / dd
        closest = q + d * height
        weight = packed[3] * wp.exp(-0.5 * wp.dot(closest, closest))
        result.total += weight
        result.height += weight * height
        result.within += weight * extent_along(gaussians, index, n)
        result.count += packed[3]
        result.first_moment += packed[3] * height
        result.second_moment += packed[3] * height * height
    return result


@wp.func
def height_and_thickness(layer: SurfaceLayer) -> wp.vec2:
    """Both [m]; zero where nothing contains the point."""
    surface = wp.vec2(0.0, 0.0)
    if layer.total >= ALPHA_MIN:
        middle = layer.first_moment / layer.count
        between = wp.max(layer.second_moment / layer.count - middle * middle, 0.0)
        surface = wp.vec2(layer.height / layer.total, wp.sqrt(layer.within / layer.total + between))
    return surface
