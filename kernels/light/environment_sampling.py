"""Directions drawn from an environment map alone, by luminance times solid angle: map and density.

Two searches in cumulative sums, so that the map is monotone in each coordinate and keeps the stratification of its
samples. Radiance is constant inside a texel, and so is the density: inside, cos(theta) and phi are uniform.
"""

import warp as wp

from beam_warp.kernels.common.constants import PI
from beam_warp.kernels.light.latlong import direction_to_latlong, latlong_nearest


@wp.struct
class EnvironmentDistribution:
    """A lat-long map and what drawing from it needs."""

    radiance: wp.array2d[wp.vec3]
    row_edges: wp.array[float]  # cumulative share of the rows, 0 to 1, (H + 1)
    column_edges: wp.array2d[float]  # cumulative share of the texels of each row, (H, W + 1)
    density: wp.array2d[float]  # [1/sr], (H, W)


@wp.struct
class EnvironmentSample:
    """A drawn direction, the radiance from there and its density [1/sr]; all zero where nothing can be drawn."""

    direction: wp.vec3
    radiance: wp.vec3
    pdf: float


@wp.func
def radiance_over_pdf(sample: EnvironmentSample) -> wp.vec3:
    result = wp.vec3()
    if sample.pdf > 0.0:
        result = sample.radiance / sample.pdf
    return result


@wp.func
def interval_of(edges: wp.array[float], value: float) -> int:
    """The last interval that begins at or below ``value`` among rising edges; empty ones are never returned."""
    low = int(0)
    high = int(edges.shape[0] - 1)
    while high - low > 1:
        middle = (low + high) / 2
        if edges[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@wp.func
def square_to_environment(distribution: EnvironmentDistribution, u: float, v: float) -> EnvironmentSample:
    """Direction for a point of the unit square: v picks row and height, u picks column and azimuth."""
    height = distribution.density.shape[0]
    width = distribution.density.shape[1]
    row = interval_of(distribution.row_edges, v)
    top = distribution.row_edges[row]
    down = (v - top) / (distribution.row_edges[row + 1] - top)
    edges = distribution.column_edges[row]
    column = interval_of(edges, u)
    left = edges[column]
    across = (u - left) / (edges[column + 1] - left)
    upper = wp.cos(PI * float(row) / float(height))
    lower = wp.cos(PI * float(row + 1) / float(height))
    z = upper + (lower - upper) * down
    radius = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    phi = (0.5 - (float(column) + across) / float(width)) * 2.0 * PI
    sample = EnvironmentSample()
    sample.direction = wp.vec3(radius * wp.cos(phi), radius * wp.sin(phi), z)
    sample.radiance = distribution.radiance[row, column]
    sample.pdf = distribution.density[row, column]
    return sample


@wp.func
def square_to_environment_pdf(distribution: EnvironmentDistribution, direction: wp.vec3) -> float:
    """Density of a direction [1/sr]."""
    uv = direction_to_latlong(direction)
    height = distribution.density.shape[0]
    width = distribution.density.shape[1]
    row = wp.clamp(int(uv[1] * float(height)), 0, height - 1)
    column = wp.clamp(int(uv[0] * float(width)), 0, width - 1)
    return distribution.density[row, column]


@wp.func
def environment_radiance(distribution: EnvironmentDistribution, direction: wp.vec3) -> wp.vec3:
    return latlong_nearest(distribution.radiance, direction)
